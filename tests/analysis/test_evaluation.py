"""Evaluation: metrics of a field that is known, and JSON that any program can read."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
import torch

from nerif.analysis.evaluation import evaluate_views, evaluate_volume
from nerif.analysis.prediction import predict_view, reproject
from nerif.common.conventions import Points, Values, Vectors
from nerif.data.volume import Volume
from nerif.fields.base import Field
from nerif.fields.grid import Boundary, VoxelField
from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Grid
from nerif.results.directory import METRICS, ResultDirectory


class Scaled(Field):
    """Another field times a factor."""

    def __init__(self, inner: Field, factor: float) -> None:
        self.inner, self.factor = inner, factor

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        value, gradient = self.inner.value_and_gradient(points)
        return self.factor * value, self.factor * gradient


def test_the_true_field_leaves_the_noise_alone(measurement, ball):
    views = evaluate_views(reproject(ball, measurement, withheld=("144deg",)))
    assert [v["withheld"] for v in views] == [False] * 4 + [True]
    for v in views:
        assert v["rms_over_sigma"] == pytest.approx(1, abs=0.12)
        assert v["cc"] > 0.999


def test_a_field_ten_per_cent_too_strong(measurement, ball):
    grid = Grid.of_resolution(measurement.box, 20)
    truth = Volume(ball.sample(grid), grid)
    metrics = evaluate_volume(Scaled(ball, 1.1), truth, measurement.n_ambient)
    assert metrics["l2_variation"] == pytest.approx(0.1, rel=1e-4)
    assert metrics["cc"] == pytest.approx(1, abs=1e-6)
    assert len(metrics["slices"]) == min(10, grid.shape[0])


def test_json_is_plain_and_kept(tmp_path):
    directory = ResultDirectory(tmp_path)
    directory.add_metrics({"a": 1.5, "bad": math.nan, "views": [{"x": math.inf, "y": (1, 2)}]})
    directory.add_metrics({"b": "text"})
    kept = json.loads((tmp_path / METRICS).read_text())
    assert kept == {"a": 1.5, "bad": None, "views": [{"x": None, "y": [1, 2]}], "b": "text"}


def test_predictions_on_views_without_valid_pixels_are_not_numbers(measurement, ball):
    valid = torch.ones(measurement.displacement.shape[:3], dtype=torch.bool)
    camera = measurement.cameras[0]
    crosses = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(measurement.box).crosses.reshape(camera.image_size)
    valid[0] = ~crosses  # what is left misses the box
    views = evaluate_views(reproject(ball, replace(measurement, valid=valid)))
    assert math.isnan(views[0]["rms_px"])
    assert views[1]["cc"] > 0.99


@pytest.mark.parametrize("model", MODELS)
def test_views_are_predicted_by_the_model_asked_for(measurement, ball, model):
    """Also of voxels, whose compiled way knows straight rays only."""
    grid = Grid.of_resolution(measurement.box, 16)
    for field in (ball, VoxelField.through(ball.sample(grid), grid)):
        predicted = reproject(field, measurement, model=model).predicted
        camera, (height, width) = measurement.cameras[1], measurement.cameras[1].image_size
        rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(measurement.box).to(dtype=torch.float32)
        forward = PathIntegral(MODELS[model](measurement.n_ambient), 200)
        expected = project(forward, field, rays).reshape(height, width, 2)
        assert float((predicted[1, :height, :width] - expected).norm() / expected.norm()) < 3e-3


@pytest.mark.parametrize("degree", [1, 3])
@pytest.mark.parametrize("model", ["lever_arm", "paraxial"])
def test_voxels_are_projected_as_any_field(measurement, ball, degree, model):
    """The compiled way through a voxel field and the way through the Field give the same view."""
    grid = Grid(measurement.box, (14, 17, 20))
    field = VoxelField(Boundary(measurement.ambient_faces).extend(ball.sample(grid), (degree + 1) // 2), grid, degree)
    camera, forward = measurement.cameras[1], PathIntegral(MODELS[model](measurement.n_ambient), 200)
    fast = predict_view(field, camera, forward, measurement.box)
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(measurement.box).to(dtype=torch.float32)
    slow = project(forward, field, rays).reshape(fast.shape)
    assert float((fast - slow).norm() / slow.norm()) < (0.02 if degree == 1 else 2e-3)
    assert torch.equal(fast[~rays.crosses.reshape(fast.shape[:2])], torch.zeros(int((~rays.crosses).sum()), 2))
