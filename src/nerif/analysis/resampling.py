"""Volumes on the grid of another: to be subtracted, or seen side by side."""

from __future__ import annotations

from dataclasses import replace

import torch

from nerif.common.conventions import InputError
from nerif.data.volume import Volume
from nerif.fields.grid import Boundary, VoxelField
from nerif.geometry import Box, Grid

__all__ = ["common_grid", "difference", "resampled"]

MOST = 128  # voxels along the longest edge of a common grid


def common_grid(first: Volume, second: Volume, most: int = MOST) -> Grid:
    """Return a grid over what both volumes cover, with voxels as small as the smaller of theirs.

    Parameters
    ----------
    most : voxels along its longest edge

    Raises
    ------
    InputError
        If their boxes do not overlap.
    """
    a, b = first.grid, second.grid
    if a == b and max(a.shape) <= most:
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
    return Grid.of_resolution(box, max(1, min(most, round(max(box.edges) / finest))))


def resampled(volume: Volume, grid: Grid) -> Volume:
    """Return a volume on another grid, trilinear between voxels; NaN outside its box and beside masked voxels.

    Parameters
    ----------
    grid : Grid, mm
    """
    if volume.grid == grid:
        return volume
    masked = ~torch.isfinite(volume.values)
    values = _sampled(torch.where(masked, 0.0, volume.values), volume.grid, grid)
    holes = _outside(volume.grid.box, grid)
    if bool(masked.any()):
        holes |= _sampled(masked.to(volume.values.dtype), volume.grid, grid) > 1e-6
    return replace(volume, values=torch.where(holes, torch.nan, values), grid=grid)


def difference(first: Volume, second: Volume, grid: Grid | None = None) -> Volume:
    """Return the second volume minus the first.

    Parameters
    ----------
    grid : of the difference; common_grid if None

    Raises
    ------
    InputError
        If they hold different quantities, or do not overlap.
    """
    if first.quantity != second.quantity:
        raise InputError(f"expected the same of both, got '{first.quantity}' and '{second.quantity}'", field="quantity")
    grid = grid or common_grid(first, second)
    values = resampled(second, grid).values.double() - resampled(first, grid).values.double()
    return Volume(values, grid, first.quantity, first.unit, first.attributes)


@torch.no_grad()
def _sampled(values: torch.Tensor, grid: Grid, onto: Grid) -> torch.Tensor:
    field = VoxelField.of(values, grid, 1, Boundary())
    points = onto.points(torch.float64).to(values.dtype).reshape(-1, 3)
    return torch.cat([field(part) for part in torch.split(points, 1 << 15)]).reshape(onto.shape)


def _outside(box: Box, grid: Grid) -> torch.Tensor:
    """Which voxel centres of a grid lie outside a box, to a nanometre."""
    points = grid.points(torch.float64)
    lower, upper = points.new_tensor(box.lower) - 1e-6, points.new_tensor(box.upper) + 1e-6
    return ((points < lower) | (points > upper)).any(dim=-1)
