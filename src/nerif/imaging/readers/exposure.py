"""Full scale of a sensor, saturated pixels, and exposure of images."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from nerif.common.conventions import percent
from nerif.imaging.readers.frames import Frames, as_float

__all__ = ["check_exposure", "effective_bits", "full_scale", "saturated"]

CANDIDATE_BITS = (8, 10, 12, 14, 16)
MIN_BITS = 8  # of a sensor
PLATEAU = 32, 8.0  # least pixels at the highest value, and least ratio to the count of any value just below
JUST_BELOW = 0.03  # of the highest value
NOISE_FREE = 0.5  # share of equal neighbours from which an image has no noise, and a plateau no meaning


def effective_bits(*sources: Frames) -> int:
    """Return the effective bits of one camera: from the metadata, else estimated from the values.

    Files of 16 bit often hold 10, 12 or 14. The estimate is the smallest of these whose range holds the largest value
    of the sampled frames (up to five per source), too small for dark images. Frames of 8 bit have 8, floats between 0
    and 1 have 1.
    """
    stated = [s.bits for s in sources if s.metadata_bits is not None or s.bits in (1, 8)]
    if stated and max(stated) == 1:
        return 1
    least = max(stated, default=CANDIDATE_BITS[1])
    peak = max(s.layout.peak for s in sources)
    return least if peak < 2**least else next(bits for bits in CANDIDATE_BITS if peak < 2**bits)


def full_scale(*sources: Frames) -> float:
    """Return the grey value of a saturated pixel: that of the metadata, unless the sampled frames exceed it.

    Else, with b effective bits, of which the lowest k are zero in all sampled frames (values shifted to the upper end
    of their container, or a digital gain), it is 2^b - 2^k; for floats from 0 to 1 it is 1.
    """
    whites = [s.white for s in sources if s.white is not None]
    if len(whites) == len(sources) and max(s.layout.peak for s in sources) <= max(whites):
        return float(max(whites))
    bits = effective_bits(*sources)
    used = int(np.bitwise_or.reduce([s.layout.used for s in sources]))
    unused = min((used & -used).bit_length() - 1, bits - MIN_BITS) if used else 0
    return float(2**bits - 2**unused) if bits > 1 else 1.0


def saturated(image: np.ndarray, full: float) -> Bool[np.ndarray, "row column"]:
    """Return the saturated pixels of a grey image.

    These are the pixels at full scale, or at the highest value of the image where that is a plateau: reached by many
    more pixels than any value just below. Values above `full` show that it was estimated too low.

    Parameters
    ----------
    full : full scale, grey values; 1 (floats of unknown scale) has no effect
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
    """Return a warning if more than the share `limit` of an image is over-exposed, or it is nearly black."""
    share = float(np.mean(saturated(image, full) | (as_float(image) >= full)))
    if share > limit:
        return f"{name}: {percent(share)} of the pixels are over-exposed (full scale {full:g}); lower the exposure"
    top = float(np.percentile(image.astype(np.float64), 99.9))  # ignores a few hot pixels
    if top < 0.02 * full:
        used = f"{percent(top / full)} of the range is used"
        return f"{name}: nearly black, {used} (full scale {full:g}); raise the exposure"
    return None
