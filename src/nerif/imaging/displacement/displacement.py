"""From images to the displacement d(p) = p - p0(p) on the flow image, with its noise and where it holds.

    flow(p) = reference(p - d(p)),     d = -(optical flow from the flow image to the reference)

How well a pattern fixes a shift: cov = <r^2> (sum grad(I) grad(I)^T)^-1, with r the difference left between the flow
image and the moved reference, and the sum over a Gaussian window of the method's own reach. The noise of d is that,
or, where there are three or more reference frames, what flow-off repeats show, plus what cov has more with flow than
without: repeats know the noise of the camera, but not where the flow is too sharp for the method. To both is added what
a window of that reach would smooth away of d once more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Shaped

from nerif.common.conventions import InputError
from nerif.imaging.displacement.exposure import saturated
from nerif.imaging.displacement.noise import FLOOR, local_correlation, smoothed_away, structure_variance
from nerif.imaging.displacement.optical_flow import FLOWS
from nerif.imaging.displacement.photometry import CameraNoise, ImagePair
from nerif.imaging.displacement.shake import border, remove_shake
from nerif.imaging.displacement.warping import warp
from nerif.imaging.readers.frames import as_float

__all__ = [
    "AtRest",
    "DisplacementMap",
    "DisplacementSettings",
    "displacement",
    "measure",
    "measure_against",
]

Grey = Shaped[np.ndarray, "row column"]
Image = Float[np.ndarray, "row column"]
REACH = {"deepflow": 1.5, "dis": 1.5, "tvl1": 1.3, "ilk": 1.6, "correlation": 1.8}
"""Standard deviation (px) of the window over which each method averages, smoothness 1 (benchmarks/displacement.py)."""

MOST_REPEATS = 12  # of the reference that are compared with the mean of the others,
MEGAPIXEL = 2**20  # in images up to this many pixels


@dataclass(frozen=True)
class DisplacementSettings:
    """How displacements are found."""

    method: str = "correlation"
    """correlation (windows of 12 px x smoothness; best on dots), dis (fast, good on noise), deepflow (the paper's),
    ilk, tvl1."""
    smoothness: float = 1.0
    """Above 1 for smoother displacements; scales window or regularisation (deepflow has a fixed one)."""
    local_contrast: int = 0
    """Window (px) over which brightness and contrast are evened out; 0 matches them over the whole image only."""
    shake_border: int = 0
    """Width (px) of the flow-free border to which a shift, turn and zoom are fitted and removed; 0 for none."""
    max_sigma: float = 0.5
    """Pixels with a noise above this are not valid, px."""
    min_correlation: float = 0.5
    """Pixels around which the two images correlate less than this once moved are not valid."""

    def __post_init__(self) -> None:
        if self.method not in FLOWS:
            raise InputError(f"expected one of {', '.join(FLOWS)}, got '{self.method}'", field="method")
        for name in ("smoothness", "max_sigma"):
            if not getattr(self, name) > 0:
                raise InputError(f"expected a positive number, got {getattr(self, name)}", field=name)
        for name in ("local_contrast", "shake_border"):
            if not getattr(self, name) >= 0:
                raise InputError(f"expected 0 or more px, got {getattr(self, name)}", field=name)
        if not -1 <= self.min_correlation < 1:
            raise InputError(f"expected a number from -1 to 1, got {self.min_correlation}", field="min_correlation")

    @property
    def reach(self) -> float:
        """Standard deviation of the window over which the method averages, px."""
        return REACH[self.method] * (1.0 if self.method == "deepflow" else self.smoothness)


@dataclass(frozen=True)
class DisplacementMap:
    """What one view measured.

    Parameters
    ----------
    displacement : (row, column, 2) d, px
    sigma : (row, column, 2) standard deviation of its noise, px
    valid : (row, column) where it holds
    noise_from : "repeats" (of the reference, and residual) or "structure tensor"
    pair : the images that it was found in; None where it is the mean of several
    """

    displacement: Float[np.ndarray, "row column 2"]
    sigma: Float[np.ndarray, "row column 2"]
    valid: Bool[np.ndarray, "row column"]
    noise_from: str
    pair: ImagePair | None = None


def displacement(
    reference: Grey, flow: Grey, settings: DisplacementSettings
) -> Float[np.ndarray, "row column 2"]:  # fmt: skip
    """Return d (px) of one flow image against one reference, both of any scale and type.

    Raises
    ------
    InputError
        If the images differ in size, are smaller than 16 px, or the reference is of one grey.
    """
    if reference.shape != flow.shape or min(flow.shape) < 16:
        raise InputError(
            f"expected reference and flow of one size, at least 16 px, got {reference.shape} and {flow.shape}",
            field="images",
        )
    first, second = _even_out(as_float(flow), as_float(reference), settings.local_contrast)
    return -FLOWS[settings.method](first, second, settings.smoothness).astype(np.float32)


@dataclass(frozen=True)
class AtRest:
    """What the reference frames of a view say, once for all flow frames.

    Parameters
    ----------
    mean : of the frames
    settings : of the method
    full : (row, column) where the sensor was full in one of them
    full_scale : grey value at which it is; infinite if not known
    averaged : number of flow frames whose displacements are averaged
    noise : (row, column, 2) of repeats: as seen, and by the gradients, px; None with fewer than three frames
    frames : number of frames
    camera : noise of the grey values; None with fewer than two frames
    """

    mean: Image
    settings: DisplacementSettings
    full: Bool[np.ndarray, "row column"]
    full_scale: float
    averaged: int
    noise: tuple[Float[np.ndarray, "row column 2"], Float[np.ndarray, "row column 2"]] | None
    frames: int = 1
    camera: CameraNoise | None = None

    @classmethod
    def of(
        cls,
        reference: Sequence[np.ndarray],
        settings: DisplacementSettings,
        full_scale: float = np.inf,
        averaged: int = 1,
    ) -> AtRest:
        """Average the frames and take the noise from their differences; frames are read when they are needed."""
        if not len(reference):
            raise InputError("expected at least one reference image, got none", field="images")
        total, full = np.zeros(reference[0].shape), np.zeros(reference[0].shape, dtype=bool)
        for image in reference:
            total += image
            full |= saturated(image, full_scale)
        noise = _repeat_sigma(reference, total, averaged, settings) if len(reference) >= 3 else None
        mean, count = total / len(reference), len(reference)
        camera = CameraNoise.of_repeats(reference[:MOST_REPEATS], mean, count) if count >= 2 else None
        return cls(mean.astype(np.float32), settings, full, full_scale, averaged, noise, count, camera)


def measure(
    reference: Sequence[np.ndarray],
    flow: Sequence[np.ndarray],
    settings: DisplacementSettings,
    full_scale: float = np.inf,
    region: Bool[np.ndarray, "row column"] | None = None,
) -> DisplacementMap:
    """Return displacement, noise and validity of a view.

    Parameters
    ----------
    reference : frames without flow; they are averaged
    flow : frames with flow; the displacements of several are averaged
    settings : of the method
    full_scale : grey value of a full sensor, infinite if not known; full pixels are not valid (exposure.saturated)
    region : where the background is seen at all, or None
    """
    if not len(reference) or not len(flow):
        raise InputError(
            f"expected at least one of each, got {len(reference)} reference, {len(flow)} flow", field="images"
        )
    return measure_against(AtRest.of(reference, settings, full_scale, len(flow)), flow, region)


def measure_against(
    rest: AtRest,
    flow: Sequence[np.ndarray],
    region: Bool[np.ndarray, "row column"] | None = None,
    images: bool = True,
) -> DisplacementMap:
    """Return displacement, noise and validity of a view whose reference is known already; see measure.

    Parameters
    ----------
    images : whether to keep them, where there is one flow image
    """
    settings, reach = rest.settings, rest.settings.reach
    full = rest.full.copy()
    shaken = np.zeros(1)

    def one(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        nonlocal full, shaken
        grey = np.asarray(image, dtype=np.float32)
        seen = displacement(rest.mean, grey, settings)
        full |= saturated(image, rest.full_scale)
        pair = _even_out(grey, warp(rest.mean, -seen), 0)
        still = _still(seen, settings)
        shaken = seen - still
        return still, local_correlation(*pair, max(3.0, reach)), structure_variance(*pair, reach)

    d, agreement, variance = _means(map(one, flow))
    sigma, source = np.sqrt(variance / len(flow)) + FLOOR, "structure tensor"
    if rest.noise is not None:
        repeats, without = rest.noise
        sigma, source = np.sqrt(repeats**2 + np.maximum(sigma**2 - without**2, 0)), "repeats"
    sigma = np.sqrt(sigma**2 + smoothed_away(d, reach) ** 2).astype(np.float32)
    height, width = d.shape[:2]
    at_row, at_column = np.arange(height)[:, None] - d[..., 1], np.arange(width) - d[..., 0]
    valid = (at_row >= 0) & (at_row <= height - 1) & (at_column >= 0) & (at_column <= width - 1)
    valid &= (agreement >= settings.min_correlation) & (sigma.max(-1) <= settings.max_sigma)
    valid &= ~_grown(full, 2)
    if region is not None:
        valid &= region
    pair = None
    if images and len(flow) == 1 and bool(valid.any()):
        usable = ~_grown(full, 2) if region is None else region & ~_grown(full, 2)
        reference = warp(rest.mean, -shaken) if settings.shake_border else rest.mean
        grey = np.asarray(flow[0], dtype=np.float32)
        pair = ImagePair.of(reference, grey, d, rest.camera, rest.frames, usable, valid)
    return DisplacementMap(d, sigma, valid, source, pair)


def _means(samples: Iterator[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, ...]:
    """Mean over the samples of each of their arrays."""
    sums, count = list(next(samples)), 1
    for sample in samples:
        sums, count = [a + b for a, b in zip(sums, sample, strict=True)], count + 1
    return tuple(a / count for a in sums)


def _still(d: Float[np.ndarray, "row column 2"], settings: DisplacementSettings) -> Float[np.ndarray, "row column 2"]:
    """Displacement without camera shake, if that is to be removed."""
    return remove_shake(d, border(d.shape[:2], settings.shake_border)) if settings.shake_border else d


def _even_out(flow: Image, reference: Image, window: int) -> tuple[Image, Image]:
    """Both images on one scale of 0 to 255, brightness and contrast matched, over windows if asked for."""
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
    reference: Sequence[np.ndarray], total: np.ndarray, averaged: int, settings: DisplacementSettings
) -> tuple[Float[np.ndarray, "row column 2"], Float[np.ndarray, "row column 2"]]:
    """Standard deviation of d between reference frames and the mean of the others: as seen, and by the gradients.

    A repeat has the variance s^2 (1 + 1/(count - 1)) if one frame has s^2, the measurement s^2 (1/averaged + 1/count).
    Of large images fewer repeats do, their squares averaged over wider windows.
    """
    from scipy.ndimage import gaussian_filter

    count, most = len(reference), min(len(reference), MOST_REPEATS)
    repeats = max(3, min(most, int(MOST_REPEATS * MEGAPIXEL / total.size)))
    window = 4.0 * np.sqrt(most / repeats)

    def repeat(i: int) -> tuple[np.ndarray, np.ndarray]:
        frame = np.asarray(reference[i], dtype=np.float32)
        others = ((total - frame) / (count - 1)).astype(np.float32)
        d = displacement(others, frame, settings)
        pair = _even_out(frame, warp(others, -d), 0)
        return _still(d, settings).astype(np.float64) ** 2, structure_variance(*pair, settings.reach)

    squares, variance = _means(map(repeat, np.linspace(0, count - 1, repeats).round().astype(int).tolist()))
    pooled = np.stack([gaussian_filter(squares[..., k], window) for k in range(2)], axis=-1)
    factor = (1 / averaged + 1 / count) / (1 + 1 / (count - 1))
    gradients = (np.sqrt(variance / repeats) + FLOOR) * np.sqrt(repeats * factor)
    return (np.sqrt(pooled * factor) + FLOOR).astype(np.float32), gradients.astype(np.float32)


def _grown(mask: np.ndarray, by: int) -> np.ndarray:
    from scipy.ndimage import binary_dilation

    return np.asarray(binary_dilation(mask, iterations=by))
