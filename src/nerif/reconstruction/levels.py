"""The grids that a classical method solves on, from coarse to fine, and the bins of pixels that each of them needs."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as functional
from jaxtyping import Bool
from torch import Tensor

from nerif.geometry import Box, Grid
from nerif.measurement import Measurement

__all__ = ["Level", "bins_at_last", "bins_of", "coarser", "levels", "pixels_in_a_voxel"]

COARSEST = 12  # voxels along the longest edge of the first grid, at least
WHILE_COARSE = 1.25  # voxels: edge of bins from which a method goes on to finer ones
AT_LAST = 0.25  # voxels: bins this small change nothing that the grid can hold


@dataclass(frozen=True)
class Level:
    """A grid, and the edge of the bins of pixels to solve with on it, px."""

    grid: Grid
    edge: int


def levels(measurement: Measurement, voxels: int, degree: int, coarse_to_fine: bool) -> list[Level]:
    """Return what to solve on.

    Parameters
    ----------
    voxels : of the last grid, along the longest edge of the box
    degree : of the spline, which asks for some along each edge
    coarse_to_fine : whether there are coarser ones before it, each of voxels twice as large
    """
    grids = _grids(measurement.box, voxels, degree, coarse_to_fine)
    last = Level(grids[-1], bins_at_last(measurement, grids[-1]))
    if not coarse_to_fine:
        return [last]
    before = [Level(grid, _bins(measurement, grid, WHILE_COARSE)) for grid in grids]
    return [*before[:-1], last] if before[-1] == last else [*before, last]


def _grids(box: Box, voxels: int, degree: int, coarse_to_fine: bool) -> list[Grid]:
    least = (degree + 1) // 2  # of a slice too
    shape = [max(least, n) for n in Grid.of_resolution(box, voxels).shape]
    grids = [Grid(box, (shape[0], shape[1], shape[2]))]
    while coarse_to_fine and max(shape) >= 2 * COARSEST:
        shape = [min(n, max(4, n // 2)) for n in shape]
        grids.insert(0, Grid(box, (shape[0], shape[1], shape[2])))
    return grids


def bins_at_last(measurement: Measurement, grid: Grid) -> int:
    """Return the edge of the bins of pixels that the last iterations on a grid take, px."""
    return _bins(measurement, grid, AT_LAST)


def bins_of(measurement: Measurement, grid: Grid) -> int:
    """Return the edge of the bins of pixels that go with a grid that stays coarse, px."""
    return _bins(measurement, grid, WHILE_COARSE)


def _bins(measurement: Measurement, grid: Grid, share: float) -> int:
    """The largest power of two whose bins are no larger than a share of a voxel."""
    most = share * pixels_in_a_voxel(measurement, grid)
    return int(1 << max(0, int(most).bit_length() - 1))


def pixels_in_a_voxel(measurement: Measurement, grid: Grid) -> float:
    """Return how many pixels the shortest edge of a voxel in the middle of the box spans, in the view of fewest."""
    middle = torch.tensor(grid.box.centre, dtype=torch.float64)
    ends = middle + torch.diag(torch.full((3,), min(grid.spacing), dtype=torch.float64))
    seen = []
    for camera in measurement.cameras:
        pixels = camera.project(torch.cat([middle[None], ends]).to(camera.intrinsics.dtype))
        spans = (pixels[1:] - pixels[0]).norm(dim=-1).nan_to_num(1.0).clamp(max=min(camera.image_size))
        seen.append(float(spans.max()))  # of the edge that is seen most from the side
    return min(seen)


def coarser(free: Bool[Tensor, "z y x"], grid: Grid) -> Bool[Tensor, "Z Y X"]:
    """Return a mask on a coarser grid: a voxel is free where any in its place is."""
    return functional.adaptive_max_pool3d(free[None, None].float(), grid.shape)[0, 0] > 0
