"""Total-variation regularisation: smooth regions with sharp fronts.

min_x  |F x - b|^2 + weight mean sqrt(|edge grad x|^2 + softness^2)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from nerif.common.settings import Count, Positive
from nerif.reconstruction.voxels.voxel_reconstructor import WeightedVoxelReconstructor

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from nerif.reconstruction.voxels.voxel_problem import Iterate, Problem

__all__ = ["TotalVariation"]


@dataclass(frozen=True)
class TotalVariation(WeightedVoxelReconstructor):
    """Voxels with an isotropic total-variation penalty, by iteratively reweighted least squares.

    Each round weights the squared gradient by 1 / |grad x| of the round before and takes a few iterations of conjugate
    gradients (docs/decisions/011).

    Source: Rudin, Osher & Fatemi, Physica D 60 (1992); Rodriguez & Wohlberg, IEEE Trans. Image Process. 18 (2009).
    """

    title: ClassVar[str] = "total variation"
    detailed: ClassVar[bool] = True
    softness: Positive = 0.1
    """Gradient, in units of the field's own scale per box edge, below which the penalty is quadratic."""
    round: Count = 10
    """Conjugate-gradient iterations between new weights."""
    iterations: Count = 60
    """Maximum iterations on each grid and with each weight."""

    @property
    def patience(self) -> int:
        return self.round  # the objective falls from round to round, not with every iteration

    def iterate(self, problem: Problem, x: Tensor, weight: float) -> Iterator[Iterate]:
        from nerif.reconstruction.voxels.face_gradients import at_faces
        from nerif.reconstruction.voxels.voxel_problem import Iterate, Penalty, minimise

        x = problem.clip(x)
        while True:
            # sqrt(g^2 + e^2) <= (g^2 + e^2) / (2 m) + m / 2 with equality at m = sqrt(g^2 + e^2) of this round
            penalty = Penalty(problem, "gradient", at_faces(0.5 / self._magnitude(problem, x)))
            for _, iterate in zip(range(self.round), minimise(problem, penalty, weight, x), strict=False):
                x = iterate.x
                yield Iterate(x, iterate.residual, float(self._magnitude(problem, x).mean()))

    def _magnitude(self, problem: Problem, x: Tensor) -> Float[Tensor, "z y x"]:
        from nerif.reconstruction.voxels.face_gradients import gradient_square

        return (gradient_square(problem.differences(x)) + self.softness**2).sqrt()
