"""The detail that a field leaves: errors on flows that it did not draw, kinds of data, refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from scipy.ndimage import gaussian_filter

from nerif.data.measurement import Measurement
from nerif.fields.phantoms import make_phantom
from nerif.fields.sum import SumField
from nerif.fields.symmetric import SymmetricVoxels
from nerif.fields.turbulence import TurbulentPlume
from nerif.fields.voxel_field import VoxelField
from nerif.forward.absorption import Absorption
from nerif.geometry import Box, Grid, Ring, paper_rig
from nerif.reconstruction.detail.detail import COARSE, SIGNIFICANT, Detail, DetailChoice, choose, voxels_of
from nerif.reconstruction.detail.gaussian_process import GaussianProcess
from nerif.reconstruction.gauge import visual_hull
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.symmetry_axis import axis_of
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.simulation.simulate import simulate
from refusals import refused

BOX = Box.around_origin((40.0, 36.0, 30.0))
N = 1.00027
GRID = Grid.of_resolution(BOX, 40)
SETTINGS = NeRIF(device="cpu")


def simulated(field, views=7, pixels=36, noise=0.05, f_number=0.0, seed=1):
    """What a ring of cameras sees of a field."""
    arc = (0.0, 180.0 * (1 - 1 / views))
    ring = Ring(views=views, arc=arc, image_size=(pixels, pixels), pixel_pitch=4.0 / pixels)
    return simulate(field, ring.cameras(f_number), BOX, N, noise, seed=seed, steps=25)


def error(field, truth):
    """Error over the variation of the truth."""
    values = truth.sample(GRID)
    return float((field.sample(GRID) - values).norm() / (values - values.mean()).norm())


def smoothed(truth, mm):
    """A reconstruction that has lost the detail of the truth."""
    values = gaussian_filter(truth.sample(GRID).numpy(), [mm / h for h in GRID.spacing[::-1]])
    return VoxelField.through(torch.from_numpy(values), GRID)


@pytest.fixture(scope="module")
def plume():
    """A turbulent plume, with detail down to two pixels of its views, and these."""
    truth = TurbulentPlume(BOX, seed=7, shortest=0.07)
    return truth, simulated(truth)


@pytest.fixture(scope="module")
def posterior(plume):
    truth, measurement = plume
    base = smoothed(truth, 1.5)
    details = [Detail(base, measurement, SETTINGS, coarse=size) for size in (1, COARSE)]
    return DetailChoice(passes=1).solve(*details)


@pytest.mark.slow
def test_voxels_are_smaller_than_pixels(plume):
    measurement = plume[1]
    pixels = [camera.pixel_size(torch.zeros(3, dtype=torch.float64)) for camera in measurement.cameras]
    edge = max(BOX.edges) / voxels_of(measurement)
    assert 0.6 < edge / float(min(pixels)) < 0.8
    assert voxels_of(simulated(plume[0], views=2, pixels=300)) == 160


def test_detail_reduces_residual_and_error_of_a_flow(plume, posterior):
    truth, measurement = plume
    base = posterior.detail.base
    assert posterior.detail.residual > 3
    assert posterior.residual < 0.5 * posterior.detail.residual
    assert error(posterior.field, truth) < 0.8 * error(base, truth)
    assert error(posterior.splines, truth) == pytest.approx(error(posterior.field, truth), rel=0.05)
    assert isinstance(posterior.field, SumField)
    assert posterior.field.parts[0] is base
    assert measurement.displacement is not None


def test_the_withheld_view_says_whether_to_blur(plume):
    truth, measurement = plume
    training, withheld = measurement.without(["0deg"]), measurement.select(["0deg"])
    right = choose(Detail(smoothed(truth, 1.0), training, SETTINGS, coarse=COARSE), withheld)
    assert right.pays
    assert not right.blurred
    generator = torch.Generator().manual_seed(1)  # a field whose own detail is wrong
    wrong = gaussian_filter(torch.randn(GRID.shape, generator=generator).numpy(), 1.0)
    values = smoothed(truth, 1.5).sample(GRID)
    spoilt = values * (1 + 1.0 * torch.from_numpy(wrong) / wrong.std())
    choice = choose(Detail(VoxelField.through(spoilt, GRID), training, SETTINGS, coarse=COARSE), withheld)
    assert choice.blurred
    assert choice.pays
    assert choice.after < choice.before
    assert choice.seconds > 0


def test_the_error_stated_is_not_the_one_that_chooses(plume, monkeypatch):
    truth, measurement = plume
    training, withheld = measurement.without(["0deg"]), measurement.select(["0deg"])
    coarse = Detail(smoothed(truth, 1.0), training, SETTINGS, coarse=COARSE)
    errors = iter([(3.0, 0.1), (1.0, 0.9), (2.0, 0.2), (4.0, 0.3)])
    pixels = []

    def trial(detail, problem, choosing, scoring):
        pixels.extend([len(choosing), len(scoring), len(detail.others(withheld))])
        return detail.solve(problem, iterations=1), *next(errors)

    monkeypatch.setattr(Detail, "trial", trial)
    choice = choose(coarse, withheld)
    assert (choice.passes, choice.after) == (2, 0.9)
    assert pixels[0] + pixels[1] == pixels[2]
    assert pixels[0] == pytest.approx(pixels[1], rel=0.1)


def test_a_detail_without_time_is_not_tried(plume, monkeypatch):
    truth, measurement = plume
    coarse = Detail(smoothed(truth, 1.0), measurement.without(["0deg"]), SETTINGS, coarse=COARSE)
    monkeypatch.setattr(Detail, "trial", None)
    choice = choose(coarse, measurement.select(["0deg"]), most=0.0)
    assert choice.seconds > 0
    assert math.isnan(choice.after)


def test_only_noise_is_not_significant():
    truth = smoothed(make_phantom("gaussians", BOX, 2), 3.0)
    assert Detail(truth, simulated(truth, pixels=24), SETTINGS).residual < SIGNIFICANT


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_errors_are_drawn_as_large_as_they_are(posterior, plume, seed):
    truth = plume[0]
    samples = torch.stack([posterior.error(seed + 10 * i).sample(GRID) for i in range(2)])
    actual = posterior.field.sample(GRID) - truth.sample(GRID)
    flow = truth.sample(GRID).abs() > 0.02 * truth.sample(GRID).abs().max()
    ratio = float(samples[:, flow].square().mean().sqrt() / actual[flow].square().mean().sqrt())
    assert 0.6 < ratio < 1.6


def test_data_that_err_by_more_than_sigma_are_not_fitted_down_to_it(plume):
    truth, measurement = plume
    optimistic = replace(measurement, sigma=measurement.sigma / 5)
    detail = Detail(smoothed(truth, 1.5), optimistic, SETTINGS)
    plain, posterior = detail.solve(detail.first(False)), detail.posterior(detail.first(False))
    assert posterior.problem.ratio == pytest.approx(plain.residual)
    assert plain.residual > 2
    assert error(posterior.field, truth) < 0.98 * error(plain.field, truth)


def test_a_solution_is_stopped(plume):
    truth, measurement = plume
    coarse, fine = (Detail(smoothed(truth, 1.5), measurement, SETTINGS, coarse=size) for size in (COARSE, 1))
    stopped = DetailChoice(passes=1).solve(fine, coarse, lambda posterior: True)
    assert (stopped.count, stopped.problem.ratio) == (1, 1.0)


def test_outside_the_masks_nothing_is_added(plume):
    truth, measurement = plume
    mask = torch.zeros_like(measurement.usable)
    mask[:, 6:-6, 6:-6] = True
    masked = replace(measurement, flow_mask=mask)
    detail = Detail(smoothed(truth, 1.5), masked, SETTINGS)
    posterior = detail.solve(detail.first(True), iterations=3)
    outside = ~visual_hull(masked, detail.grid)
    assert bool(outside.any())
    assert not posterior.coefficients[outside].any()
    assert bool(posterior.coefficients[~outside].any())


def test_bounds_hold(plume):
    truth, measurement = plume
    detail = Detail(smoothed(truth, 1.5), measurement, replace(SETTINGS, upper=0.0))
    posterior = detail.solve(detail.first(False), iterations=5)
    assert float(posterior.coefficients.max()) <= 0


def test_a_symmetric_flow_keeps_its_symmetry():
    cameras, box = paper_rig(28)
    truth = make_phantom("underexpanded", box, 0)
    measurement = simulate(truth, cameras[:1], box, N, 0.02, 0, steps=30)
    settings = Tikhonov(voxels=20, symmetry="axis", axis_sigma_mm=0.0, axis_sigma_deg=0.0, device="cpu")
    result = settings(measurement)
    detail = Detail(result.field, measurement, settings, axis_of(settings, measurement))
    posterior = detail.solve(detail.first(False))
    assert isinstance(posterior.splines, SymmetricVoxels)
    assert posterior.residual < 0.8 * detail.residual
    grid = Grid.of_resolution(box, 48)
    errors = [float((f.sample(grid) - truth.sample(grid)).norm()) for f in (result.field, posterior.field)]
    assert errors[1] < errors[0]


def test_absorption(box):
    truth = make_phantom("gaussians", box, 1)
    scaled = VoxelField.through(truth.sample(Grid.of_resolution(box, 30)) / -2e-4 * 0.05, Grid.of_resolution(box, 30))
    ring = Ring(views=5, arc=(0.0, 144.0), image_size=(20, 26), pixel_pitch=0.11)
    measurement = simulate(scaled, ring.cameras(), box, N, 0.02, seed=5, steps=30, techniques=[Absorption])
    base = VoxelField.through(0.8 * scaled.sample(Grid.of_resolution(box, 30)), Grid.of_resolution(box, 30))
    detail = Detail(base, measurement, SETTINGS)
    posterior = detail.solve(detail.first(False))
    assert posterior.residual < 0.3 * detail.residual
    assert float(posterior.splines.sample(detail.grid).min()) > -1e-3 * float(scaled.sample(detail.grid).max())


def test_rays_that_bend():
    balls = make_phantom("gaussians", BOX, 1)
    truth = VoxelField.through(60 * balls.sample(GRID), GRID)  # strong, as a flow in water
    measurement = simulated(truth, views=4, pixels=28, noise=0.01)
    residual = {m: Detail(truth, measurement, replace(SETTINGS, model=m)).residual for m in ("auto", "curved")}
    assert residual["curved"] < 0.8 * residual["auto"]


def test_a_measurement_without_sigma_is_refused(plume):
    truth, measurement = plume
    with refused("measurement"):
        Detail(smoothed(truth, 1.5), replace(measurement, sigma=None), SETTINGS)
    with refused("measurement"):
        GaussianProcess()(replace(measurement, sigma=None))


def test_the_gaussian_process_beats_tikhonov_on_turbulence(plume):
    truth, measurement = plume
    steps, method = [], GaussianProcess(voxels=30, device="cpu")
    result = method(measurement, steps.append)
    assert result.outcome.reason == "iterations"
    smooth = method.first(measurement, resume=steps[-1].capture())  # Tikhonov's, complete
    assert error(result.field, truth) < 0.85 * error(smooth.field, truth)
    assert steps[-1].step == len(steps) == len(result.history)
    assert [step.progress for step in steps] == sorted(step.progress for step in steps)
    assert 0.5 < steps[-1].progress <= 1
    assert [s.seconds for s in steps] == sorted(s.seconds for s in steps)
    again = method(measurement, resume=steps[-1].capture())
    torch.testing.assert_close(again.field.sample(GRID), result.field.sample(GRID), rtol=0, atol=1e-9)


def test_the_gaussian_process_stops_on_request_and_at_its_limit(plume):
    measurement = plume[1]
    last = []

    def stop(step):
        last.append(step)
        return "residual_over_sigma" in step.losses and step.losses["voxels"] == 12

    small = GaussianProcess(voxels=24, device="cpu")
    stopped = small(measurement, stop)
    assert stopped.outcome.reason == "interrupted"
    assert stopped.history[-1]["voxels"] == 12
    limited = replace(small, time_limit=1e-3)(measurement)
    assert limited.outcome.reason == "time_limit"
    assert math.isfinite(float(limited.field.sample(GRID).sum()))
    short, whole = small.split_for_cross_validation()
    assert (short.voxels, whole) == (12, small)


@pytest.mark.slow
def test_total_variation_leaves_detail_too(plume):
    truth, measurement = plume
    assert isinstance(measurement, Measurement)
    result = TotalVariation(voxels=16, device="cpu")(measurement)
    details = [Detail(result.field, measurement, TotalVariation(device="cpu"), coarse=size) for size in (1, COARSE)]
    posterior = DetailChoice().solve(*details)
    assert posterior.residual < 0.7 * details[0].residual
    assert error(posterior.field, truth) < error(result.field, truth)
