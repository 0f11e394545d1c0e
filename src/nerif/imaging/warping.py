"""A picture moved by a displacement map."""

from __future__ import annotations

import numpy as np

__all__ = ["warp"]


def warp(image: np.ndarray, movement: np.ndarray) -> np.ndarray:
    """Return image(p + movement(p)) by cubic splines, edge values beyond the edges."""
    from scipy.ndimage import map_coordinates

    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    where = [rows + movement[..., 1], columns + movement[..., 0]]
    return np.asarray(map_coordinates(image.astype(np.float32), where, order=3, mode="nearest"))
