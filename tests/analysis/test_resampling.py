"""Volumes on each other's grid."""

from __future__ import annotations

import torch

from nerif.analysis.resampling import common_grid, difference, resampled
from nerif.data.volume import Volume
from nerif.geometry import Box, Grid
from refusals import refused


def sloping(grid: Grid) -> Volume:
    """A field that is linear in x, y and z, which trilinear interpolation meets exactly."""
    points = grid.points(torch.float64)
    return Volume((points @ torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)).float(), grid, "density", "kg m-3")


def test_a_linear_field_is_the_same_on_another_grid():
    coarse = Grid(Box((-3, -4, -5), (3, 4, 5)), (10, 8, 6))
    fine = Grid(Box((-2, -3, -4), (2, 3, 4)), (21, 16, 11))
    torch.testing.assert_close(resampled(sloping(coarse), fine).values, sloping(fine).values, atol=1e-4, rtol=0)


def test_there_is_nothing_outside_the_box_or_beside_masked_voxels():
    grid = Grid(Box((0, 0, 0), (4, 5, 6)), (6, 5, 4))
    values = sloping(grid).values.clone()
    values[2, 2, 1] = torch.nan
    wide = Grid(Box((-4, 0, 0), (4, 5, 6)), (6, 5, 8))
    found = resampled(Volume(values, grid), wide).values
    assert bool(found[:, :, :4].isnan().all())
    assert int(found[:, :, 4:].isnan().sum()) == 1
    assert bool(found[2, 2, 5].isnan())


def test_a_common_grid_is_over_what_both_cover_and_as_fine_as_the_finer():
    first = Volume(torch.zeros(10, 8, 6), Grid(Box((0, 0, 0), (6, 8, 10)), (10, 8, 6)))
    second = Volume(torch.zeros(4, 4, 6), Grid(Box((3, 0, 0), (6, 2, 2)), (4, 4, 6)))
    grid = common_grid(first, second)
    assert grid == Grid(Box((3, 0, 0), (6, 2, 2)), (4, 4, 6))
    assert common_grid(first, first) == first.grid
    assert max(common_grid(first, first, 5).shape) == 5
    apart = Volume(torch.zeros(2, 3, 4), Grid(Box((7, 0, 0), (8, 1, 1)), (2, 3, 4)))
    with refused("volumes"):
        common_grid(first, apart)


def test_the_difference_of_the_same_field_is_nothing():
    first, second = (sloping(Grid(Box((-3, -4, -5), (3, 4, 5)), shape)) for shape in ((10, 8, 6), (20, 16, 12)))
    found = difference(first, second)
    assert found.grid.shape == (20, 16, 12)
    inner = found.values[1:-1, 1:-1, 1:-1]
    assert float(inner.abs().max()) < 1e-4
    with refused("quantity"):
        difference(first, Volume(second.values, second.grid, "n"))
