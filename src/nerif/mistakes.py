"""Mistakes that happen between a camera and a measurement, each as the change that undoes it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from nerif.geometry import Camera

__all__ = ["Correction", "everywhere", "exchanges", "of_one_view"]

View = Callable[[Tensor], Tensor]  # (row, column, component) to the same


def _signs(u: float, v: float) -> View:
    return lambda d: d * d.new_tensor([u, v])


CHANGES: tuple[tuple[str, View], ...] = (
    ("u and v are swapped", lambda d: d.flip(-1)),
    ("the sign of the displacement is flipped (is it the optical flow, which is -d?)", _signs(-1, -1)),
    ("the sign of u is flipped", _signs(-1, 1)),
    ("the sign of v is flipped", _signs(1, -1)),
    ("the picture is mirrored left to right", lambda d: _signs(-1, 1)(d.flip(1))),
    ("the columns are reversed", lambda d: d.flip(1)),
    ("the picture is upside down, mirrored top to bottom", lambda d: _signs(1, -1)(d.flip(0))),
    ("the rows are reversed", lambda d: d.flip(0)),
    ("the picture is turned by 180 degrees", lambda d: -d.flip(0, 1)),
)
"""What may have happened to one view, and how it is undone; each undoes itself."""

EVERYWHERE = (0, 3, 4, 6)
"""Those of CHANGES that can be told when they happened to all views: a flipped sign of everything can not."""


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
        """Return displacements (view, row, column, component) without the mistake; each view has its own size."""
        d = d.clone()
        if self.change is None:
            i, j = self.views
            d[[i, j]] = d[[j, i]]
            return d
        for i in self.views:
            height, width = cameras[i].image_size
            d[i, :height, :width] = self.change(d[i, :height, :width])
        return d


def of_one_view(view: int) -> list[Correction]:
    """Everything that may be wrong with one view alone."""
    return [Correction((view,), words, change) for words, change in CHANGES]


def exchanges(cameras: Sequence[Camera]) -> list[Correction]:
    """Every two views of one picture size that may be exchanged."""
    sizes = [c.image_size for c in cameras]
    pairs = [(j, i) for i in range(len(sizes)) for j in range(i) if sizes[i] == sizes[j]]
    return [Correction(pair, "these two views are exchanged", None) for pair in pairs]


def everywhere(views: int) -> list[Correction]:
    """What may be wrong with all views alike."""
    words = {3: "the sign of one component, u or v, is flipped"}  # both look alike, but for the sign of the field
    return [Correction(tuple(range(views)), words.get(k, CHANGES[k][0]), CHANGES[k][1]) for k in EVERYWHERE]
