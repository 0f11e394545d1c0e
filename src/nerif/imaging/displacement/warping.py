"""Images and volumes warped by a displacement map."""

from __future__ import annotations

import numpy as np

__all__ = ["warp"]


def warp(image: np.ndarray, movement: np.ndarray) -> np.ndarray:
    """Return image(p + movement(p)) by cubic splines, with edge values beyond the edges.

    Parameters
    ----------
    image : (row, column) or (z, y, x)
    movement : (row, column, 2) u, v, or (z, y, x, 3) x, y, z, px
    """
    from scipy.ndimage import map_coordinates

    where = [cell + movement[..., -1 - axis] for axis, cell in enumerate(np.indices(image.shape))]
    return np.asarray(map_coordinates(image.astype(np.float32), where, order=3, mode="nearest"))
