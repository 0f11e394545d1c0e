"""Periodic cubic splines at points and the adjoint, compiled by Numba; a thread for each channel.

Coefficients have three more layers at the end of each axis, those of the beginning: neighbours are then contiguous.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from nerif.fields.spline_kernel import FASTMATH, weights_at

__all__ = ["LAYERS", "interpolate", "spread"]

LAYERS = 3


@njit(parallel=True, cache=True)
def interpolate(c, points, values, spline):
    """Values (channel, point) of coefficients (channel, z, y, x) at points (point, 3) in nodes."""
    for channel in prange(c.shape[0]):
        _interpolate(c[channel], points, values[channel], spline)


@njit(parallel=True, cache=True)
def spread(c, points, gradient, by_coefficients, by_points, spline):
    """Derivatives of sum(gradient * values) by coefficients (added) and, for each channel, by points."""
    for channel in prange(c.shape[0]):
        _spread(c[channel], points, gradient[channel], by_coefficients[channel], by_points[channel], spline)


@njit(fastmath=FASTMATH, nogil=True, cache=True)
def _neighbours(p, count, spline):
    """Index of the first of four nodes about a position, their weights and slopes, in single precision."""
    cell = np.floor(p)
    (a, b, c, d), (e, f, g, h) = weights_at(p - cell, spline)
    weights = np.float32(a), np.float32(b), np.float32(c), np.float32(d)
    slopes = np.float32(e), np.float32(f), np.float32(g), np.float32(h)
    return (int(cell) - 1) % count, weights, slopes


@njit(fastmath=FASTMATH, nogil=True, cache=True)
def _interpolate(c, points, values, spline):
    nz, ny, nx = c.shape[0] - LAYERS, c.shape[1] - LAYERS, c.shape[2] - LAYERS
    for n in range(points.shape[0]):
        ix, wx, _ = _neighbours(float(points[n, 0]), nx, spline)
        iy, wy, _ = _neighbours(float(points[n, 1]), ny, spline)
        iz, wz, _ = _neighbours(float(points[n, 2]), nz, spline)
        value = np.float32(0)
        for k in range(4):
            plane = np.float32(0)
            for j in range(4):
                row = c[iz + k, iy + j]
                along = row[ix] * wx[0] + row[ix + 1] * wx[1] + row[ix + 2] * wx[2] + row[ix + 3] * wx[3]
                plane += along * wy[j]
            value += plane * wz[k]
        values[n] = value


@njit(fastmath=FASTMATH, nogil=True, cache=True)
def _spread(c, points, gradient, by_coefficients, by_points, spline):
    nz, ny, nx = c.shape[0] - LAYERS, c.shape[1] - LAYERS, c.shape[2] - LAYERS
    for n in range(points.shape[0]):
        ix, wx, sx = _neighbours(float(points[n, 0]), nx, spline)
        iy, wy, sy = _neighbours(float(points[n, 1]), ny, spline)
        iz, wz, sz = _neighbours(float(points[n, 2]), nz, spline)
        g = gradient[n]
        gx = gy = gz = np.float32(0)
        for k in range(4):
            plane = plane_x = across = np.float32(0)
            for j in range(4):
                row, out = c[iz + k, iy + j], by_coefficients[iz + k, iy + j]
                a, b, d, e = row[ix], row[ix + 1], row[ix + 2], row[ix + 3]
                along = a * wx[0] + b * wx[1] + d * wx[2] + e * wx[3]
                plane_x += (a * sx[0] + b * sx[1] + d * sx[2] + e * sx[3]) * wy[j]
                plane += along * wy[j]
                across += along * sy[j]
                share = g * wz[k] * wy[j]
                out[ix] += share * wx[0]
                out[ix + 1] += share * wx[1]
                out[ix + 2] += share * wx[2]
                out[ix + 3] += share * wx[3]
            gx += plane_x * wz[k]
            gy += across * wz[k]
            gz += plane * sz[k]
        by_points[n, 0], by_points[n, 1], by_points[n, 2] = g * gx, g * gy, g * gz
