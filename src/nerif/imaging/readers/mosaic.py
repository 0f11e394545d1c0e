"""Recognise raw images of colour cameras by the mosaic of their colour filters (Bayer pattern).

The filters multiply the light S by a factor for each place in a cell of 2 x 2 px,

    I(r, c) = S(r, c) (1 + a (-1)^r + b (-1)^c + d (-1)^(r + c)),

so that the spectrum of the image has peaks exactly at the highest frequencies, of heights a, b, d relative to the mean.
They are the same in all parts of the image, and exceed the spectrum around them, unlike those of regular patterns of
dots or squares. Two filters on a diagonal of the cell are green and equal: a = b or a = -b, unlike sensors with an
offset between even and odd rows (a alone) or columns (b alone).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Shaped

__all__ = ["PATTERNS", "bayer_pattern", "phase_means"]

PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
"""Colours of the first two pixels of the first two rows."""

TILE = 32  # px, parts of the image that are compared
MIN_TILES = 4
MIN_SPREAD = 0.04  # between the filters, relative to the mean: a weaker mosaic has little effect on displacements
EQUAL = 0.15  # of the spread, largest difference of the two greens
MIN_SHARE = 0.8  # of the tiles, which agree with their mean, by their squared brightness
PART = 512  # px, part of the image whose spectrum is examined
REACH = 0.75  # of the highest frequency, distance from the peak within which
MIN_PEAK = 2.0  # its power exceeds all other power by this ratio
LOBE = 3  # bins that a peak is wide

WAVES = np.array([[1, 1, 1, 1], [1, 1, -1, -1], [1, -1, 1, -1], [1, -1, -1, 1]], dtype=np.float32)
"""The terms 1, (-1)^r, (-1)^c, (-1)^(r + c) at the places (0, 0), (0, 1), (1, 0), (1, 1) of a cell."""


def phase_means(image: Shaped[np.ndarray, "row column"]) -> tuple[float, ...]:
    """Return the mean grey value at the places (0, 0), (0, 1), (1, 0), (1, 1) of the cells; 0 where there are none."""
    places = (image[r::2, c::2] for r in (0, 1) for c in (0, 1))
    return tuple(float(place.mean()) if place.size else 0.0 for place in places)


def bayer_pattern(image: Shaped[np.ndarray, "row column"]) -> str:
    """Return the possible patterns of a raw mosaic, such as "RGGB or BGGR": red and blue cannot be distinguished.

    The result is empty for other images, and for those of less than four tiles of 32 px.
    """
    places = _places_of_tiles(image)
    if len(places) < MIN_TILES:
        return ""
    brightness, *waves = WAVES @ places.T
    power = float(brightness @ brightness)
    if not power > 0:
        return ""
    heights = np.stack(waves, axis=-1)  # a, b, d of each tile, times its brightness
    mean = brightness @ heights / power
    first, second, third, fourth = (float(x) for x in WAVES.T @ [1.0, *mean])
    spread = max(first, second, third, fourth) - min(first, second, third, fourth)
    differences = abs(first - fourth), abs(second - third)
    if spread < MIN_SPREAD or min(differences) > EQUAL * spread:
        return ""
    agreeing = heights @ mean > 0.5 * (mean @ mean) * brightness
    if np.square(brightness[agreeing]).sum() < MIN_SHARE * power or not _has_peak(image, int(np.abs(mean).argmax())):
        return ""
    # where red and blue are equal as well, the brighter diagonal is green
    on_first = first + fourth > second + third if max(differences) < EQUAL * spread else differences[0] < differences[1]
    return "GRBG or GBRG" if on_first else "RGGB or BGGR"


def _window(n: int) -> Float[np.ndarray, " n"]:
    """Weights with smooth edges, symmetric, so that a gradient of brightness has no effect."""
    return (0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(n) + 0.5) / n)).astype(np.float32)


def _places_of_tiles(image: np.ndarray) -> Float[np.ndarray, "tile 4"]:
    """Weighted mean at each place of the cells, in each tile of an image."""
    rows, columns = (n // TILE for n in image.shape)
    tiles = image[: rows * TILE, : columns * TILE].reshape(rows, TILE // 2, 2, columns, TILE // 2, 2)
    window = _window(TILE).reshape(TILE // 2, 2)
    return np.einsum("yrpxcq,rp,cq->yxpq", tiles, window, window, optimize=True).reshape(-1, 4) / TILE**2


def _has_peak(image: np.ndarray, wave: int) -> bool:
    """Whether the spectrum has its largest peak within REACH at the highest frequency of a (0), b (1) or d (2)."""
    from scipy.fft import rfft2

    height, width = (min(n, PART) // 2 * 2 for n in image.shape)
    top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
    part = image[top : top + height, left : left + width] * (_window(height)[:, None] * _window(width))
    power = np.square(np.abs(rfft2(part)))
    row, column = 0 if wave == 1 else height // 2, 0 if wave == 0 else width // 2
    around = _within(REACH * height / 2, height, row)[:, None] & _within(REACH * width / 2, width, column)
    own_rows, own_columns = (_within(LOBE, n, 0) | _within(LOBE, n, n // 2) for n in (height, width))
    around &= ~(own_rows[:, None] & own_columns)  # the mean, and the other two peaks
    half = width // 2 + 1  # the rest of the spectrum mirrors it
    return bool(power[row, column] > MIN_PEAK * power[around[:, :half]].max())


def _within(reach: float, n: int, centre: int) -> Bool[np.ndarray, " n"]:
    """Whether frequencies 0 to n - 1, which are periodic, are within `reach` of one of them."""
    distance = np.abs(np.arange(n) - centre)
    return np.minimum(distance, n - distance) <= reach
