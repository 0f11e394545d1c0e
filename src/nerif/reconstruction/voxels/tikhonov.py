"""Tikhonov regularisation: the smoothest, or smallest, field that fits the data to within the noise.

min_x  |F x - b|^2 + weight |L x|^2,      L = 1, edge grad, or edge^2 div grad
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

from nerif.reconstruction.voxels.voxel_reconstructor import WeightedVoxelReconstructor

if TYPE_CHECKING:
    from torch import Tensor

    from nerif.reconstruction.voxels.voxel_problem import Iterate, Problem

__all__ = ["Tikhonov"]


@dataclass(frozen=True)
class Tikhonov(WeightedVoxelReconstructor):
    """Voxels with a quadratic penalty, solved by conjugate gradients.

    Source: Tikhonov & Arsenin (1977); for BOST: Nicolas et al., Exp. Fluids 57:13 (2016).
    """

    title: ClassVar[str] = "Tikhonov"
    penalty: Literal["identity", "gradient", "laplacian"] = "gradient"
    """Quantity that is penalised: the field, its gradient, or its Laplacian."""

    def iterate(self, problem: Problem, x: Tensor, weight: float) -> Iterator[Iterate]:
        from nerif.reconstruction.voxels.voxel_problem import Penalty, minimise

        yield from minimise(problem, Penalty(problem, self.penalty), weight, x)
