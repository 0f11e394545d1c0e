"""Window cross-correlation, as in particle image velocimetry, of images or volumes, in several passes with deformation.

Each window of the first array is correlated with the same window of the second, warped by the movement so far; the peak
is fitted by a Gaussian through three points per direction; outliers are replaced. Arrays are indexed (row, column) or
(z, y, x), movements have components (u, v) or (x, y, z).

A window that moves unevenly has a correlation peak only if the movement differs by less than a dot across it. Images
therefore begin binned, where dots are larger: peaks of 25 px come out as well as those of 2 px.

Sources: Scarano, Iterative image deformation methods in PIV, Meas. Sci. Technol. 13 (2002) R1; Westerweel & Scarano,
Universal outlier detection for PIV data, Exp. Fluids 39 (2005) 1096. No library has it under a compatible licence.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np

from nerif.common.conventions import InputError
from nerif.imaging.displacement.warping import warp
from nerif.imaging.quality.thumbnails import binned
from nerif.imaging.readers.frames import as_float

__all__ = ["Vectors", "correlate", "normalised_median_outliers", "window_correlation"]

MIN_VARIANCE = 1e-4  # of a window, relative to the mean
BINNINGS = 8, 4, 2  # before the images themselves
SMOOTH, COARSE = 0.7, 6.0  # px, standard deviations of the means between which the detail of a binned image lies
OUTLIER, OUTLIER_NOISE = 2.0, 0.1  # of the normalised deviation from the median of the neighbours; px
MIN_PEAK = 0.1  # of the correlation, which is 1 where both windows are equal


@dataclass(frozen=True)
class Vectors:
    """Movements at the centres of windows."""

    axes: tuple[np.ndarray, ...]  #: centres along each axis of the arrays, px (in volumes: voxels)
    movement: np.ndarray  #: (*nodes, d) in px; interpolated from the neighbours where not valid
    valid: np.ndarray  #: (*nodes) False where the peak is low or the vector is an outlier


def window_correlation(flow: np.ndarray, reference: np.ndarray, window: int = 16) -> np.ndarray:
    """Return the movement w (row, column, 2) in px of every pixel from the flow image to the reference.

    Parameters
    ----------
    flow, reference : (row, column) grey images of one scale
    window : edge of the interrogation windows, px; they overlap by three quarters
    """
    if min(flow.shape) < 2 * window:
        raise InputError(
            f"expected at most half the image ({min(flow.shape) // 2} px), got {window} px", field="window"
        )
    vectors = None
    for binning in (b for b in BINNINGS if min(flow.shape) >= 2 * window * b):
        a, b = _detail(flow, binning), _detail(reference, binning)
        start = np.zeros((*a.shape, 2)) if vectors is None else _interpolated(vectors, a.shape, binning) / binning
        coarse = correlate(a, b, window, 2, start=start)
        centres = tuple(binning * c + (binning - 1) / 2 for c in coarse.axes)
        vectors = Vectors(centres, binning * coarse.movement, coarse.valid)
    if vectors is None:
        return _interpolated(correlate(flow, reference, window), flow.shape)
    vectors = correlate(flow, reference, window, 3, start=_interpolated(vectors, flow.shape))
    return _interpolated(vectors, flow.shape)


def _detail(image: np.ndarray, binning: int) -> np.ndarray:
    """The binned image without its uneven light."""
    from scipy.ndimage import gaussian_filter

    small = binned(image, binning)
    return np.asarray(gaussian_filter(small, SMOOTH) - gaussian_filter(small, COARSE))


def correlate(
    first: np.ndarray, second: np.ndarray, window: int, passes: int = 4, central: bool = False,
    start: np.ndarray | None = None,
) -> Vectors:  # fmt: skip
    """Return the movement from the first array to the second at the centres of windows.

    Parameters
    ----------
    first, second : images or volumes of one shape and scale
    window : edge of the windows, px; without a start the first pass uses twice that where four of them fit
    passes : number of passes; windows overlap by three quarters
    central : whether both arrays are warped by half, so that a vector belongs to the middle of its path; else it
        belongs to the position in the first array
    start : (*shape, d) movement from which the first pass goes on, px; None for 0
    """
    if first.shape != second.shape:
        raise InputError(f"expected the shape of the first, {first.shape}, got {second.shape}", field="second")
    if not 4 <= window <= min(first.shape):
        raise InputError(f"expected between 4 and the shortest edge, {min(first.shape)}, got {window}", field="window")
    if passes < 1:
        raise InputError(f"expected at least 1, got {passes}", field="passes")
    movement = np.zeros((*first.shape, first.ndim), dtype=np.float32) if start is None else start
    for i in range(passes):
        size = 2 * window if i == 0 and start is None and min(first.shape) >= 4 * window else window
        starts = [_starts(n, size, max(2, size // 4)) for n in first.shape]
        a = warp(first, -movement / 2) if central else first
        b = warp(second, movement / 2 if central else movement)
        residual, height = _shifts(a, b, starts, size)
        axes = tuple(s + (size - 1) / 2 for s in starts)
        movements = _at(movement, axes) + residual
        bad = normalised_median_outliers(movements) | ~(height > MIN_PEAK) | (np.abs(residual).max(-1) > size / 3)
        vectors = Vectors(axes, _replace(movements, bad), ~bad)
        if i < passes - 1:
            movement = _interpolated(vectors, first.shape)
    return vectors


def _starts(length: int, size: int, step: int) -> np.ndarray:
    starts = np.arange(0, length - size + 1, step)
    return starts if starts[-1] == length - size else np.append(starts, length - size)


def _shifts(
    first: np.ndarray, second: np.ndarray, starts: list[np.ndarray], size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Shift (*nodes, d) and height (*nodes) of the correlation peak of every window; height 0 without contrast."""
    from scipy import fft

    dimensions = first.ndim
    within = tuple(range(1, dimensions + 1))  # axes of a stack of windows
    axis = np.exp(-0.5 * ((np.arange(size) - (size - 1) / 2) / size / 0.3) ** 2)
    weight = reduce(lambda w, a: w[..., None] * a, [axis] * dimensions)
    weight = (weight / weight.sum()).astype(np.float32)
    shifts, heights, strengths = [], [], []
    for start in starts[0]:  # the windows of one start at a time, to limit memory
        a, b = (
            (w - (w * weight).sum(within, keepdims=True)) * np.sqrt(weight)
            for w in (_windows(array[start : start + size], starts[1:], size) for array in (first, second))
        )
        product = np.conj(fft.rfftn(a, axes=within)) * fft.rfftn(b, axes=within)
        surface = fft.fftshift(fft.irfftn(product, s=(size,) * dimensions, axes=within), axes=within)
        strength = np.sqrt((a**2).sum(within) * (b**2).sum(within)) + 1e-12
        shift, height = _peak(surface / np.expand_dims(strength, within))
        shifts.append(shift)
        heights.append(height)
        strengths.append(strength)
    nodes = [len(s) for s in starts]
    contrast = np.stack(strengths) > MIN_VARIANCE * np.mean(strengths)
    return np.stack(shifts).reshape(*nodes, dimensions), (np.stack(heights) * contrast).reshape(nodes)


