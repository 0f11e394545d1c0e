"""An open file of images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np

__all__ = ["ImageFile"]


class ImageFile(ABC):
    """An open file of images, whose metadata are those of the same name in Frames."""

    bits: int | None = None
    """Effective bits in the metadata."""
    white: int | None = None
    """Grey value of a saturated pixel in the metadata."""
    cfa: str | None = None
    """Bayer pattern in the metadata."""
    channels: tuple[int, int] = (1, 1)
    """The number of channels, such as colours, and how many images of one follow one another."""
    notes: tuple[str, ...] = ()
    """Warnings about the file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @staticmethod  # noqa: B027 (most need none)
    def check_package() -> None:
        """Raise InputError if an optional package that reads these files is not installed."""

    def __len__(self) -> int:
        return 1

    @abstractmethod
    def read(self, i: int) -> np.ndarray:
        """Return image `i` as stored; channels, if any, as R, G, B."""
