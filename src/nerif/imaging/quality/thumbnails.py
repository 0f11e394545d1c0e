"""Binned images, to compare many images at little cost: correlation, shift of the camera, local displacement."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float, Shaped

from nerif.common.blocks import blocks
from nerif.common.conventions import InputError
from nerif.imaging.noise import local_correlation
from nerif.imaging.readers.frames import as_float
from nerif.imaging.readers.views import View, read_sample
from nerif.imaging.shake import remove_shake

__all__ = [
    "Thumbnail", "binned", "common_shift", "local_displacement", "match", "parabola", "related", "shifted",
    "thumbnails",
]  # fmt: skip

LONGEST = 256  # px of the longer side
COARSE = 6.0  # px, standard deviation of the mean that is subtracted: vignettes and lamps are alike in all scenes
FINE = 1.0  # px, standard deviation of the mean that follows binning: finer structures are undersampled
EVEN = 0.5  # of the median variance is added to the local one, so that parts without a pattern stay weak
CLIP = 4.0  # standard deviations; an edge or a reflection does not outweigh the pattern
TILE = 16  # px
MIN_PIXELS = 10_000  # of an image; in smaller ones, half hidden and noisy, one scene correlates no more than chance
HIGH = 0.3  # correlation that no two scenes have
SHIFTED = 4.0  # px, shortest shift of a whole image that is looked for before displacements
LARGE = 0.2  # share of the image that has to move as a whole
SIGNIFICANT = 8.0  # standard deviations over all shifts; the highest peak of two scenes has five


@dataclass(frozen=True)
class Thumbnail:
    """An image binned to 256 px or less."""

    detail: Float[np.ndarray, "row column"]
    """Grey values minus their local mean, in local standard deviations; 0 in an image of a single grey."""
    spectrum: Complex[np.ndarray, "row frequency"]
    """Fourier transform of the detail under a window that fades towards the edges, of norm 1."""
    binning: int  #: pixels of the image per pixel of the thumbnail
    grey: float  #: mean of the grey values

    @classmethod
    def of(cls, image: Shaped[np.ndarray, "row column"]) -> Thumbnail:
        """Return the thumbnail of an image."""
        from scipy.ndimage import gaussian_filter

        binning = -(-max(image.shape) // LONGEST)
        small = binned(image, binning)
        fine = gaussian_filter(small, FINE, mode="nearest") if binning > 1 else small
        detail = fine - gaussian_filter(small, COARSE, mode="nearest")
        local = gaussian_filter(detail**2, COARSE, mode="nearest")
        deviation = np.sqrt(local + EVEN * np.median(local) + 1e-12)
        detail = np.clip(detail / deviation, -CLIP, CLIP)
        return cls._with_spectrum(detail, binning, float(image.mean()))

    @classmethod
    def median(cls, thumbnails: Sequence[Thumbnail]) -> Thumbnail:
        """Return the median image."""
        detail = np.median([t.detail for t in thumbnails], axis=0)
        return cls._with_spectrum(detail, thumbnails[0].binning, float(np.median([t.grey for t in thumbnails])))

    @classmethod
    def _with_spectrum(cls, detail: np.ndarray, binning: int, grey: float) -> Thumbnail:
        from scipy import fft

        rows, columns = detail.shape
        window = np.hanning(rows + 2)[1:-1, None] * np.hanning(columns + 2)[1:-1]
        faded = (detail - detail.mean()) * window
        norm = float(np.linalg.norm(faded))
        spectrum = fft.rfft2((faded / norm if norm else faded).astype(np.float32))
        return cls(detail.astype(np.float32), spectrum, binning, grey)


def thumbnails(view: View, source: str, most: int, shape: tuple[int, ...]) -> Iterator[Thumbnail]:
    """Yield the thumbnails of up to `most` images of a source, those that can be read and have this shape."""
    with suppress(InputError):  # no such images, reported elsewhere
        for _, _, image in read_sample(view, source, most):
            if not isinstance(image, InputError) and image.shape == shape:
                yield Thumbnail.of(image)


def binned(image: Shaped[np.ndarray, "row column"], binning: int) -> Float[np.ndarray, "rows columns"]:
    """Return the mean over squares of `binning` px; incomplete ones at the edges are dropped."""
    return as_float(blocks(image, binning, binning)).mean(axis=(1, 3))


def match(first: Thumbnail, second: Thumbnail) -> tuple[float, Float[np.ndarray, " 2"]]:
    """Return the highest correlation of two images over all shifts, and the shift (x, y) of the second, px."""
    surface = _correlation(first, second).astype(np.float64)
    shape = surface.shape
    row, column = np.unravel_index(surface.argmax(), shape)
    peak = float(surface[row, column])

    y = row + parabola(surface[row - 1, column], peak, surface[(row + 1) % shape[0], column])[0]
    x = column + parabola(surface[row, column - 1], peak, surface[row, (column + 1) % shape[1]])[0]
    wrapped = [(v + n / 2) % n - n / 2 for v, n in ((x, shape[1]), (y, shape[0]))]
    return peak, np.array(wrapped) * first.binning


def common_shift(first: Thumbnail, second: Thumbnail) -> Float[np.ndarray, " 2"]:
    """Return the shift (x, y) of the second image as a whole, px; 0 if short, or if more correlates without a shift."""
    shift = match(first, second)[1]
    if np.linalg.norm(shift) < SHIFTED:
        return np.zeros(2)
    still, moved = (
        float(np.mean(local_correlation(shifted(first, s), second.detail, TILE / 2) > HIGH)) for s in (0 * shift, shift)
    )
    return shift if moved > max(still, LARGE) else np.zeros(2)


def parabola(before: float, top: float, after: float) -> tuple[float, float]:
    """Return position from the middle and height of the peak of the parabola through three points."""
    curvature = before - 2 * top + after
    position = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    return position, top - 0.25 * (before - after) * position


def related(first: Thumbnail, second: Thumbnail) -> bool:
    """Return whether two images correlate at any shift by more than chance; small images count as related."""
    if first.detail.shape != second.detail.shape:
        return False
    if first.detail.size < MIN_PIXELS:
        return True
    surface = _correlation(first, second)
    peak, chance = float(surface.max()), float(surface.std())
    return peak > HIGH or peak > SIGNIFICANT * chance > 0


def _correlation(first: Thumbnail, second: Thumbnail) -> Float[np.ndarray, "row column"]:
    """Correlation by the shift of the second image."""
    from scipy import fft

    return np.asarray(fft.irfft2(np.conj(first.spectrum) * second.spectrum, s=first.detail.shape))


def shifted(thumbnail: Thumbnail, shift: Float[np.ndarray, " 2"]) -> Float[np.ndarray, "row column"]:
    """Return the detail of a thumbnail, shifted by (x, y) px of the image."""
    from scipy.ndimage import shift as moved

    return np.asarray(moved(thumbnail.detail, shift[::-1] / thumbnail.binning, order=3, mode="nearest"))


def local_displacement(
    a: Float[np.ndarray, "row column"], b: Float[np.ndarray, "row column"]
) -> Float[np.ndarray, "tile 2"]:
    """Return the displacement (x, y) of squares of 16 px from detail a to detail b, px of these, by a linear fit.

    Subtracted is the similarity (shift, rotation, zoom) that fits the squares best: the movement of the camera.
    """
    gy, gx = np.gradient(a)
    difference = a - b

    def total(product: np.ndarray) -> np.ndarray:
        return binned(product, TILE).astype(np.float64)

    xx, yy, xy, xd, yd = map(total, (gx * gx, gy * gy, gx * gy, gx * difference, gy * difference))
    ridge = 0.05 * float(np.mean(xx + yy)) + 1e-12  # squares without pattern have no displacement
    xx, yy = xx + ridge, yy + ridge
    determinant = xx * yy - xy**2
    d = np.stack([(yy * xd - xy * yd) / determinant, (xx * yd - xy * xd) / determinant], axis=-1)
    return remove_shake(d, np.ones(d.shape[:2], dtype=bool)).reshape(-1, 2)
