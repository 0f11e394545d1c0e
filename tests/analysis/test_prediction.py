"""Views of a network sampled on voxels, as for large images: their error, and how it is reported."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import xarray as xr

from bodies import cuboid
from nerif.analysis import prediction
from nerif.analysis.prediction import SampledViews, on_grid, on_voxels, reproject, splines_for_views
from nerif.data.measurement import Measurement
from nerif.data.reprojection import Accuracy, Reprojection
from nerif.fields.network import Network, NeuralField
from nerif.fields.network_kinds import network_in
from nerif.fields.network_shape import NetworkShape
from nerif.fields.phantoms import GaussianBalls
from nerif.fields.sum import SumField
from nerif.forward.deflection import MODELS, Deflection
from nerif.forward.path_integral import PathIntegral
from nerif.geometry import Box, Grid, Ring

BOX = Box((-12.0, -10.0, -8.0), (12.0, 10.0, 8.0))


@pytest.fixture(scope="module")
def network() -> NeuralField:
    """A random network, not 0 at the faces of the box."""
    torch.manual_seed(3)
    return NeuralField(Network(NetworkShape(depth=2, width=12, octaves=1)).requires_grad_(False), BOX, 1e-3)


@pytest.fixture(scope="module")
def empty() -> Measurement:
    """Two views of 40 x 46 px."""
    ring = Ring(views=2, arc=(0.0, 70.0), image_size=(40, 46), pixel_pitch=0.06, elevation=8.0)
    return Measurement(ring.cameras(), torch.zeros(2, 40, 46, 2), BOX, 1.00027)


def rms(values: torch.Tensor) -> float:
    return float(values.square().mean().sqrt())


@pytest.mark.parametrize("model", MODELS)
def test_sampled_views_and_their_accuracy(empty, model):
    centre, width, depth = torch.tensor([[1.0, -0.5, 0.0]]), torch.tensor([3.0]), torch.tensor([-2e-4])
    ball = GaussianBalls(centre.double(), width.double(), depth.double())
    forward, crosses = PathIntegral(MODELS[model](empty.n_ambient), prediction.SAMPLES), empty.sees_box
    exact = reproject(ball, empty, model=model).predicted[crosses]
    views = SampledViews(ball, (on_voxels(ball, BOX, voxels=10),), BOX, forward)  # a lattice of every second pixel
    sampled = torch.stack([views(camera) for camera in empty.cameras])
    error = rms(sampled[crosses] - exact)
    assert error < 0.03 * rms(exact)
    accuracy = views.accuracy(Deflection, empty.cameras, list(sampled))
    assert accuracy.error == pytest.approx(error, rel=0.25)
    assert accuracy.pixels > 300
    assert "10 voxels" in accuracy.method


def test_large_images_of_a_network_are_sampled(network, empty, monkeypatch):
    exact, crosses = reproject(network, empty), empty.sees_box
    assert [a.error for a in exact.accuracies] == [0]
    monkeypatch.setitem(prediction.EXACT_WORK, "cpu", 0.0)
    sampled = reproject(network, empty, splines=splines_for_views(network, empty, voxels=30))
    size = rms(exact.predicted[crosses])
    assert 0 < sampled.accuracies[0].error < 0.05 * size
    assert rms((sampled.predicted - exact.predicted)[crosses]) < 0.05 * size
    assert (sampled.predicted[~crosses] == 0).all()


def test_each_technique_has_its_own_error_and_the_network_is_sampled_once(network, empty, monkeypatch):
    fringes = {"fringes": torch.zeros(2, 40, 46), "fringes_sigma": torch.ones(2, 40, 46)}
    combined = replace(empty, sigma=torch.ones_like(empty.displacement), maps=fringes, wavelength_nm=532.0)
    calls = []
    monkeypatch.setattr(prediction, "on_voxels", lambda *args: calls.append(args) or on_voxels(*args[:3], 10))
    monkeypatch.setitem(prediction.EXACT_WORK, "cpu", 0.0)
    sampled = reproject(network, combined)
    monkeypatch.setitem(prediction.EXACT_WORK, "cpu", torch.inf)
    exact = reproject(network, combined)
    assert len(calls) == 1
    for accuracy in sampled.accuracies:
        name = accuracy.technique.name
        error = rms((sampled.maps[name] - exact.maps[name])[empty.sees_box])
        assert accuracy.error == pytest.approx(error, rel=0.5)
    pixels, waves = (accuracy.entries for accuracy in sampled.accuracies)
    assert (pixels["measured"], pixels["unit"]) == ("displacement", "px")
    assert (waves["measured"], waves["unit"]) == ("fringes", "1")
    assert [" px rms" in accuracy.sentence for accuracy in sampled.accuracies] == [True, False]


def test_only_networks_on_many_pixels_are_sampled(network, empty):
    points = prediction._points(empty.cameras)
    assert points == prediction.SAMPLES * 2 * 40 * 46
    assert prediction._is_exact(network.network, points, "cpu")
    paper = Network(NetworkShape())
    full = prediction._points(Ring(views=12, image_size=(1024, 1024)).cameras())
    assert not prediction._is_exact(paper, full, "cpu")
    most = prediction.EXACT_WORK["cpu"] / sum(p.numel() for p in paper.parameters())
    walls = network_in(BOX, NetworkShape(), bodies=[cuboid((-5.0, -5.0, -0.1), (5.0, 5.0, 0.1))])
    assert not prediction._is_exact(paper, 2 * most, "cpu")
    assert prediction._is_exact(walls, 2 * most, "cpu")


def test_the_file_records_how_it_was_predicted(network, empty, tmp_path):
    views = replace(reproject(network, empty, ("70deg",)), accuracies=(Accuracy(Deflection, "a spline", 0.01, 7),))
    views.write(tmp_path / "r.nc")
    with xr.open_dataset(tmp_path / "r.nc", engine="h5netcdf") as file:
        assert file.attrs["predicted_by"] == "a spline"
        assert file["displacement"].attrs["predicted_error"] == 0.01
    back = Reprojection.read(tmp_path / "r.nc")
    assert back.withheld == ("70deg",)
    assert torch.equal(back.predicted, views.predicted)
    assert torch.equal(back.measurement.displacement, empty.displacement)


def test_a_volume_on_the_voxels_of_the_splines_has_the_values_of_the_network(network):
    grid = Grid.of_resolution(BOX, 12)
    splines = on_voxels(network, BOX, voxels=12)
    same, other = on_grid(network, splines, grid), on_grid(network, splines, Grid.of_resolution(BOX, 13))
    assert same is splines
    assert other is network
    values = network.sample(grid)
    torch.testing.assert_close(same.sample(grid), values, rtol=0, atol=1e-5 * float(values.abs().max()))
    both = on_grid(SumField(network, splines), splines, grid)
    torch.testing.assert_close(both.sample(grid), 2 * values, rtol=0, atol=2e-5 * float(values.abs().max()))
