"""Displacement d(p) = p - p0(p) on the flow image, with its noise and validity.

    flow(p) = reference(p - d(p)),     d = -(optical flow from the flow image to the reference)

The pattern determines a shift with cov = <r^2> (sum grad(I) grad(I)^T)^-1: r is the residual between the flow image and
the warped reference, the sum is over a Gaussian window of the method's reach. The noise of d is derived from cov or,
with three or more reference frames, from the scatter of flow-off repeats plus the excess of cov with flow over cov
without: repeats contain the noise of the camera, but not the error where the flow is too sharp for the method. The
smoothing error of a window of that reach, applied to d, is added to both.

Where pixels move far, d is measured from the reference to the flow image as well, and the difference is added.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Shaped

from nerif.common.conventions import InputError
from nerif.imaging.displacement.optical_flow import FLOWS
from nerif.imaging.displacement.photometry import CameraNoise, ImagePair
from nerif.imaging.displacement.warping import warp
from nerif.imaging.imaging_settings import DisplacementSettings
from nerif.imaging.noise import FLOOR, local_correlation, smoothing_error, structure_variance
from nerif.imaging.quality.thumbnails import Thumbnail, common_shift
from nerif.imaging.readers.exposure import saturated
from nerif.imaging.readers.frames import as_float
from nerif.imaging.shake import border, remove_shake

__all__ = [
    "OVEREXPOSED", "DisplacementMap", "Reference", "displacement", "measure",
]  # fmt: skip

Grey = Shaped[np.ndarray, "row column"]
Image = Float[np.ndarray, "row column"]
Vectors = Float[np.ndarray, "row column 2"]
PixelMask = Bool[np.ndarray, "row column"]

OVEREXPOSED, UNEVEN = "over-exposed", "displaced too unevenly"  # causes of loss
FAR = 5.0  # px beyond the shift of the whole image; from here on d is measured in both directions
MAX_REPEATS = 12  # reference frames that are compared with the mean of the others,
MEGAPIXEL = 2**20  # in images up to this number of pixels


@dataclass(frozen=True)
class DisplacementMap:
    """Displacement of one view."""

    displacement: Vectors  #: d, px
    sigma: Vectors  #: standard deviation of its noise, px
    valid: PixelMask
    noise_source: str  #: "repeats" (of the reference, and residual) or "structure tensor"
    pair: ImagePair | None = None  #: the images; None for the mean of several
    losses: Mapping[str, float] = field(default_factory=dict)
    """Shares of the region's pixels that are not valid, by cause, the largest first."""
    shift: tuple[int, int] = (0, 0)  #: of the whole image (u, v) between reference and flow, px; 0 below 4 px

    @property
    def loss_text(self) -> str:
        """The losses in words, such as "52 % uncorrelated, 9 % over-exposed"."""
        return ", ".join(f"{100 * share:.0f} % {cause}" for cause, share in self.losses.items() if share >= 0.005)


def displacement(reference: Grey, flow: Grey, settings: DisplacementSettings) -> Vectors:
    """Return d (px) of one flow image against one reference, both of any scale and type."""
    return _displacement_and_shift(reference, flow, settings)[0]


def _displacement_and_shift(
    reference: Grey, flow: Grey, settings: DisplacementSettings
) -> tuple[Vectors, tuple[int, int]]:
    """The displacement, and the shift (u, v) of the whole image from which it was measured on, px."""
    if reference.shape != flow.shape or min(flow.shape) < 16:
        raise InputError(
            f"expected reference and flow of one size, at least 16 px, got {reference.shape} and {flow.shape}",
            field="images",
        )
    first, second = _equalised(as_float(flow), as_float(reference), settings.local_contrast)
    u, v = common_shift(Thumbnail.of(second), Thumbnail.of(first)).round().astype(int).tolist()
    if u or v:
        rows, columns = (np.clip(np.arange(n) - s, 0, n - 1) for n, s in zip(second.shape, (v, u), strict=True))
        second = second[np.ix_(rows, columns)]
    movement = FLOWS[settings.method](first, second, settings.smoothness)
    return ((u, v) - movement).astype(np.float32), (u, v)


