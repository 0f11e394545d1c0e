"""Regions of a measurement with the ambient index."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from nerif.common.conventions import InputError

if TYPE_CHECKING:
    from nerif.geometry.grid import Box

__all__ = ["Region", "check_region"]

Region = tuple[float, float, float, float, float, float]
"""A box x0 x1 y0 y1 z0 z1, mm, which may be as small as a point."""


def check_region(region: Region, box: Box | None = None) -> None:
    """Raise InputError if a region x0 x1 y0 y1 z0 z1 (mm) is not a box, or is outside the box of a measurement."""
    got = " ".join(f"{value:g}" for value in region)
    lower, upper = region[::2], region[1::2]
    if len(region) != 6 or not all(a <= b and abs(a) < math.inf > abs(b) for a, b in zip(lower, upper, strict=False)):
        raise InputError(f"expected x0 x1 y0 y1 z0 z1 in mm, x0 <= x1, got {got}", field="ambient_region")
    inside = box is None or all(
        a >= c and b <= d for a, b, c, d in zip(lower, upper, box.lower, box.upper, strict=True)
    )
    if not inside:
        assert box is not None
        edges = " ".join(f"{value:g}" for pair in zip(box.lower, box.upper, strict=True) for value in pair)
        raise InputError(f"expected a region within the box {edges} mm, got {got}", field="ambient_region")
