"""Choice of the regularisation weight from the data, from a weight that smooths too much downwards.

discrepancy   where sigma is known: the weight at which the residual equals the noise, mean (r / sigma)^2 = 1
L-curve       otherwise, or where the grid cannot resolve the data to the noise: the corner of log residual against log
              penalty

Sources: Morozov, Soviet Math. Dokl. 7 (1966); Hansen, SIAM Review 34 (1992).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import Tensor

from nerif.reconstruction.voxels.voxel_problem import Iterate

__all__ = ["COARSE_WEIGHT", "DISCREPANCY", "WeightChoice", "choose_weight", "sharpest_corner"]

FACTOR = 10**0.5  # between one weight and the next
HIGHEST, LOWEST = 1e-1, 1e-6
COARSE_WEIGHT = 1e-2  # on coarse grids, whose solution is only a start
PAST_CORNER = 3  # weights below the corner before it is accepted
MIN_DECREASE = 0.3  # of the excess over the noise, by which a lower weight must reduce the residual
DISCREPANCY = "the residual equals the noise (discrepancy principle)"

Solve = Callable[[float, Tensor], Iterate]
"""Solve with a weight, from a start."""


@dataclass(frozen=True)
class WeightChoice:
    """A weight, the field to start from, and the reason for the choice."""

    weight: float
    x: Tensor
    reason: str


def choose_weight(solve: Solve, x: Tensor, noise: float | None = None, guess: float | None = None) -> WeightChoice:
    """Return the weight by the discrepancy principle or the L-curve, starting from x.

    The noise is its residual |F x - b|^2, None where sigma is not known; the guess is the weight of a coarser grid,
    around which to search, or None to begin with HIGHEST.
    """
    weights = [HIGHEST if guess is None else guess]
    path = [solve(weights[0], x)]
    if noise is not None and path[0].residual <= noise:
        return _upward(solve, weights[0], path[0], noise)
    corner, bend = 0, 0.0
    while weights[-1] / FACTOR >= LOWEST:
        weights.append(weights[-1] / FACTOR)
        path.append(solve(weights[-1], path[-1].x))
        if noise is not None and path[-1].residual <= noise:
            return _between(weights[-2], path[-2], weights[-1], path[-1], noise)
        corner, bend = sharpest_corner([(p.residual, p.penalty) for p in path])
        needed = (corner, len(path) - 2, len(path) - 1, 0 if guess is not None else corner)
        path = [p if i in needed else replace(p, x=x) for i, p in enumerate(path)]  # frees memory
        if bend > 0 and len(path) > corner + PAST_CORNER:
            break
        decrease = path[-2].residual - path[-1].residual
        if guess is not None and noise is not None and decrease < MIN_DECREASE * (path[-2].residual - noise):
            return WeightChoice(weights[0], path[0].x, "weight of the coarser grid" + _excess(path[-1], noise))
    if bend <= 0:
        corner = len(path) - 1 if guess is None else 0
    fallback = "lowest weight of the search" if guess is None else "weight of the coarser grid"
    reason = "corner of the L-curve" if bend > 0 else f"{fallback}, since the L-curve has no corner"
    return WeightChoice(weights[corner], path[corner].x, reason + _excess(path[-1], noise))


def sharpest_corner(points: list[tuple[float, float]]) -> tuple[int, float]:
    """Return the index of the corner of an L-curve of (residual, penalty), and its curvature; (0, 0) if there is none.

    The curvature in logarithms is that of the circle through a point and its two neighbours (Menger), positive where
    the curve bends like an L as the weight falls: first along the residual, then along the penalty.
    """
    best, sharpest = 0, 0.0
    logs = [(math.log(max(r, 1e-300)), math.log(max(p, 1e-300))) for r, p in points]
    for i in range(1, len(logs) - 1):
        a, b, c = logs[i - 1 : i + 2]
        if not (a[0] > b[0] > c[0] and a[1] < b[1] < c[1]):
            continue  # not on the curve: unconverged, or both change by rounding only
        turn = (c[0] - a[0]) * (b[1] - a[1]) - (b[0] - a[0]) * (c[1] - a[1])  # twice the area between them
        curvature = 2 * turn / (math.dist(a, b) * math.dist(b, c) * math.dist(a, c))
        if curvature > sharpest:
            best, sharpest = i, curvature
    return best, sharpest


def _excess(last: Iterate, noise: float | None) -> str:
    """A remark on a residual that remains above the noise."""
    if noise is None:
        return ""
    ratio = math.sqrt(last.residual / noise)
    return f" (the residual remains at {ratio:.2f} sigma: sigma too small, or grid too coarse for the flow?)"


def _upward(solve: Solve, weight: float, iterate: Iterate, noise: float) -> WeightChoice:
    """Raise the weight until the residual exceeds the noise."""
    while weight < 1e6 * HIGHEST:
        above = solve(weight * FACTOR, iterate.x)
        if above.residual > noise:
            return _between(weight * FACTOR, above, weight, iterate, noise)
        weight, iterate = weight * FACTOR, above
    return WeightChoice(weight, iterate.x, "highest weight of the search: the signal does not exceed the noise")


def _between(upper: float, above: Iterate, lower: float, below: Iterate, noise: float) -> WeightChoice:
    """Interpolate the residual in logarithms."""
    share = math.log(above.residual / noise) / math.log(above.residual / max(below.residual, 1e-300))
    return WeightChoice(upper * (lower / upper) ** share, below.x, DISCREPANCY)
