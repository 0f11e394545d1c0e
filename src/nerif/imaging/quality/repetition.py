"""Backgrounds that repeat (checkers, lines, printed grids of dots), by their autocorrelation.

A shift of such a background is known only up to whole periods; along lines it is not known at all. The autocorrelation
of a random pattern has no second peak that comes near the height of its origin. It is computed in windows spread over
the image, since the period changes with perspective.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

from nerif.imaging.quality.thumbnails import binned, parabola

__all__ = ["Repetition", "repetition"]

WINDOW = 48, 96  # px, half the image between these limits
BINNINGS = 1, 2, 4  # for periods up to 0.4 windows times this
REACH = 0.4  # of the window: autocorrelation at larger shifts has too few pixels
GRID = 4  # most windows per side of the image; neighbours overlap by half
COARSE = 6.0  # part of the window that is the standard deviation of the mean that is subtracted
HEIGHT = 0.45  # of a peak, relative to the origin
NEARLY = 0.8  # of the highest peak: the shortest shift with such a peak is the period
MAJORITY = 0.6  # of the windows that agree
SHORTEST = 3.0  # px, period; a shorter one cannot be resolved
SPREAD = 0.15  # of the periods of windows, relative to their median
DISTINCT = 20.0  # degrees between the directions of two periods
ALONG = 8.0  # degrees from an axis of the image within which a direction is named by it


@dataclass(frozen=True)
class Repetition:
    """The repetition of a background."""

    periods: tuple[Float[np.ndarray, " 2"], ...]
    """Shortest shifts (x, y) that map the background onto itself, px: two, one of lines, none of random lines."""
    lines: Float[np.ndarray, " 2"] | None = None
    """Unit vector (x, y) along the lines; None if the background changes in all directions."""

    def __str__(self) -> str:
        parts = [f"every {np.linalg.norm(p):.1f} px {_direction(p)}" for p in self.periods]
        text = f"repeats {' and '.join(parts)}, so shifts are known only up to whole periods" if parts else ""
        if self.lines is not None:
            none = f"has lines {_direction(self.lines)}, and no shift along them can be measured"
            text = f"{text}; it {none}" if text else none
        return text

    def reach(self, d: Float[np.ndarray, "pixel 2"]) -> Float[np.ndarray, " pixel"]:
        """Return the largest part of a period that each displacement d (px) covers; from 1/2 on it is ambiguous."""
        return np.max([np.abs(d @ p) / (p @ p) for p in self.periods] or [np.zeros(len(d))], axis=0)


def repetition(image: Shaped[np.ndarray, "row column"]) -> Repetition | None:
    """Return the repetition of a background, or None."""
    for binning in BINNINGS:
        small = binned(image, binning)
        least, most = WINDOW
        if min(small.shape) < least:
            return None
        edge = min(most, max(least, min(small.shape) // 2))
        results = [_of_window(window) for window in _windows(small, edge)]
        for lines in (True, False):
            matches = [r for r in results if r is not None and (r.lines is not None) == lines]
            if len(matches) >= max(2, MAJORITY * len(results)) and (common := _median(matches, binning)):
                return common
    return None


def _windows(image: np.ndarray, edge: int) -> Iterator[np.ndarray]:
    rows, columns = (
        np.linspace(0, n - edge, min(GRID, 1 + 2 * (n - edge) // edge)).astype(int).tolist() for n in image.shape
    )
    for row in rows:
        for column in columns:
            yield image[row : row + edge, column : column + edge]


def _of_window(window: np.ndarray) -> Repetition | None:
    """The repetition of a window by its autocorrelation."""
    from scipy.ndimage import map_coordinates, maximum_filter

    surface, (row, column) = _autocorrelation(window)
    if not surface.size:
        return None
    reach = int(REACH * min(window.shape))
    radii = np.arange(reach)
    angles = np.deg2rad(np.arange(0, 180, 1.0))
    y, x = (part[:, None] * radii for part in (np.sin(angles), np.cos(angles)))
    rays = map_coordinates(surface, [row + y, column + x], order=1)
    along = int(rays.min(axis=1).argmax())
    if rays[along].min() > HEIGHT:
        direction = np.array([np.cos(angles[along]), np.sin(angles[along])])
        profile = rays[(along + 90) % 180]
        inner = profile[1:-1]
        peaks = 1 + np.flatnonzero((inner > profile[:-2]) & (inner >= profile[2:]) & (inner > HEIGHT))
        across = np.array([-direction[1], direction[0]])
        return Repetition(tuple(across * (k + parabola(*profile[k - 1 : k + 2])[0]) for k in peaks[:1]), direction)
    maxima: list[tuple[np.ndarray, float]] = []  # shift and height
    for r, c in np.argwhere((surface == maximum_filter(surface, 3)) & (surface > HEIGHT)):
        if 0 < r < len(surface) - 1 and 0 < c < surface.shape[1] - 1:
            (x, left), (y, up) = parabola(*surface[r, c - 1 : c + 2]), parabola(*surface[r - 1 : r + 2, c])
            shift = np.array([c + x - column, r + y - row])
            positive = shift[0] > 0.5 or (abs(shift[0]) <= 0.5 and shift[1] > 0)
            if positive and SHORTEST <= np.linalg.norm(shift) <= reach:
                maxima.append((shift, left + up - surface[r, c]))
    least = NEARLY * max((height for _, height in maxima), default=0.0)
    shifts = sorted((shift for shift, height in maxima if height > least), key=np.linalg.norm)
    if not shifts:
        return None
    return Repetition((shifts[0], *[s for s in shifts if _angle(s, shifts[0]) > DISTINCT][:1]))


def _autocorrelation(window: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """Autocorrelation at shifts up to half the window, and the position of its origin; empty without contrast."""
    from scipy import fft
    from scipy.ndimage import gaussian_filter

    y, x = (np.ravel(v) for v in np.mgrid[[slice(-1, 1, n * 1j) for n in window.shape]])
    light = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)  # which a filter distorts at the edges
    detail = window - (light @ np.linalg.lstsq(light, window.ravel(), rcond=None)[0]).reshape(window.shape)
    detail -= gaussian_filter(detail, min(window.shape) / COARSE, mode="nearest")
    detail -= detail.mean()
    shape = tuple(2 * n for n in window.shape)

    def squared(image: np.ndarray) -> np.ndarray:
        return np.asarray(fft.irfft2(np.abs(fft.rfft2(image, s=shape)) ** 2, s=shape))

    total, count = squared(detail.astype(np.float64)), squared(np.ones(window.shape))
    if not total[0, 0] > 0:
        return np.empty((0, 0)), (0, 0)
    surface = fft.fftshift(total / np.maximum(count, 1) * (count[0, 0] / total[0, 0]))
    (height, width), (row, column) = window.shape, (n // 2 for n in window.shape)
    return surface[height - row : height + row + 1, width - column : width + column + 1], (row, column)


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two directions, 0 to 90 degrees."""
    cosine = abs(a @ b) / (np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.degrees(np.arccos(min(cosine, 1.0))))


