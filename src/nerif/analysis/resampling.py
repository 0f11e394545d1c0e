"""Resampling of a volume onto the grid of another, for differences and comparison."""

from __future__ import annotations

from dataclasses import replace

import torch

from nerif.common.conventions import InputError
from nerif.data.volume import Volume
from nerif.fields.voxel_field import Boundary, VoxelField
from nerif.geometry import Box, Grid

__all__ = ["common_grid", "difference", "resampled"]

MAX_VOXELS = 128  # along the longest edge of a common grid
MARGIN = 1e-6  # mm


def common_grid(first: Volume, second: Volume, max_voxels: int = MAX_VOXELS) -> Grid:
    """Return a grid over the intersection of both boxes, with the smaller voxels of the two.

    Parameters
    ----------
    max_voxels : along its longest edge
    """
    a, b = first.grid, second.grid
    if a == b and max(a.shape) <= max_voxels:
        return a
    lower = [max(p, q) for p, q in zip(a.box.lower, b.box.lower, strict=True)]
    upper = [min(p, q) for p, q in zip(a.box.upper, b.box.upper, strict=True)]
    if not all(p < q for p, q in zip(lower, upper, strict=True)):
        raise InputError(
            f"expected boxes that overlap, got {a.box.lower} to {a.box.upper} and {b.box.lower} to "
            f"{b.box.upper} mm; compare results of the same rig",
            field="volumes",
        )
    box = Box((lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2]))
    finest = min(*a.spacing, *b.spacing)
    return Grid.of_resolution(box, max(1, min(max_voxels, round(max(box.edges) / finest))))


def resampled(volume: Volume, grid: Grid) -> Volume:
    """Return a volume on another grid by trilinear interpolation; NaN outside its box and beside masked voxels."""
    if volume.grid == grid:
        return volume
    masked = ~torch.isfinite(volume.values)
    values = _sampled(torch.where(masked, 0.0, volume.values), volume.grid, grid)
    points = grid.points(torch.float64)
    lower, upper = (points.new_tensor(corner) for corner in (volume.grid.box.lower, volume.grid.box.upper))
    undefined = ((points < lower - MARGIN) | (points > upper + MARGIN)).any(dim=-1)
    if bool(masked.any()):
        undefined |= _sampled(masked.to(volume.values.dtype), volume.grid, grid) > 1e-6
    return replace(volume, values=torch.where(undefined, torch.nan, values), grid=grid)


def difference(first: Volume, second: Volume, grid: Grid | None = None) -> Volume:
    """Return the second volume minus the first, on a grid or their common_grid."""
    if first.quantity != second.quantity:
        raise InputError(
            f"expected two volumes of one, got '{first.quantity}' and '{second.quantity}'", field="quantity"
        )
    grid = grid or common_grid(first, second)
    values = resampled(second, grid).values.double() - resampled(first, grid).values.double()
    return Volume(values, grid, first.quantity, first.unit, first.attributes)


@torch.no_grad()
def _sampled(values: torch.Tensor, grid: Grid, onto: Grid) -> torch.Tensor:
    field = VoxelField.of(values, grid, 1, Boundary())
    points = onto.points(torch.float64).to(values.dtype).reshape(-1, 3)
    return torch.cat([field(part) for part in torch.split(points, 1 << 15)]).reshape(onto.shape)
