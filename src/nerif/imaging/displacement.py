"""From pictures to the displacement d(p) = p - p0(p) on the flow picture, with its noise and where it holds.

    flow(p) = reference(p - d(p)),     d = -(optical flow from the flow picture to the reference)

How well a pattern fixes a shift: cov = <r^2> (sum grad(I) grad(I)^T)^-1, with r the difference left between the flow
picture and the moved reference, and the sum over a Gaussian window of the method's own reach. The noise of d is that,
or, where there are three or more reference frames, what flow-off repeats show, plus what cov has more with flow than
without: repeats know the noise of the camera, but not where the flow is too sharp for the method. To both is added what
a window of that reach would smooth away of d once more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from nerif.conventions import InputError
from nerif.imaging.optical_flow import FLOWS, warp

__all__ = [
    "AtRest",
    "DisplacementMap",
    "DisplacementSettings",
    "displacement",
    "measure",
    "measure_against",
    "remove_shake",
]

Image = Float[np.ndarray, "row column"]
REACH = {"deepflow": 1.5, "dis": 1.5, "tvl1": 1.3, "ilk": 1.6, "correlation": 1.8}
"""Standard deviation (px) of the window over which each method averages, smoothness 1 (benchmarks/displacement.py)."""

FLOOR = 1e-3  # px: no optical flow is better than that


@dataclass(frozen=True)
class DisplacementSettings:
    """How displacements are found."""

    method: str = "correlation"
    """correlation (windows of 12 px x smoothness; best on dots), dis (best on noise, fast), deepflow (the paper's),
    ilk, tvl1."""
    smoothness: float = 1.0
    """Above 1 for smoother displacements; scales window or regularisation (deepflow has a fixed one)."""
    local_contrast: int = 0
    """Window (px) over which brightness and contrast are evened out; 0 matches them over the whole picture only."""
    shake_border: int = 0
    """Width (px) of the flow-free border to which a shift, turn and zoom are fitted and removed; 0 for none."""
    max_sigma: float = 0.5
    """Pixels with a noise above this are not valid, px."""
    min_correlation: float = 0.5
    """Pixels around which the two pictures correlate less than this once moved are not valid."""

    def __post_init__(self) -> None:
        if self.method not in FLOWS:
            raise InputError(f"method: expected one of {', '.join(FLOWS)}, got '{self.method}'")
        for name in ("smoothness", "max_sigma"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name}: expected a positive number, got {getattr(self, name)}")
        for name in ("local_contrast", "shake_border"):
            if not getattr(self, name) >= 0:
                raise InputError(f"{name}: expected 0 or more px, got {getattr(self, name)}")
        if not -1 <= self.min_correlation < 1:
            raise InputError(f"min_correlation: expected a number from -1 to 1, got {self.min_correlation}")

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
    """

    displacement: Float[np.ndarray, "row column 2"]
    sigma: Float[np.ndarray, "row column 2"]
    valid: Bool[np.ndarray, "row column"]
    noise_from: str


def displacement(reference: Image, flow: Image, settings: DisplacementSettings) -> Float[np.ndarray, "row column 2"]:
    """Return d (px) of one flow picture against one reference, both of any scale.

    Raises
    ------
    InputError
        If the pictures differ in size, are smaller than 16 px, or the reference is of one grey.
    """
    if reference.shape != flow.shape or min(flow.shape) < 16:
        raise InputError(
            f"pictures: expected reference and flow of one size, at least 16 px, got {reference.shape} and {flow.shape}"
        )
    first, second = _even_out(flow, reference, settings.local_contrast)
    return -FLOWS[settings.method](first, second, settings.smoothness).astype(np.float32)


@dataclass(frozen=True)
class AtRest:
    """What the reference frames of a view say, once for all flow frames.

    Parameters
    ----------
    mean : of the frames
    settings : of the method
    full : (row, column) where the sensor was full in one of them
    full_scale : grey value at which it is, if known
    averaged : number of flow frames whose displacements are averaged
    noise : (row, column, 2) of repeats: as seen, and by the gradients, px; None with fewer than three frames
    """

    mean: Image
    settings: DisplacementSettings
    full: Bool[np.ndarray, "row column"]
    full_scale: float | None
    averaged: int
    noise: tuple[Float[np.ndarray, "row column 2"], Float[np.ndarray, "row column 2"]] | None

    @classmethod
    def of(
        cls,
        reference: Sequence[np.ndarray],
        settings: DisplacementSettings,
        full_scale: float | None = None,
        averaged: int = 1,
    ) -> AtRest:
        """Average the frames and take the noise from their differences."""
        if not len(reference):
            raise InputError("pictures: expected at least one reference picture, got none")
        frames = [np.asarray(f, dtype=np.float32) for f in reference]
        full = np.any([np.asarray(p) >= (np.inf if full_scale is None else full_scale) for p in reference], axis=0)
        noise = _repeat_sigma(frames, averaged, settings) if len(frames) >= 3 else None
        return cls(np.stack(frames).mean(axis=0), settings, full, full_scale, averaged, noise)


def measure(
    reference: Sequence[np.ndarray],
    flow: Sequence[np.ndarray],
    settings: DisplacementSettings,
    full_scale: float | None = None,
    region: Bool[np.ndarray, "row column"] | None = None,
) -> DisplacementMap:
    """Return displacement, noise and validity of a view.

    Parameters
    ----------
    reference : frames without flow; they are averaged
    flow : frames with flow; the displacements of several are averaged
    settings : of the method
    full_scale : grey value at which the sensor is full, if known: such pixels are not valid
    region : where the background is seen at all, or None
    """
    if not len(reference) or not len(flow):
        raise InputError(f"pictures: expected at least one of each, got {len(reference)} reference, {len(flow)} flow")
    return measure_against(AtRest.of(reference, settings, full_scale, len(flow)), flow, region)


def measure_against(
    rest: AtRest, flow: Sequence[np.ndarray], region: Bool[np.ndarray, "row column"] | None = None
) -> DisplacementMap:
    """Return displacement, noise and validity of a view whose reference is known already; see measure."""
    mean, settings = rest.mean, rest.settings
    maps, rests = [], []
    for picture in (np.asarray(p, dtype=np.float32) for p in flow):
        seen = displacement(mean, picture, settings)
        rests.append(_even_out(picture, warp(mean, -seen), 0))
        maps.append(_still(seen, settings))
    d = np.stack(maps).mean(axis=0)
    agreement = np.mean([_local_correlation(a, b, max(3.0, settings.reach)) for a, b in rests], axis=0)
    sigma, source = _structure_sigma(rests, settings.reach), "structure tensor"
    if rest.noise is not None:
        repeats, without = rest.noise
        sigma, source = np.sqrt(repeats**2 + np.maximum(sigma**2 - without**2, 0)), "repeats"
    sigma = np.sqrt(sigma**2 + _smoothed_away(d, settings.reach) ** 2).astype(np.float32)
    rows, columns = np.mgrid[: d.shape[0], : d.shape[1]]
    at_row, at_column = rows - d[..., 1], columns - d[..., 0]
    valid = (at_row >= 0) & (at_row <= d.shape[0] - 1) & (at_column >= 0) & (at_column <= d.shape[1] - 1)
    valid &= (agreement >= settings.min_correlation) & (sigma.max(-1) <= settings.max_sigma)
    if rest.full_scale is not None:
        full = np.any([rest.full, *(np.asarray(p) >= rest.full_scale for p in flow)], axis=0)
        valid &= ~_grown(full, 2)
    if region is not None:
        valid &= region
    return DisplacementMap(d, sigma, valid, source)


def remove_shake(
    d: Float[np.ndarray, "row column 2"], still: Bool[np.ndarray, "row column"]
) -> Float[np.ndarray, "row column 2"]:
    """Take away the similarity d = t + [[a, -b], [b, a]] p that fits best where nothing flows.

    Parameters
    ----------
    d : px
    still : pixels without flow; outliers among them count little (Cauchy's loss)
    """
    if still.sum() < 8:
        raise InputError(f"shake: expected at least 8 pixels without flow, got {int(still.sum())}; widen the border")
    from scipy.optimize import least_squares

    rows, columns = np.mgrid[: d.shape[0], : d.shape[1]].astype(np.float64)
    scale = max(d.shape[:2]) / 2
    x, y = (columns - columns.mean()) / scale, (rows - rows.mean()) / scale

    def design(at: np.ndarray | slice) -> np.ndarray:
        one, zero = np.ones_like(x[at]), np.zeros_like(x[at])
        u = np.stack([one, zero, x[at], -y[at]], axis=-1)
        v = np.stack([zero, one, y[at], x[at]], axis=-1)
        return np.stack([u, v], axis=-2)

    a, b = design(still).reshape(-1, 4), d[still].reshape(-1).astype(np.float64)
    start = np.linalg.lstsq(a, b, rcond=None)[0]
    noise = 1.4826 * np.median(np.abs(a @ start - b)) + 1e-6
    fit = least_squares(lambda p: a @ p - b, start, jac=lambda p: a, loss="cauchy", f_scale=2 * noise)
    everywhere = design(slice(None)).reshape(-1, 4) @ fit.x
    return (d - everywhere.reshape(d.shape)).astype(np.float32)


def _still(d: Float[np.ndarray, "row column 2"], settings: DisplacementSettings) -> Float[np.ndarray, "row column 2"]:
    """Displacement without camera shake, if that is to be removed."""
    return remove_shake(d, border(d.shape[:2], settings.shake_border)) if settings.shake_border else d


def border(shape: tuple[int, ...], width: int) -> Bool[np.ndarray, "row column"]:
    """Return the outer `width` px of a picture."""
    if 2 * width >= min(shape):
        raise InputError(f"shake_border: expected less than half the picture ({min(shape) // 2} px), got {width}")
    mask = np.ones(shape, dtype=bool)
    mask[width:-width, width:-width] = False
    return mask


def _even_out(flow: Image, reference: Image, window: int) -> tuple[Image, Image]:
    """Both pictures on one scale of 0 to 255, brightness and contrast matched, over windows if asked for."""
    from scipy.ndimage import gaussian_filter

    low, high = np.percentile(reference, (0.5, 99.5))
    if not high > low:
        raise InputError("reference: expected a picture of a pattern, got one of a single grey")
    pictures = []
    for picture in (flow, reference):
        if window:
            mean = gaussian_filter(picture, window / 2)
            spread = np.sqrt(gaussian_filter((picture - mean) ** 2, window / 2))
            even = (picture - mean) / (spread + 0.05 * (high - low))
            pictures.append((127.5 + 50 * even).astype(np.float32))
        else:
            gain, offset = reference.std() / max(float(picture.std()), 1e-6), reference.mean() - picture.mean()
            even = (picture - picture.mean()) * gain + picture.mean() + offset
            pictures.append((255 * (even - low) / (high - low)).astype(np.float32))
    return pictures[0], pictures[1]


def _structure_sigma(pairs: Sequence[tuple[Image, Image]], reach: float) -> Float[np.ndarray, "row column 2"]:
    """Standard deviation of a shift from the gradients of the picture and what is left of the difference."""
    from scipy.ndimage import gaussian_filter

    pixels = 4 * np.pi * reach**2  # effective number in a Gaussian window
    variances = []
    for flow, moved in pairs:
        gv, gu = np.gradient(moved.astype(np.float64))
        uu, vv, uv = (gaussian_filter(g, reach) * pixels for g in (gu * gu, gv * gv, gu * gv))
        left = gaussian_filter((flow - moved).astype(np.float64) ** 2, max(4.0, 2 * reach))
        determinant = np.maximum(uu * vv - uv**2, 1e-9 * (uu + vv) ** 2 + 1e-12)
        variances.append(np.stack([left * vv / determinant, left * uu / determinant], axis=-1))
    return (np.sqrt(np.mean(variances, axis=0) / len(variances)) + FLOOR).astype(np.float32)


def _repeat_sigma(
    frames: Sequence[np.ndarray], averaged: int, settings: DisplacementSettings
) -> tuple[Float[np.ndarray, "row column 2"], Float[np.ndarray, "row column 2"]]:
    """Standard deviation of d between reference frames and the mean of the others: as seen, and by the gradients.

    A repeat has the variance s^2 (1 + 1/(count - 1)) if one frame has s^2, the measurement s^2 (1/averaged + 1/count).
    """
    from scipy.ndimage import gaussian_filter

    count, total = len(frames), np.sum(frames, axis=0, dtype=np.float64)
    chosen = np.linspace(0, count - 1, min(count, 12)).round().astype(int)
    squares, pairs = [], []
    for i in chosen:
        others = ((total - frames[i]) / (count - 1)).astype(np.float32)
        d = displacement(others, frames[i], settings)
        squares.append(_still(d, settings).astype(np.float64) ** 2)
        pairs.append(_even_out(frames[i], warp(others, -d), 0))
    pooled = np.stack([gaussian_filter(np.mean(squares, axis=0)[..., k], 4.0) for k in range(2)], axis=-1)
    factor = (1 / averaged + 1 / count) / (1 + 1 / (count - 1))
    seen = (np.sqrt(pooled * factor) + FLOOR).astype(np.float32)
    return seen, _structure_sigma(pairs, settings.reach) * np.sqrt(len(pairs) * factor)


def _smoothed_away(d: Float[np.ndarray, "row column 2"], reach: float) -> Float[np.ndarray, "row column 2"]:
    """Rms over a Gaussian window of what that window takes from d, px."""
    from scipy.ndimage import gaussian_filter

    parts = [gaussian_filter((d[..., k] - gaussian_filter(d[..., k], reach)) ** 2, reach) for k in range(2)]
    return np.sqrt(np.stack(parts, axis=-1))


def _local_correlation(a: Image, b: Image, reach: float) -> Image:
    """Correlation coefficient of two pictures over a Gaussian window."""
    from scipy.ndimage import gaussian_filter

    a, b = a.astype(np.float64), b.astype(np.float64)
    mean_a, mean_b = gaussian_filter(a, reach), gaussian_filter(b, reach)
    cross = gaussian_filter(a * b, reach) - mean_a * mean_b
    variance = (gaussian_filter(a * a, reach) - mean_a**2) * (gaussian_filter(b * b, reach) - mean_b**2)
    return cross / np.sqrt(np.maximum(variance, 1e-6))


def _grown(mask: np.ndarray, by: int) -> np.ndarray:
    from scipy.ndimage import binary_dilation

    return np.asarray(binary_dilation(mask, iterations=by))
