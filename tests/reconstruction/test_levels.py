"""Grids from coarse to fine, the bins of pixels that go with them, and the weight carried from one to the next."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scipy.ndimage import gaussian_filter

from nerif.data.measurement import Measurement
from nerif.fields.phantoms import GaussianBalls, make_phantom
from nerif.geometry import Box, Grid, Ring, paper_rig
from nerif.reconstruction.neural.bins import binned_rays
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.layout import InSpace
from nerif.reconstruction.voxels.levels import Level, levels, pixels_in_a_voxel
from nerif.reconstruction.voxels.problem import Iterate
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.weight import choose_weight
from nerif.simulation.simulate import simulate


@pytest.fixture(scope="module")
def flame() -> Measurement:
    """A flame that is seen by images of many more pixels than the grids here have voxels."""
    cameras, box = paper_rig(96)
    return simulate(make_phantom("flame", box, 0), cameras[::3], box, 1.00027, 0.05, 0, steps=20)


def _levels(measurement, voxels, coarse_to_fine):
    layout = InSpace(measurement.box, (), "cubic")
    return levels(measurement, layout.grids(voxels, coarse_to_fine), coarse_to_fine)


def test_pixels_in_a_voxel_are_those_of_the_lens(flame):
    """Focal length in pixels over the distance from the lens."""
    grid = Grid.of_resolution(flame.box, 24)
    camera = flame.cameras[0]
    distance = float(camera.translation.norm())
    expected = float(camera.intrinsics[0, 0]) / distance * min(grid.spacing)
    assert pixels_in_a_voxel(flame, grid) == pytest.approx(expected, rel=2e-2)


def test_bins_are_a_voxel_wide_before_the_end_and_small_at_the_end(flame):
    found = _levels(flame, 48, coarse_to_fine=True)
    assert [max(level.grid.shape) for level in found] == [12, 24, 48, 48]
    wide = [level.edge / pixels_in_a_voxel(flame, level.grid) for level in found[:-1]]
    assert all(0.5 < w < 1.3 for w in wide), wide
    assert found[-1].edge == 1
    assert _levels(flame, 48, coarse_to_fine=False) == [Level(found[-1].grid, 1)]
    assert _levels(flame, 4, coarse_to_fine=True)[-1].edge > 1  # single pixels would change nothing


def test_a_camera_in_the_middle_of_the_box_has_bins_of_some_size(flame):
    middle = replace(flame.cameras[0], translation=torch.zeros(3, dtype=torch.float64))
    inside = replace(flame, cameras=(middle, *flame.cameras[1:]))
    assert 0 < pixels_in_a_voxel(inside, Grid.of_resolution(flame.box, 24)) <= 96


def test_a_view_without_a_whole_bin_keeps_its_pixels(flame):
    (observation,) = flame.observations
    found = binned_rays(flame, observation, 128)  # larger than the image
    assert all(torch.allclose(a, b) for a, b in zip(found[1:], flame.rays()[1:], strict=True))
    assert torch.allclose(found[0].direction, flame.rays()[0].direction)


def test_coarse_grids_and_bins_change_the_way_and_not_the_end(flame):
    method = Tikhonov(voxels=16, device="cpu", regularisation=1e-3, tolerance=1e-6, iterations=100)
    way, straight = method(flame), replace(method, coarse_to_fine=False)(flame)
    assert {r["bin_edge"] for r in way.history} > {r["bin_edge"] for r in straight.history} == {1.0}
    grid = Grid.of_resolution(flame.box, 16)
    a, b = (r.field.sample(grid) for r in (way, straight))
    assert float((a - b).norm() / b.norm()) < 5e-3


@pytest.mark.slow
def test_bins_bring_no_noise_into_a_field_that_is_regularised_by_stopping_alone(flame):
    truth = make_phantom("flame", flame.box, 0).sample(Grid.of_resolution(flame.box, 24))
    noise = 0.4 * torch.randn(flame.displacement.shape, generator=torch.Generator().manual_seed(1))
    noisy = replace(flame, displacement=flame.displacement + noise, sigma=torch.full_like(flame.displacement, 0.4))
    method = Landweber(voxels=24, device="cpu")

    def error(settings: Landweber) -> float:
        found = settings(noisy).field.sample(Grid.of_resolution(flame.box, 24))
        return float((found - truth).norm() / truth.norm())

    assert error(method) < 1.05 * error(replace(method, coarse_to_fine=False))


def test_pixels_judge_also_where_the_last_bins_are_larger():
    """Noise alike in neighbours: bins of it have more than their share, pixels have just that."""
    ring = Ring(views=3, arc=(0.0, 120.0), image_size=(128, 128), pixel_pitch=0.0375)
    box = Box.cube(50.0)
    ball = GaussianBalls(torch.zeros(1, 3), torch.tensor([9.0]), torch.tensor([1e-4]))
    clean = simulate(ball, ring.cameras(), box, 1.00027, 0.0, 0, steps=20)
    d = torch.randn(clean.displacement.shape, generator=torch.Generator().manual_seed(0))
    smooth = torch.from_numpy(gaussian_filter(d.numpy(), (0, 1.5, 1.5, 0)))
    sigma = 0.02
    noise = sigma * smooth / smooth.std()
    seen = replace(clean, displacement=clean.displacement + noise, sigma=torch.full_like(d, sigma))
    found = Tikhonov(voxels=8, device="cpu")(seen)
    assert found.history[-1]["bin_edge"] > 1
    assert "the residual equals the noise (discrepancy principle)" in found.outcome.message


def test_a_run_stopped_on_a_grid_with_bins_goes_on_from_there(flame):
    method = Tikhonov(voxels=24, device="cpu", iterations=12)
    whole = method(flame)
    first = method(flame, on_step=lambda step: step.step == 3)
    assert first.outcome.reason == "interrupted"
    assert first.history[-1]["bin_edge"] > 1
    again = method(flame, resume=first.state)
    grid = Grid.of_resolution(flame.box, 24)
    a, b = (r.field.sample(grid) for r in (whole, again))
    assert float((a - b).norm() / a.norm()) < 1e-2


def test_a_weight_that_is_being_chosen_is_chosen_the_same_after_a_pause(flame):
    """Also where the run began from a field, which is not there any more."""
    method = Tikhonov(voxels=24, device="cpu", iterations=3)
    start = replace(method, voxels=8, regularisation=0.1)(flame).field
    whole = method(flame, start=start)
    parted = method(flame, start=start, on_step=lambda step: step.step == 8)
    again = method(flame, resume=parted.state)
    assert "; weight" in whole.outcome.message
    assert parted.history[-1]["bin_edge"] == 1
    assert again.outcome.reason == whole.outcome.reason
    assert again.history[-1]["weight"] == pytest.approx(whole.history[-1]["weight"], rel=0.05)


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
    assert choice.reason == "the residual equals the noise (discrepancy principle)"
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
    assert choice.reason.startswith("weight of the coarser grid (the residual remains at 2.2")
    assert len(asked) == 2
