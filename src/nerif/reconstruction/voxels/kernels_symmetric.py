"""Sums along rays over a spline of (r, h), and the adjoint, on all cores of a CPU, compiled by Numba.

In the frame of a symmetry (geometry/symmetry.py) sample m of a ray is at start + m stride, that is at some (r, h). The
field is summed, or its gradient along e1, e2, e3, in double precision.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from nerif.fields.spline_kernel import CUBIC, FASTMATH, LINEAR, weights_at
from nerif.reconstruction.voxels.kernels_numba import GRADIENT, VALUE, profile_at

__all__ = ["integrate", "spread"]

RAY_GROUPS = 16  # each with coefficients of its own, so that the sum does not depend on the number of threads


def integrate(degree: int, padded: Tensor, path: Sequence[Tensor], plane: Tensor, gradient: bool) -> Tensor:
    """Return per ray the integrals of the gradient along e1, e2, e3, (n, 3), or of the field, (n, 1).

    `padded` (z, k, x) is extended along z and x. `path` is start, stride (n, 3), profile (n, 2) or (n, m, 1), count
    (n,). `plane` (8) is lower r and h, voxel edges along r and h, voxels along r and h, rounding of the axis (below 0:
    no axis), layers before the first coefficient.
    """
    part = GRADIENT if gradient else VALUE
    sums = np.zeros((len(path[0]), len(part)))
    arrays = [a.numpy() for a in (padded, *path, plane)]
    _integrate(*arrays, sums, LINEAR if degree == 1 else CUBIC, part)
    return torch.from_numpy(sums)


def spread(
    degree: int, sums: Tensor, path: Sequence[Tensor], plane: Tensor, shape: Sequence[int], groups: int = RAY_GROUPS
) -> Tensor:
    """Apply the adjoint to integrals (n, 3) or (n, 1): return coefficients (group, z, k, x) of each group of rays."""
    part = VALUE if sums.shape[1] == 1 else GRADIENT
    each = np.zeros((groups, *shape))
    _spread(each, *(a.numpy() for a in (*path, plane, sums)), LINEAR if degree == 1 else CUBIC, part)
    return torch.from_numpy(each)


@njit(fastmath=FASTMATH)
def _sample(start, stride, m, plane, spline):
    """Whether a sample is on the grid; r and its direction; first coefficients along r and h and their weights."""
    x, y, h = start[0] + m * stride[0], start[1] + m * stride[1], start[2] + m * stride[2]
    if plane[6] >= 0:
        r = np.sqrt(x * x + y * y + plane[6] * plane[6])
        along, aside = x / r, y / r
    else:
        r, along, aside = x, 1.0, 0.0
    pr, ph = (r - plane[0]) / plane[2] - 0.5, (h - plane[1]) / plane[3] - 0.5
    cr = min(max(np.floor(pr), -1.0), plane[4] - 1)
    ch = min(max(np.floor(ph), -1.0), plane[5] - 1)
    first = plane[7] - len(spline) // 2 + 1
    inside = -0.5 <= pr <= plane[4] - 0.5
    weights_r, weights_h = weights_at(pr - cr, spline), weights_at(ph - ch, spline)
    return inside, r, along, aside, int(cr + first), int(ch + first), weights_r, weights_h


@njit(fastmath=FASTMATH)
def _phases(angles):
    """(m, k), exp(-2 pi i m k / angles) of the harmonics m = 1 ... (angles - 1) / 2."""
    phases = np.empty(((angles - 1) // 2, angles), dtype=np.complex128)
    for m in range(len(phases)):
        for k in range(angles):
            phases[m, k] = np.exp(-2j * np.pi * ((m + 1) * k) / angles)
    return phases


@njit(fastmath=FASTMATH)
def _angles(r, along, aside, phases, share, rise):
    """Set D_k (`share`) and its slopes along e1 and e2 (`rise`)."""
    count = len(share)
    share[:], rise[:] = 1.0 / count, 0.0
    u, power = complex(along, aside), complex(2.0 / count, 0.0)
    for m in range(len(phases)):
        east, north = (m + 1) * power / r * (1.0 - u * along), (m + 1) * power / r * (1j - u * aside)
        power = power * u
        for k in range(count):
            share[k] += (power * phases[m, k]).real
            rise[k, 0] += (east * phases[m, k]).real
            rise[k, 1] += (north * phases[m, k]).real


@njit(parallel=True, fastmath=FASTMATH, cache=True)
def _integrate(padded, start, stride, profile, count, plane, sums, spline, part):
    neighbours, angles = len(spline), padded.shape[1]
    phases = _phases(angles)
    for n in prange(len(start)):
        share, rise = np.ones(angles), np.zeros((angles, 2))
        q1 = q2 = q3 = 0.0
        for m in range(count[n]):
            inside, r, along, aside, ir, ih, (br, sr), (bh, sh) = _sample(start[n], stride[n], m, plane, spline)
            if not inside:
                continue
            if angles > 1:
                _angles(r, along, aside, phases, share, rise)
            w = profile_at(profile[n], m)
            for k in range(angles):
                f = fr = fh = 0.0
                for j in range(neighbours):
                    line = sideways = 0.0
                    for i in range(neighbours):
                        c = padded[ih + j, k, ir + i]
                        line += c * br[i]
                        sideways += c * sr[i]
                    f += line * bh[j]
                    fr += sideways * bh[j]
                    fh += line * sh[j]
                if len(part) == 1:
                    q1 += w * share[k] * f
                else:
                    fr *= share[k] / plane[2]
                    q1 += w * (fr * along + rise[k, 0] * f)
                    q2 += w * (fr * aside + rise[k, 1] * f)
                    q3 += w * share[k] * fh / plane[3]
        sums[n, 0] = q1
        if len(part) == 3:
            sums[n, 1], sums[n, 2] = q2, q3


@njit(parallel=True, fastmath=FASTMATH, cache=True)
def _spread(each, start, stride, profile, count, plane, sums, spline, part):
    neighbours, angles, rays = len(spline), each.shape[2], len(start)
    phases = _phases(angles)
    for chunk in prange(len(each)):
        padded = each[chunk]
        share, rise = np.ones(angles), np.zeros((angles, 2))
        for n in range(chunk * rays // len(each), (chunk + 1) * rays // len(each)):
            for m in range(count[n]):
                inside, r, along, aside, ir, ih, (br, sr), (bh, sh) = _sample(start[n], stride[n], m, plane, spline)
                if not inside:
                    continue
                if angles > 1:
                    _angles(r, along, aside, phases, share, rise)
                w = profile_at(profile[n], m)
                for k in range(angles):
                    if len(part) == 1:
                        f, fr, fh = w * share[k] * sums[n, 0], 0.0, 0.0
                    else:
                        f = w * (sums[n, 0] * rise[k, 0] + sums[n, 1] * rise[k, 1])
                        fr = w * share[k] * (sums[n, 0] * along + sums[n, 1] * aside) / plane[2]
                        fh = w * share[k] * sums[n, 2] / plane[3]
                    for j in range(neighbours):
                        line, sideways = f * bh[j] + fh * sh[j], fr * bh[j]
                        for i in range(neighbours):
                            padded[ih + j, k, ir + i] += line * br[i] + sideways * sr[i]
