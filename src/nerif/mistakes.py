"""Mistakes that happen between a camera and a measurement, each as the change that undoes it."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from nerif.data.measurement import Observation
from nerif.geometry import Camera

__all__ = ["Correction", "everywhere", "exchanges", "of_one_view", "orders"]

SORTED = "pictures and cameras were sorted differently, one by numbers (2, 10), the other by letters (10, 2)"
REVERSED = "pictures and cameras are in opposite order"

View = Callable[[Tensor], Tensor]  # (row, column, channel) to the same


@dataclass(frozen=True)
class Change:
    """What may have happened to a view.

    Parameters
    ----------
    code : of its Finding
    words : for people
    undo : the change that undoes it
    everywhere : what it is called where it happened to all views; nothing where that cannot be told
    square : whether it can happen to square pictures only
    """

    code: str
    words: str
    undo: View
    everywhere: str = ""
    square: bool = False


def _signs(u: float, v: float) -> View:
    return lambda d: d * d.new_tensor([u, v])


MIRRORED, UPSIDE_DOWN = "the picture is mirrored left to right", "the picture is upside down, mirrored top to bottom"
TURNED = "the picture is turned by 180 degrees"

TRANSPOSED, QUARTER = "the picture is transposed (rows and columns exchanged)", "the picture is turned by 90 degrees"


def _vectors_of(picture: View, u: float, v: float) -> View:
    """Undo what happened to a picture whose rows became columns: its vectors have the axes exchanged, and signs."""
    return lambda d: _signs(u, v)(picture(d).flip(-1))


OF_VECTORS = (
    Change("swapped", "u and v are swapped", lambda d: d.flip(-1), "u and v are swapped"),
    Change("flipped", "the sign of the displacement is flipped (is it the optical flow, which is -d?)", _signs(-1, -1)),
    Change("flipped_u", "the sign of u is flipped", _signs(-1, 1)),
    # of either component it looks alike, but for the sign of the field
    Change("flipped_v", "the sign of v is flipped", _signs(1, -1), "the sign of one component, u or v, is flipped"),
    Change("mirrored", MIRRORED, lambda d: _signs(-1, 1)(d.flip(1)), MIRRORED),
    Change("reversed_columns", "the columns are reversed", lambda d: d.flip(1)),
    Change("upside_down", UPSIDE_DOWN, lambda d: _signs(1, -1)(d.flip(0)), UPSIDE_DOWN),
    Change("reversed_rows", "the rows are reversed", lambda d: d.flip(0)),
    Change("turned", TURNED, lambda d: -d.flip(0, 1)),
    Change("transposed", TRANSPOSED, _vectors_of(lambda d: d.transpose(0, 1), 1, 1), TRANSPOSED, square=True),
    Change("reversed_axes", "rows and columns are exchanged, not u and v", lambda d: d.transpose(0, 1), square=True),
    Change("quarter_turn", QUARTER, _vectors_of(lambda d: d.rot90(1, (0, 1)), 1, -1), square=True),
    Change("quarter_turn", QUARTER, _vectors_of(lambda d: d.rot90(-1, (0, 1)), -1, 1), square=True),
)
"""Of maps with two components in the picture."""

OF_SCALARS = (
    Change("mirrored", MIRRORED, lambda d: d.flip(1), MIRRORED),
    Change("upside_down", UPSIDE_DOWN, lambda d: d.flip(0), UPSIDE_DOWN),
    Change("turned", TURNED, lambda d: d.flip(0, 1)),
    Change("transposed", TRANSPOSED, lambda d: d.transpose(0, 1), TRANSPOSED, square=True),
    Change("quarter_turn", QUARTER, lambda d: d.rot90(1, (0, 1)), square=True),
    Change("quarter_turn", QUARTER, lambda d: d.rot90(-1, (0, 1)), square=True),
)
"""Of maps with one number a pixel."""

SIGN = Change("flipped", "the sign is flipped", lambda d: -d)
"""Of one number a pixel that may be negative. A flipped sign of everything cannot be told."""


@dataclass(frozen=True)
class Correction:
    """What is wrong with which views.

    Parameters
    ----------
    views : indices
    code : of its Finding
    words : for people
    change : what undoes it in each of them; None where pictures have the places of others
    order : of each of these views then, the number under which its picture is
    """

    views: tuple[int, ...]
    code: str
    words: str
    change: View | None
    order: tuple[int, ...] = ()

    def undo(self, d: Tensor, cameras: Sequence[Camera]) -> Tensor:
        """Return values (view, row, column, channel) without the mistake; each view has its own size."""
        d = d.clone()
        if self.change is None:
            d[list(self.views)] = d[list(self.order)]
            return d
        for i in self.views:
            height, width = cameras[i].image_size
            d[i, :height, :width] = self.change(d[i, :height, :width].clone())
        return d


def _changes(observation: Observation, cameras: Sequence[Camera]) -> list[Change]:
    """What may have happened to the pictures of these cameras."""
    changes = OF_VECTORS if len(observation.technique.channels) == 2 else OF_SCALARS
    if len(observation.technique.channels) == 1 and observation.signed:
        changes = (*changes, SIGN)
    square = all(height == width for height, width in (c.image_size for c in cameras))
    return [change for change in changes if square or not change.square]


def of_one_view(view: int, observation: Observation, cameras: Sequence[Camera]) -> list[Correction]:
    """Everything that may be wrong with one view alone."""
    return [Correction((view,), c.code, c.words, c.undo) for c in _changes(observation, [cameras[view]])]


def exchanges(cameras: Sequence[Camera]) -> list[Correction]:
    """Every two views of one picture size that may be exchanged."""
    sizes = [c.image_size for c in cameras]
    pairs = [(j, i) for i in range(len(sizes)) for j in range(i) if sizes[i] == sizes[j]]
    return [Correction(pair, "exchanged", "these two views are exchanged", None, pair[::-1]) for pair in pairs]


def orders(cameras: Sequence[Camera]) -> list[Correction]:
    """Orders in which the pictures of all views may have been given to the cameras, where their sizes allow it."""
    names, sizes = [c.name for c in cameras], [c.image_size for c in cameras]
    every = tuple(range(len(names)))
    by_number = sorted(every, key=lambda i: [float(word) for word in re.findall(r"\d+(?:\.\d+)?", names[i])])
    by_letter = sorted(every, key=lambda i: names[i])
    there, back = dict(zip(by_number, by_letter, strict=True)), dict(zip(by_letter, by_number, strict=True))
    ways = {tuple(there[i] for i in every): SORTED, tuple(back[i] for i in every): SORTED, every[::-1]: REVERSED}
    ways.pop(every, None)
    possible = {order: words for order, words in ways.items() if [sizes[i] for i in order] == sizes}
    return [Correction(every, "reordered", words, None, order) for order, words in possible.items()]


def everywhere(observation: Observation, cameras: Sequence[Camera]) -> list[Correction]:
    """What may be wrong with all views alike."""
    views = tuple(range(len(cameras)))
    changes = _changes(observation, cameras)
    return [Correction(views, c.code, c.everywhere, c.undo) for c in changes if c.everywhere]
