"""Periodic cubic splines of four channels at points, and the adjoint, compiled by Numba in single precision.

Coefficients are (z, y, x, channel), so that the four channels of a node are one vector register. Three more layers at
the end of each axis repeat those of the beginning: neighbours are then contiguous.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from nerif.fields.spline_kernel import FASTMATH

__all__ = ["CHANNELS", "LAYERS", "interpolate", "spread"]

CHANNELS, LAYERS = 4, 3
CHUNK = 4096  # points
HALF, SIXTH, TWO_THIRDS = np.float32(1 / 2), np.float32(1 / 6), np.float32(2 / 3)
ONE, TWO, THREE_HALVES = np.float32(1), np.float32(2), np.float32(3 / 2)


@njit(fastmath=FASTMATH, nogil=True, cache=True)
def _neighbours(p, count):
    """Index of the first of four nodes about a position, their weights and slopes, as in fields.spline_kernel."""
    cell = np.floor(p)
    t = p - cell
    s = ONE - t
    t2, s2 = t * t, s * s
    weights = s2 * s * SIXTH, TWO_THIRDS - t2 + HALF * t2 * t, TWO_THIRDS - s2 + HALF * s2 * s, t2 * t * SIXTH
    slopes = -HALF * s2, THREE_HALVES * t2 - TWO * t, TWO * s - THREE_HALVES * s2, HALF * t2
    first = int(cell) - 1
    if first < 0 or first >= count:
        first %= count
    return np.uint64(first), weights, slopes


@njit(parallel=True, fastmath=FASTMATH, cache=True)
def interpolate(c, points, values):
    """Values (point, channel) of coefficients (z, y, x, channel) at points (point, 3) in nodes."""
    nz, ny, nx = c.shape[0] - LAYERS, c.shape[1] - LAYERS, c.shape[2] - LAYERS
    count = points.shape[0]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        for n in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            ix, wx, _ = _neighbours(points[n, 0], nx)
            iy, wy, _ = _neighbours(points[n, 1], ny)
            iz, wz, _ = _neighbours(points[n, 2], nz)
            v0 = v1 = v2 = v3 = np.float32(0)
            for k in range(4):
                for j in range(4):
                    w = wz[k] * wy[j]
                    row = c[iz + np.uint64(k), iy + np.uint64(j)]
                    for i in range(4):
                        m, weight = ix + np.uint64(i), w * wx[i]
                        v0 += weight * row[m, 0]
                        v1 += weight * row[m, 1]
                        v2 += weight * row[m, 2]
                        v3 += weight * row[m, 3]
            values[n, 0], values[n, 1], values[n, 2], values[n, 3] = v0, v1, v2, v3


@njit(parallel=True, fastmath=FASTMATH, cache=True)
def spread(c, points, gradient, by_coefficients, by_points):
    """Derivatives of sum(gradient * values) by coefficients, added to those of each thread, and by points."""
    nz, ny, nx = c.shape[0] - LAYERS, c.shape[1] - LAYERS, c.shape[2] - LAYERS
    threads, count = by_coefficients.shape[0], points.shape[0]
    for thread in prange(threads):
        total = by_coefficients[thread]
        for n in range(count * thread // threads, count * (thread + 1) // threads):
            ix, wx, sx = _neighbours(points[n, 0], nx)
            iy, wy, sy = _neighbours(points[n, 1], ny)
            iz, wz, sz = _neighbours(points[n, 2], nz)
            g0, g1, g2, g3 = gradient[n, 0], gradient[n, 1], gradient[n, 2], gradient[n, 3]
            gx = gy = gz = np.float32(0)
            for k in range(4):
                for j in range(4):
                    w = wz[k] * wy[j]
                    row = c[iz + np.uint64(k), iy + np.uint64(j)]
                    out = total[iz + np.uint64(k), iy + np.uint64(j)]
                    along = slope = np.float32(0)
                    for i in range(4):
                        m, weight = ix + np.uint64(i), w * wx[i]
                        projected = g0 * row[m, 0] + g1 * row[m, 1] + g2 * row[m, 2] + g3 * row[m, 3]
                        along += wx[i] * projected
                        slope += sx[i] * projected
                        out[m, 0] += weight * g0
                        out[m, 1] += weight * g1
                        out[m, 2] += weight * g2
                        out[m, 3] += weight * g3
                    gx += w * slope
                    gy += wz[k] * sy[j] * along
                    gz += sz[k] * wy[j] * along
            by_points[n, 0], by_points[n, 1], by_points[n, 2] = gx, gy, gz
