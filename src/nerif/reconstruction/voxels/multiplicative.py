"""Multiplicative iterations for non-negative fields and line integrals: MLEM, and MART view by view.

    MLEM    x <- x A^T (y / A x) / A^T 1                       the most likely x for Poisson-distributed y
    MART    x <- x exp(mu A_v^T ln (y_v / A_v x) / A_v^T 1),      one view v after the other

x >= 0 is preserved, and a voxel on a ray that measured 0 stays 0.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

from annotated_types import Gt, Le

from nerif.common.conventions import InputError
from nerif.reconstruction.voxels.voxel_reconstructor import VoxelReconstructor

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from nerif.data.measurement import Measurement
    from nerif.geometry import Grid
    from nerif.reconstruction.voxels.ray_block import Block
    from nerif.reconstruction.voxels.voxel_problem import Iterate, Problem

__all__ = ["MART", "MLEM"]


@dataclass(frozen=True)
class Multiplicative(VoxelReconstructor):
    """The shared loop and start of both methods."""

    coarse_to_fine: bool = False
    """Start on a coarse grid and halve the voxels from solution to solution."""

    def iterate(self, problem: Problem, x: Tensor, weight: float) -> Iterator[Iterate]:
        from nerif.reconstruction.voxels.voxel_problem import Iterate

        blocks = self.blocks(problem)
        while True:
            for block in blocks:
                x = problem.clip(self.update(block, x))
            yield Iterate(x, problem.residual(x), 0.0)

    def begin(self, problem: Problem, x: Tensor) -> Tensor:
        """Return x, above 0 everywhere; for x <= 0 the uniform field whose projections have the sum of the data."""
        from nerif.reconstruction.voxels.ray_block import FLOOR, Block

        for part in problem.target.parts:
            if not part.model.additive:
                raise InputError(
                    f"mlem and mart need line integrals of a non-negative field, got {part.model.name}; "
                    "use --method tikhonov, tv or nerif",
                    field="method",
                )
        mean = float(x.clamp_min(0).mean())
        if mean > 0:
            return problem.clip(x.clamp_min(FLOOR * mean))
        block, uniform = Block.of(problem, None), problem.clip(x.new_ones(x.shape))
        return uniform * (float(block.data.sum()) / max(float(block.project(uniform).sum()), block.floor) or 1.0)

    @abstractmethod
    def blocks(self, problem: Problem) -> list[Block]: ...

    @abstractmethod
    def update(self, block: Block, x: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]: ...


@dataclass(frozen=True)
class MLEM(Multiplicative):
    """Voxels by maximum likelihood and expectation maximisation, for absorption, emission and particle images.

    It stops at the noise where sigma is known (discrepancy principle), else when the residual falls by less than the
    tolerance per iteration, or after the given iterations.

    Source: Shepp & Vardi, IEEE Trans. Med. Imaging 1 (1982) 113; for transmission as line integrals see Lange & Carson,
    J. Comput. Assist. Tomogr. 8 (1984) 306.
    """

    title: ClassVar[str] = "MLEM"
    iterations: int = 100
    """Maximum iterations."""

    def blocks(self, problem: Problem) -> list[Block]:
        from nerif.reconstruction.voxels.ray_block import Block

        return [Block.of(problem, None)]

    def update(self, block: Block, x: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        return x * block.back_project(block.data / block.project(x)) / block.reach


@dataclass(frozen=True)
class MART(Multiplicative):
    """Voxels by the multiplicative algebraic reconstruction technique, all rays of a view at a time.

    Source: Gordon, Bender & Herman, J. Theor. Biol. 29 (1970) 471; for particles: Elsinga, Scarano, Wieneke & van
    Oudheusden, Exp. Fluids 41 (2006) 933; by blocks: Byrne, IEEE Trans. Image Process. 2 (1993) 96.
    """

    title: ClassVar[str] = "MART"
    relaxation: Annotated[float, Gt(0), Le(1)] = 1.0
    """Exponent mu; above 0, at most 1."""
    iterations: int = 10
    """Maximum iterations, each with one update per view."""

    def memory_bytes(self, measurement: Measurement, grid: Grid, device: str = "cpu") -> int:
        """Return the memory of a run, with an operator and a reach for every view."""
        reach = len(measurement.cameras) * math.prod(grid.shape) * self.itemsize
        return super().memory_bytes(measurement, grid, device) + self.operator_bytes(measurement, grid) + reach

    def blocks(self, problem: Problem) -> list[Block]:
        from nerif.reconstruction.voxels.ray_block import Block

        views = sorted({int(v) for part in problem.target.parts for v in part.rays.view.unique()})
        return [Block.of(problem, view) for view in views]

    def update(self, block: Block, x: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        ratio = (block.data.clamp_min(block.floor) / block.project(x)).log()
        return x * (self.relaxation * block.back_project(ratio) / block.reach).exp()
