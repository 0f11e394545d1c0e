"""Total-variation regularisation: smooth regions with sharp fronts.

min_x  |F x - b|^2 + weight mean sqrt(|edge grad x|^2 + softness^2)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.reconstruction.voxels.voxel_problem import Iterate, Penalty, Problem, minimise
from nerif.reconstruction.voxels.voxel_reconstructor import WeightedVoxelReconstructor

__all__ = ["TotalVariation", "at_faces", "gradient_square"]


@dataclass(frozen=True)
class TotalVariation(WeightedVoxelReconstructor):
    """Voxels with an isotropic total-variation penalty, by iteratively reweighted least squares.

    Each round weights the squared gradient by 1 / |grad x| of the round before and takes a few iterations of conjugate
    gradients (docs/decisions/011).

    Source: Rudin, Osher & Fatemi, Physica D 60 (1992); Rodriguez & Wohlberg, IEEE Trans. Image Process. 18 (2009).
    """

    title: ClassVar[str] = "total variation"
    detailed: ClassVar[bool] = True
    softness: float = 0.1
    """Gradient, in units of the field's own scale per box edge, below which the penalty is quadratic."""
    round: int = 10
    """Conjugate-gradient iterations between new weights."""
    iterations: int = 60
    """Maximum iterations on each grid and with each weight."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.softness > 0:
            raise InputError(f"expected above 0, got {self.softness}", field="softness")
        if self.round < 1:
            raise InputError(f"expected at least 1 iteration, got {self.round}", field="round")

    @property
    def patience(self) -> int:
        return self.round  # the objective falls from round to round, not with every iteration

    def iterate(self, problem: Problem, x: Tensor, weight: float) -> Iterator[Iterate]:
        x = problem.clip(x)
        while True:
            # sqrt(g^2 + e^2) <= (g^2 + e^2) / (2 m) + m / 2 with equality at m = sqrt(g^2 + e^2) of this round
            penalty = Penalty(problem, "gradient", at_faces(0.5 / self._magnitude(problem, x)))
            for _, iterate in zip(range(self.round), minimise(problem, penalty, weight, x), strict=False):
                x = iterate.x
                yield Iterate(x, iterate.residual, float(self._magnitude(problem, x).mean()))

    def _magnitude(self, problem: Problem, x: Tensor) -> Float[Tensor, "z y x"]:
        return (gradient_square(problem.differences(x)) + self.softness**2).sqrt()


def gradient_square(along: tuple[Tensor, Tensor, Tensor]) -> Float[Tensor, "z y x"]:
    """|grad|^2 at voxel centres: the mean of the squares at the two faces, summed over the axes."""
    means = []
    for axis, difference in enumerate(along):
        square, n = difference.square(), difference.shape[axis] - 1
        means.append(0.5 * (square.narrow(axis, 0, n) + square.narrow(axis, 1, n)))
    return reduce(torch.add, means)


def at_faces(weight: Float[Tensor, "z y x"]) -> tuple[Tensor, Tensor, Tensor]:
    """Weights of the squares at the faces such that sum_voxels weight |grad|^2 = sum_faces weight difference^2."""
    faces = []
    for axis in range(3):
        edge = torch.zeros_like(weight.narrow(axis, 0, 1))
        faces.append(0.5 * (torch.cat([edge, weight], dim=axis) + torch.cat([weight, edge], dim=axis)))
    return faces[0], faces[1], faces[2]
