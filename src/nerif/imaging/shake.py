"""Movements of the camera between reference and flow: shift, rotation and zoom of the image, and shifts of its rows."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from nerif.common.conventions import InputError

__all__ = ["border", "remove_shake", "row_movement"]

Vectors = Float[np.ndarray, "row column 2"]
PixelMask = Bool[np.ndarray, "row column"]

END = 0.1  # of a row, at its left and at its right
LEAST_ROWS, MOST_ROWS = 16, 200  # that are compared
SAME = 0.8  # correlation of the movements of both ends


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


def row_movement(d: Vectors, valid: PixelMask) -> float:
    """Return the median movement of rows as a whole, px, beyond shift, rotation and zoom of the image.

    It is 0 where the left and right ends of the rows move differently. A flow that reaches both ends is in a part of
    the rows only, so that their median movement is small.
    """
    width = max(round(END * d.shape[1]), 1)
    left, right = (slice(None), slice(width)), (slice(None), slice(-width, None))
    rows = np.flatnonzero(np.minimum(valid[left].mean(axis=1), valid[right].mean(axis=1)) > 0.5)
    rows = rows[:: max(1, len(rows) // MOST_ROWS)]
    if len(rows) < LEAST_ROWS:
        return 0.0
    from scipy.stats import theilslopes

    def profile(end: tuple[slice, slice]) -> np.ndarray:
        weight = valid[end][rows, :, None]
        mean = (d[end][rows] * weight).sum(axis=1) / weight.sum(axis=1)
        lines = [theilslopes(mean[:, k], rows) for k in range(2)]  # hardly moved by a flow in a part of the rows
        return np.asarray(mean - np.stack([line.intercept + line.slope * rows for line in lines], axis=-1))

    a, b = profile(left), profile(right)
    same = float((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum() + 1e-12))
    return float(np.median(np.linalg.norm((a + b) / 2, axis=-1))) if same > SAME else 0.0
