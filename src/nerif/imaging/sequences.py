"""What one view recorded, and which part of the frames is its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerif.conventions import InputError
from nerif.imaging.readers import Frames, size_in_words

__all__ = ["Crop", "ImageSequence"]


@dataclass(frozen=True)
class Crop:
    """A part of each frame, such as one end of a fibre bundle, turned upright.

    First the crop, then the rotation, then the flip. Views of one sensor are crops of one sequence.

    Parameters
    ----------
    row, column : of the top-left pixel
    height, width : px; 0 for all up to the frame's edge
    flip : "", "horizontal" (left and right change places), "vertical" or "both"
    rotate : 0, 90, 180 or 270 degrees counter-clockwise
    """

    row: int = 0
    column: int = 0
    height: int = 0
    width: int = 0
    flip: str = ""
    rotate: int = 0

    def __post_init__(self) -> None:
        for name in ("row", "column", "height", "width"):
            if getattr(self, name) < 0:
                raise InputError(f"crop: expected {name} 0 or more (px), got {getattr(self, name)}")
        if self.flip not in ("", "horizontal", "vertical", "both"):
            raise InputError(f"crop: expected flip 'horizontal', 'vertical', 'both' or '', got '{self.flip}'")
        if self.rotate not in (0, 90, 180, 270):
            raise InputError(f"crop: expected rotate 0, 90, 180 or 270 (degrees), got {self.rotate}")

    def shape_of(self, shape: tuple[int, int], name: str = "crop") -> tuple[int, int]:
        """Return height and width after this crop; InputError if it reaches beyond a frame of `shape`."""
        height, width = self.height or shape[0] - self.row, self.width or shape[1] - self.column
        bottom, right = self.row + height, self.column + width
        if bottom > shape[0] or right > shape[1] or height < 1 or width < 1:
            raise InputError(
                f"{name}: expected a crop within its {size_in_words(shape)}, got rows {self.row} to {bottom} "
                f"and columns {self.column} to {right}"
            )
        return (width, height) if self.rotate in (90, 270) else (height, width)

    def __call__(self, image: np.ndarray, name: str = "crop") -> np.ndarray:
        """Return that part of an image (row, column)."""
        self.shape_of((image.shape[0], image.shape[1]), name)
        rows = slice(self.row, self.row + self.height if self.height else None)
        columns = slice(self.column, self.column + self.width if self.width else None)
        part = np.rot90(image[rows, columns], self.rotate // 90)
        if self.flip in ("horizontal", "both"):
            part = part[:, ::-1]
        if self.flip in ("vertical", "both"):
            part = part[::-1]
        return np.ascontiguousarray(part)


@dataclass(frozen=True)
class ImageSequence:
    """What one view recorded: the background at rest and through the flow.

    Parameters
    ----------
    reference, flow : frames without and with flow, of one size and bit depth
    crop : the view's part of each frame, if not all of it
    name : of the view

    Raises
    ------
    InputError
        If reference and flow differ in size or bit depth, or the crop reaches beyond the frame.
    """

    reference: Frames
    flow: Frames
    crop: Crop | None = None
    name: str = ""

    def __post_init__(self) -> None:
        ours, theirs = self.reference.layout, self.flow.layout
        known = [frames.known_bits or frames.bits for frames in (self.reference, self.flow)]
        if None in (
            self.reference.known_bits,
            self.flow.known_bits,
        ):  # may well be the same
            known = [8 * ours.dtype.itemsize, 8 * theirs.dtype.itemsize]
        sizes = (size_in_words(ours.shape), size_in_words(theirs.shape))
        for expected, got in (sizes, (f"{known[0]} bit", f"{known[1]} bit")):
            if expected != got:
                raise InputError(
                    f"{theirs.example}: expected {expected} as in its reference {ours.example}, got {got}; "
                    "record both alike"
                )
        if self.crop:
            self.crop.shape_of(ours.shape, ours.example)

    @property
    def times(self) -> np.ndarray | None:
        """When each flow frame was taken, s."""
        return self.flow.times

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width after the crop, px."""
        return self.crop.shape_of(self.reference.shape) if self.crop else self.reference.shape

    @property
    def bits(self) -> int:
        """Effective bits of both: those that a file tells, if one does."""
        return self.reference.known_bits or self.flow.known_bits or self.reference.bits

    def reference_frame(self, i: int) -> np.ndarray:
        """Return reference frame `i`, cropped."""
        return self._cropped(self.reference, i)

    def flow_frame(self, i: int) -> np.ndarray:
        """Return flow frame `i`, cropped."""
        return self._cropped(self.flow, i)

    def _cropped(self, frames: Frames, i: int) -> np.ndarray:
        return self.crop(frames[i], frames.name(i)) if self.crop else frames[i]
