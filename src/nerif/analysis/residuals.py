"""Whiteness test of the residual of a view, and the known cause whose pattern explains a correlated one.

    z_b = sum_{p in b} r_p / sqrt(n_b s^2),    s^2 = mean r^2,    grain = sqrt(mean z_b^2)

over blocks b of n pixels: 1 for independent residuals, more where neighbours are correlated. The patterns of known
causes are fitted to z_b one by one; the cause that removes most of what white noise would not leave is reported.

Source: the portmanteau test of residuals for whiteness, Box and Pierce, J. Am. Stat. Assoc. 65 (1970).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from statistics import NormalDist

import numpy as np
from jaxtyping import Bool, Float, Int

__all__ = ["Whiteness", "white_noise", "whiteness"]

Map = Float[np.ndarray, "row column c"]
Mask = Bool[np.ndarray, "row column"]

COARSE, FINE = 8, 2  # px, edges of blocks: several windows of optical flow; the blur of a lens or a window
MIN_BLOCKS = 12
QUARTILE = NormalDist().inv_cdf(0.625)  # of the absolute value of a standard normal variate
SIGNIFICANT = 4.0  # standard deviations of the grain of white noise
MIN_GRAIN = {COARSE: 1.25, FINE: 1.1}  # below these, the correlated part is at most about half of the noise in a block
MIN_SHARE = {COARSE: 0.2, FINE: 0.12}  # of the correlated part, that a cause has to explain
MIN_ROWS = 0.5  # of it, that the movement of rows has to explain: they have more parameters than other causes


@dataclass(frozen=True)
class Whiteness:
    """Outcome of the test of a residual."""

    grain: float  #: 1 for white noise, larger for correlated residuals
    white: bool  #: whether it is compatible with white noise
    cause: str  #: one of remedies.CAUSES, or empty
    share: float  #: of the correlated part that the cause explains
    row: float  #: of the largest block, px
    column: float

    @property
    def correlated(self) -> float:
        """The rms of the correlated part over that of the residual: sqrt((grain^2 - 1) / n)."""
        return 0.0 if self.white else math.sqrt(max(self.grain**2 - 1, 0.0)) / COARSE


def whiteness(residual: Map, predicted: Map | None, mask: Mask) -> Whiteness | None:
    """Test the residual of a view; None for too few pixels, or a residual of 0.

    Parameters
    ----------
    residual : measured less predicted, over sigma where that is known
    predicted : None where the patterns of the causes are not those of a shifted map, as in images
    mask : valid pixels
    """
    valid = np.where(mask[..., None], residual, 0.0).astype(np.float64)
    square = float((valid**2).sum()) / max(valid.shape[-1] * int(mask.sum()), 1)
    sums, count = _block_sums(valid, FINE), _block_sums(mask[..., None].astype(np.float64), FINE)

    @cache
    def patterns() -> dict[str, list[Map]]:
        if predicted is None:
            return {}
        causes = _patterns(_block_sums(predicted.astype(np.float64), FINE) / FINE**2)
        return {cause: [np.where(np.isfinite(p), count * p, 0.0) for p in maps] for cause, maps in causes.items()}

    def coarser(sums: Map) -> Map:
        return _block_sums(sums, COARSE // FINE)

    coarse = _tested(
        coarser(sums), coarser(count), square, COARSE,
        lambda: {cause: [*map(coarser, maps)] for cause, maps in patterns().items()},
    )  # fmt: skip
    fine = None if coarse is None else _tested(sums, count, square, FINE, patterns)
    if coarse is None or fine is None:
        return None
    cause, share = _largest(fine.shares)
    if cause != "blur" or share < MIN_SHARE[FINE]:  # of a blur, the field follows the smooth part and leaves the fine
        cause, share = _largest({name: share for name, share in coarse.shares.items() if name != "blur"})
        if share < MIN_SHARE[COARSE]:
            cause, share = "", 0.0
    white = not (coarse.correlated or fine.correlated)
    return Whiteness(coarse.grain, white, cause, min(share, 1.0), coarse.row, coarse.column)


def white_noise(residual: Map, mask: Mask) -> float | None:
    """Estimate the rms of the pixel-to-pixel noise from the mixed second difference; None without four neighbours.

        m = r_ij - r_i+1,j - r_i,j+1 + r_i+1,j+1,      s = q / (2 c),      q the quartile of |m|

    with c the quartile of the absolute value of a standard normal variate. Variations over several pixels cancel in m,
    and unresolved detail in part of an image does not move the quartile. Correlated noise is underestimated.

    Parameters
    ----------
    residual : measured less predicted
    mask : valid pixels

    Source: after J. Immerkaer, Comput. Vis. Image Underst. 64 (1996) 300.
    """
    full = mask[:-1, :-1] & mask[1:, :-1] & mask[:-1, 1:] & mask[1:, 1:]
    r = residual.astype(np.float64)
    mixed = np.abs(r[:-1, :-1] - r[1:, :-1] - r[:-1, 1:] + r[1:, 1:])
    return float(np.quantile(mixed[full], 0.25)) / (2 * QUARTILE) if full.any() else None


def _largest(shares: dict[str, float]) -> tuple[str, float]:
    return max(shares.items(), key=lambda item: item[1], default=("", 0.0))


@dataclass(frozen=True)
class _BlockTest:
    """The test on blocks of one size; row and column are those of the largest z_b."""

    grain: float
    correlated: bool
    shares: dict[str, float]
    row: float
    column: float


def _tested(
    sums: Map, count: Map, square: float, edge: int, patterns: Callable[[], dict[str, list[Map]]]
) -> _BlockTest | None:
    """The test of the sums of a residual over blocks, each of a count of pixels; `patterns`: the same sums of them."""
    full = count[..., 0] >= edge * edge / 2
    if int(full.sum()) < MIN_BLOCKS or not square > 0:
        return None
    n = count[full]
    z = sums[full] / np.sqrt(n * square)  # variance 1 for white noise
    energy = float((z**2).mean())
    correlated = energy > max(1 + SIGNIFICANT * math.sqrt(2 / z.size), MIN_GRAIN[edge] ** 2)
    shares: dict[str, float] = {}
    for cause, maps in (patterns() if correlated else {}).items():
        shares[cause] = _explained(z, np.stack([of_blocks[full] / np.sqrt(n) for of_blocks in maps], axis=-1))
    if shares and (share := max(_explained_by_means(z, group) for group in np.argwhere(full).T)) > MIN_ROWS:
        shares["rows"] = share
    worst = int(np.argmax((z**2).sum(axis=1)))
    row, column = (float(i + 0.5) * edge for i in np.argwhere(full)[worst])
    return _BlockTest(math.sqrt(energy), correlated, shares, row, column)


def _block_sums(values: Map, edge: int) -> Float[np.ndarray, "rows columns c"]:
    rows, columns = (np.arange(0, n - n % edge, edge) for n in values.shape[:2])
    whole = values[: len(rows) * edge, : len(columns) * edge]
    return np.add.reduceat(np.add.reduceat(whole, rows, axis=0), columns, axis=1)


def _explained(z: Float[np.ndarray, "b c"], patterns: Float[np.ndarray, "b c pattern"]) -> float:
    """The share of the excess over white noise that a linear combination of patterns explains."""
    flat, basis = z.ravel(), patterns.reshape(z.size, -1)
    size = np.linalg.norm(basis, axis=0)
    basis = basis[:, size > 0] / size[size > 0]
    if not basis.shape[1]:
        return 0.0
    weights, *_ = np.linalg.lstsq(basis, flat, rcond=1e-6)
    explained = float((flat**2).sum() - ((flat - basis @ weights) ** 2).sum()) - basis.shape[1]
    return explained / (float((flat**2).sum()) - flat.size)


def _explained_by_means(z: Float[np.ndarray, "b c"], group: Int[np.ndarray, " b"]) -> float:
    """The share of the excess over white noise that the means of groups explain, beyond the mean of all.

    The median group counts: a shutter moves all rows, flow beyond the box leaves residuals in a few.
    """
    _, group, count = np.unique(group, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(group, column) for column in (z - z.mean(axis=0)).T], axis=-1)
    explained = len(count) * float(np.median((sums**2 / count[:, None]).sum(axis=1))) - (len(count) - 1) * z.shape[1]
    return explained / (float((z**2).sum()) - z.size)


def _patterns(predicted: Map) -> dict[str, list[Map]]:
    """The patterns that each cause adds to a predicted map, to first order."""
    rows, columns, channels = predicted.shape
    d = predicted.astype(np.float64)
    along, down = np.gradient(d, axis=1), np.gradient(d, axis=0)
    half = max(rows, columns) / 2
    x = np.broadcast_to(((np.arange(columns) - (columns - 1) / 2) / half)[None, :, None], d.shape)
    y = np.broadcast_to(((np.arange(rows) - (rows - 1) / 2) / half)[:, None, None], d.shape)
    offsets = [np.zeros_like(d) for _ in range(channels)]
    for channel, pattern in enumerate(offsets):
        pattern[..., channel] = 1.0
    laplacian = np.gradient(along, axis=1) + np.gradient(down, axis=0)
    rotation = x * down - y * along
    if channels == 2:  # vectors turn with the image
        rotation = rotation * half + np.stack([d[..., 1], -d[..., 0]], axis=-1)
    return {"offset": offsets, "calibration": [along, down, rotation], "scale": [d], "blur": [laplacian]}
