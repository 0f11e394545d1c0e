"""Settings of a movie of volumes over time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from nerif.common.conventions import InputError
from nerif.common.settings import Positive, check_settings

__all__ = ["MovieSettings"]


@dataclass(frozen=True)
class MovieSettings:
    """Settings of a movie."""

    style: Literal["isosurface", "slices", "arrows", "streamlines"] = "isosurface"
    """Isosurface, or three slices through the centre of the box; of a velocity also arrows or streamlines."""
    quantity: str = ""
    """Quantity to draw (default: density, the field if it is another than the index, or the speed)."""
    level: float | None = None
    """Value of the isosurface, in the plotted unit (default: halfway between the ambient and the extreme)."""
    size: tuple[int, int] = (960, 720)
    """Width and height, px."""
    azimuth: float = 35.0
    """Direction of the viewpoint around z, degrees."""
    elevation: float = 20.0
    """Height of the viewpoint, degrees."""
    frames_per_second: Positive = 20.0
    """Frames per second of the movie."""

    def __post_init__(self) -> None:
        check_settings(self)
        if min(self.size) < 16 or any(s % 2 for s in self.size):
            raise InputError(f"expected an even width and height of 16 px or more, got {self.size}", field="size")
