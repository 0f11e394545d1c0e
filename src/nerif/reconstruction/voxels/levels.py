"""The grids of a voxel method from coarse to fine, and the bins of pixels on each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as functional
from jaxtyping import Bool
from torch import Tensor

from nerif.data.measurement import Measurement
from nerif.geometry import Grid

__all__ = ["FINE_BIN", "Level", "bins_of", "coarser", "levels", "pixels_in_a_voxel", "resolved_voxels"]

SMALLEST = 0.7  # px: in smaller voxels, steps at the lines of sight alone would explain the data (docs/decisions/064)
COARSE_BIN = 1.25  # voxels: edge of bins before the last level
FINE_BIN = 0.25  # voxels: bins this small blur nothing that the grid can resolve


@dataclass(frozen=True)
class Level:
    """A grid, and the edge of its bins of pixels, px."""

    grid: Grid
    edge: int


def levels(measurement: Measurement, grids: Sequence[Grid], coarse_to_fine: bool) -> list[Level]:
    """Return the levels of grids from coarse to fine; unless coarse_to_fine, only the last grid with its fine bins."""
    last = Level(grids[-1], bins_of(measurement, grids[-1], FINE_BIN))
    if not coarse_to_fine:
        return [last]
    coarse = [Level(grid, bins_of(measurement, grid)) for grid in grids]
    return [*coarse[:-1], last] if coarse[-1] == last else [*coarse, last]


def bins_of(measurement: Measurement, grid: Grid, voxels: float = COARSE_BIN) -> int:
    """Return the edge of bins of pixels for a grid: the largest power of two within some voxels, px."""
    largest = voxels * pixels_in_a_voxel(measurement, grid)
    return int(1 << max(0, int(largest).bit_length() - 1))


def pixels_in_a_voxel(measurement: Measurement, grid: Grid) -> float:
    """Return the pixels across the shortest edge of a voxel in the middle of the box, in the view with fewest."""
    middle = torch.tensor(measurement.box.centre, dtype=torch.float64)
    ends = middle + torch.diag(torch.full((3,), min(grid.spacing), dtype=torch.float64))
    largest = []
    for camera in measurement.cameras:
        pixels = camera.project(torch.cat([middle[None], ends]).to(camera.intrinsics.dtype))
        spans = (pixels[1:] - pixels[0]).norm(dim=-1).nan_to_num(1.0).clamp(max=min(camera.image_size))
        largest.append(float(spans.max()))  # of the edge nearest to the image plane
    return min(largest)


def resolved_voxels(measurement: Measurement) -> int:
    """Return the voxels along the longest edge of the box that are SMALLEST of the widest pixels, at least 8."""
    return max(8, round(max(measurement.box.edges) / (SMALLEST * max(measurement.pixel_sizes))))


def coarser(free: Bool[Tensor, "z y x"], grid: Grid) -> Bool[Tensor, "Z Y X"]:
    """Return a mask on a coarser grid: a voxel is free if any part of it is."""
    return functional.adaptive_max_pool3d(free[None, None].float(), grid.shape)[0, 0] > 0
