"""Sums over the planes that rays cross, and their adjoint, on all cores of a CPU, compiled by Numba.

See kernels_torch.py for the same in plain PyTorch, and planes.py for what a path is. Arithmetic is in double precision.

What is known before goes by the length of a tuple, so that no branch is left in the compiled loops: `spline` has a
number for each neighbour, `part` three for the gradient and one for the value. Indices are unsigned, for signed ones
are asked each time whether they count from the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit, prange
from numba.extending import overload

__all__ = ["CUBIC", "FASTMATH", "GRADIENT", "LINEAR", "VALUE", "integrate", "profile_at", "spread", "weights_at"]

FASTMATH = {"reassoc", "contract", "nsz", "arcp"}  # no promise of finite numbers: a NaN stays a NaN
LINEAR, CUBIC = (0.0, 0.0), (0.0, 0.0, 0.0, 0.0)
VALUE, GRADIENT = (0.0,), (0.0, 0.0, 0.0)
SLAB = 8  # planes that a thread adds to at a time, which stay in its cache


def integrate(degree: int, value: np.ndarray, slope: np.ndarray | None, path: Sequence[np.ndarray]) -> np.ndarray:
    """Return (n, 3), the integrals of the slopes along u, v and the axis, or (n, 1), that of the value, of each ray."""
    kind = VALUE if slope is None else GRADIENT
    seen = np.empty((len(path[0]), len(kind)))
    _integrate(value, value if slope is None else slope, *path, seen, LINEAR if degree == 1 else CUBIC, kind)
    return seen


def spread(degree: int, seen: np.ndarray, path: Sequence[np.ndarray], shape: Sequence[int]) -> list[np.ndarray]:
    """Return what the adjoint makes of integrals (n, 3) or (n, 1): planes of the value and, of three, of the slope."""
    kind = VALUE if seen.shape[1] == 1 else GRADIENT
    planes = [np.zeros(shape) for _ in range(1 if kind == VALUE else 2)]
    _spread(planes[0], planes[-1], *path, seen, LINEAR if degree == 1 else CUBIC, kind)
    return planes


def _linear(t: Any, spline: Any) -> Any:
    return (1 - t, t), (-1.0, 1.0)


def _cubic(t: Any, spline: Any) -> Any:
    s = 1 - t
    t2, s2 = t * t, s * s
    weights = (s2 * s / 6, 2 / 3 - t2 + 0.5 * t2 * t, 2 / 3 - s2 + 0.5 * s2 * s, t2 * t / 6)
    slopes = (-0.5 * s2, 1.5 * t2 - 2 * t, 2 * s - 1.5 * s2, 0.5 * t2)
    return weights, slopes


def weights_at(t: Any, spline: Any) -> Any:
    """Weights of the neighbours, and their slopes, as fields.grid.spline_weights has them."""
    return _linear(t, spline) if len(spline) == 2 else _cubic(t, spline)


@overload(weights_at, jit_options={"fastmath": FASTMATH})
def _compiled_weights(t: Any, spline: Any) -> Any:
    return _linear if len(spline) == 2 else _cubic  # by the type of `spline`, so that no branch is left


def _even_weight(profile, m):
    return profile[0] + m * profile[1]


def _listed_weight(profile, m):
    return profile[m, 0]


def profile_at(profile, m):
    """Weight of a sample: the profile of a ray is (2,), first value and increment, or (m, 1), sample by sample."""
    raise NotImplementedError("compiled only")


@overload(profile_at, jit_options={"fastmath": FASTMATH})
def _compiled_profile(profile, m):
    return _even_weight if profile.ndim == 1 else _listed_weight


@njit(fastmath=FASTMATH)
def _weight(profile, lost, m, count):
    # without a branch, which would halve the speed of the loops
    return profile_at(profile, m) * (1.0 - (m == 0) * lost[0] - (m == count - 1) * lost[1])


@njit(fastmath=FASTMATH)
def _along(value, slope, start, stride, profile, lost, first, count, spline, part):
    """Integrals of one ray; of the value alone in the first place."""
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
def _integrate(value, slope, start, stride, profile, lost, first, count, seen, spline, part):
    for r in prange(count.shape[0]):
        q = _along(value, slope, start[r], stride[r], profile[r], lost[r], first[r], count[r], spline, part)
        for i in range(len(part)):
            seen[r, i] = q[i]


@njit(fastmath=FASTMATH)
def _back(value, slope, start, stride, profile, lost, first, count, low, high, q, spline, part):
    """Add what one ray says to the planes that it crosses between two of its samples."""
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
def _spread(value, slope, start, stride, profile, lost, first, count, seen, spline, part):
    # a slab of planes is one thread's, so that no two write to the same place: the sum is the same however many threads
    # there are
    planes = value.shape[0]
    for slab in prange((planes + SLAB - 1) // SLAB):
        begin, end = slab * SLAB, min(planes, (slab + 1) * SLAB)
        for r in range(count.shape[0]):
            low, high = max(0, begin - first[r]), min(count[r], end - first[r])
            if low < high:
                _back(
                    value, slope, start[r], stride[r], profile[r], lost[r], first[r], count[r], low, high, seen[r],
                    spline, part,
                )  # fmt: skip
