"""The grids that a classical method solves on, from coarse to fine, and the bins of pixels that each of them needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as functional
from jaxtyping import Bool
from torch import Tensor

from nerif.data.measurement import Measurement
from nerif.geometry import Grid

__all__ = ["Level", "bins_at_last", "bins_of", "coarser", "levels", "pixels_in_a_voxel"]

WHILE_COARSE = 1.25  # voxels: edge of bins from which a method goes on to finer ones
AT_LAST = 0.25  # voxels: bins this small change nothing that the grid can hold


@dataclass(frozen=True)
class Level:
    """A grid, and the edge of the bins of pixels to solve with on it, px."""

    grid: Grid
    edge: int


def levels(measurement: Measurement, grids: Sequence[Grid], coarse_to_fine: bool) -> list[Level]:
    """Return what to solve on.

    Parameters
    ----------
    grids : from coarse to fine (layout.py)
    coarse_to_fine : whether to begin with larger bins of pixels
    """
    last = Level(grids[-1], bins_at_last(measurement, grids[-1]))
    if not coarse_to_fine:
        return [last]
    before = [Level(grid, _bins(measurement, grid, WHILE_COARSE)) for grid in grids]
    return [*before[:-1], last] if before[-1] == last else [*before, last]


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
    middle = torch.tensor(measurement.box.centre, dtype=torch.float64)
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
