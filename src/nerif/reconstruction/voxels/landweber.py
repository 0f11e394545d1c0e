"""Landweber iteration: gradient descent on the misfit, stopped before it fits the noise.

x <- x + omega F^T (b - F x),       0 < omega < 2 / |F|^2
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from nerif.common.conventions import InputError
from nerif.common.settings import NonNegative
from nerif.reconstruction.voxels.voxel_reconstructor import VoxelReconstructor

if TYPE_CHECKING:
    from torch import Tensor

    from nerif.reconstruction.voxels.voxel_problem import Iterate, Problem

__all__ = ["Landweber"]


@dataclass(frozen=True)
class Landweber(VoxelReconstructor):
    """Voxels by Landweber iteration, regularised by the number of iterations.

    It stops at the noise where sigma is known (discrepancy principle), else when the residual falls by less than the
    tolerance per iteration, or after the given iterations.

    Source: Landweber, Am. J. Math. 73 (1951); momentum: Nesterov, Soviet Math. Dokl. 27 (1983), with the restart of
    O'Donoghue & Candes, Found. Comput. Math. 15 (2015).
    """

    title: ClassVar[str] = "Landweber"
    coarse: ClassVar[float] = 3
    momentum: bool = True
    """Nesterov's momentum: the same accuracy in far fewer iterations."""
    relaxation: float = 1.0
    """Step omega in units of 1 / |F|^2; below 2 (1 with momentum)."""
    tolerance: NonNegative = 3e-3
    """Convergence criterion: relative decrease of the objective per iteration, averaged over several."""
    iterations: int = 200
    """Maximum iterations on each grid."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0 < self.relaxation < 2) or (self.momentum and self.relaxation > 1):
            raise InputError(
                f"expected above 0 and below 2 (with momentum at most 1), got {self.relaxation}", field="relaxation"
            )

    def iterate(self, problem: Problem, x: Tensor, weight: float) -> Iterator[Iterate]:
        from nerif.reconstruction.voxels.operator import operator_norm
        from nerif.reconstruction.voxels.voxel_problem import Iterate

        x = problem.clip(x)
        # the norm is estimated from below, and too long a step diverges
        norm = operator_norm(problem.forward, problem.adjoint, problem.random(), tolerance=1e-2)
        step = self.relaxation / (1.05 * norm) ** 2
        ahead, k, last = x, 0, float("inf")
        r = problem.data - problem.forward(ahead)
        while True:
            x_last, x, k = x, problem.clip(ahead + step * problem.adjoint(r)), k + 1
            ahead = problem.clip(x + (k / (k + 3)) * (x - x_last)) if self.momentum else x
            r = problem.data - problem.forward(ahead)
            if self.momentum and float(r.square().sum()) > last:  # restart without momentum
                ahead, k = x, 0
                r = problem.data - problem.forward(ahead)
            last = float(r.square().sum())
            yield Iterate(ahead, last, 0.0)
