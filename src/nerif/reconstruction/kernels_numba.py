"""The path integral through a voxel grid and its adjoint on all cores of a CPU, compiled by Numba.

See kernels_torch.py for the same in plain PyTorch. Along ray r the samples m = 0 ... count - 1 stand at

    x_m = start + m stride  (in voxels, 0 at the first coefficient of the padded array)

with the weight w_m = profile_0 + m profile_1 of a profile (n, 2), or profile_m of one (n, m, 1). A matrix (n, c, 3)
takes sum_m w_m grad f(x_m), a matrix (n, c, 1) takes sum_m w_m f(x_m). Arithmetic is in double precision.

What is known before goes by the length of a tuple, so that no branch is left in the compiled loops: `spline` has a
number for each neighbour, `part` three for the gradient and one for the value.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit, prange
from numba.extending import overload

__all__ = ["adjoint", "forward"]

FASTMATH = {"reassoc", "contract", "nsz", "arcp"}  # no promise of finite numbers: a NaN stays a NaN
LINEAR, CUBIC = (0.0, 0.0), (0.0, 0.0, 0.0, 0.0)
VALUE, GRADIENT = (0.0,), (0.0, 0.0, 0.0)
SLAB = 4  # planes; at least the 4 that a cubic spline touches, so that slabs of one colour never meet
BLOCK = 64  # rays, neighbours in an image mostly, of which is known between which planes they stay


def forward(degree: int, padded: np.ndarray, path: Sequence[np.ndarray], matrix: np.ndarray, seen: np.ndarray) -> None:
    """Add to `seen` (n, c) what the matrix of each ray makes of the padded coefficients (z, y, x)."""
    _forward(padded, *path, matrix, seen, *_kind(degree, matrix))


def adjoint(degree: int, seen: np.ndarray, path: Sequence[np.ndarray], matrix: np.ndarray, padded: np.ndarray) -> None:
    """Add to the padded coefficients (z, y, x) what the adjoint makes of `seen` (n, c)."""
    _adjoint(padded, *path, matrix, seen, *_kind(degree, matrix))


def _kind(degree: int, matrix: np.ndarray) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return LINEAR if degree == 1 else CUBIC, GRADIENT if matrix.shape[-1] == 3 else VALUE


def _linear(t: Any, spline: Any) -> Any:
    return (1 - t, t), (-1.0, 1.0)


def _cubic(t: Any, spline: Any) -> Any:
    s = 1 - t
    near, far = 4 - 6 * t * t + 3 * t * t * t, 4 - 6 * s * s + 3 * s * s * s
    weights = (s * s * s / 6, near / 6, far / 6, t * t * t / 6)
    slopes = (-0.5 * s * s, 1.5 * t * t - 2 * t, 2 * s - 1.5 * s * s, 0.5 * t * t)
    return weights, slopes


def _weights(t: Any, spline: Any) -> Any:
    """Weights of the neighbours, and their slopes, as fields.grid.spline_weights has them."""
    return _linear(t, spline) if len(spline) == 2 else _cubic(t, spline)


@overload(_weights, jit_options={"fastmath": FASTMATH})
def _compiled_weights(t: Any, spline: Any) -> Any:
    return _linear if len(spline) == 2 else _cubic  # by the type of `spline`, so that no branch is left


def _even_weight(profile, m):
    return profile[0] + m * profile[1]


def _listed_weight(profile, m):
    return profile[m, 0]


def _weight(profile, m):
    """Weight of a sample: the profile of a ray is (2,), first value and increment, or (m, 1), sample by sample."""
    raise NotImplementedError("compiled only")


@overload(_weight, jit_options={"fastmath": FASTMATH})
def _compiled_weight(profile, m):
    return _even_weight if profile.ndim == 1 else _listed_weight


@njit(fastmath=FASTMATH)
def _integrate(c, start, stride, profile, count, spline, part):
    """Sum of w grad f along one ray, in field per voxel, or of w f, in the first place."""
    neighbours = len(spline)
    qx = qy = qz = 0.0
    for m in range(count):
        x, y, z = start[0] + m * stride[0], start[1] + m * stride[1], start[2] + m * stride[2]
        ix, iy, iz = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
        bx, sx = _weights(x - ix, spline)
        by, sy = _weights(y - iy, spline)
        bz, sz = _weights(z - iz, spline)
        gx = gy = gz = 0.0
        for k in range(neighbours):
            for j in range(neighbours):
                along = slope = 0.0
                for i in range(neighbours):
                    value = c[iz + k, iy + j, ix + i]
                    along += value * bx[i]
                    slope += value * sx[i]
                if len(part) == 1:
                    gx += along * by[j] * bz[k]
                else:
                    gx += slope * by[j] * bz[k]
                    gy += along * sy[j] * bz[k]
                    gz += along * by[j] * sz[k]
        w = _weight(profile, m)
        qx += w * gx
        qy += w * gy
        qz += w * gz
    return qx, qy, qz


@njit(parallel=True, fastmath=FASTMATH, cache=True)
def _forward(c, start, stride, profile, count, matrix, seen, spline, part):
    for r in prange(count.shape[0]):
        q = _integrate(c, start[r], stride[r], profile[r], count[r], spline, part)
        for i in range(seen.shape[1]):
            for j in range(len(part)):
                seen[r, i] += matrix[r, i, j] * q[j]


@njit(fastmath=FASTMATH)
def _spread(c, start, stride, profile, count, q, first, last, spline, part):
    """Add w q . grad of each basis function along one ray, or w q of each, for the samples between two planes."""
    neighbours = len(spline)
    low, high = 0, count
    # about which samples: one more at both ends, for each is asked again below
    if abs(stride[2]) * count > 1e-3:
        a, b = (first - start[2]) / stride[2], (last - start[2]) / stride[2]
        if a > b:
            a, b = b, a
        if b < -1 or a > count:
            return
        low = max(0, int(a) - 1)
        if b < count - 2:
            high = int(b) + 2
    for m in range(low, high):
        z = start[2] + m * stride[2]
        iz = int(np.floor(z))
        if iz < first or iz >= last:
            continue
        x, y = start[0] + m * stride[0], start[1] + m * stride[1]
        ix, iy = int(np.floor(x)), int(np.floor(y))
        bx, sx = _weights(x - ix, spline)
        by, sy = _weights(y - iy, spline)
        bz, sz = _weights(z - iz, spline)
        w = _weight(profile, m)
        ax, ay, az = w * q[0], w * q[1], w * q[2]
        for k in range(neighbours):
            for j in range(neighbours):
                if len(part) == 1:
                    slope, along = 0.0, ax * by[j] * bz[k]
                else:
                    slope = ax * by[j] * bz[k]
                    along = ay * sy[j] * bz[k] + az * by[j] * sz[k]
                for i in range(neighbours):
                    c[iz + k, iy + j, ix + i] += slope * sx[i] + along * bx[i]


@njit(parallel=True, fastmath=FASTMATH, cache=True)
def _adjoint(c, start, stride, profile, count, matrix, seen, spline, part):
    # each slab of planes is one thread's; every second one first, then the others, so that no two write to the same
    # voxel: one array is enough, and the sum is the same however many threads there are
    rays = count.shape[0]
    blocks = (rays + BLOCK - 1) // BLOCK
    low, high = np.empty(blocks), np.empty(blocks)
    q = np.zeros((rays, 3))
    for b in prange(blocks):
        below, above = 1e30, -1e30
        for r in range(b * BLOCK, min(rays, (b + 1) * BLOCK)):
            for i in range(seen.shape[1]):
                for j in range(len(part)):
                    q[r, j] += matrix[r, i, j] * seen[r, i]
            end = start[r, 2] + stride[r, 2] * count[r]
            below, above = min(below, start[r, 2], end), max(above, start[r, 2], end)
        low[b], high[b] = below, above
    slabs = (c.shape[0] + SLAB - 1) // SLAB
    for colour in range(2):
        for half in prange((slabs + 1 - colour) // 2):
            first = (2 * half + colour) * SLAB
            for b in range(blocks):
                if high[b] < first - 1 or low[b] > first + SLAB + 1:
                    continue
                for r in range(b * BLOCK, min(rays, (b + 1) * BLOCK)):
                    _spread(c, start[r], stride[r], profile[r], count[r], q[r], first, first + SLAB, spline, part)
