"""Masks drawn by hand: polygons and strokes of a brush, one over the other, and the pictures that nerif mask reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from nerif.common.conventions import InputError
from nerif.common.files import atomic

__all__ = ["MaskShape", "mask_of", "write_masks"]

KINDS = {"polygon": 3, "brush": 1}
"""Kinds of shapes, and the fewest points of each."""


@dataclass(frozen=True)
class MaskShape:
    """A shape in a view.

    Parameters
    ----------
    kind : polygon or brush
    points : (column, row) of corners, or along the stroke, px; the centre of the top-left pixel is (0, 0)
    inside : whether it is flow, or takes flow away
    width : of a brush, px

    Raises
    ------
    InputError
        If there is no such kind, there are too few points, one is not finite, or the width is not positive.
    """

    kind: str
    points: tuple[tuple[float, float], ...]
    inside: bool = True
    width: float = 8.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"kind: expected {' or '.join(KINDS)}, got '{self.kind}'")
        if len(self.points) < KINDS[self.kind]:
            raise InputError(f"points: expected {KINDS[self.kind]} or more of a {self.kind}, got {len(self.points)}")
        if not np.isfinite(np.array(self.points, dtype=float)).all():
            raise InputError(f"points: expected finite numbers, got {self.points}")
        if not self.width > 0:
            raise InputError(f"width: expected px above 0, got {self.width}")


def mask_of(shapes: Sequence[MaskShape], shape: tuple[int, int]) -> Bool[np.ndarray, "row column"]:
    """Return where shapes leave flow, later ones over earlier ones.

    Parameters
    ----------
    shapes : in the order they were drawn
    shape : height and width of the view, px
    """
    from PIL import Image, ImageDraw

    picture = Image.new("1", (shape[1], shape[0]), 0)
    draw = ImageDraw.Draw(picture)
    for s in shapes:
        if s.kind == "polygon":
            draw.polygon(list(s.points), fill=int(s.inside), outline=int(s.inside))
            continue
        if len(s.points) > 1:
            draw.line(list(s.points), fill=int(s.inside), width=max(1, round(s.width)))
        for x, y in s.points:  # round ends and joints
            r = (s.width - 1) / 2
            draw.ellipse((x - r, y - r, x + r, y + r), fill=int(s.inside))
    return np.asarray(picture, dtype=bool)


def write_masks(
    folder: Path, drawn: Mapping[str, Sequence[MaskShape]], shapes: Mapping[str, tuple[int, int]]
) -> list[Path]:
    """Write VIEW.png of each view that something was drawn in, white where the flow is, and return their paths.

    Parameters
    ----------
    drawn : shapes by the name of the view
    shapes : height and width of the views, px

    Raises
    ------
    InputError
        If what was drawn covers nothing of a view, or all of it, or the name of a view can be no file's name: nothing
        is written then.
    """
    from PIL import Image

    for name in drawn:
        if name in ("", ".", "..") or any(sign in name for sign in "/\\\0"):
            raise InputError(f"view: expected names that files can have, without / and \\, got {name!r}; rename it")
    masks = {name: mask_of(own, shapes[name]) for name, own in drawn.items() if own}
    for name, mask in masks.items():
        if mask.all() or not mask.any():
            raise InputError(f"mask of view '{name}': expected some of it, got {'all' if mask.any() else 'nothing'}")
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, mask in masks.items():
        path = folder / f"{name}.png"
        with atomic(path) as part:
            Image.fromarray(mask.astype(np.uint8) * 255).save(part, format="PNG")
        written.append(path)
    return written