def _median(results: Sequence[Repetition], binning: int) -> Repetition | None:
    """Median of the repetitions of windows, with as many periods as most have; None if they differ."""
    lines = None if results[0].lines is None else _mean_direction([r.lines for r in results if r.lines is not None])
    count = int(np.median([len(r.periods) for r in results]))
    periods: list[np.ndarray] = []
    for k in range(count):
        candidates = [r.periods[j] for r in results for j in range(len(r.periods)) if j < count]
        first = periods[0] if periods else results[0].periods[0]
        close = [p for p in candidates if (_angle(p, first) <= DISTINCT) == (k == 0)]
        if len(close) < MAJORITY * len(results):
            return None if k == 0 and lines is None else Repetition(tuple(p * binning for p in periods), lines)
        lengths = np.array([np.linalg.norm(p) for p in close])
        if np.median(np.abs(lengths / np.median(lengths) - 1)) > SPREAD:
            return None
        periods.append(_mean_direction(close) * float(np.median(lengths)))
    if not periods and lines is None:
        return None
    periods.sort(key=lambda p: abs(p[1]) / np.linalg.norm(p))
    return Repetition(tuple(p * binning for p in periods), lines)


def _mean_direction(vectors: Sequence[np.ndarray]) -> np.ndarray:
    """Mean of directions, whose signs have no meaning, as a unit vector."""
    units = np.array([v / np.linalg.norm(v) for v in vectors])
    _, axes = np.linalg.eigh(units.T @ units)
    axis = axes[:, -1]
    return axis if axis[0] > 1e-6 or (abs(axis[0]) <= 1e-6 and axis[1] > 0) else -axis


def _direction(vector: np.ndarray) -> str:
    angle = float(np.degrees(np.arctan2(vector[1], vector[0]))) % 180
    if min(angle, 180 - angle) < ALONG:
        return "along x"
    return "along y" if abs(angle - 90) < ALONG else f"at {angle:.0f}° from x towards y"
