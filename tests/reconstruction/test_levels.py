"""Levels from coarse to fine, their bins of pixels, and the regularisation weight: on the way and on a toy problem."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch
from scipy.ndimage import gaussian_filter

from nerif.data.measurement import Measurement
from nerif.fields.phantoms import GaussianBalls, make_phantom
from nerif.geometry import Box, Grid, Ring, paper_rig
from nerif.reconstruction.bins import binned_rays
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.layout import InSpace
from nerif.reconstruction.voxels.levels import Level, levels, pixels_in_a_voxel
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.voxel_problem import Iterate
from nerif.reconstruction.voxels.weight import DISCREPANCY, HIGHEST, LOWEST, choose_weight, sharpest_corner
from nerif.simulation.simulate import simulate


@pytest.fixture(scope="module")
def flame() -> Measurement:
    """A flame in images of many more pixels than the grids here have voxels."""
    cameras, box = paper_rig(96)
    return simulate(make_phantom("flame", box, 0), cameras[::3], box, 1.00027, 0.05, 0, steps=20)


def difference(a, b, voxels: int) -> float:
    grid = Grid.of_resolution(a.box, voxels)
    x, y = (r.field.sample(grid) for r in (a, b))
    return float((x - y).norm() / y.norm())


def test_bins_are_a_voxel_wide_before_the_end_and_small_at_the_end(flame):
    def of(voxels, coarse_to_fine):
        return levels(
            flame, InSpace(box=flame.box, faces=(), basis="cubic").grids(voxels, coarse_to_fine), coarse_to_fine
        )

    result = of(48, coarse_to_fine=True)
    assert [max(level.grid.shape) for level in result] == [12, 24, 48, 48]
    assert all(0.5 < level.edge / pixels_in_a_voxel(flame, level.grid) < 1.3 for level in result[:-1])
    assert result[-1].edge == 1
    assert of(48, coarse_to_fine=False) == [Level(result[-1].grid, 1)]
    assert of(4, coarse_to_fine=True)[-1].edge > 1  # single pixels would change nothing


def test_pixels_in_a_voxel_also_for_a_camera_in_the_box(flame):
    """Focal length in pixels over the distance from the lens."""
    grid, camera = Grid.of_resolution(flame.box, 24), flame.cameras[0]
    expected = float(camera.intrinsics[0, 0]) / float(camera.translation.norm()) * min(grid.spacing)
    assert pixels_in_a_voxel(flame, grid) == pytest.approx(expected, rel=2e-2)
    middle = replace(camera, translation=torch.zeros(3, dtype=torch.float64))
    assert 0 < pixels_in_a_voxel(replace(flame, cameras=(middle, *flame.cameras[1:])), grid) <= 96


def test_a_view_without_a_whole_bin_keeps_its_pixels(flame):
    rays, *values = binned_rays(flame, flame.observations[0], 128)  # larger than the image
    pixels, *expected = flame.rays()
    assert all(torch.allclose(a, b) for a, b in zip(values, expected, strict=True))
    assert torch.allclose(rays.direction, pixels.direction)


@pytest.mark.slow
def test_coarse_grids_and_bins_change_the_path_and_not_the_end(flame):
    method = Tikhonov(voxels=16, device="cpu", regularisation=1e-3, tolerance=1e-6, iterations=100)
    coarse, fine = method(flame), replace(method, coarse_to_fine=False)(flame)
    assert {r["bin_edge"] for r in coarse.history} > {r["bin_edge"] for r in fine.history} == {1.0}
    assert difference(coarse, fine, 16) < 5e-3


@pytest.mark.slow
def test_bins_bring_no_noise_into_a_field_that_is_regularised_by_stopping_alone(flame):
    truth = make_phantom("flame", flame.box, 0).sample(Grid.of_resolution(flame.box, 24))
    noise = 0.4 * torch.randn(flame.displacement.shape, generator=torch.Generator().manual_seed(1))
    noisy = replace(flame, displacement=flame.displacement + noise, sigma=torch.full_like(flame.displacement, 0.4))
    errors = [
        float((Landweber(voxels=24, device="cpu", coarse_to_fine=c)(noisy).field.sample(
            Grid.of_resolution(flame.box, 24)) - truth).norm() / truth.norm())
        for c in (True, False)
    ]  # fmt: skip
    assert errors[0] < 1.05 * errors[1]


def test_the_residual_is_that_of_pixels_also_where_the_last_bins_are_larger():
    """Correlated noise: bins of it have more than their sigma states, pixels have just that."""
    ring = Ring(views=3, arc=(0.0, 120.0), image_size=(128, 128), pixel_pitch=0.0375)
    ball = GaussianBalls(torch.zeros(1, 3), torch.tensor([9.0]), torch.tensor([1e-4]))
    clean = simulate(ball, ring.cameras(), Box.cube(50.0), 1.00027, 0.0, 0, steps=20)
    d = torch.randn(clean.displacement.shape, generator=torch.Generator().manual_seed(0))
    smooth = torch.from_numpy(gaussian_filter(d.numpy(), (0, 1.5, 1.5, 0)))
    noise = 0.02 * smooth / smooth.std()
    result = Tikhonov(voxels=8, device="cpu")(
        replace(clean, displacement=clean.displacement + noise, sigma=torch.full_like(d, 0.02))
    )
    assert result.history[-1]["bin_edge"] > 1
    assert DISCREPANCY in result.outcome.message


@pytest.mark.slow
def test_a_search_for_the_weight_is_the_same_after_a_pause(flame):
    """Also if the run began from a field, which the resumed run does not have."""
    method = Tikhonov(voxels=24, device="cpu", iterations=3)
    start = replace(method, voxels=8, regularisation=0.1)(flame).field
    whole = method(flame, start=start)
    first = method(flame, start=start, on_step=lambda step: step.step == 8)
    again = method(flame, resume=first.state)
    assert "; weight" in whole.outcome.message
    assert first.history[-1]["bin_edge"] > 1  # the search is under way
    assert again.outcome.reason == whole.outcome.reason
    assert again.history[-1]["weight"] == pytest.approx(whole.history[-1]["weight"], rel=0.05)


# -- the weight --------------------------------------------------------------------------------------------------------

SINGULAR = torch.logspace(0, -4, 200, dtype=torch.float64)
TRUTH = SINGULAR**0.5  # smooth: smallest where the operator is


def diagonal(sigma: float):
    """The exact solver of a diagonal least-squares problem with identity penalty, the data, and the weights used."""
    noise = sigma * torch.randn(200, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    data, weights = SINGULAR * TRUTH + noise, []

    def solve(weight: float, x: torch.Tensor) -> Iterate:
        weights.append(weight)
        x = SINGULAR * data / (SINGULAR**2 + weight)
        return Iterate(x, float((SINGULAR * x - data).square().sum()), float(x.square().sum()))

    return solve, data, weights


@pytest.mark.parametrize("sigma", [0.003, 0.01, 0.03])
def test_the_discrepancy_principle_reaches_the_noise_from_above(sigma):
    (solve, _, weights), noise = diagonal(sigma), 200 * sigma**2
    choice = choose_weight(solve, torch.zeros(200), noise)
    assert solve(choice.weight, choice.x).residual == pytest.approx(noise, rel=0.1)
    assert choice.reason == DISCREPANCY
    assert weights[0] == HIGHEST
    assert all(b < a for a, b in itertools.pairwise(weights[:-1]))


def test_the_weight_rises_if_the_data_are_mostly_noise():
    solve, data, _ = diagonal(1.0)
    most = float(data.square().sum())
    choice = choose_weight(solve, torch.zeros(200), 0.9 * most)
    assert choice.weight > HIGHEST
    assert solve(choice.weight, choice.x).residual == pytest.approx(0.9 * most, rel=0.1)
    assert "does not exceed the noise" in choose_weight(solve, torch.zeros(200), 1.1 * most).reason


@pytest.mark.parametrize("sigma", [0.003, 0.01])
def test_the_corner_of_the_l_curve_is_near_the_best_weight(sigma):
    solve, _, _ = diagonal(sigma)

    def error(weight: float) -> float:
        return float((solve(weight, torch.zeros(200)).x - TRUTH).norm())

    choice = choose_weight(solve, torch.zeros(200))
    assert "corner" in choice.reason
    assert error(choice.weight) < 3 * min(error(10 ** (-i / 4)) for i in range(4, 29))


def test_a_residual_that_cannot_reach_the_noise_leaves_the_corner():
    solve, _, _ = diagonal(0.01)

    def floor(weight: float, x: torch.Tensor) -> Iterate:
        return replace(iterate := solve(weight, x), residual=iterate.residual + 0.05)

    choice = choose_weight(floor, torch.zeros(200), 200 * 0.01**2)
    assert "corner" in choice.reason
    assert "sigma" in choice.reason
    assert LOWEST < choice.weight < HIGHEST


def test_the_sharpest_corner_of_an_l():
    flat = [(10.0 ** (3 - i), 1.0 + 0.01 * i) for i in range(5)]  # the residual falls, the penalty is constant
    steep = [(0.1 / (1 + 0.01 * i), 10.0**i) for i in range(1, 5)]
    corner, bend = sharpest_corner(flat + steep)
    assert (corner, bend > 0) == (4, True)
    assert sharpest_corner([(math.exp(-i), math.exp(i)) for i in range(6)])[1] == pytest.approx(0, abs=1e-9)
    assert sharpest_corner([(1.0, 1.0), (0.5, 0.9), (0.4, 5.0)]) == (0, 0.0)  # the penalty fell: not an L


@pytest.mark.parametrize(("floor", "guess", "weight", "reason"), [
    (0.0, 3e-3, 2e-3, DISCREPANCY), (0.0, 1e-3, 2e-3, DISCREPANCY),
    (1e-2, 1e-3, 1e-3, "weight of the coarser grid (the residual remains at 2.2"),
])  # fmt: skip
def test_the_weight_of_a_coarser_grid_is_corrected_or_retained(floor, guess, weight, reason):
    """For solutions whose residual falls with the weight towards a floor."""
    weights = []

    def solve(weight: float, x: torch.Tensor) -> Iterate:
        weights.append(weight)
        return Iterate(torch.full_like(x, weight), floor + weight, 1 / weight)

    choice = choose_weight(solve, torch.zeros(1), noise=2e-3, guess=guess)
    assert choice.weight == pytest.approx(weight, rel=0.02)
    assert choice.reason.startswith(reason)
    assert len(weights) == 2
