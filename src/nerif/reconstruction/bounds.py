"""Bounds of the field: what is known of its lowest and highest value; the ambient, 0, lies between them."""

from __future__ import annotations

import math

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement

__all__ = ["check_bounds", "check_resumed", "field_bounds", "in_units"]


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
            f"expected bounds of the field around 0, the ambient, got {lower} to {upper}; those of an "
            "index are of the excess over the ambient",
            field="lower, upper",
        )


def field_bounds(measurement: Measurement, lower: float | None, upper: float | None) -> tuple[float, float]:
    """Return the bounds asked for, else those that the technique knows; -inf and inf where there are none.

    Raises
    ------
    InputError
        If the two together leave the field no range around 0; names the one that was asked for.
    """
    technique = measurement.observations[0].technique
    (least, most), asked = technique.bounds, {"lower": lower, "upper": upper}
    low, high = least if lower is None else lower, most if upper is None else upper
    if not low <= 0 <= high or low == high:
        names = " and ".join(name for name, value in asked.items() if value is not None)
        raise InputError(
            f"expected to leave a range around 0, got {low:g} to {high:g} with the bounds of "
            f"{technique.quantity}, {least:g} to {most:g}; give another value, or none",
            field=names,
        )
    return low, high


def check_resumed(began: tuple[float, float], asked: tuple[float, float]) -> None:
    """Refuse to go on with a network that cannot leave other bounds than those asked for.

    Raises
    ------
    InputError
        Naming both.
    """
    if not all(math.isclose(a, b, rel_tol=1e-4) for a, b in zip(began, asked, strict=True)):
        first, other = (f"{low:g} to {high:g}" for low, high in (began, asked))
        raise InputError(
            f"expected the bounds that the run began with, {first}, got {other}; give the same --lower and "
            "--upper, or start without --resume",
            field="resume",
        )


def in_units(bounds: tuple[float, float], scale: float) -> tuple[float, float]:
    """Return bounds of a field that is given in units of `scale`."""
    return bounds[0] / scale, bounds[1] / scale
