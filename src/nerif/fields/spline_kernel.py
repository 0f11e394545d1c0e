"""Values and gradients of B-splines at points, compiled by Numba in double precision.

VoxelField.value_and_gradient is the readable twin. Branches are resolved at compile time by the length of the tuple
`spline`, which has one entry per neighbour. Indices are unsigned, since signed ones are tested for counting from the
end. The kernel has one thread, the caller's: Numba's threads may be started by one Python thread at a time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from numba.extending import overload
from torch import Tensor

__all__ = ["CUBIC", "FASTMATH", "LINEAR", "evaluate", "weights_at"]

FASTMATH = {"reassoc", "contract", "nsz", "arcp"}  # without the promise of finite numbers: a NaN stays a NaN
LINEAR, CUBIC = (0.0, 0.0), (0.0, 0.0, 0.0, 0.0)


def evaluate(coefficients: Tensor, degree: int, points: Tensor, lower: Any, upper: Any, spacing: Any) -> Any:
    """Return values (n,) and gradients (n, 3) at points (n, 3), in their precision, all on the CPU."""
    values, gradients = np.empty(len(points)), np.empty((len(points), 3))
    where, c = points.detach().numpy(), coefficients.detach().contiguous().numpy()
    box, spline = np.array([lower, upper, spacing]), LINEAR if degree == 1 else CUBIC
    _evaluate(c, where, box, values, gradients, spline)
    return torch.from_numpy(values).to(points), torch.from_numpy(gradients).to(points)


def _linear(t: Any, spline: Any) -> Any:
    return (1 - t, t), (-1.0, 1.0)


def _cubic(t: Any, spline: Any) -> Any:
    s = 1 - t
    t2, s2 = t * t, s * s
    weights = (s2 * s / 6, 2 / 3 - t2 + 0.5 * t2 * t, 2 / 3 - s2 + 0.5 * s2 * s, t2 * t / 6)
    slopes = (-0.5 * s2, 1.5 * t2 - 2 * t, 2 * s - 1.5 * s2, 0.5 * t2)
    return weights, slopes


def weights_at(t: Any, spline: Any) -> Any:
    """Weights of the neighbours and their slopes, as in fields.grid.spline_weights."""
    return _linear(t, spline) if len(spline) == 2 else _cubic(t, spline)


@overload(weights_at, jit_options={"fastmath": FASTMATH})
def _compiled_weights(t: Any, spline: Any) -> Any:
    return _linear if len(spline) == 2 else _cubic


@njit(fastmath=FASTMATH)
def _axis(p, box, axis):
    """Position in voxels from the first centre, nearest in the box, and its derivative: 0 outside."""
    inside = min(max(p, box[0, axis]), box[1, axis])
    return (inside - box[0, axis]) / box[2, axis] - 0.5, 1.0 * (inside == p) / box[2, axis]


@njit(fastmath=FASTMATH, nogil=True, cache=True)
def _evaluate(c, points, box, values, gradients, spline):
    count = len(spline)
    shift = count // 2 - (count - 1) // 2  # layers beyond the face, less the neighbours before the cell
    for m in range(points.shape[0]):
        if np.isnan(points[m, 0]) or np.isnan(points[m, 1]) or np.isnan(points[m, 2]):
            values[m] = np.nan
            gradients[m] = np.nan
            continue
        x, dx = _axis(float(points[m, 0]), box, 0)
        y, dy = _axis(float(points[m, 1]), box, 1)
        z, dz = _axis(float(points[m, 2]), box, 2)
        cx, cy, cz = np.floor(x), np.floor(y), np.floor(z)
        wx, sx = weights_at(x - cx, spline)
        wy, sy = weights_at(y - cy, spline)
        wz, sz = weights_at(z - cz, spline)
        ix, iy, iz = np.uint64(cx + shift), np.uint64(cy + shift), np.uint64(cz + shift)
        value = gx = gy = gz = 0.0
        for k in range(count):
            plane = plane_x = across = 0.0
            for j in range(count):
                along = slope = 0.0
                for i in range(count):
                    q = c[iz + np.uint64(k), iy + np.uint64(j), ix + np.uint64(i)]
                    along += q * wx[i]
                    slope += q * sx[i]
                plane += along * wy[j]
                across += along * sy[j]
                plane_x += slope * wy[j]
            value += plane * wz[k]
            gx += plane_x * wz[k]
            gy += across * wz[k]
            gz += plane * sz[k]
        values[m] = value
        gradients[m, 0] = gx * dx
        gradients[m, 1] = gy * dy
        gradients[m, 2] = gz * dz
