"""Evaluation of known fields, and their projections by voxels."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from nerif.analysis.evaluation import evaluate_views, evaluate_volume
from nerif.analysis.prediction import predict, predict_view, reproject
from nerif.data.volume import Volume
from nerif.fields.phantoms import GaussianBalls
from nerif.fields.voxel_field import Boundary, VoxelField
from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Grid, Ring
from nerif.imaging.displacement.warping import warp
from nerif.results.directory import METRICS, ResultDirectory
from refusals import refused


def test_the_residual_of_the_true_field_is_the_noise(measurement, ball):
    views = evaluate_views(reproject(ball, measurement, withheld=("144deg",)))
    assert [v["withheld"] for v in views] == [False] * 4 + [True]
    for v in views:
        assert v["rms_over_sigma"] == pytest.approx(1, abs=0.12)
        assert v["cc"] > 0.999


def test_displacements_by_windows_are_compared_with_averages_where_the_images_were_measured(measurement, ball):
    cameras = Ring(views=2, image_size=(72, 88), pixel_pitch=0.02).cameras()
    rng, data = np.random.default_rng(0), predict(ball, cameras, measurement.box, measurement.n_ambient)
    exact = data.displacement.nan_to_num(0.0).numpy()
    shape = exact.shape[:3]
    sigma = 0.03 * float(np.sqrt(np.mean(exact**2)))
    windows = gaussian_filter(exact, (0, 1.8, 1.8, 0)) + sigma * rng.standard_normal(exact.shape)
    still = gaussian_filter(rng.random(shape), (0, 0.8, 0.8))
    images = {"reference": still, "flow": np.stack([warp(s, -d) for s, d in zip(still, exact, strict=True)])}
    maps = {name: torch.from_numpy(grey).float() for name, grey in images.items()}
    alone = replace(data, displacement=torch.from_numpy(windows).float(), sigma=torch.full(exact.shape, sigma))
    with_images = replace(alone, maps=maps | {"image_sigma": torch.full(shape, 0.01)})
    for data, cause in ((alone, "blur"), (with_images, "")):
        views = [v for v in evaluate_views(reproject(ball, data)) if v["measured"] == "displacement"]
        assert {v["residual_test"]["cause"] for v in views} == {cause}
    assert max(v["rms_over_sigma"] for v in views) < 1.3


def test_a_field_ten_per_cent_too_strong(measurement, ball):
    grid = Grid.of_resolution(measurement.box, 20)
    stronger = GaussianBalls(ball.centres, ball.widths, 1.1 * ball.amplitudes)
    metrics = evaluate_volume(stronger, Volume(ball.sample(grid), grid), measurement.n_ambient)
    assert metrics["l2_variation"] == pytest.approx(0.1, rel=1e-4)
    assert metrics["cc"] == pytest.approx(1, abs=1e-6)
    assert len(metrics["slices"]) == min(10, grid.shape[0])


def test_metrics_are_plain_json_and_accumulate(tmp_path):
    directory = ResultDirectory(tmp_path)
    directory.add_metrics(slices=[{"z_mm": 1.0, "cc": 0.5, "ssim": math.nan, "psnr": math.inf}])
    directory.add_metrics(device="cpu")
    scores = {"z_mm": 1.0, "cc": 0.5, "ssim": None, "psnr": None}
    expected = {"version": 1, "device": "cpu", "slices": [scores]}
    assert json.loads((tmp_path / METRICS).read_text()) == expected
    metrics = directory.metrics()
    assert math.isnan(metrics.slices[0]["ssim"])
    assert metrics.l2 is None


@pytest.mark.parametrize(
    ("entries", "field"),
    [({"views": []}, "version"), ({"version": 1, "cc": "high"}, "cc"), ({"version": 1, "clarity": 2}, "clarity")],
)
def test_metrics_of_another_form_are_refused(tmp_path, entries, field):
    (tmp_path / METRICS).write_text(json.dumps(entries))
    with refused(field):
        ResultDirectory(tmp_path).metrics()


def test_scores_of_a_view_without_valid_pixels_are_nan(measurement, ball):
    valid = torch.ones(measurement.displacement.shape[:3], dtype=torch.bool)
    valid[0] = ~measurement.sees_box[0]
    views = evaluate_views(reproject(ball, replace(measurement, valid=valid)))
    assert math.isnan(views[0]["rms"])
    assert views[1]["cc"] > 0.99


def rays_of(measurement):
    camera = measurement.cameras[1]
    return camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(measurement.box).to(dtype=torch.float32)


@pytest.mark.parametrize("model", MODELS)
def test_views_are_predicted_by_the_given_model(measurement, ball, model):
    """Also of voxels, whose compiled operator has straight rays only."""
    grid = Grid.of_resolution(measurement.box, 16)
    height, width = measurement.cameras[1].image_size
    forward = PathIntegral(MODELS[model](measurement.n_ambient), 200)
    for field in (ball, VoxelField.through(ball.sample(grid), grid)):
        predicted = reproject(field, measurement, model=model).predicted
        expected = project(forward, field, rays_of(measurement)).reshape(height, width, 2)
        assert float((predicted[1, :height, :width] - expected).norm() / expected.norm()) < 3e-3


@pytest.mark.parametrize("degree", [1, 3])
@pytest.mark.parametrize("model", ["lever_arm", "paraxial"])
def test_the_compiled_operator_projects_voxels_as_any_field(measurement, ball, degree, model):
    grid = Grid(measurement.box, (14, 17, 20))
    field = VoxelField(Boundary(measurement.ambient_faces).extend(ball.sample(grid), (degree + 1) // 2), grid, degree)
    camera, forward = measurement.cameras[1], PathIntegral(MODELS[model](measurement.n_ambient), 200)
    fast, rays = predict_view(field, camera, forward, measurement.box), rays_of(measurement)
    slow = project(forward, field, rays).reshape(fast.shape)
    assert float((fast - slow).norm() / slow.norm()) < (0.02 if degree == 1 else 2e-3)
    assert not bool(fast[~rays.crosses.reshape(fast.shape[:2])].any())