@dataclass(frozen=True)
class Reference:
    """Evaluation of the reference frames of a view, common to all its flow frames."""

    mean: Image  #: of the frames
    settings: DisplacementSettings
    overexposed: PixelMask  #: pixels saturated in any of them
    full_scale: float  #: grey value of a saturated pixel; infinite if unknown
    averages: int  #: number of flow frames whose displacements are averaged
    noise: tuple[Vectors, Vectors] | None
    """Scatter of d between repeats, and by the structure tensor, px; None with fewer than three frames."""
    count: int = 1  #: number of frames
    camera_noise: CameraNoise | None = None  #: noise of the grey values; None with fewer than two frames

    @classmethod
    def of(
        cls, frames: Sequence[np.ndarray], settings: DisplacementSettings, full_scale: float = np.inf, averages: int = 1
    ) -> Reference:
        """Average the frames, and derive the noise from their differences; frames are read as needed."""
        count = len(frames)
        if not count:
            raise InputError("expected at least one reference image, got none", field="images")
        total, overexposed = np.zeros(frames[0].shape), np.zeros(frames[0].shape, dtype=bool)
        for image in frames:
            total += image
            overexposed |= saturated(image, full_scale)
        noise = _repeat_sigma(frames, total, averages, settings) if count >= 3 else None
        mean = total / count
        camera_noise = CameraNoise.of_repeats(frames[:MAX_REPEATS], mean, count) if count >= 2 else None
        return cls(mean.astype(np.float32), settings, overexposed, full_scale, averages, noise, count, camera_noise)

    def measure(
        self, flow: Sequence[np.ndarray], region: PixelMask | None = None, keep_images: bool = True
    ) -> DisplacementMap:
        """Return displacement, noise and validity, averaged over flow frames, and the image pair of a single one.

        `region` is where the background is visible.
        """
        from scipy.ndimage import binary_dilation

        settings, reach = self.settings, self.settings.reach
        overexposed = self.overexposed.copy()
        shake, shift = np.zeros(1), (0, 0)

        def maps(image: np.ndarray) -> tuple[np.ndarray, ...]:
            nonlocal overexposed, shake, shift
            grey = np.asarray(image, dtype=np.float32)
            total, shift = _displacement_and_shift(self.mean, grey, settings)
            overexposed |= saturated(image, self.full_scale)
            pair = _equalised(grey, warp(self.mean, -total), 0)
            agreement = local_correlation(*pair, max(3.0, reach))
            d = _without_shake(total, settings, _shown(total) & (agreement >= settings.min_correlation))
            shake = total - d
            difference = self._difference(grey, total, shift, agreement)
            return d, total, agreement, structure_variance(*pair, reach), difference

        d, total, agreement, variance, difference = _means(map(maps, flow))
        sigma, source = np.sqrt(variance / len(flow)) + FLOOR, "structure tensor"
        if self.noise is not None:
            scatter, without_flow = self.noise
            sigma, source = np.sqrt(scatter**2 + np.maximum(sigma**2 - without_flow**2, 0)), "repeats"
        sigma = np.sqrt(sigma**2 + smoothing_error(d, reach) ** 2 + difference / 2).astype(np.float32)
        inside_reference = _shown(total)
        exposed = ~binary_dilation(overexposed, iterations=2)
        conditions = {
            OVEREXPOSED: exposed,
            "outside the reference": inside_reference,
            "uncorrelated": agreement >= settings.min_correlation,
            UNEVEN: difference.sum(-1) <= settings.max_sigma**2,
            f"with noise above {settings.max_sigma:g} px": sigma.max(-1) <= settings.max_sigma,
        }
        inside = np.ones(inside_reference.shape, dtype=bool) if region is None else region
        usable, valid, losses = inside & exposed, inside, {}
        for cause, condition in conditions.items():  # a pixel counts for the first cause
            losses[cause] = float((valid & ~condition).sum() / max(int(inside.sum()), 1))
            valid = valid & condition
        losses = dict(sorted(losses.items(), key=lambda item: -item[1]))
        pair = None
        if keep_images and len(flow) == 1 and bool(valid.any()):
            reference = self.mean
            if settings.shake_border:
                reference, usable = warp(reference, -shake), usable & _shown(shake, 1.0)
            grey = np.asarray(flow[0], dtype=np.float32)
            pair = ImagePair.of(reference, grey, d, self.camera_noise, self.count, usable, valid)
        return DisplacementMap(d, sigma, valid, source, pair, losses, shift)

    def _difference(self, flow: Image, d: Vectors, shift: tuple[int, int], agreement: Image) -> Vectors:
        """Local mean square of the difference of d from reference to flow image and back, px^2; 0 if none moves far."""
        from scipy.ndimage import gaussian_filter

        far = np.linalg.norm(d - np.array(shift), axis=-1) > FAR
        if not np.any(far & (agreement >= self.settings.min_correlation)):
            return np.zeros_like(d)
        back = displacement(flow, self.mean, self.settings)
        parts = [warp(back[..., k], -d) + d[..., k] for k in range(2)]
        return np.stack([gaussian_filter(part**2, self.settings.reach) for part in parts], axis=-1)


