"""Window cross-correlation, as in particle image velocimetry: several passes, the reference deformed in between.

Each window of the flow picture is correlated with the same window of the reference, moved by what is known so far; the
peak is fitted by a Gaussian through three points a direction; vectors that do not fit their neighbours are replaced.

Sources: Scarano, Iterative image deformation methods in PIV, Meas. Sci. Technol. 13 (2002) R1; Westerweel & Scarano,
Universal outlier detection for PIV data, Exp. Fluids 39 (2005) 1096. No library under a licence like ours was found.
"""

from __future__ import annotations

import numpy as np

from nerif.conventions import InputError
from nerif.imaging.warping import warp

__all__ = ["normalised_median_outliers", "window_correlation"]


def window_correlation(flow: np.ndarray, reference: np.ndarray, window: int = 16, passes: int = 4) -> np.ndarray:
    """Return the movement w (row, column, 2) in px of every pixel from the flow picture to the reference.

    Parameters
    ----------
    flow, reference : (row, column) grey pictures of one scale
    window : edge of the interrogation windows of the last passes, px; the first uses twice that
    passes : number of passes; windows overlap by three quarters

    Raises
    ------
    InputError
        If a picture is smaller than two windows.
    """
    if min(flow.shape) < 2 * window:
        raise InputError(f"window: expected at most half the picture ({min(flow.shape) // 2} px), got {window} px")
    movement = np.zeros((*flow.shape, 2), dtype=np.float32)
    for i in range(passes):
        size = 2 * window if i == 0 and min(flow.shape) >= 4 * window else window
        step = max(2, size // 4)
        moved = warp(reference, movement)
        rows, columns = (_starts(n, size, step) for n in flow.shape)
        residual, height = _correlate(flow, moved, rows, columns, size)
        centre_rows, centre_columns = rows + (size - 1) / 2, columns + (size - 1) / 2
        known = _at(movement, centre_rows, centre_columns)
        vectors = known + residual
        bad = normalised_median_outliers(vectors) | ~(height > 0.1) | (np.abs(residual).max(-1) > size / 3)
        vectors = _replace(vectors, bad)
        movement = _to_pixels(vectors, centre_rows, centre_columns, flow.shape)
    return movement


def _starts(length: int, size: int, step: int) -> np.ndarray:
    starts = np.arange(0, length - size + 1, step)
    return starts if starts[-1] == length - size else np.append(starts, length - size)


def _correlate(
    flow: np.ndarray, moved: np.ndarray, rows: np.ndarray, columns: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Shift (2) and height (0 to 1) of the correlation peak of every window."""
    from scipy import fft

    axis = (np.arange(size) - (size - 1) / 2) / size
    weight = np.exp(-0.5 * (axis / 0.3) ** 2)
    weight = weight[:, None] * weight[None, :]
    weight = (weight / weight.sum()).astype(np.float32)
    shifts, heights = [], []
    for row in rows:  # one row of windows at a time bounds the memory
        strips = [
            np.lib.stride_tricks.sliding_window_view(i[row : row + size], size, axis=1)[:, columns].swapaxes(0, 1)
            for i in (flow, moved)
        ]
        a, b = ((s - (s * weight).sum((1, 2), keepdims=True)) * np.sqrt(weight) for s in strips)
        product = np.conj(fft.rfft2(a)) * fft.rfft2(b)
        surface = fft.fftshift(fft.irfft2(product, s=(size, size)), axes=(1, 2))
        norm = np.sqrt((a**2).sum((1, 2)) * (b**2).sum((1, 2))) + 1e-12
        shift, height = _peak(surface / norm[:, None, None])
        shifts.append(shift)
        heights.append(height)
    return np.stack(shifts), np.stack(heights)


def _peak(surface: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where (u, v) the highest point of each surface lies from its middle, by Gaussian fits through three points."""
    n, size, _ = surface.shape
    inner = surface[:, 1:-1, 1:-1].reshape(n, -1)
    best = inner.argmax(axis=1)
    i, j = best // (size - 2) + 1, best % (size - 2) + 1
    each = np.arange(n)
    height = surface[each, i, j]

    def fit(before: np.ndarray, after: np.ndarray) -> np.ndarray:
        floor = 1e-6
        l0, l1, l2 = (np.log(np.maximum(v, floor)) for v in (before, height, after))
        curvature = l0 - 2 * l1 + l2
        return np.where(curvature < 0, 0.5 * (l0 - l2) / np.where(curvature < 0, curvature, -1), 0)

    v = i - size // 2 + fit(surface[each, i - 1, j], surface[each, i + 1, j])
    u = j - size // 2 + fit(surface[each, i, j - 1], surface[each, i, j + 1])
    return np.stack([u, v], axis=-1), height


def normalised_median_outliers(vectors: np.ndarray, threshold: float = 2.0, noise: float = 0.1) -> np.ndarray:
    """Return which vectors (row, column, 2) differ from the median of their eight neighbours by more than `threshold`.

    |d - median| / (median |d_i - median| + noise) > threshold, `noise` in px (Westerweel & Scarano 2005).
    """
    padded = np.pad(vectors, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    rows, columns = vectors.shape[:2]
    around = np.stack(
        [padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    )  # fmt: skip
    median = _nanmedian(around)
    spread = _nanmedian(np.abs(around - median))
    ratio = np.abs(vectors - median) / (spread + noise)
    return np.asarray(np.hypot(ratio[..., 0], ratio[..., 1]) > threshold)


def _nanmedian(values: np.ndarray) -> np.ndarray:
    """Median along the first axis without NaN; NumPy's own takes several times as long."""
    ordered = np.sort(values, axis=0)  # NaN last
    count = np.isfinite(values).sum(axis=0)[None]
    low, high = (np.take_along_axis(ordered, k, axis=0)[0] for k in ((count - 1) // 2, count // 2))
    return np.asarray((low + high) / 2)


def _replace(vectors: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Put the mean of the good vectors around it, near ones counting more, in the place of each bad one."""
    from scipy.ndimage import gaussian_filter

    if not bad.any() or bad.all():
        return np.where(bad[..., None], 0, vectors)
    weight = gaussian_filter((~bad).astype(float), 1.5) + 1e-9
    filled = [gaussian_filter(np.where(bad, 0, vectors[..., k]), 1.5) / weight for k in range(2)]
    return np.where(bad[..., None], np.stack(filled, axis=-1), vectors)


def _at(movement: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    from scipy.ndimage import map_coordinates

    where = np.meshgrid(rows, columns, indexing="ij")
    return np.stack([map_coordinates(movement[..., k], where, order=1, mode="nearest") for k in range(2)], axis=-1)


def _to_pixels(vectors: np.ndarray, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Cubic splines through the vectors; beyond the outer ones their values go on."""
    from scipy.interpolate import RectBivariateSpline

    at_rows = np.clip(np.arange(shape[0]), rows[0], rows[-1])
    at_columns = np.clip(np.arange(shape[1]), columns[0], columns[-1])
    order = min(3, len(rows) - 1, len(columns) - 1)
    splines = [RectBivariateSpline(rows, columns, vectors[..., k], kx=order, ky=order) for k in range(2)]
    return np.stack([spline(at_rows, at_columns) for spline in splines], axis=-1).astype(np.float32)
