"""Grids from coarse to fine, the bins of pixels that go with them, and the weight carried from one to the next."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerif.fields.phantoms import make_phantom
from nerif.geometry import Grid, paper_rig
from nerif.measurement import Measurement
from nerif.reconstruction.bins import binned_rays
from nerif.reconstruction.levels import Level, levels, pixels_in_a_voxel
from nerif.reconstruction.problem import Iterate
from nerif.reconstruction.tikhonov import Tikhonov
from nerif.reconstruction.weight import choose_weight
from nerif.simulation import simulate


@pytest.fixture(scope="module")
def flame() -> Measurement:
    """A flame that is seen by pictures of many more pixels than the grids here have voxels."""
    cameras, box = paper_rig(96)
    return simulate(make_phantom("flame", box, 0), cameras[::3], box, 1.00027, 0.05, 0, steps=20)


def test_pixels_in_a_voxel_are_those_of_the_lens(flame):
    """Focal length in pixels over the distance from the lens."""
    grid = Grid.of_resolution(flame.box, 24)
    camera = flame.cameras[0]
    distance = float(camera.translation.norm())
    expected = float(camera.intrinsics[0, 0]) / distance * min(grid.spacing)
    assert pixels_in_a_voxel(flame, grid) == pytest.approx(expected, rel=2e-2)


def test_bins_are_a_voxel_wide_before_the_end_and_small_at_the_end(flame):
    found = levels(flame, 48, 3, coarse_to_fine=True)
    assert [max(level.grid.shape) for level in found] == [12, 24, 48, 48]
    wide = [level.edge / pixels_in_a_voxel(flame, level.grid) for level in found[:-1]]
    assert all(0.5 < w < 1.3 for w in wide), wide
    assert found[-1].edge == 1
    assert levels(flame, 48, 3, coarse_to_fine=False) == [Level(found[-1].grid, 1)]
    assert levels(flame, 4, 3, coarse_to_fine=True)[-1].edge > 1  # single pixels would change nothing


def test_a_view_without_a_whole_bin_keeps_its_pixels(flame):
    (observation,) = flame.observations
    found = binned_rays(flame, observation, 128)  # larger than the picture
    assert all(torch.allclose(a, b) for a, b in zip(found[1:], flame.rays()[1:], strict=True))
    assert torch.allclose(found[0].direction, flame.rays()[0].direction)


def test_coarse_grids_and_bins_change_the_way_and_not_the_end(flame):
    method = Tikhonov(voxels=16, device="cpu", regularisation=1e-3, tolerance=1e-6, iterations=100)
    way, straight = method(flame), replace(method, coarse_to_fine=False)(flame)
    assert {r["bin_edge"] for r in way.history} > {r["bin_edge"] for r in straight.history} == {1.0}
    grid = Grid.of_resolution(flame.box, 16)
    a, b = (r.field.sample(grid) for r in (way, straight))
    assert float((a - b).norm() / b.norm()) < 5e-3


def solver(floor: float):
    """Solves whose residual falls with the weight towards a floor, and the weights asked for."""
    asked: list[float] = []

    def solve(weight: float, x: torch.Tensor) -> Iterate:
        asked.append(weight)
        return Iterate(torch.full_like(x, weight), floor + weight, 1 / weight)

    return solve, asked


def test_a_weight_is_mended_about_that_of_a_coarser_grid():
    solve, asked = solver(0.0)
    choice = choose_weight(solve, torch.zeros(1), noise=2e-3, guess=3e-3)
    assert choice.reason == "residual is the noise (discrepancy principle)"
    assert choice.weight == pytest.approx(2e-3, rel=0.02)
    assert len(asked) == 2
    solve, asked = solver(0.0)
    assert choose_weight(solve, torch.zeros(1), noise=2e-3, guess=1e-3).weight == pytest.approx(2e-3, rel=0.02)
    assert len(asked) == 2


def test_a_grid_too_coarse_for_the_noise_keeps_the_weight_and_says_so():
    solve, asked = solver(1e-2)
    choice = choose_weight(solve, torch.zeros(1), noise=2e-3, guess=1e-3)
    assert choice.weight == 1e-3
    assert float(choice.x) == pytest.approx(1e-3)
    assert choice.reason.startswith("that of a coarser grid (the residual stays at 2.2")
    assert len(asked) == 2
