"""Settings of vectors that another program computed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from nerif.common.settings import Checked, NonNegative

__all__ = ["LENGTHS", "RATES", "VectorSettings"]

LENGTHS = {"mm": 1.0, "m": 1e3, "cm": 10.0, "um": 1e-3, "µm": 1e-3}
"""Units of length, mm."""
RATES = {f"{unit}/s": length for unit, length in LENGTHS.items()}


@dataclass(frozen=True)
class VectorSettings(Checked):
    """What the files of vectors do not say, or say wrongly; empty and 0: by the file or its program."""

    columns: tuple[str, ...] = ()
    """Names of the columns or variables of x, y, u, v, and optionally of a flag or mask, such as x y u v flags."""
    first_image: Literal["reference", "flow"] = "reference"
    """Image from which the vectors point to the other; flow turns all signs."""
    y_axis: Literal["", "up", "down"] = ""
    """Direction of y and v (default: by the file and its program)."""
    position_unit: Literal["", "px", *LENGTHS] = ""  # type: ignore[valid-type]
    """Unit of x and y (default: by the file, else px)."""
    vector_unit: Literal["", "px", *LENGTHS, *RATES] = ""  # type: ignore[valid-type]
    """Unit of u and v (default: by the file, else px)."""
    scale: NonNegative = 0.0
    """Length of a pixel, mm, for vectors in units of length."""
    origin: tuple[float, float] | None = None
    """Pixel x y, counted from 0, at which x = y = 0, for positions in units of length."""
    time_step: NonNegative = 0.0
    """Time between the two images, s, for vectors in units of velocity."""
    window: NonNegative = 0.0
    """Edge of the interrogation window of the last pass, px of the images; 0: two steps of the grid, the usual overlap
    of a half."""
    noise: Literal["auto", "file", "repeats", "neighbours"] = "auto"
    """Standard deviation of the vectors: uncertainty in the file, scatter of the averaged frames (three or more), or
    scatter among neighbours; auto: the first of these that there is."""
    sigma: NonNegative = 0.0
    """Standard deviation of all vectors, px of the images; 0: by --noise."""
