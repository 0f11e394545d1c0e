"""Sums over the planes that rays cross, and the adjoint, in PyTorch: for GPUs, and as the readable twin.

kernels_numba.py is the compiled twin for CPUs; planes.py defines a path.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.fields.voxel_field import spline_weights

__all__ = ["integrate", "spread"]

SAMPLES_AT_A_TIME = {"cpu": 1 << 14, "gpu": 1 << 22}
"""What stays in the cache of a CPU, and fills a GPU."""
CHUNK_BYTES = 1 << 30  # of the arrays of a chunk on a GPU, about 60 numbers a sample


def integrate(
    degree: int, value: Float[Tensor, "k v u"], slope: Float[Tensor, "k v u"] | None, path: Sequence[Tensor]
) -> Float[Tensor, "n q"]:
    """Return per ray the integrals of the slopes along u, v and the axis, (n, 3), or of the value alone, (n, 1)."""
    integrals = []
    for chunk in _chunks(path):
        place, (bu, bv), (su, sv), w = _samples(degree, chunk, value.shape)
        sums = [torch.zeros_like(w) for _ in range(1 if slope is None else 3)]
        for j in range(degree + 1):
            row = _row(place, j, value.shape, degree)
            line = value.reshape(-1)[row]
            if slope is None:
                sums[0] += (line * bu).sum(-1) * bv[..., j]
                continue
            sums[0] += (line * su).sum(-1) * bv[..., j]
            sums[1] += (line * bu).sum(-1) * sv[..., j]
            sums[2] += (slope.reshape(-1)[row] * bu).sum(-1) * bv[..., j]
        integrals.append(torch.stack([(w * g).sum(-1) for g in sums], dim=-1))
    return torch.cat(integrals)


def spread(degree: int, sums: Float[Tensor, "n q"], path: Sequence[Tensor], shape: Sequence[int]) -> list[Tensor]:
    """Apply the adjoint to integrals (n, 3) or (n, 1): return planes of the value and, for three, of the slope."""
    planes = [sums.new_zeros(*shape) for _ in range(1 if sums.shape[1] == 1 else 2)]
    first = 0
    for chunk in _chunks(path):
        place, (bu, bv), (su, sv), w = _samples(degree, chunk, planes[0].shape)
        q = sums[first : first + len(w)]
        first += len(w)
        for j in range(degree + 1):
            row = _row(place, j, planes[0].shape, degree).reshape(-1)
            if len(planes) == 1:
                share = (w * q[:, :1] * bv[..., j])[..., None] * bu
            else:
                share = (w * q[:, :1] * bv[..., j])[..., None] * su + (w * q[:, 1:2] * sv[..., j])[..., None] * bu
                across = (w * q[:, 2:] * bv[..., j])[..., None] * bu
                planes[1].reshape(-1).index_add_(0, row, across.reshape(-1))
            planes[0].reshape(-1).index_add_(0, row, share.reshape(-1))
    return planes


def _chunks(path: Sequence[Tensor]) -> Iterator[list[Tensor]]:
    count = path[-1]
    size = max(1, SAMPLES_AT_A_TIME["cpu" if count.device.type == "cpu" else "gpu"] // max(1, int(count.max())))
    for first in range(0, len(count), size):
        yield [a[first : first + size] for a in path]


def _samples(
    degree: int, path: Sequence[Tensor], shape: torch.Size
) -> tuple[Tensor, tuple[Tensor, ...], tuple[Tensor, ...], Tensor]:
    """First neighbour (plane, v, u), weights and slopes along u and v, and w of every sample; w = 0 beyond the last."""
    start, stride, profile, lost, first, count = path
    last = count[:, None] - 1
    m = torch.arange(int(count.max()), device=start.device)
    step = torch.minimum(m, last)
    position = start[:, None] + step[..., None].to(start) * stride[:, None]
    highest = torch.tensor([shape[2], shape[1]], device=start.device) - (degree + 1)
    cell = torch.minimum(position.floor().long().clamp_min(0), highest)
    weights, slopes = spline_weights(position - cell, degree)
    w = profile[:, :1] + step * profile[:, 1:] if profile.ndim == 2 else profile[..., 0].gather(1, step.long())
    w = w * (1 - (m == 0) * lost[:, :1] - (m == last) * lost[:, 1:]) * (m <= last)
    place = torch.cat([(first[:, None] + step)[..., None].long(), cell.flip(-1)], dim=-1)
    return place, weights.unbind(-2), slopes.unbind(-2), w


def _row(place: Tensor, j: int, shape: torch.Size, degree: int) -> Tensor:
    """Flat indices of the neighbours along u, j rows after the first."""
    first = (place[..., 0] * shape[1] + place[..., 1] + j) * shape[2] + place[..., 2]
    return first[..., None] + torch.arange(degree + 1, device=place.device)
