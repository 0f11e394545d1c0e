"""Rays of one view, or of all, as multiplicative iterations use them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.voxel_problem import Problem

__all__ = ["FLOOR", "Block"]

FLOOR = 1e-6  # of the mean: lower limit of the start, and of a prediction that is a divisor


@dataclass(frozen=True)
class Block:
    """The rays of one view or of all."""

    operators: tuple[VoxelOperator, ...]  # one for each technique
    data: Float[Tensor, " n"]  # measured values, 0 where noise made them negative
    reach: Float[Tensor, "z y x"]  # A^T 1; 1 where no ray passes
    scale: float  # field of one unit of x
    floor: float  # of predictions

    @classmethod
    def of(cls, problem: Problem, view: int | None) -> Block:
        """Return the block of a view, or of all."""
        operators, values = [], []
        for operator, part in zip(problem.operators, problem.target.parts, strict=True):
            if view is not None:
                rays = (part.rays.view == view).nonzero()[:, 0]
                if not len(rays):
                    continue
                part = part[rays]
                operator = operator.for_rays(part.rays, part.model)
            operators.append(operator)
            values.append(part.measured.reshape(-1).to(operator.device, operator.dtype))
        data = torch.cat(values).clamp_min(0)
        floor = FLOOR * float(data.mean()) or FLOOR
        block = cls(tuple(operators), data, torch.ones_like(problem.zero()), problem.scale, floor)
        reach = block.back_project(torch.ones_like(data))
        return replace(block, reach=torch.where(reach > 0, reach, torch.ones_like(reach)))

    def project(self, x: Float[Tensor, "z y x"]) -> Float[Tensor, " n"]:
        """Return A x, no smaller than the floor."""
        projections = [operator(x * self.scale).reshape(-1) for operator in self.operators]
        return torch.cat(projections).clamp_min(self.floor)

    def back_project(self, y: Float[Tensor, " n"]) -> Float[Tensor, "z y x"]:
        """Return A^T y."""
        parts = y.split([operator.range_shape[0] for operator in self.operators])
        images = [a.T(part[:, None]) * self.scale for a, part in zip(self.operators, parts, strict=True)]
        return torch.stack(images).sum(dim=0)
