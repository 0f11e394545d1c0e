"""The grids that a classical method solves on, from coarse to fine."""

from __future__ import annotations

import torch.nn.functional as functional
from jaxtyping import Bool
from torch import Tensor

from nerif.geometry import Box, Grid

__all__ = ["coarser", "levels"]

COARSEST = 12  # voxels along the longest edge of the first grid, at least


def levels(box: Box, voxels: int, degree: int, coarse_to_fine: bool) -> list[Grid]:
    """Return the grids to solve on.

    Parameters
    ----------
    voxels : of the last grid, along the longest edge of the box
    degree : of the spline, which asks for some along each edge
    coarse_to_fine : whether there are coarser ones before it, each of voxels twice as large
    """
    least = (degree + 1) // 2  # of a slice too
    shape = [max(least, n) for n in Grid.of_resolution(box, voxels).shape]
    grids = [Grid(box, (shape[0], shape[1], shape[2]))]
    while coarse_to_fine and max(shape) >= 2 * COARSEST:
        shape = [min(n, max(4, n // 2)) for n in shape]
        grids.insert(0, Grid(box, (shape[0], shape[1], shape[2])))
    return grids


def coarser(free: Bool[Tensor, "z y x"], grid: Grid) -> Bool[Tensor, "Z Y X"]:
    """Return a mask on a coarser grid: a voxel is free where any in its place is."""
    return functional.adaptive_max_pool3d(free[None, None].float(), grid.shape)[0, 0] > 0
