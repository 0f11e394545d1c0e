"""The path integral through a voxel grid and its adjoint on all cores of a CPU, compiled by Numba.

See kernels_torch.py for the same in plain PyTorch. Along ray r the samples m = 0 ... count - 1 stand at

    x_m = start + m stride  (in voxels, 0 at the first coefficient of the padded array),   w_m = lever_0 + m lever_1

and d = matrix sum_m w_m grad n(x_m). Arithmetic is in double precision, whatever the arrays are.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange
from numba.extending import overload

__all__ = ["adjoint", "forward"]

FASTMATH = {"reassoc", "contract", "nsz", "arcp"}  # no promise of finite numbers: a NaN stays a NaN
LINEAR, CUBIC = (0.0, 0.0), (0.0, 0.0, 0.0, 0.0)
SLAB = 4  # planes; at least the 4 that a cubic spline touches, so that slabs of one colour never meet
BLOCK = 64  # rays, neighbours in an image mostly, of which is known between which planes they stay


def forward(degree: int, padded: np.ndarray, rays: tuple[np.ndarray, ...], displacement: np.ndarray) -> None:
    """Write the displacement (n, 2) of each ray through the padded coefficients (z, y, x)."""
    _forward(padded, *rays, displacement, LINEAR if degree == 1 else CUBIC)


def adjoint(degree: int, displacement: np.ndarray, rays: tuple[np.ndarray, ...], padded: np.ndarray) -> None:
    """Add to the padded coefficients (z, y, x) what the adjoint makes of displacements (n, 2)."""
    _adjoint(padded, *rays, displacement, LINEAR if degree == 1 else CUBIC)


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


@njit(fastmath=FASTMATH)
def _integrate(c, start, stride, count, lever, spline):
    """Sum of w grad n along one ray, in index per voxel."""
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
                gx += slope * by[j] * bz[k]
                gy += along * sy[j] * bz[k]
                gz += along * by[j] * sz[k]
        w = lever[0] + m * lever[1]
        qx += w * gx
        qy += w * gy
        qz += w * gz
    return qx, qy, qz


@njit(parallel=True, fastmath=FASTMATH, cache=True)
def _forward(c, start, stride, lever, matrix, count, displacement, spline):
    for r in prange(count.shape[0]):
        qx, qy, qz = _integrate(c, start[r], stride[r], count[r], lever[r], spline)
        for i in range(2):
            displacement[r, i] = matrix[r, i, 0] * qx + matrix[r, i, 1] * qy + matrix[r, i, 2] * qz


@njit(fastmath=FASTMATH)
def _spread(c, start, stride, count, lever, q, first, last, spline):
    """Add w q . grad of each basis function along one ray, for the samples between planes `first` and `last`."""
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
        w = lever[0] + m * lever[1]
        ax, ay, az = w * q[0], w * q[1], w * q[2]
        for k in range(neighbours):
            for j in range(neighbours):
                slope = ax * by[j] * bz[k]
                along = ay * sy[j] * bz[k] + az * by[j] * sz[k]
                for i in range(neighbours):
                    c[iz + k, iy + j, ix + i] += slope * sx[i] + along * bx[i]


@njit(parallel=True, fastmath=FASTMATH, cache=True)
def _adjoint(c, start, stride, lever, matrix, count, displacement, spline):
    # each slab of planes is one thread's; every second one first, then the others, so that no two write to the same
    # voxel: one array is enough, and the sum is the same however many threads there are
    rays = count.shape[0]
    blocks = (rays + BLOCK - 1) // BLOCK
    low, high = np.empty(blocks), np.empty(blocks)
    q = np.empty((rays, 3))
    for b in prange(blocks):
        below, above = 1e30, -1e30
        for r in range(b * BLOCK, min(rays, (b + 1) * BLOCK)):
            for i in range(3):
                q[r, i] = matrix[r, 0, i] * displacement[r, 0] + matrix[r, 1, i] * displacement[r, 1]
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
                    _spread(c, start[r], stride[r], count[r], lever[r], q[r], first, first + SLAB, spline)
