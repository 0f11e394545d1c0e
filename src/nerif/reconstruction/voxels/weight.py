"""Choosing the weight of a penalty from the data alone, on the way down from a weight that smooths too much.

discrepancy   where sigma is known: the weight at which the residual is the noise, mean (r / sigma)^2 = 1
L-curve       else, or where the grid cannot come down to the noise: the corner of log residual against log penalty

Sources: Morozov, Soviet Math. Dokl. 7 (1966); Hansen, SIAM Review 34 (1992).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from nerif.reconstruction.voxels.problem import Iterate

__all__ = ["FIRST", "Choice", "choose_weight", "sharpest_corner"]

FACTOR = 10**0.5  # between one weight and the next
HIGHEST, LOWEST = 1e-1, 1e-6
FIRST = 1e-2  # on coarse grids, which are there to start from
PAST = 3  # weights beyond the corner before it is believed
IDLE = 0.3  # of what is above the noise: a weight that takes away less than that does not lead down to it

Solve = Callable[[float, Tensor], Iterate]
"""Solves with a weight, from a start."""


@dataclass(frozen=True)
class Choice:
    """A weight, where to start solving with it, and on what grounds it was chosen."""

    weight: float
    x: Tensor
    reason: str


def choose_weight(solve: Solve, x: Tensor, noise: float | None = None, guess: float | None = None) -> Choice:
    """Return the weight by the discrepancy principle or the L-curve; see the head of this file.

    Parameters
    ----------
    solve : see Solve
    x : where to start
    noise : the residual |F x - b|^2 that noise alone would leave, or None where sigma is not known
    guess : the weight on a coarser grid, about which it is sought; None to begin with one that smooths too much
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
        kept = (corner, len(path) - 2, len(path) - 1, 0 if guess is not None else corner)
        path = [p if i in kept else _without_x(p, x) for i, p in enumerate(path)]
        if bend > 0 and len(path) > corner + PAST:
            break
        if guess is not None and noise is not None and _idle(path[-2], path[-1], noise):
            return Choice(weights[0], path[0].x, "that of a coarser grid" + _left(path[-1], noise))
    if bend <= 0:
        corner = len(path) - 1 if guess is None else 0
    without = "lowest weight tried" if guess is None else "that of a coarser grid"
    reason = "corner of the L-curve" if bend > 0 else f"{without}, for the L-curve has no corner"
    return Choice(weights[corner], path[corner].x, reason + _left(path[-1], noise))


def sharpest_corner(points: list[tuple[float, float]]) -> tuple[int, float]:
    """Return which point of a curve of (residual, penalty) is the corner of the L, and its curvature; (0, 0) if none.

    The curvature in logarithms is that of the circle through a point and its two neighbours (Menger), positive where
    the curve turns as an L does when the weight falls: first along the residual, then along the penalty.
    """
    best, sharpest = 0, 0.0
    logs = [(math.log(max(r, 1e-300)), math.log(max(p, 1e-300))) for r, p in points]
    for i in range(1, len(logs) - 1):
        a, b, c = logs[i - 1 : i + 2]
        if not (a[0] > b[0] > c[0] and a[1] < b[1] < c[1]):
            continue  # not on the curve yet: not converged, or next to nothing of either
        turn = (c[0] - a[0]) * (b[1] - a[1]) - (b[0] - a[0]) * (c[1] - a[1])  # twice the area between them
        curvature = 2 * turn / (math.dist(a, b) * math.dist(b, c) * math.dist(a, c))
        if curvature > sharpest:
            best, sharpest = i, curvature
    return best, sharpest


def _left(last: Iterate, noise: float | None) -> str:
    """What is to be said of a residual that does not come down to the noise."""
    if noise is None:
        return ""
    left = math.sqrt(last.residual / noise)
    return f" (the residual stays at {left:.2f} sigma: sigma too small, or grid too coarse for the flow?)"


def _idle(above: Iterate, below: Iterate, noise: float) -> bool:
    """Whether a lower weight hardly brings the residual nearer to the noise: the grid cannot come down to it."""
    return above.residual - below.residual < IDLE * (above.residual - noise)


def _upward(solve: Solve, weight: float, here: Iterate, noise: float) -> Choice:
    """The noise was reached at once: go up until it is not."""
    while weight < 1e6 * HIGHEST:
        there = solve(weight * FACTOR, here.x)
        if there.residual > noise:
            return _between(weight * FACTOR, there, weight, here, noise)
        weight, here = weight * FACTOR, there
    return Choice(weight, here.x, "highest weight tried: what was measured is no more than the noise")


def _between(upper: float, above: Iterate, lower: float, below: Iterate, noise: float) -> Choice:
    """Interpolate the residual in logarithms."""
    share = math.log(above.residual / noise) / math.log(above.residual / max(below.residual, 1e-300))
    weight = upper * (lower / upper) ** share
    return Choice(weight, below.x, "residual is the noise (discrepancy principle)")


def _without_x(iterate: Iterate, x: Tensor) -> Iterate:
    return Iterate(x, iterate.residual, iterate.penalty)
