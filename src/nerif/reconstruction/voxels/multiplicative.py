"""Multiplicative iterations for fields and line integrals that are not negative: MLEM, and MART view by view.

    MLEM    x <- x A^T (y / A x) / A^T 1                       the most likely x of Poisson-distributed y
    MART    x <- x exp(mu A_v^T ln (y_v / A_v x) / A_v^T 1),      one view v after the other

Neither can leave x >= 0, and a voxel that any ray finds empty stays empty.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.geometry import Grid
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.problem import Iterate, Problem
from nerif.reconstruction.voxels.settings import VoxelReconstructor

__all__ = ["MART", "MLEM"]

FLOOR = 1e-6  # of the mean: what a start may be no smaller than, and a prediction that is divided by


@dataclass(frozen=True)
class Multiplicative(VoxelReconstructor):
    """What both have in common: where they begin, and what they refuse."""

    coarse_to_fine: bool = False
    """Start on a coarse grid and halve the voxels from solution to solution."""

    def iterate(self, problem: Problem, x: Tensor, weight: float) -> Iterator[Iterate]:
        blocks = self.blocks(problem)
        while True:
            for block in blocks:
                x = problem.clip(self.update(block, x))
            residual = float((problem.data - problem.forward(x)).square().sum())
            yield Iterate(x, residual, 0.0)

    def begin(self, problem: Problem, x: Tensor) -> Tensor:
        check_positive(problem)
        return start(problem, x)

    @abstractmethod
    def blocks(self, problem: Problem) -> list[Block]:
        """Return the rays that each update of an iteration sees."""

    @abstractmethod
    def update(self, block: Block, x: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """Return the next x by some rays."""


@dataclass(frozen=True)
class MLEM(Multiplicative):
    """Voxels by maximum likelihood and expectation maximisation, for absorption, emission and particle images.

    It stops at the noise where sigma is known (discrepancy principle), else when an iteration gains less than the
    tolerance, or after the given iterations.

    Source: Shepp & Vardi, IEEE Trans. Med. Imaging 1 (1982) 113; for transmission as line integrals see Lange & Carson,
    J. Comput. Assist. Tomogr. 8 (1984) 306.
    """

    iterations: int = 100
    """Most iterations."""

    def blocks(self, problem: Problem) -> list[Block]:
        return [Block.of(problem, None)]

    def update(self, block: Block, x: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        return x * block.back(block.measured / block.see(x)) / block.reach


@dataclass(frozen=True)
class MART(Multiplicative):
    """Voxels by the multiplicative algebraic reconstruction technique, all rays of a view at a time.

    Source: Gordon, Bender & Herman, J. Theor. Biol. 29 (1970) 471; for particles: Elsinga, Scarano, Wieneke & van
    Oudheusden, Exp. Fluids 41 (2006) 933; by blocks: Byrne, IEEE Trans. Image Process. 2 (1993) 96.
    """

    relaxation: float = 1.0
    """Exponent mu; above 0, at most 1."""
    iterations: int = 10
    """Most iterations, each of which sees every view once."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.relaxation <= 1:
            raise InputError(f"expected above 0 and at most 1, got {self.relaxation}", field="relaxation")

    def memory_bytes(self, measurement: Measurement, grid: Grid, device: str = "cpu") -> int:
        """Return what a run will need at most: of every view its own operator, and where its rays pass, as well."""
        reach = len(measurement.cameras) * math.prod(grid.shape) * self.itemsize
        return super().memory_bytes(measurement, grid, device) + self.operator_bytes(measurement, grid) + reach

    def blocks(self, problem: Problem) -> list[Block]:
        views = sorted({int(v) for part in problem.target.parts for v in part.rays.view.unique()})
        return [Block.of(problem, view) for view in views]

    def update(self, block: Block, x: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        ratio = (block.measured.clamp_min(block.floor) / block.see(x)).log()
        return x * torch.exp(self.relaxation * block.back(ratio) / block.reach)


@dataclass(frozen=True)
class Block:
    """Rays of one technique, of all views or of one.

    Parameters
    ----------
    operators : VoxelOperator of each technique
    measured : (n,) what they measured, 0 where noise made it less
    reach : (z, y, x) A^T 1; 1 where no ray passes
    scale : field of one unit of x
    floor : of predictions
    """

    operators: tuple[VoxelOperator, ...]
    measured: Float[Tensor, " n"]
    reach: Float[Tensor, "z y x"]
    scale: float
    floor: float

    @classmethod
    def of(cls, problem: Problem, view: int | None) -> Block:
        """Take the rays of a view, or all."""
        operators, measured = [], []
        for operator, part in zip(problem.operators, problem.target.parts, strict=True):
            if view is not None:
                mine = (part.rays.view == view).nonzero()[:, 0]
                if not len(mine):
                    continue
                part = part[mine]
                operator = operator.for_rays(part.rays, part.model)
            operators.append(operator)
            measured.append(part.measured.reshape(-1).to(operator.device, operator.dtype))
        values = torch.cat(measured).clamp_min(0)
        floor = FLOOR * float(values.mean()) or FLOOR
        block = cls(tuple(operators), values, torch.ones_like(problem.zero()), problem.scale, floor)
        reach = block.back(torch.ones_like(values))
        return cls(block.operators, values, torch.where(reach > 0, reach, torch.ones_like(reach)), problem.scale, floor)

    def see(self, x: Float[Tensor, "z y x"]) -> Float[Tensor, " n"]:
        """Return A x, no smaller than the floor."""
        seen = [operator(x * self.scale).reshape(-1) for operator in self.operators]
        return torch.cat(seen).clamp_min(self.floor)

    def back(self, y: Float[Tensor, " n"]) -> Float[Tensor, "z y x"]:
        """Return A^T y."""
        parts = y.split([operator.range_shape[0] for operator in self.operators])
        images = [a.T(part[:, None]) * self.scale for a, part in zip(self.operators, parts, strict=True)]
        return torch.stack(images).sum(dim=0)


def check_positive(problem: Problem) -> None:
    """Refuse techniques that do not see sums of what is there.

    Raises
    ------
    InputError
        Naming the methods that serve.
    """
    for part in problem.target.parts:
        if not part.model.additive:
            raise InputError(
                f"mlem and mart take line integrals of what is never negative, not {part.model.name}; "
                "give --method tikhonov, tv or nerif",
                field="method",
            )


def start(problem: Problem, x: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
    """Return where to begin: x, above 0 everywhere, or the even field that makes the sum of what was measured."""
    mean = float(x.clamp_min(0).mean())
    if mean > 0:
        return problem.clip(x.clamp_min(FLOOR * mean))
    block, even = Block.of(problem, None), problem.clip(torch.ones_like(x))
    return even * (float(block.measured.sum()) / max(float(block.see(even).sum()), block.floor) or 1.0)
