"""Image pairs and camera noise: the data of a reconstruction directly from images.

    var(grey) = read^2 + grey / e,      e electrons per grey value

Both constants follow from two or more reference images; with a single one they follow from the residual of the flow
image after warping and scaling the reference, which includes the error of the displacement.

Interpolation between the pixels of a reference is inaccurate for sharp dots of few pixels, with an error that grows
with the gradient of the pattern and the distance f of the shift from whole pixels. The residual determines its size a:

    sigma^2 = <var(flow) + var(reference) + a^2 |f|^2 |grad(reference)|^2>

The mean is over the dots around a pixel. A weight that differed from dot to paper would select pixels by their measured
values: displacements came out 5 to 14 % too small (rendered dots of 3 px, 0.02 to 0.3 px).
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
PixelMask = Bool[np.ndarray, "row column"]

BRIGHTNESS_CLASSES = 16
MIN_PIXELS = 32  # of a class
MEDIAN_OF_SQUARE = 0.4549  # of a standard normal variable
TRIMMED = 0.99  # share of the pixels, those with the least residual, that determine a


@dataclass(frozen=True)
class CameraNoise:
    """Noise of a camera."""

    read: float  #: variance without light, grey values squared
    shot: float  #: variance per grey value, grey values

    @classmethod
    def of_repeats(cls, images: Sequence[np.ndarray], mean: Grey, count: int) -> CameraNoise:
        """Return the noise by the variance of repeats, scaled to the brightness of their mean.

        An image of variance s^2 differs from the mean of `count` by s^2 (1 - 1/count).
        """
        squares, level = np.zeros(mean.shape), float(mean.mean())
        for image in images:
            grey = np.asarray(image, dtype=np.float64)
            squares += (grey * (level / max(float(grey.mean()), 1e-9)) - mean) ** 2
        return cls._fit(mean, squares / (len(images) * (count - 1) / count), 1.0)

    @classmethod
    def of_residual(cls, flow: Grey, predicted: Grey, good: PixelMask) -> CameraNoise:
        """Return the noise by the residual of a flow image, half of which is the reference's."""
        residual = as_float(flow) - as_float(predicted)
        return cls._fit(flow[good], residual[good].astype(np.float64) ** 2 / 2, MEDIAN_OF_SQUARE)

    @classmethod
    def _fit(cls, grey: np.ndarray, squares: np.ndarray, median: float) -> CameraNoise:
        """Fit the line through the variances of brightness classes: means, or medians, robust to outliers."""
        from scipy.optimize import nnls

        grey, squares = grey.ravel().astype(np.float64), squares.ravel()
        order = np.argsort(grey)
        parts = np.array_split(order, min(BRIGHTNESS_CLASSES, max(len(order) // MIN_PIXELS, 1)))
        classes = [part for part in parts if len(part)]
        level = np.array([max(grey[part].mean(), 0.0) for part in classes])
        of_class = np.mean if median == 1.0 else lambda x: np.median(x) / median
        variance = np.array([of_class(squares[part]) for part in classes])
        weight = 1 / np.maximum(variance, ROUNDING_VARIANCE)  # the error of a variance is proportional to it
        (read, shot), _ = nnls(np.stack([weight, weight * level], axis=1), weight * variance)
        return cls(max(float(read), ROUNDING_VARIANCE), float(shot))

    def variance(self, grey: Image) -> Image:
        """Return the variance of grey values."""
        return grey_variance(grey, self.read, self.shot)


@dataclass(frozen=True)
class ImagePair:
    """The images of a view without and with flow."""

    reference: Image  #: grey values, mean of all images without flow, warped by the shake of the camera
    flow: Image  #: grey values; NaN where saturated or without background
    sigma: Image  #: standard deviation of the difference between the flow image and the warped reference, grey values

    @classmethod
    def of(
        cls, reference: Grey, flow: Grey, d: Float[np.ndarray, "row column 2"], noise: CameraNoise | None, repeats: int,
        usable: PixelMask, valid: PixelMask,
    ) -> ImagePair:  # fmt: skip
        """Return the pair with its noise.

        Parameters
        ----------
        d : displacement, px
        noise : of the camera; None: from the residual
        repeats : number of images averaged in the reference
        usable : pixels of the flow image that are well exposed and show the background
        valid : pixels with a valid d
        """
        reference, flow = as_float(reference), as_float(flow)
        prediction, good = warp(reference, -d), valid & usable if bool((valid & usable).any()) else usable
        gain, offset = np.polyfit(prediction[good], flow[good], 1)
        residual = flow - (gain * prediction + offset)
        noise = noise or CameraNoise.of_residual(flow, flow - residual, good)
        variance = difference_variance(flow, reference, noise.read, noise.shot, gain, repeats)
        variance += _interpolation_variance(gain * prediction, residual, d, variance, good)
        flow = np.where(usable, flow, np.nan)
        return cls(reference.astype(np.float32), flow.astype(np.float32), np.sqrt(variance).astype(np.float32))


def _interpolation_variance(
    prediction: Image, residual: Image, d: Float[np.ndarray, "row column 2"], variance: Image, good: PixelMask
) -> Image:
    """Variance of the residual caused by interpolation between the pixels of the reference."""
    steep = np.square(np.gradient(prediction.astype(np.float64))).sum(axis=0)
    share = local_mean(np.square(d - np.round(d)).sum(axis=-1) * steep)
    squares, shares = residual[good].astype(np.float64) ** 2, share[good]
    small = squares <= np.quantile(squares, TRIMMED)
    factor = float((squares - variance[good])[small].sum() / max(shares[small].sum(), 1e-12))
    return np.asarray(max(factor, 0.0) * share)
