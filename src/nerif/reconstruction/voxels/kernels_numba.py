"""Sums over the planes that rays cross, and the adjoint, on all cores of a CPU, compiled by Numba in double precision.

kernels_torch.py is the readable twin; planes.py defines a path.

Branches are resolved at compile time by the length of a tuple: `spline` has one entry per neighbour, `part` three for
the gradient and one for the value. Indices are unsigned, since signed ones are tested for counting from the end.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numba import njit, prange
from numba.extending import overload
from torch import Tensor

from nerif.fields.spline_kernel import CUBIC, FASTMATH, LINEAR, weights_at

__all__ = ["GRADIENT", "VALUE", "integrate", "profile_at", "spread"]

VALUE, GRADIENT = (0.0,), (0.0, 0.0, 0.0)
SLAB_PLANES = 8  # that a thread adds to at a time, and that stay in its cache


def integrate(degree: int, value: Tensor, slope: Tensor | None, path: Sequence[Tensor]) -> Tensor:
    """Return per ray the integrals of the slopes along u, v and the axis, (n, 3), or of the value alone, (n, 1)."""
    part = VALUE if slope is None else GRADIENT
    sums = np.empty((len(path[0]), len(part)))
    planes = value.numpy(), (value if slope is None else slope).numpy()
    _integrate(*planes, *(a.numpy() for a in path), sums, LINEAR if degree == 1 else CUBIC, part)
    return torch.from_numpy(sums)


def spread(degree: int, sums: Tensor, path: Sequence[Tensor], shape: Sequence[int]) -> list[Tensor]:
    """Apply the adjoint to integrals (n, 3) or (n, 1): return planes of the value and, for three, of the slope."""
    part = VALUE if sums.shape[1] == 1 else GRADIENT
    planes = [np.zeros(shape) for _ in range(1 if part == VALUE else 2)]
    arrays = [a.numpy() for a in (*path, sums)]
    _spread(planes[0], planes[-1], *arrays, LINEAR if degree == 1 else CUBIC, part)
    return [torch.from_numpy(plane) for plane in planes]


def _even_weight(profile, m):
    return profile[0] + m * profile[1]


def _listed_weight(profile, m):
    return profile[m, 0]


def profile_at(profile, m):
    """Weight of sample m; the profile of a ray is (2,), first value and increment, or (m, 1), one value a sample."""
    raise NotImplementedError("compiled only")


@overload(profile_at, jit_options={"fastmath": FASTMATH})
def _compiled_profile(profile, m):
    return _even_weight if profile.ndim == 1 else _listed_weight


@njit(fastmath=FASTMATH)
def _weight(profile, lost, m, count):
    # a branch would halve the speed of the loops
    return profile_at(profile, m) * (1.0 - (m == 0) * lost[0] - (m == count - 1) * lost[1])


@njit(fastmath=FASTMATH)
def _along(value, slope, start, stride, profile, lost, first, count, spline, part):
    """Integrals of one ray; of the value: the first of the three."""
    neighbours = len(spline)
    qu = qv = qa = 0.0
    for m in range(count):
        u, v = start[0] + m * stride[0], start[1] + m * stride[1]
        cu = min(max(np.floor(u), 0.0), float(value.shape[2] - neighbours))
        cv = min(max(np.floor(v), 0.0), float(value.shape[1] - neighbours))
        bu, su = weights_at(u - cu, spline)
        bv, sv = weights_at(v - cv, spline)
        k, iv, iu = np.uint64(first + m), np.uint64(cv), np.uint64(cu)
        gu = gv = ga = 0.0
        for j in range(neighbours):
            along = sideways = across = 0.0
            for i in range(neighbours):
                c = value[k, iv + np.uint64(j), iu + np.uint64(i)]
                along += c * bu[i]
                if len(part) == 3:
                    sideways += c * su[i]
                    across += slope[k, iv + np.uint64(j), iu + np.uint64(i)] * bu[i]
            if len(part) == 3:
                gu += sideways * bv[j]
                gv += along * sv[j]
                ga += across * bv[j]
            else:
                gu += along * bv[j]
        w = _weight(profile, lost, m, count)
        qu += w * gu
        qv += w * gv
        qa += w * ga
    return qu, qv, qa


@njit(parallel=True, fastmath=FASTMATH, cache=True)
def _integrate(value, slope, start, stride, profile, lost, first, count, sums, spline, part):
    for r in prange(count.shape[0]):
        q = _along(value, slope, start[r], stride[r], profile[r], lost[r], first[r], count[r], spline, part)
        for i in range(len(part)):
            sums[r, i] = q[i]


@njit(fastmath=FASTMATH)
def _back(value, slope, start, stride, profile, lost, first, count, low, high, q, spline, part):
    """Add one ray to the planes of its samples low to high - 1."""
    neighbours = len(spline)
    for m in range(low, high):
        u, v = start[0] + m * stride[0], start[1] + m * stride[1]
        cu = min(max(np.floor(u), 0.0), float(value.shape[2] - neighbours))
        cv = min(max(np.floor(v), 0.0), float(value.shape[1] - neighbours))
        bu, su = weights_at(u - cu, spline)
        bv, sv = weights_at(v - cv, spline)
        k, iv, iu = np.uint64(first + m), np.uint64(cv), np.uint64(cu)
        w = _weight(profile, lost, m, count)
        for j in range(neighbours):
            if len(part) == 3:
                sideways, along, across = w * q[0] * bv[j], w * q[1] * sv[j], w * q[2] * bv[j]
                for i in range(neighbours):
                    value[k, iv + np.uint64(j), iu + np.uint64(i)] += sideways * su[i] + along * bu[i]
                    slope[k, iv + np.uint64(j), iu + np.uint64(i)] += across * bu[i]
            else:
                along = w * q[0] * bv[j]
                for i in range(neighbours):
                    value[k, iv + np.uint64(j), iu + np.uint64(i)] += along * bu[i]


@njit(parallel=True, fastmath=FASTMATH, cache=True)
def _spread(value, slope, start, stride, profile, lost, first, count, sums, spline, part):
    # each slab belongs to one thread: no races, and the sum does not depend on the number of threads
    planes = value.shape[0]
    for slab in prange((planes + SLAB_PLANES - 1) // SLAB_PLANES):
        begin, end = slab * SLAB_PLANES, min(planes, (slab + 1) * SLAB_PLANES)
        for r in range(count.shape[0]):
            low, high = max(0, begin - first[r]), min(count[r], end - first[r])
            if low < high:
                _back(
                    value, slope, start[r], stride[r], profile[r], lost[r], first[r], count[r], low, high, sums[r],
                    spline, part,
                )  # fmt: skip
