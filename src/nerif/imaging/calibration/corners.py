"""Corners of a calibration target in an image: their order, and where they are to a hundredth of a pixel."""

from __future__ import annotations

import numpy as np

__all__ = ["eight_bit", "first_at_a_black_square", "first_at_the_upper_left", "saddle_points", "spacing"]


def eight_bit(image: np.ndarray) -> np.ndarray:
    """Stretch the image to eight bits."""
    low, high = np.percentile(image.astype(np.float64), (0.2, 99.8))
    scaled = (image.astype(np.float32) - low) * (255 / max(float(high - low), 1e-6))
    return np.clip(np.round(scaled), 0, 255).astype(np.uint8)


def first_at_a_black_square(image: np.ndarray, pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Order corners so that the first square, beyond the first corner, is the black one of our own print."""
    columns, rows = shape
    grid = pixels.reshape(rows, columns, 2)
    (x1, y1), (x2, y2) = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if x1 * y2 - x2 * y1 < 0:  # columns to the right and rows down, not mirrored
        grid = grid[::-1]
    means = []
    for i in (0, 1):  # the inner squares next to the first corner along the first row: black where i is even
        square = grid[0:2, i : i + 2].mean(axis=(0, 1))
        means.append(float(_sample(image, square)))
    return (grid if means[0] < means[1] else grid[::-1, ::-1]).reshape(-1, 2)


def saddle_points(image: np.ndarray, pixels: np.ndarray, room: float) -> tuple[np.ndarray, np.ndarray]:
    """Move corners to the saddle point of the grey values around them, and tell which stay near where they were.

    A quadratic surface is fitted by least squares under a Gaussian weight, again around each new point (Lucchese &
    Mitra, Using saddle points for subpixel feature detection, 2002): 0.005 to 0.02 px on rendered images, where
    OpenCV's own refinements leave 0.02 to 0.05 px. `room` is the reach (px) that the fit may have: up to the markers,
    whose own edges would pull at it.
    """
    from scipy.ndimage import map_coordinates, spline_filter

    half = int(np.clip(room, 2, 7))
    y, x = (g.ravel().astype(np.float64) for g in np.mgrid[-half : half + 1, -half : half + 1])
    weight = np.exp(-((x**2 + y**2) / (half / 2) ** 2) / 4)
    fit = np.linalg.pinv(np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=-1) * weight[:, None])
    spline = spline_filter(image.astype(np.float64))
    found = pixels.copy()
    for _ in range(8):
        around = [found[:, 1:] + y, found[:, :1] + x]
        grey = map_coordinates(spline, around, order=3, prefilter=False, mode="nearest") * weight
        a, b, c, d, e, _ = fit @ grey.T
        determinant = 4 * a * c - b * b
        determinant = np.where(determinant < 0, determinant, -np.inf)  # a hill or a hollow: stay
        step = np.stack([b * e - 2 * c * d, b * d - 2 * a * e], axis=-1) / determinant[:, None]
        found = found + np.clip(step, -1, 1)
        if np.abs(step).max() < 1e-4:
            break
    return found, np.linalg.norm(found - pixels, axis=1) < max(2.0, 0.3 * half)


def _sample(image: np.ndarray, where: np.ndarray) -> float:
    """Mean of 3 x 3 pixels."""
    u, v = np.round(where).astype(int)
    return float(image[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2].mean())


def first_at_the_upper_left(pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Order circles so that rows go down and columns to the right in the image."""
    columns, rows = shape
    grid = pixels.reshape(rows, columns, 2)
    if grid[0, 0, 1] + grid[0, -1, 1] > grid[-1, 0, 1] + grid[-1, -1, 1]:
        grid = grid[::-1, ::-1]
    return grid.reshape(-1, 2)


def spacing(pixels: np.ndarray, ids: np.ndarray, shape: tuple[int, int]) -> float:
    """Shortest distance between neighbouring points in the image, px."""
    where = {int(i): p for i, p in zip(ids, pixels, strict=True)}
    columns, _ = shape
    near = [
        float(np.linalg.norm(where[i] - where[j]))
        for i in where
        for j in (i + 1, i + columns)
        if j in where and not (j == i + 1 and j % columns == 0)
    ]
    return min(near, default=8.0)
