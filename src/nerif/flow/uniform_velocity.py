"""The convection velocity of a flow, by correlation of consecutive frames."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["common_velocity"]

FARTHEST = 0.4  # of an edge of the box, in an interval
SEEN = 0.3  # of the squared density: both frames have it in their overlap


def common_velocity(
    theta: Float[Tensor, "t z y x"], spacing: Sequence[float], intervals: Sequence[float]
) -> Float[Tensor, 3]:
    """Return the velocity along x, y, z (mm/s) with which consecutive frames correlate best: the median of all.

    Parameters
    ----------
    spacing : of the voxels along z, y, x, mm
    intervals : between the frames, s
    """
    size = [2 * n for n in theta.shape[1:]]  # zeros around: the flow leaves the box
    lags = [torch.fft.fftfreq(n, 1 / n) for n in size]
    near = [lag.abs() <= max(1.0, FARTHEST * n / 2) for lag, n in zip(lags, size, strict=True)]
    nearby = near[0][:, None, None] & near[1][:, None] & near[2]

    def correlated(a: Tensor, b: Tensor) -> Tensor:
        return torch.fft.irfftn(torch.fft.rfftn(a, s=size).conj() * torch.fft.rfftn(b, s=size), s=size)

    velocities, ones = [], torch.ones_like(theta[0])
    for before, after, seconds in zip(theta[:-1], theta[1:], intervals, strict=True):
        energies = torch.stack([correlated(before.square(), ones), correlated(ones, after.square())])  # in both frames
        allowed = nearby & (energies > SEEN * energies[:, 0, 0, 0].reshape(2, 1, 1, 1)).all(dim=0)
        correlation = correlated(before, after) / energies.prod(dim=0).clamp_min(1e-30).sqrt()
        peak = torch.unravel_index(correlation.masked_fill(~allowed, -torch.inf).argmax(), size)
        whole = [round(float(lag[at])) for lag, at in zip(lags, peak, strict=True)]
        shift = torch.tensor(whole) + _rest(before, after, whole)
        velocities.append((shift * torch.tensor(spacing) / seconds).flip(0))
    return torch.stack(velocities).median(dim=0).values


def _rest(before: Tensor, after: Tensor, shift: Sequence[int]) -> Float[Tensor, 3]:
    """Displacement in voxels along z, y, x beyond a shift in whole ones, by the gradient where both frames overlap."""
    sizes = list(zip(before.shape, shift, strict=True))
    a = before[tuple(slice(max(0, -m), n - max(0, m)) for n, m in sizes)]
    b = after[tuple(slice(max(0, m), n - max(0, -m)) for n, m in sizes)]
    axes = [axis for axis, n in enumerate(a.shape) if n > 1]
    slopes = torch.stack(torch.gradient(0.5 * (a + b), dim=axes)).flatten(1).T
    rest = torch.zeros(3)
    rest[axes] = torch.linalg.lstsq(slopes, (a - b).reshape(-1, 1), driver="gelsd").solution[:, 0]
    return rest.clamp(-1, 1)
