"""Flow images with their reference and the noise of the camera: what a reconstruction straight from images takes.

    var(grey) = read^2 + grey / e,      e electrons a grey value

Two or more reference images tell both; of a single one what is left of the flow image tells it, once the reference
is moved and made as bright, the error of the displacement included.

Between pixels a reference is known by interpolation, which sharp dots of few pixels defeat: the more, the steeper the
pattern and the farther from a whole pixel the shift f is. What is left of the flow image tells by how much:

    sigma^2 = <var(flow) + var(reference) + a^2 |f|^2 |grad(reference)|^2>

The mean is over the dots around a pixel. A weight that differed from dot to paper would choose among pixels by what
they measured: displacements came out 5 to 14 % too small (rendered dots of 3 px, 0.02 to 0.3 px).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Shaped

from nerif.forward.images import ROUNDING_VARIANCE, difference_variance, grey_variance, local_mean
from nerif.imaging.displacement.warping import warp
from nerif.imaging.readers.frames import as_float

__all__ = ["CameraNoise", "ImagePair"]

Grey = Shaped[np.ndarray, "row column"]
Image = Float[np.ndarray, "row column"]

CLASSES = 16  # of brightness
FEWEST = 32  # pixels of one
GAUSSIAN = 0.4549  # the median of the square of a standard normal variable
TRIMMED = 0.99  # share of the pixels, those with the least residual, that tell a


@dataclass(frozen=True)
class CameraNoise:
    """Noise of a camera.

    Parameters
    ----------
    read : variance without light, grey values squared
    shot : variance that a grey value adds, grey values
    """

    read: float
    shot: float

    @classmethod
    def of_repeats(cls, images: Sequence[np.ndarray], mean: Grey, count: int) -> CameraNoise:
        """Return the noise by the variance of images of one thing, each as bright as a mean that they are part of.

        An image of variance s^2 differs from the mean of `count` by s^2 (1 - 1/count).
        """
        squares, level = np.zeros(mean.shape), float(mean.mean())
        for image in images:
            grey = np.asarray(image, dtype=np.float64)
            squares += (grey * (level / max(float(grey.mean()), 1e-9)) - mean) ** 2
        return cls._fitted(mean, squares / (len(images) * (count - 1) / count), 1.0)

    @classmethod
    def of_residual(cls, flow: Grey, predicted: Grey, good: Bool[np.ndarray, "row column"]) -> CameraNoise:
        """Return the noise by what is left of a flow image, half of it the reference's."""
        left = as_float(flow) - as_float(predicted)
        return cls._fitted(flow[good], left[good].astype(np.float64) ** 2 / 2, GAUSSIAN)

    @classmethod
    def _fitted(cls, grey: np.ndarray, squares: np.ndarray, median: float) -> CameraNoise:
        """The line through the variances of classes of brightness; of residuals by medians, which outliers leave."""
        from scipy.optimize import nnls

        grey, squares = grey.ravel().astype(np.float64), squares.ravel()
        order = np.argsort(grey)
        classes = [part for part in np.array_split(order, min(CLASSES, max(len(order) // FEWEST, 1))) if len(part)]
        at = np.array([max(grey[part].mean(), 0.0) for part in classes])
        of_class = np.mean if median == 1.0 else lambda x: np.median(x) / median
        variance = np.array([of_class(squares[part]) for part in classes])
        weight = 1 / np.maximum(variance, ROUNDING_VARIANCE)  # the error of a variance is a share of it
        found, _ = nnls(np.stack([weight, weight * at], axis=1), weight * variance)
        return cls(max(float(found[0]), ROUNDING_VARIANCE), float(found[1]))

    def variance(self, grey: Image) -> Image:
        """Return the variance of grey values."""
        return grey_variance(grey, self.read, self.shot)


@dataclass(frozen=True)
class ImagePair:
    """The images of a view without and with flow.

    Parameters
    ----------
    reference : grey values, the mean of all images without flow, moved as the camera shook
    flow : grey values; NaN where the sensor was full or the background is not seen
    sigma : standard deviation of the difference between the flow image and the reference, moved, grey values
    """

    reference: Image
    flow: Image
    sigma: Image

    @classmethod
    def of(
        cls,
        reference: Grey,
        flow: Grey,
        d: Float[np.ndarray, "row column 2"],
        noise: CameraNoise | None,
        repeats: int,
        usable: Bool[np.ndarray, "row column"],
        valid: Bool[np.ndarray, "row column"],
    ) -> ImagePair:
        """Return the pair.

        Parameters
        ----------
        d : displacement, px
        noise : of the camera, or None where what is left has to tell it
        repeats : images that the reference is the mean of
        usable : pixels of the flow image that were exposed well and see the background
        valid : pixels where d holds
        """
        reference, flow = as_float(reference), as_float(flow)
        moved, good = warp(reference, -d), valid & usable if bool((valid & usable).any()) else usable
        gain, offset = np.polyfit(moved[good], flow[good], 1)
        left = flow - (gain * moved + offset)
        noise = noise or CameraNoise.of_residual(flow, flow - left, good)
        variance = difference_variance(flow, reference, noise.read, noise.shot, gain, repeats)
        variance += _of_interpolation(gain * moved, left, d, variance, good)
        seen = np.where(usable, flow, np.nan)
        return cls(reference.astype(np.float32), seen.astype(np.float32), np.sqrt(variance).astype(np.float32))


def _of_interpolation(
    moved: Image, left: Image, d: Float[np.ndarray, "row column 2"], variance: Image,
    good: Bool[np.ndarray, "row column"],
) -> Image:  # fmt: skip
    """What interpolation between the pixels of the reference adds to the variance of what is left."""
    steep = np.square(np.gradient(moved.astype(np.float64))).sum(axis=0)
    share = local_mean(np.square(d - np.round(d)).sum(axis=-1) * steep)
    squares, shares = left[good].astype(np.float64) ** 2, share[good]
    few = squares <= np.quantile(squares, TRIMMED)
    found = float((squares - variance[good])[few].sum() / max(shares[few].sum(), 1e-12))
    return np.asarray(max(found, 0.0) * share)
