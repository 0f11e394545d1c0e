"""Times of frames in files, in the units of the CF conventions, and what they say about frames that are missing."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

__all__ = ["whole_steps"]

Times = Float[np.ndarray, "frame"]
Numbers = Int[np.ndarray, "frame"]

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
