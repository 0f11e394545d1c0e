"""Tikhonov regularisation: the smoothest field, or the smallest, that fits the data as well as it should.

min_x  |F x - b|^2 + weight |L x|^2,      L = 1, edge grad, or edge^2 div grad
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from nerif.conventions import InputError
from nerif.reconstruction.problem import Iterate, Penalty, Problem, conjugate_gradients
from nerif.reconstruction.voxels import WeightedVoxelReconstructor

__all__ = ["Tikhonov"]

ROUND = 10  # iterations between looks at which bounds are met


@dataclass(frozen=True)
class Tikhonov(WeightedVoxelReconstructor):
    """Voxels with a quadratic penalty, solved by conjugate gradients.

    Source: Tikhonov & Arsenin (1977); for BOST: Nicolas et al., Exp. Fluids 57:13 (2016).
    """

    penalty: Literal["identity", "gradient", "laplacian"] = "gradient"
    """What is kept small: the index excess, its gradient, or its Laplacian."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.penalty not in Penalty.KINDS:
            raise InputError(f"penalty: expected one of {', '.join(Penalty.KINDS)}, got '{self.penalty}'")

    def iterate(self, problem: Problem, x: Tensor, weight: float) -> Iterator[Iterate]:
        penalty = Penalty(problem, self.penalty)
        if problem.bounds is None:
            yield from conjugate_gradients(problem, penalty, weight, x)
        while True:  # active set: solve with the voxels at their bounds held, look again
            x = problem.clip(x)
            for _, iterate in zip(range(ROUND), conjugate_gradients(problem, penalty, weight, x), strict=False):
                x = problem.clip(iterate.x)
                yield Iterate(x, iterate.residual, iterate.penalty)
