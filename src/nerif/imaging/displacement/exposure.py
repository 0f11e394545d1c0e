"""The grey value at which a sensor is full, which pixels reach it, and whether an image is well exposed."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from nerif.imaging.readers.frames import Frames, as_float

__all__ = ["check_exposure", "effective_bits", "full_scale", "saturated"]

CANDIDATE_BITS = (8, 10, 12, 14, 16)
FEWEST_BITS = 8  # of a sensor
PLATEAU = 32, 8.0  # pixels that have the highest value, and times the most that have any value just below
JUST_BELOW = 0.03  # of the highest value
NOISE_FREE = 0.5  # share of neighbouring pixels that are equal: in an image without noise a plateau tells nothing


def effective_bits(*sources: Frames) -> int:
    """Return the bits that the values of one camera fill: from the metadata, else the fewest that hold those seen.

    Files of 16 bit often hold 10, 12 or 14 without saying so. The guess is the smallest of 10, 12, 14 and 16 whose
    range holds the largest value of the frames looked at (up to five a source); dark images make it too small.
    Frames of 8 bit have 8, floats between 0 and 1 have 1.
    """
    stated = [s.bits for s in sources if s.known_bits is not None or s.bits in (1, 8)]
    if stated and max(stated) == 1:
        return 1
    least = max(stated, default=CANDIDATE_BITS[1])
    peak = max(s.layout.peak for s in sources)
    return least if peak < 2**least else next(bits for bits in CANDIDATE_BITS if peak < 2**bits)


def full_scale(*sources: Frames) -> float:
    """Return the grey value of a full sensor.

    With b effective bits, of which the lowest k are zero in all frames looked at (bits moved to the upper end of their
    container, or a digital gain), that is 2^b - 2^k; 1 for floats from 0 to 1.
    """
    bits = effective_bits(*sources)
    used = int(np.bitwise_or.reduce([s.layout.used for s in sources]))
    unused = min((used & -used).bit_length() - 1, bits - FEWEST_BITS) if used else 0
    return float(2**bits - 2**unused) if bits > 1 else 1.0


def saturated(image: np.ndarray, full: float) -> Bool[np.ndarray, "row column"]:
    """Return the pixels at which the sensor was full.

    These are the pixels at full scale, or at the highest value of the image where that is a plateau: reached by many
    more pixels than any value just below. An image with values above `full` shows that this was guessed too low.

    Parameters
    ----------
    image : (row, column) grey values
    full : grey value of a full sensor; 1, floats scaled by who knows what, tells nothing
    """
    top = float(image.max())
    level = full if full > 1 and top <= full else np.inf
    return np.asarray(as_float(image) >= (top if _is_plateau(image) else level))


def _is_plateau(image: np.ndarray) -> bool:
    if image.dtype.kind != "u":
        return False
    counts = np.bincount(image.ravel())
    top = len(counts) - 1
    fewest, factor = PLATEAU
    below = counts[min(int((1 - JUST_BELOW) * top), top - 1) : top]
    if counts[top] < fewest or not below.size or counts[top] < factor * max(1, int(below.max())):
        return False
    left, right = image[:, :-1], image[:, 1:]
    darker = left < top
    return bool(darker.any()) and float(np.mean(left[darker] == right[darker])) < NOISE_FREE


def check_exposure(image: np.ndarray, full: float, name: str, limit: float = 0.01) -> str | None:
    """Return a line naming the image if more than `limit` of it is over-exposed, or it is nearly black, else None."""
    share = float(np.mean(saturated(image, full) | (as_float(image) >= full)))
    if share > limit:
        return f"{name}: {share:.1%} of the pixels are over-exposed (full scale {full:g}); lower the exposure"
    top = float(np.percentile(image.astype(np.float64), 99.9))  # a few hot pixels do not make light
    if top < 0.02 * full:
        return f"{name}: nearly black, {top / full:.1%} of the range is used (full scale {full:g}); raise the exposure"
    return None
