"""The part of the frames of a sensor that belongs to a view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.settings import Natural, check_settings
from nerif.imaging.readers.frames import size_in_words

__all__ = ["Crop"]


@dataclass(frozen=True)
class Crop:
    """A part of each frame, such as one end of a fibre bundle: cropped, then rotated, then flipped."""

    row: Natural = 0  #: of the top-left pixel
    column: Natural = 0  #: of the top-left pixel
    height: Natural = 0  #: px; 0 for all up to the edge of the frame
    width: Natural = 0  #: px; 0 for all up to the edge of the frame
    flip: str = ""  #: "", "horizontal" (exchanges left and right), "vertical" or "both"
    rotate: int = 0  #: 0, 90, 180 or 270 degrees counter-clockwise

    def __post_init__(self) -> None:
        check_settings(self)
        if self.flip not in ("", "horizontal", "vertical", "both"):
            raise InputError(f"expected 'horizontal', 'vertical', 'both' or '', got '{self.flip}'", field="flip")
        if self.rotate not in (0, 90, 180, 270):
            raise InputError(f"expected 0, 90, 180 or 270 degrees, got {self.rotate}", field="rotate")

    def shape_of(self, shape: tuple[int, int], name: str = "crop") -> tuple[int, int]:
        """Return height and width after the crop of a frame of `shape`; InputError if it reaches beyond."""
        height, width = self.height or shape[0] - self.row, self.width or shape[1] - self.column
        bottom, right = self.row + height, self.column + width
        if bottom > shape[0] or right > shape[1] or height < 1 or width < 1:
            raise InputError(
                f"expected a crop within its {size_in_words(shape)}, got rows {self.row} to {bottom} "
                f"and columns {self.column} to {right}",
                field=name,
            )
        return (width, height) if self.rotate in (90, 270) else (height, width)

    def __call__(self, image: np.ndarray, name: str = "crop") -> np.ndarray:
        """Return this part of an image (row, column)."""
        self.shape_of((image.shape[0], image.shape[1]), name)
        rows = slice(self.row, self.row + self.height if self.height else None)
        columns = slice(self.column, self.column + self.width if self.width else None)
        part = np.rot90(image[rows, columns], self.rotate // 90)
        if self.flip in ("horizontal", "both"):
            part = part[:, ::-1]
        if self.flip in ("vertical", "both"):
            part = part[::-1]
        return np.ascontiguousarray(part)
