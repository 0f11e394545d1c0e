"""Bounds of the field: what is known of its lowest and highest value; the ambient, 0, lies between them."""

from __future__ import annotations

import math

from nerif.conventions import InputError
from nerif.measurement import Measurement

__all__ = ["check_bounds", "field_bounds", "in_units"]


def check_bounds(lower: float | None, upper: float | None) -> None:
    """Refuse bounds that do not hold the ambient between them.

    Raises
    ------
    InputError
        Naming both.
    """
    low, high = -math.inf if lower is None else lower, math.inf if upper is None else upper
    if not low <= 0 <= high or low == high:
        raise InputError(
            f"lower, upper: expected bounds of the field around 0, the ambient, got {lower} to {upper}; those of an "
            "index are of the excess over the ambient"
        )


def field_bounds(measurement: Measurement, lower: float | None, upper: float | None) -> tuple[float, float]:
    """Return the bounds asked for, else those that the technique knows; -inf and inf where there are none."""
    low, high = measurement.observations[0].technique.bounds
    return low if lower is None else lower, high if upper is None else upper


def in_units(bounds: tuple[float, float], scale: float) -> tuple[float, float]:
    """Return bounds of a field that is given in units of `scale`."""
    return bounds[0] / scale, bounds[1] / scale