def _windows(slab: np.ndarray, starts: list[np.ndarray], size: int) -> np.ndarray:
    """The windows (n, size, ...) of a slab of their thickness."""
    others = tuple(range(1, slab.ndim))
    views = np.lib.stride_tricks.sliding_window_view(slab, (size,) * len(others), axis=others)
    index: tuple[slice | np.ndarray, ...] = (slice(None), *np.ix_(*starts))
    return np.moveaxis(views[index], 0, len(others)).reshape(-1, *(size,) * slab.ndim)


def _peak(surface: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (u, v) or (x, y, z) of each surface's peak from its centre by Gaussian fits, and its height."""
    n, size, dimensions = len(surface), surface.shape[1], surface.ndim - 1
    inner = surface[(slice(None), *(slice(1, -1),) * dimensions)]
    best = np.unravel_index(inner.reshape(n, -1).argmax(axis=1), inner.shape[1:])
    top = np.stack([np.arange(n), *(b + 1 for b in best)])
    height = surface[tuple(top)]

    def fit(axis: int) -> np.ndarray:
        step = np.zeros((dimensions + 1, 1), dtype=int)
        step[axis] = 1
        around = surface[tuple(top - step)], height, surface[tuple(top + step)]
        l0, l1, l2 = (np.log(np.maximum(v, 1e-6)) for v in around)
        curvature = l0 - 2 * l1 + l2
        return np.where(curvature < 0, 0.5 * (l0 - l2) / np.where(curvature < 0, curvature, -1), 0)

    return np.stack([top[a] - size // 2 + fit(a) for a in range(dimensions, 0, -1)], axis=-1), height


def normalised_median_outliers(vectors: np.ndarray) -> np.ndarray:
    """Return which vectors (*nodes, d) differ from the median of their 8 or 26 neighbours too much.

    |d - median| / (median |d_i - median| + OUTLIER_NOISE) > OUTLIER      (Westerweel & Scarano 2005)
    """
    vectors, nodes = as_float(vectors), vectors.shape[:-1]
    padded = np.pad(vectors, (*((1, 1),) * len(nodes), (0, 0)), constant_values=np.nan)
    around = np.stack(
        [
            padded[tuple(slice(i, i + n) for i, n in zip(start, nodes, strict=True))]
            for start in np.ndindex((3,) * len(nodes))
            if any(i != 1 for i in start)
        ]
    )
    median = _nanmedian(around)
    ratio = np.abs(vectors - median) / (_nanmedian(np.abs(around - median)) + OUTLIER_NOISE)
    return np.asarray(np.sqrt((ratio**2).sum(axis=-1)) > OUTLIER)


def _nanmedian(values: np.ndarray) -> np.ndarray:
    """Median along the first axis without NaN, several times faster than NumPy's."""
    ordered = np.sort(values, axis=0)  # NaN last
    count = np.isfinite(values).sum(axis=0)[None]
    low, high = (np.take_along_axis(ordered, k, axis=0)[0] for k in ((count - 1) // 2, count // 2))
    return np.asarray((low + high) / 2)


def _replace(vectors: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Replace bad vectors by the Gaussian-weighted mean of the good ones around them."""
    from scipy.ndimage import gaussian_filter

    if not bad.any() or bad.all():
        return np.where(bad[..., None], 0, vectors)
    weight = gaussian_filter((~bad).astype(float), 1.5) + 1e-9
    means = [gaussian_filter(np.where(bad, 0, vectors[..., k]), 1.5) / weight for k in range(vectors.shape[-1])]
    return np.where(bad[..., None], np.stack(means, axis=-1), vectors)


def _at(movement: np.ndarray, axes: tuple[np.ndarray, ...]) -> np.ndarray:
    from scipy.ndimage import map_coordinates

    where = np.meshgrid(*axes, indexing="ij")
    parts = [map_coordinates(movement[..., k], where, order=1, mode="nearest") for k in range(movement.shape[-1])]
    return np.stack(parts, axis=-1)


def _interpolated(vectors: Vectors, shape: tuple[int, ...], binning: int = 1) -> np.ndarray:
    """The movement (*shape, d) of pixels, or bins of them, by cubic splines, constant beyond the outer vectors."""
    from scipy.interpolate import make_interp_spline

    movement = vectors.movement
    for axis, (centres, n) in enumerate(zip(vectors.axes, shape, strict=True)):
        if len(centres) == 1:
            movement = movement.repeat(n, axis=axis)
            continue
        positions = np.clip(binning * np.arange(n) + (binning - 1) / 2, centres[0], centres[-1])
        movement = make_interp_spline(centres, movement, min(3, len(centres) - 1), axis=axis)(positions)
    return np.asarray(movement, dtype=np.float32)
