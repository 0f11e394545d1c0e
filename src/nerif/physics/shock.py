"""The angle of a shock to the stream, by the field of density or index.

    angle = arcsin(|N . s|),      N = grad n / |grad n|,      s the direction of the stream

over the places of steepest compression, grad n . s > 0. For a plane and a conical shock it is the same everywhere; a
bow shock has many, of which this is the one of its strongest part.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nerif.data.volume import Volume

__all__ = ["shock_angle"]

STEEPEST = 0.5  # of the steepest gradient, from which on a place belongs to the shock
QUANTILE = 0.999  # of the gradients: the steepest one, without single voxels
SMOOTH = 1.0  # voxels, standard deviation of a Gaussian
LEAST = 5  # voxels along an edge
MAX_SPREAD = 10.0  # degrees between the quartiles, beyond which there is no single angle


def shock_angle(excess: Volume, stream: Sequence[float]) -> tuple[float, float] | None:
    """Return the angle between shock and stream, and half the distance of its quartiles, degrees; None if unclear.

    Parameters
    ----------
    excess : index excess or density
    stream : (3,) direction x, y, z, of any length
    """
    import numpy as np
    from scipy.ndimage import gaussian_filter

    if min(excess.values.shape) < LEAST:
        return None
    values = excess.values.double().numpy()
    missing = np.isnan(values)
    values = gaussian_filter(np.where(missing, 0.0, values), SMOOTH)
    spacing = excess.grid.spacing
    slope = np.stack(np.gradient(values, *spacing[::-1])[::-1], axis=-1)
    border = np.ones(values.shape, dtype=bool)
    border[2:-2, 2:-2, 2:-2] = missing[2:-2, 2:-2, 2:-2]
    along = slope @ (np.asarray(stream, dtype=np.float64) / np.linalg.norm(stream))
    steepness = np.where(border | (along <= 0), 0.0, np.linalg.norm(slope, axis=-1))
    steepest = float(np.quantile(steepness, QUANTILE))
    shock = steepness > STEEPEST * steepest
    if not steepest > 0:
        return None
    angles = np.degrees(np.arcsin(np.clip(along[shock] / steepness[shock], 0, 1)))
    low, middle, high = np.quantile(angles, [0.25, 0.5, 0.75])
    spread = float(high - low) / 2
    return (float(middle), spread) if 2 * spread < MAX_SPREAD and math.isfinite(spread) else None
