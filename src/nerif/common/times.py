"""Times of frames in files, in the units of the CF conventions, and missing frames by gaps between them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from nerif.common.conventions import InputError

__all__ = ["INTERVAL", "check_interval", "frame_range", "interval", "same_instants", "seconds", "whole_steps"]

Times = Float[np.ndarray, "frame"]
Numbers = Int[np.ndarray, "frame"]

INTERVAL = "frame_interval_s"
"""Attribute of a film: median interval of its frames, s, by which times that have lost their unit are recognised."""

PER_SECOND = {"s": 1, "sec": 1, "second": 1, "ms": 1e3, "msec": 1e3, "millisecond": 1e3, "us": 1e6, "\u00b5s": 1e6,
              "\u03bcs": 1e6, "usec": 1e6, "microsecond": 1e6, "ns": 1e9, "nsec": 1e9, "nanosecond": 1e9}  # fmt: skip
SECONDS = {"min": 60, "minute": 60, "h": 3600, "hr": 3600, "hour": 3600, "d": 86400, "day": 86400}
"""Units of time of the CF conventions, also in the plural, and before "since" and a date."""

TENTH = 0.03  # of a power of 1000: 20 %
CLOSE = 1e-3  # of an interval
UNEVEN = 0.2  # of an interval: times that deviate by more count no frames


def whole_steps(times: Times) -> Numbers | None:
    """Return the numbers of frames, from 0, by times at whole multiples of an interval; None if they are at others.

    Frames that a camera dropped are gaps in the numbers.
    """
    intervals = np.diff(times)
    if not (intervals > 0).all():
        return None
    if not len(intervals):
        return np.arange(len(times))
    steps = intervals / np.median(intervals[intervals < 1.5 * intervals.min()])
    if (np.abs(steps - np.rint(steps)) > UNEVEN).any():
        return None
    return np.concatenate([[0], np.rint(steps).astype(np.int64).cumsum()])


def frame_range(text: str) -> tuple[int, int]:
    """Return the first frame of FIRST:LAST, and the one after its last."""
    try:
        first, last = (int(word) for word in text.split(":"))
        if not 0 <= first < last:
            raise ValueError
    except ValueError:
        raise InputError(f"expected all, or FIRST:LAST such as 0:400, got '{text}'", field="frames") from None
    return first, last


def seconds(numbers: np.ndarray, units: object, field: str | Path) -> Times:
    """Return times in s: numbers in a unit of the CF conventions (s by default), spans of time, or dates (since 1970).

    Parameters
    ----------
    numbers : as they are stored
    units : such as "ms", or "milliseconds since 2024-05-03 12:00:00" (then since that date)
    field : that the error names
    """
    if numbers.dtype.kind in "mM":
        return numbers.astype(f"{numbers.dtype.kind}8[ns]").astype(np.int64) / 1e9
    if numbers.dtype.kind not in "fiu":
        raise InputError(f"coordinate time: expected numbers, got {numbers.dtype}", field=field)
    unit = re.split(r"\s+since\s", str(units or "s").strip())[0]
    unit = unit if unit in PER_SECOND | SECONDS else unit.lower().removesuffix("s")
    if unit not in PER_SECOND | SECONDS:
        raise InputError(
            f"coordinate time: expected a unit such as s, ms or milliseconds since 2024-05-03, got '{units}'",
            field=field,
        )
    return np.asarray(numbers / PER_SECOND[unit] if unit in PER_SECOND else numbers * SECONDS[unit], dtype=np.float64)


def interval(times: Sequence[float]) -> dict[str, float]:
    """Return the attribute of a film that states the median interval of its frames; none for a single frame."""
    return {INTERVAL: float(np.median(np.diff(times)))} if len(times) > 1 else {}


def check_interval(times: Sequence[float], attributes: Mapping[str, Any], field: str | Path) -> None:
    """Refuse times that differ from the interval that a film states by a power of 1000: their unit is another one."""
    expected = attributes.get(INTERVAL)
    if not isinstance(expected, float | int) or not expected > 0 or len(times) < 2:
        return
    actual = interval(times)[INTERVAL]
    powers = math.log10(actual / expected) / 3
    if round(powers) and abs(powers - round(powers)) < TENTH:
        raise InputError(
            f"coordinate time: expected frames {expected:g} s apart, as when they were measured ({INTERVAL}), got "
            f"{actual:g} s; was the unit of time lost when the film was saved again? State it, such as units = 'ms'",
            field=field,
        )


def same_instants(a: Sequence[float], b: Sequence[float]) -> bool:
    """Return whether two films have the same times, s, to rounding."""
    if len(a) != len(b):
        return False
    scale = min(np.diff(a).min(), np.diff(b).min()) if len(a) > 1 else 1.0
    return bool((np.abs(np.subtract(a, b)) <= CLOSE * scale).all())
