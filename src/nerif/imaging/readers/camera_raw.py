"""Raw images of photo cameras, by rawpy (LibRaw)."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.image_names import RAW
from nerif.common.installation import optional
from nerif.imaging.readers.image_file import ImageFile

__all__ = ["CameraRaw"]


class CameraRaw(ImageFile):
    """The visible part of the sensor, as the sensor lies: raw values less the black level."""

    @staticmethod
    def check_package() -> None:
        _rawpy()

    @cached_property
    def _content(self) -> tuple[np.ndarray, int, tuple[int, int], str]:
        """Image, white level, size of the pattern of colours, and its first two pixels of two rows."""
        with _rawpy().imread(str(self._path)) as raw:
            values, colours = raw.raw_image_visible, raw.raw_colors_visible
            if values.ndim != 2:
                raise InputError("expected raw values, one a pixel, got colours; export it as TIFF")
            black = np.array(raw.black_level_per_channel)
            image = np.maximum(values.astype(np.int32) - black[colours], 0).astype(np.uint16)
            names = raw.color_desc.decode()
            size = (1, 1) if raw.raw_pattern is None or raw.num_colors == 1 else raw.raw_pattern.shape
            return image, int(raw.white_level - black.min()), size, "".join(names[k] for k in colours[:2, :2].flat)

    @property
    def white(self) -> int:  # type: ignore[override]
        return self._content[1]

    @property
    def bits(self) -> int:  # type: ignore[override]
        return max(8, self.white.bit_length())

    @property
    def cfa(self) -> str | None:  # type: ignore[override]
        _, _, size, colours = self._content
        return colours if size == (2, 2) else None

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        height, width = self._content[2]
        if (height, width) in ((1, 1), (2, 2)):
            return ()
        return (f"raw values of a colour mosaic of {height} x {width} px, which is no Bayer pattern",)

    def read(self, i: int) -> np.ndarray:
        return self._content[0]


def _rawpy() -> Any:
    return optional("rawpy", "raw", f"raw images ({' '.join(RAW)})", ", or export the images as TIFF")