def measure(
    reference: Sequence[np.ndarray], flow: Sequence[np.ndarray], settings: DisplacementSettings,
    full_scale: float = np.inf, region: PixelMask | None = None,
) -> DisplacementMap:  # fmt: skip
    """Return displacement, noise and validity of a view.

    Parameters
    ----------
    reference : frames without flow; they are averaged
    flow : frames with flow; their displacements are averaged
    full_scale : grey value of a saturated pixel, infinite if unknown; saturated pixels are not valid
    region : where the background is visible, or None
    """
    if not len(reference) or not len(flow):
        raise InputError(
            f"expected at least one of each, got {len(reference)} reference, {len(flow)} flow", field="images"
        )
    return Reference.of(reference, settings, full_scale, len(flow)).measure(flow, region)


def _means(samples: Iterator[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, ...]:
    """Mean over the samples of each of their arrays."""
    sums, count = list(next(samples)), 1
    for sample in samples:
        sums, count = [a + b for a, b in zip(sums, sample, strict=True)], count + 1
    return tuple(a / count for a in sums)


def _shown(d: Vectors, margin: float = 0.0) -> PixelMask:
    """Whether the reference, extended by a margin (px), shows what a pixel of the flow image shows."""
    height, width = d.shape[:2]
    row, column = np.arange(height)[:, None] - d[..., 1], np.arange(width) - d[..., 0]
    inside = (row >= -margin) & (row <= height - 1 + margin) & (column >= -margin) & (column <= width - 1 + margin)
    return np.asarray(inside)


def _without_shake(d: Vectors, settings: DisplacementSettings, measured: PixelMask | bool = True) -> Vectors:
    return remove_shake(d, border(d.shape[:2], settings.shake_border) & measured) if settings.shake_border else d


def _equalised(flow: Image, reference: Image, window: int) -> tuple[Image, Image]:
    """Both images on one scale of 0 to 255, with equal brightness and contrast over windows, or the whole image."""
    from scipy.ndimage import gaussian_filter

    low, high = np.percentile(reference, (0.5, 99.5))
    if not high > low:
        raise InputError("expected an image of a pattern, got one of a single grey", field="reference")
    images = []
    for image in (flow, reference):
        if window:
            mean = gaussian_filter(image, window / 2)
            spread = np.sqrt(gaussian_filter((image - mean) ** 2, window / 2))
            even = (image - mean) / (spread + 0.05 * (high - low))
            images.append((127.5 + 50 * even).astype(np.float32))
        else:
            gain, offset = reference.std() / max(float(image.std()), 1e-6), reference.mean() - image.mean()
            even = (image - image.mean()) * gain + image.mean() + offset
            images.append((255 * (even - low) / (high - low)).astype(np.float32))
    return images[0], images[1]


def _repeat_sigma(
    frames: Sequence[np.ndarray], total: np.ndarray, averages: int, settings: DisplacementSettings
) -> tuple[Vectors, Vectors]:
    """Standard deviation of d between reference frames and the mean of the others: scatter, and by structure tensor.

    A repeat has the variance s^2 (1 + 1/(count - 1)) if one frame has s^2, the measurement s^2 (1/averages + 1/count).
    Of large images fewer repeats suffice, with their squares averaged over wider windows.
    """
    from scipy.ndimage import gaussian_filter

    count, most = len(frames), min(len(frames), MAX_REPEATS)
    repeats = max(3, min(most, int(MAX_REPEATS * MEGAPIXEL / total.size)))
    window = 4.0 * np.sqrt(most / repeats)

    def repeat(i: int) -> tuple[np.ndarray, np.ndarray]:
        frame = np.asarray(frames[i], dtype=np.float32)
        others = ((total - frame) / (count - 1)).astype(np.float32)
        d = displacement(others, frame, settings)
        pair = _equalised(frame, warp(others, -d), 0)
        return _without_shake(d, settings).astype(np.float64) ** 2, structure_variance(*pair, settings.reach)

    squares, variance = _means(map(repeat, np.linspace(0, count - 1, repeats).round().astype(int).tolist()))
    pooled = np.stack([gaussian_filter(squares[..., k], window) for k in range(2)], axis=-1)
    factor = (1 / averages + 1 / count) / (1 + 1 / (count - 1))
    gradients = (np.sqrt(variance / repeats) + FLOOR) * np.sqrt(repeats * factor)
    return (np.sqrt(pooled * factor) + FLOOR).astype(np.float32), gradients.astype(np.float32)
