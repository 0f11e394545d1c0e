"""The sum of fields: values, gradients, its file, its symmetry and its views."""

from __future__ import annotations

import pytest
import torch

from nerif.analysis.prediction import predict, reproject
from nerif.fields.network import Network, NeuralField
from nerif.fields.network_shape import NetworkShape
from nerif.fields.phantoms import make_phantom
from nerif.fields.sum import SumField
from nerif.fields.symmetric import symmetry_of_field
from nerif.fields.voxel_field import VoxelField
from nerif.forward.path_integral import PathIntegral, project
from nerif.forward.registry import forward_models
from nerif.geometry import Box, Grid

BOX = Box((-12.0, -10.0, -8.0), (12.0, 10.0, 8.0))


@pytest.fixture(scope="module")
def both():
    """A network, and splines of another field."""
    torch.manual_seed(5)
    network = NeuralField(Network(NetworkShape(width=16)).eval().requires_grad_(False), BOX, 2e-4)
    grid = Grid(BOX, (9, 11, 14))
    return network, VoxelField.through(make_phantom("gaussians", BOX, 3).sample(grid), grid)


def test_values_and_gradients_add_up(both):
    points = torch.rand(30, 3, generator=torch.Generator().manual_seed(0)) * 16 - 8
    total = SumField(*both).to("cpu")
    value, gradient = total.value_and_gradient(points)
    torch.testing.assert_close(value, both[0](points) + both[1](points))
    torch.testing.assert_close(gradient, both[0].gradient(points) + both[1].gradient(points))
    torch.testing.assert_close(total(points), value)


@pytest.mark.parametrize("model", ["lever_arm", "curved"])
def test_views_are_the_path_integrals_of_the_whole(both, measurement, model, monkeypatch):
    total = SumField(*both)
    exact = PathIntegral(forward_models(measurement.techniques, measurement, model)[0], 400)
    rays = measurement.rays()[0]
    expected = project(exact, total, rays)
    views = reproject(total, measurement, model=model)
    crossing = measurement.usable & measurement.sees_box
    scale = float(expected.square().mean().sqrt())
    assert float((views.predicted[crossing] - expected).square().mean().sqrt()) < 0.003 * scale
    monkeypatch.setattr("nerif.analysis.prediction.EXACT_WORK", {"cpu": 0.0})
    sampled = reproject(total, measurement, model=model)
    assert float((sampled.predicted[crossing] - expected).square().mean().sqrt()) < 0.02 * scale
    assert 0 < sampled.accuracies[0].error < 0.02 * scale
    ideal = predict(total, measurement.cameras, BOX, 1.00027, model).displacement[crossing]
    assert float((ideal - expected).square().mean().sqrt()) < 0.003 * scale


def test_its_symmetry_is_that_of_its_first_part(both):
    assert symmetry_of_field(SumField(*both)) is None
