"""Lowest and highest value of the field; the ambient, 0, lies between them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from nerif.common.conventions import InputError

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement

__all__ = ["check_bounds", "check_same_bounds", "field_bounds", "in_units"]


def check_bounds(lower: float | None, upper: float | None) -> None:
    """Raise InputError unless the ambient lies between the bounds."""
    if not _valid(-math.inf if lower is None else lower, math.inf if upper is None else upper):
        raise InputError(
            f"expected bounds of the field around 0, the ambient, got {lower} to {upper}; those of an "
            "index are of the excess over the ambient",
            field="lower, upper",
        )


def field_bounds(measurement: Measurement, lower: float | None, upper: float | None) -> tuple[float, float]:
    """Return the bounds of the settings, else of the technique; -inf and inf where there are none."""
    technique = measurement.observations[0].technique
    lowest, highest = technique.bounds
    low, high = lowest if lower is None else lower, highest if upper is None else upper
    if not _valid(low, high):
        names = " and ".join(name for name, value in (("lower", lower), ("upper", upper)) if value is not None)
        raise InputError(
            f"expected a range around 0, got {low:g} to {high:g} with the bounds of "
            f"{technique.quantity}, {lowest:g} to {highest:g}; give another value, or none",
            field=names,
        )
    return low, high


def check_same_bounds(before: tuple[float, float], bounds: tuple[float, float]) -> None:
    """Raise InputError unless the bounds are those of the network to be resumed, which cannot change."""
    if not all(math.isclose(a, b, rel_tol=1e-4) for a, b in zip(before, bounds, strict=True)):
        first, other = (f"{low:g} to {high:g}" for low, high in (before, bounds))
        raise InputError(
            f"expected the bounds of the run to be resumed, {first}, got {other}; give the same --lower and "
            "--upper, or start without --resume",
            field="resume",
        )


def in_units(bounds: tuple[float, float], scale: float) -> tuple[float, float]:
    """Return the bounds of the field over `scale`."""
    return bounds[0] / scale, bounds[1] / scale


def _valid(low: float, high: float) -> bool:
    return low <= 0 <= high and low != high
