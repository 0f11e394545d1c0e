"""Similarity of two volumes or two maps (paper, App. C), and the coverage of standard deviations."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

__all__ = [
    "FLOW", "LEVELS", "correlation", "coverage", "psnr", "slice_metrics", "ssim", "view_metrics", "volume_errors",
    "volume_metrics",
]  # fmt: skip

Array = np.ndarray

FLOW = 0.02  #: share of the largest excess above which a voxel counts as flow
LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)  #: confidence levels of a reliability diagram
SLICES = 10  # across z
NAN = float("nan")


def correlation(a: Float[Array, "*n"], b: Float[Array, "*n"]) -> float:
    """Return the correlation coefficient (paper, Eq. (cc)); NaN if either is constant."""
    x, y = a.astype(np.float64).ravel(), b.astype(np.float64).ravel()
    x, y = x - x.mean(), y - y.mean()
    norm = math.sqrt(float(x @ x) * float(y @ y))
    return float(x @ y) / norm if norm > 0 else NAN


def psnr(truth: Float[Array, "*n"], test: Float[Array, "*n"]) -> float:
    """Return the peak signal-to-noise ratio in dB (paper, Eq. (psnr)); the peak is the range of the truth."""
    span = float(truth.max() - truth.min())
    if span == 0:
        return NAN
    error = float(np.square(truth.astype(np.float64) - test.astype(np.float64)).mean())
    return 10 * math.log10(span**2 / error) if error > 0 else float("inf")


def ssim(
    truth: Float[Array, "*n"], test: Float[Array, "*n"], valid: Bool[Array, "*n"] | None = None, span: float = 0.0
) -> float:
    """Return the mean structural similarity (paper, Eq. (ssim)) over windows of 7, in 2-D or 3-D.

    Parameters
    ----------
    valid : windows about these values are counted; invalid ones, which the windows need, are set equal in both
    span : range of the truth; 0: that of its valid values
    """
    from skimage.metrics import structural_similarity

    values = truth if valid is None else truth[valid]
    span = span or (float(values.max() - values.min()) if values.size else 0.0)
    if span == 0 or min(truth.shape) < 7:
        return NAN
    if valid is None:
        return float(structural_similarity(truth.astype(np.float64), test.astype(np.float64), data_range=span))
    a, b = (np.where(valid, x, 0.0).astype(np.float64) for x in (truth, test))
    return float(structural_similarity(a, b, data_range=span, full=True)[1][valid].mean())


def volume_errors(truth: Float[Array, "z y x"], test: Float[Array, "z y x"], n_ambient: float) -> dict[str, float]:
    """Compare two volumes of index excess where the truth is not NaN, as within a body.

    l2 = |n_gt - n_rec| / |n_gt - 1| (the paper's; small because n - 1 is mostly the ambient),
    l2_variation = |n_gt - n_rec| / |n_gt - n_ambient|, and cc.
    """
    valid = np.isfinite(truth)
    gt, rec = truth[valid].astype(np.float64), test[valid].astype(np.float64)
    error = float(np.linalg.norm(gt - rec))
    variation = float(np.linalg.norm(gt))
    return {
        "l2": error / float(np.linalg.norm(gt + (n_ambient - 1))),
        "l2_variation": error / variation if variation > 0 else NAN,
        "cc": correlation(gt, rec),
    }


def volume_metrics(truth: Float[Array, "z y x"], test: Float[Array, "z y x"], n_ambient: float) -> dict[str, float]:
    """Compare two volumes of index excess: volume_errors, ssim and psnr."""
    valid = np.isfinite(truth)
    similarity = ssim(truth, test, None if valid.all() else valid)
    return {**volume_errors(truth, test, n_ambient), "ssim": similarity, "psnr": psnr(truth[valid], test[valid])}


def slice_metrics(
    truth: Float[Array, "z y x"], test: Float[Array, "z y x"], heights: Float[Array, " z"]
) -> list[dict[str, float]]:
    """Return cc, ssim and psnr of equally spaced slices across z; `heights` in mm."""
    nz = truth.shape[0]
    indices = np.unique(((np.arange(SLICES) + 0.5) * nz / SLICES).astype(int))
    records = []
    for i in indices:
        gt, rec, valid = truth[i], test[i], np.isfinite(truth[i])
        scores = {"cc": NAN, "ssim": ssim(gt, rec, None if valid.all() else valid), "psnr": NAN}
        if valid.any():
            scores |= {"cc": correlation(gt[valid], rec[valid]), "psnr": psnr(gt[valid], rec[valid])}
        records.append({"z_mm": float(heights[i]), **scores})
    return records


def view_metrics(
    measured: Float[Array, "row column c"], predicted: Float[Array, "row column c"], valid: Array
) -> dict[str, float]:
    """Return cc, ssim, psnr and rms difference of a view over the valid pixels."""
    if not valid.any():
        return {"cc": NAN, "ssim": NAN, "psnr": NAN, "rms": NAN}
    a, b = measured[valid], predicted[valid]
    rms = float(np.sqrt(np.mean((a - b).astype(np.float64) ** 2)))
    span = float(a.max() - a.min())
    channels = range(measured.shape[-1])
    similarity = NAN
    if span > 0:
        similarity = float(np.mean([ssim(measured[..., c], predicted[..., c], valid, span) for c in channels]))
    return {"cc": correlation(a, b), "ssim": similarity, "psnr": psnr(a, b), "rms": rms}


def coverage(
    error: Float[Array, "*n"], std: Float[Array, "*n"], flow: Bool[Array, "*n"]
) -> dict[str, float | list[float]]:
    """Return how often errors lie within standard deviations, everywhere and in the flow.

    one_sigma, two_sigma: within one and two standard deviations, also _in_flow;
    reliability: in the flow, within the interval of each of LEVELS; spearman: rank correlation of |error| and std.

    Source: Guo et al., On calibration of modern neural networks, Proc. ICML (2017), for the diagram.
    """
    from scipy.stats import norm, spearmanr

    size, std, inside = np.abs(error).ravel(), std.ravel(), flow.ravel()
    one, two = size <= std, size <= 2 * std
    z = [float(norm.ppf((1 + level) / 2)) for level in LEVELS]
    return {
        "two_sigma": float(two.mean()),
        "two_sigma_in_flow": float(two[inside].mean()),
        "one_sigma": float(one.mean()),
        "one_sigma_in_flow": float(one[inside].mean()),
        "reliability": [float((size[inside] <= k * std[inside]).mean()) for k in z],
        "spearman": float(spearmanr(size, std).statistic),
    }
