"""What a field leaves unexplained of a view: is it white, and if not, of what does it have the pattern?

    z_b = sum_{p in b} r_p / sqrt(n_b s^2),    s^2 = mean r^2,    grain = sqrt(mean z_b^2)

over blocks b of n pixels: 1 where neighbouring residuals have nothing to do with one another, more where they are
alike. What is alike has a pattern. Those that known causes leave are fitted to the z_b, each on its own, and the one
that takes away most of what white noise would not leave is named.

Source: the portmanteau idea of testing residuals for whiteness, Box and Pierce, J. Am. Stat. Assoc. 65 (1970).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from jaxtyping import Bool, Float

__all__ = ["CAUSES", "Leftover", "leftover", "white_noise"]

Map = Float[np.ndarray, "row column c"]

BLOCK, FINE = 8, 2  # px: some windows of optical flow, and what a lens or a window smears
FEWEST = 12  # blocks of which something can be said
QUARTILE = NormalDist().inv_cdf(0.625)  # of the absolute value of a standard normal variate
SURE = 4.0  # standard deviations of the grain of white noise
GRAIN = {BLOCK: 1.25, FINE: 1.1}  # below these what is alike is at most about half of what noise leaves in a block
NAMED = {BLOCK: 0.2, FINE: 0.12}  # of what is alike, that a pattern has to take away to be named

CAUSES = {
    "offset": "the whole image is displaced (a shaken camera): --refine shift, or nerif displacement --shake-border",
    "calibration": "the view is not looked at from where the calibration says: nerif check names one that is upside "
    "down, mirrored or exchanged; where it names none, --refine cameras",
    "scale": "all of it is too large or too small: distances, pixel pitch, sensitivity, or a method that flattens",
    "blur": "what was measured is smoother or sharper than the field's: windows of optical flow, the lens (--aperture)",
}
"""Patterns of residuals, and what leaves them."""


@dataclass(frozen=True)
class Leftover:
    """What is left unexplained of a view.

    Parameters
    ----------
    grain : 1 for white noise, larger where neighbours are alike
    white : whether chance may have made it
    cause : the pattern that it has, one of CAUSES, or nothing
    share : of what is alike that this pattern takes away
    row, column : px, where most of it is
    """

    grain: float
    white: bool
    cause: str
    share: float
    row: float
    column: float

    @property
    def alike(self) -> float:
        """How large what is alike is, over the rms of all that is left: sqrt((grain^2 - 1) / n)."""
        return 0.0 if self.white else math.sqrt(max(self.grain**2 - 1, 0.0)) / BLOCK


def leftover(residual: Map, predicted: Map | None, mask: Bool[np.ndarray, "row column"]) -> Leftover | None:
    """Test what is left of a view; None where there are too few pixels to tell.

    Parameters
    ----------
    residual : measured less predicted, over sigma where that is known
    predicted : what the field predicts; None where causes leave other patterns, as in images
    mask : pixels that count
    """
    coarse, fine = (_tested(residual, predicted, mask, edge) for edge in (BLOCK, FINE))
    if coarse is None or fine is None:
        return None
    cause, share = _most(fine.shares)
    if cause != "blur" or share < NAMED[FINE]:  # the field takes up what is smooth of a blur, and leaves what is fine
        cause, share = _most({name: share for name, share in coarse.shares.items() if name != "blur"})
        if share < NAMED[BLOCK]:
            cause, share = "", 0.0
    return Leftover(coarse.grain, not (coarse.alike or fine.alike), cause, min(share, 1.0), coarse.row, coarse.column)


def white_noise(residual: Map, mask: Bool[np.ndarray, "row column"]) -> float | None:
    """Estimate the rms of the noise that differs from pixel to pixel, by the mixed second difference.

        m = r_ij - r_i+1,j - r_i,j+1 + r_i+1,j+1,      s = q / (2 c),      q the quartile of |m|

    with c the quartile of the absolute value of a standard normal variate. What varies over several pixels cancels in
    m, and fine detail that the field leaves unexplained in part of an image does not move the quartile. Of noise that
    is correlated among neighbours it is less than the rms.

    Parameters
    ----------
    residual : measured less predicted
    mask : pixels that count

    Returns
    -------
    In the unit of the residual; None where there are no four neighbours.

    Source: after J. Immerkaer, Comput. Vis. Image Underst. 64 (1996) 300.
    """
    full = mask[:-1, :-1] & mask[1:, :-1] & mask[:-1, 1:] & mask[1:, 1:]
    r = residual.astype(np.float64)
    mixed = np.abs(r[:-1, :-1] - r[1:, :-1] - r[:-1, 1:] + r[1:, 1:])
    return float(np.quantile(mixed[full], 0.25)) / (2 * QUARTILE) if full.any() else None


def _most(shares: dict[str, float]) -> tuple[str, float]:
    return max(shares.items(), key=lambda item: item[1], default=("", 0.0))


@dataclass(frozen=True)
class _Test:
    """Residuals in blocks of one size: their grain, whether that is more than chance, shares of causes, the worst."""

    grain: float
    alike: bool
    shares: dict[str, float]
    row: float
    column: float


def _tested(residual: Map, predicted: Map | None, mask: Bool[np.ndarray, "row column"], edge: int) -> _Test | None:
    kept = np.where(mask[..., None], residual, 0.0).astype(np.float64)
    count = _blocks(mask.astype(np.float64)[..., None], edge)[..., 0]
    full = count >= edge * edge / 2
    square = float((kept**2).sum()) / max(kept.shape[-1] * int(mask.sum()), 1)
    if int(full.sum()) < FEWEST or not square > 0:
        return None
    own = count[full][:, None]
    z = _blocks(kept, edge)[full] / np.sqrt(own * square)  # of white noise each has the variance 1
    energy = float((z**2).mean())
    alike = energy > max(1 + SURE * math.sqrt(2 / z.size), GRAIN[edge] ** 2)
    shares: dict[str, float] = {}
    for cause, patterns in (_patterns(predicted) if alike and predicted is not None else {}).items():
        means = [_blocks(np.where(mask[..., None], p, 0.0), edge)[full] / np.sqrt(own) for p in patterns]
        shares[cause] = _share(z, np.stack(means, axis=-1))
    worst = int(np.argmax((z**2).sum(axis=1)))
    row, column = (float(i + 0.5) * edge for i in np.argwhere(full)[worst])
    return _Test(math.sqrt(energy), alike, shares, row, column)


def _blocks(values: Map, edge: int) -> Float[np.ndarray, "rows columns c"]:
    """Sums over blocks; a rim that fills none is left out."""
    rows, columns, channels = values.shape
    high, wide = rows // edge, columns // edge
    cut = values[: high * edge, : wide * edge]
    return cut.reshape(high, edge, wide, edge, channels).sum(axis=(1, 3))


def _share(z: Float[np.ndarray, "b c"], patterns: Float[np.ndarray, "b c pattern"]) -> float:
    """Of what white noise would not leave, the share that a sum of patterns takes away."""
    flat, own = z.ravel(), patterns.reshape(z.size, -1)
    size = np.linalg.norm(own, axis=0)
    own = own[:, size > 0] / size[size > 0]
    if not own.shape[1]:
        return 0.0
    found, *_ = np.linalg.lstsq(own, flat, rcond=1e-6)
    taken = float((flat**2).sum() - ((flat - own @ found) ** 2).sum()) - own.shape[1]
    return taken / (float((flat**2).sum()) - flat.size)


def _patterns(predicted: Map) -> dict[str, list[Map]]:
    """The patterns of every cause."""
    rows, columns, channels = predicted.shape
    d = predicted.astype(np.float64)
    along, down = np.gradient(d, axis=1), np.gradient(d, axis=0)
    half = max(rows, columns) / 2
    x = np.broadcast_to(((np.arange(columns) - (columns - 1) / 2) / half)[None, :, None], d.shape)
    y = np.broadcast_to(((np.arange(rows) - (rows - 1) / 2) / half)[:, None, None], d.shape)
    each = [np.zeros_like(d) for _ in range(channels)]
    for channel, pattern in enumerate(each):
        pattern[..., channel] = 1.0
    smooth = np.gradient(along, axis=1) + np.gradient(down, axis=0)
    turned = x * down - y * along
    if channels == 2:  # vectors turn with the image
        turned = turned * half + np.stack([d[..., 1], -d[..., 0]], axis=-1)
    return {"offset": each, "calibration": [along, down, turned], "scale": [d], "blur": [smooth]}
