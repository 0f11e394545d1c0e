"""Mistakes that happen between a camera and a measurement, each as the change that undoes it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from nerif.geometry import Camera
from nerif.observation import Observation

__all__ = ["Correction", "everywhere", "exchanges", "of_one_view"]

View = Callable[[Tensor], Tensor]  # (row, column, channel) to the same


@dataclass(frozen=True)
class Change:
    """What may have happened to a view.

    Parameters
    ----------
    words : for people
    undo : the change that undoes it, and itself
    everywhere : what it is called where it happened to all views; nothing where that cannot be told
    """

    words: str
    undo: View
    everywhere: str = ""


def _signs(u: float, v: float) -> View:
    return lambda d: d * d.new_tensor([u, v])


MIRRORED, UPSIDE_DOWN = "the picture is mirrored left to right", "the picture is upside down, mirrored top to bottom"
TURNED = "the picture is turned by 180 degrees"

OF_VECTORS = (
    Change("u and v are swapped", lambda d: d.flip(-1), "u and v are swapped"),
    Change("the sign of the displacement is flipped (is it the optical flow, which is -d?)", _signs(-1, -1)),
    Change("the sign of u is flipped", _signs(-1, 1)),
    # of either component it looks alike, but for the sign of the field
    Change("the sign of v is flipped", _signs(1, -1), "the sign of one component, u or v, is flipped"),
    Change(MIRRORED, lambda d: _signs(-1, 1)(d.flip(1)), MIRRORED),
    Change("the columns are reversed", lambda d: d.flip(1)),
    Change(UPSIDE_DOWN, lambda d: _signs(1, -1)(d.flip(0)), UPSIDE_DOWN),
    Change("the rows are reversed", lambda d: d.flip(0)),
    Change(TURNED, lambda d: -d.flip(0, 1)),
)
"""Of maps with two components in the picture."""

OF_SCALARS = (
    Change(MIRRORED, lambda d: d.flip(1), MIRRORED),
    Change(UPSIDE_DOWN, lambda d: d.flip(0), UPSIDE_DOWN),
    Change(TURNED, lambda d: d.flip(0, 1)),
)
"""Of maps with one number a pixel."""

SIGN = Change("the sign is flipped", lambda d: -d)
"""Of one number a pixel that may be negative. A flipped sign of everything cannot be told."""


@dataclass(frozen=True)
class Correction:
    """What is wrong with which views.

    Parameters
    ----------
    views : indices
    words : for people
    change : what undoes it in each of them; None exchanges the two
    """

    views: tuple[int, ...]
    words: str
    change: View | None

    def undo(self, d: Tensor, cameras: Sequence[Camera]) -> Tensor:
        """Return values (view, row, column, channel) without the mistake; each view has its own size."""
        d = d.clone()
        if self.change is None:
            i, j = self.views
            d[[i, j]] = d[[j, i]]
            return d
        for i in self.views:
            height, width = cameras[i].image_size
            d[i, :height, :width] = self.change(d[i, :height, :width])
        return d


def _changes(observation: Observation) -> tuple[Change, ...]:
    if len(observation.technique.channels) == 2:
        return OF_VECTORS
    return (*OF_SCALARS, SIGN) if observation.signed else OF_SCALARS


def of_one_view(view: int, observation: Observation) -> list[Correction]:
    """Everything that may be wrong with one view alone."""
    return [Correction((view,), c.words, c.undo) for c in _changes(observation)]


def exchanges(cameras: Sequence[Camera]) -> list[Correction]:
    """Every two views of one picture size that may be exchanged."""
    sizes = [c.image_size for c in cameras]
    pairs = [(j, i) for i in range(len(sizes)) for j in range(i) if sizes[i] == sizes[j]]
    return [Correction(pair, "these two views are exchanged", None) for pair in pairs]


def everywhere(views: int, observation: Observation) -> list[Correction]:
    """What may be wrong with all views alike."""
    return [Correction(tuple(range(views)), c.everywhere, c.undo) for c in _changes(observation) if c.everywhere]
