"""Volumes on the grid of another."""

from __future__ import annotations

import torch

from nerif.analysis.resampling import common_grid, difference, resampled
from nerif.data.volume import Volume
from nerif.geometry import Box, Grid
from refusals import refused

BOX = Box((-3, -4, -5), (3, 4, 5))


def linear(grid: Grid) -> Volume:
    """A field that trilinear interpolation reproduces exactly."""
    points = grid.points(torch.float64)
    return Volume((points @ torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)).float(), grid, "density", "kg m-3")


def test_a_linear_field_is_the_same_on_another_grid():
    coarse, fine = Grid(BOX, (10, 8, 6)), Grid(Box((-2, -3, -4), (2, 3, 4)), (21, 16, 11))
    torch.testing.assert_close(resampled(linear(coarse), fine).values, linear(fine).values, atol=1e-4, rtol=0)


def test_nan_outside_the_box_and_beside_masked_voxels():
    grid, wide = Grid(Box((0, 0, 0), (4, 5, 6)), (6, 5, 4)), Grid(Box((-4, 0, 0), (4, 5, 6)), (6, 5, 8))
    values = linear(grid).values.clone()
    values[2, 2, 1] = torch.nan
    result = resampled(Volume(values, grid), wide).values.isnan()
    assert bool(result[:, :, :4].all())
    assert int(result[:, :, 4:].sum()) == 1
    assert bool(result[2, 2, 5])


def test_a_common_grid_is_the_intersection_with_the_finer_voxels():
    first, second, apart = (
        Volume(torch.zeros(shape), Grid(Box(lower, upper), shape))
        for lower, upper, shape in (
            ((0, 0, 0), (6, 8, 10), (10, 8, 6)), ((3, 0, 0), (6, 2, 2), (4, 4, 6)), ((7, 0, 0), (8, 1, 1), (2, 3, 4)),
        )
    )  # fmt: skip
    assert common_grid(first, second) == Grid(Box((3, 0, 0), (6, 2, 2)), (4, 4, 6))
    assert common_grid(first, first) == first.grid
    assert max(common_grid(first, first, 5).shape) == 5
    with refused("volumes"):
        common_grid(first, apart)


def test_the_difference_of_the_same_field_is_zero():
    first, second = (linear(Grid(BOX, shape)) for shape in ((10, 8, 6), (20, 16, 12)))
    result = difference(first, second)
    assert result.grid.shape == (20, 16, 12)
    assert float(result.values[1:-1, 1:-1, 1:-1].abs().max()) < 1e-4
    with refused("quantity"):
        difference(first, Volume(second.values, second.grid, "n"))
