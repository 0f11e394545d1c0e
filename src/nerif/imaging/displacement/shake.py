"""Movements of the camera between reference and flow: shift, rotation and zoom of the whole image."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from nerif.common.conventions import InputError

__all__ = ["border", "remove_shake"]

Vectors = Float[np.ndarray, "row column 2"]
PixelMask = Bool[np.ndarray, "row column"]


def remove_shake(d: Vectors, still: PixelMask) -> Vectors:
    """Subtract the similarity d = t + [[a, -b], [b, a]] p that fits best where nothing flows.

    Parameters
    ----------
    d : px
    still : pixels without flow, fitted with Cauchy's loss, robust to outliers
    """
    if still.sum() < 8:
        raise InputError(
            f"expected at least 8 pixels without flow, got {int(still.sum())}; widen the border", field="shake"
        )
    from scipy.optimize import least_squares

    rows, columns = np.mgrid[: d.shape[0], : d.shape[1]].astype(np.float64)
    scale = max(d.shape[:2]) / 2
    x, y = (columns - columns.mean()) / scale, (rows - rows.mean()) / scale
    one, zero = np.ones_like(x), np.zeros_like(x)
    design = np.stack([np.stack([one, zero, x, -y], axis=-1), np.stack([zero, one, y, x], axis=-1)], axis=-2)
    a, b = design[still].reshape(-1, 4), d[still].reshape(-1).astype(np.float64)
    start = np.linalg.lstsq(a, b, rcond=None)[0]
    noise = 1.4826 * np.median(np.abs(a @ start - b)) + 1e-6
    fit = least_squares(lambda p: a @ p - b, start, jac=lambda p: a, loss="cauchy", f_scale=2 * noise)
    return (d - (design.reshape(-1, 4) @ fit.x).reshape(d.shape)).astype(np.float32)


def border(shape: tuple[int, ...], width: int) -> PixelMask:
    """Return the outer `width` px of an image."""
    if 2 * width >= min(shape):
        raise InputError(f"expected less than half the image ({min(shape) // 2} px), got {width}", field="shake_border")
    mask = np.ones(shape, dtype=bool)
    mask[width:-width, width:-width] = False
    return mask
