"""The path integral through a voxel grid and its adjoint in plain PyTorch: for CUDA, and to compare with.

See kernels_numba.py for the same on all cores of a CPU. Along ray r the samples m = 0 ... count - 1 stand at

    x_m = start + m stride  (in voxels, 0 at the first coefficient of the padded array)

with the weight w_m = profile_0 + m profile_1 of a profile (n, 2), or profile_m of one (n, m, 1). A matrix (n, c, 3)
takes sum_m w_m grad f(x_m), a matrix (n, c, 1) takes sum_m w_m f(x_m).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.fields.grid import spline_weights

__all__ = ["adjoint", "forward"]

POINTS = {"cpu": 1 << 14, "cuda": 1 << 22}
"""Samples taken at a time: what stays in the cache of a CPU, and fills a GPU."""

CHUNK_BYTES = 1 << 30  # of the arrays that a chunk on a GPU takes, some 60 numbers a sample


def forward(
    degree: int, padded: Tensor, path: Sequence[Tensor], matrix: Tensor, seen: Float[Tensor, "n c"]
) -> None:
    """Add to `seen` what the matrix of each ray makes of the padded coefficients (z, y, x)."""
    flat, shape = padded.reshape(-1), padded.shape
    for part, (start, stride, profile, count) in _chunks(path):
        index, (bx, by, bz), (sx, sy, sz), w = _samples(degree, start, stride, profile, count)
        gx, gy, gz = (torch.zeros_like(w) for _ in range(3))
        for k in range(degree + 1):
            for j in range(degree + 1):
                line = flat[_line(index, k, j, shape, degree)]
                along = (line * bx).sum(-1)
                if matrix.shape[-1] == 1:
                    gx += along * by[..., j] * bz[..., k]
                    continue
                gx += (line * sx).sum(-1) * by[..., j] * bz[..., k]
                gy += along * sy[..., j] * bz[..., k]
                gz += along * by[..., j] * sz[..., k]
        q = torch.stack([(w * g).sum(-1) for g in (gx, gy, gz)[: matrix.shape[-1]]], dim=-1)
        seen[part] += torch.einsum("nij,nj->ni", matrix[part], q)


def adjoint(
    degree: int, seen: Float[Tensor, "n c"], path: Sequence[Tensor], matrix: Tensor, padded: Tensor
) -> None:
    """Add to the padded coefficients (z, y, x) what the adjoint makes of `seen`."""
    flat, shape = padded.reshape(-1), padded.shape
    for part, (start, stride, profile, count) in _chunks(path):
        index, (bx, by, bz), (sx, sy, sz), w = _samples(degree, start, stride, profile, count)
        q = torch.einsum("nij,ni->nj", matrix[part], seen[part])
        for k in range(degree + 1):
            for j in range(degree + 1):
                ax, *others = (w * a[:, None] for a in q.unbind(-1))
                if not others:
                    share = (ax * by[..., j] * bz[..., k])[..., None] * bx
                else:
                    ay, az = others
                    along = ay * sy[..., j] * bz[..., k] + az * by[..., j] * sz[..., k]
                    share = (ax * by[..., j] * bz[..., k])[..., None] * sx + along[..., None] * bx
                flat.index_add_(0, _line(index, k, j, shape, degree).reshape(-1), share.reshape(-1))


def _chunks(path: Sequence[Tensor]) -> Iterator[tuple[slice, list[Tensor]]]:
    count = path[-1]
    longest = max(1, int(count.max())) if len(count) else 1
    size = max(1, POINTS.get(count.device.type, 1 << 14) // longest)
    for first in range(0, len(count), size):
        part = slice(first, first + size)
        yield part, [a[part] for a in path]


def _samples(
    degree: int, start: Tensor, stride: Tensor, profile: Tensor, count: Tensor
) -> tuple[Tensor, tuple[Tensor, ...], tuple[Tensor, ...], Tensor]:
    """First neighbour, weights and slopes along x, y, z, and w of every sample; w = 0 beyond a ray's own count."""
    m = torch.arange(max(1, int(count.max())), device=start.device)
    step = torch.minimum(m, (count[:, None] - 1).clamp_min(0)).to(start)
    x = start[:, None] + step[..., None] * stride[:, None]
    cell = x.floor()
    weights, slopes = spline_weights(x - cell, degree)
    even = profile.ndim == 2
    w = profile[:, :1] + step * profile[:, 1:] if even else profile[..., 0].gather(1, step.long())
    w = w * (m < count[:, None])
    return cell.long(), weights.unbind(-2), slopes.unbind(-2), w


def _line(index: Tensor, k: int, j: int, shape: torch.Size, degree: int) -> Tensor:
    """Flat indices of the neighbours along x, k planes and j rows on from the first."""
    first = ((index[..., 2] + k) * shape[1] + index[..., 1] + j) * shape[2] + index[..., 0]
    return first[..., None] + torch.arange(degree + 1, device=index.device)
