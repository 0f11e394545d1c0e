"""Views of a network by way of voxels, as large images are re-projected: how near they are, and what is told."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerif.analysis import prediction
from nerif.analysis.prediction import SampledViews, on_voxels, reproject
from nerif.data.measurement import Measurement
from nerif.data.reprojection import Accuracy, Reprojection
from nerif.fields.network import Network, NetworkShape, NeuralField
from nerif.fields.phantoms import GaussianBalls
from nerif.forward.deflection import MODELS, Deflection
from nerif.forward.path_integral import PathIntegral
from nerif.geometry import Box, Ring

BOX = Box((-12.0, -10.0, -8.0), (12.0, 10.0, 8.0))


@pytest.fixture(scope="module")
def network() -> NeuralField:
    """A network with whatever weights, which reaches through every face of the box."""
    torch.manual_seed(3)
    made = Network(NetworkShape(depth=2, width=12, octaves=1)).requires_grad_(False)
    return NeuralField(made, BOX, 1e-3)


@pytest.fixture(scope="module")
def empty() -> Measurement:
    """Two views of 40 x 46 px."""
    ring = Ring(views=2, arc=(0.0, 70.0), image_size=(40, 46), pixel_pitch=0.06, elevation=8.0)
    return Measurement(ring.cameras(), torch.zeros(2, 40, 46, 2), BOX, 1.00027)


@pytest.mark.parametrize("model", MODELS)
def test_views_by_way_of_voxels_are_near_the_integral_and_say_how_near(empty, model, monkeypatch):
    monkeypatch.setattr(prediction, "VOXELS", 10)  # a lattice of every second pixel
    centre, width, depth = torch.tensor([[1.0, -0.5, 0.0]]), torch.tensor([3.0]), torch.tensor([-2e-4])
    ball = GaussianBalls(centre.double(), width.double(), depth.double())
    forward, seen = PathIntegral(MODELS[model](empty.n_ambient), prediction.SAMPLES), empty.sees_box
    exact = reproject(ball, empty, model=model).predicted
    views = SampledViews(ball, on_voxels(ball, BOX), BOX, forward)
    near = torch.stack([views(camera) for camera in empty.cameras])
    apart, rms = (float(d[seen].square().mean().sqrt()) for d in (near - exact, exact))
    assert apart < 0.03 * rms
    accuracy = views.accuracy(Deflection, empty.cameras, list(near))
    assert accuracy.error == pytest.approx(apart, rel=0.25)
    assert accuracy.compared > 300
    assert "10 voxels" in accuracy.how


def test_large_images_of_a_network_take_the_short_way(network, empty, monkeypatch):
    exact = reproject(network, empty)
    assert [a.error for a in exact.accuracies] == [0]
    monkeypatch.setitem(prediction.EXACT_WORK, "cpu", 0.0)
    monkeypatch.setattr(prediction, "VOXELS", 30)
    near = reproject(network, empty)
    seen = empty.sees_box
    apart, rms = (float(d[seen].square().mean().sqrt()) for d in (near.predicted - exact.predicted, exact.predicted))
    assert 0 < near.accuracies[0].error < 0.05 * rms
    assert apart < 0.05 * rms
    assert (near.predicted[~seen] == 0).all()


def test_each_technique_has_its_own_error_and_unit_and_the_network_is_sampled_once(network, empty, monkeypatch):
    fringes = {"fringes": torch.zeros(2, 40, 46), "fringes_sigma": torch.ones(2, 40, 46)}
    combined = replace(empty, sigma=torch.ones_like(empty.displacement), maps=fringes, wavelength_nm=532.0)
    monkeypatch.setitem(prediction.EXACT_WORK, "cpu", 0.0)
    monkeypatch.setattr(prediction, "VOXELS", 10)
    sampled = []
    monkeypatch.setattr(prediction, "on_voxels", lambda *args: sampled.append(args) or on_voxels(*args))
    near = reproject(network, combined)
    monkeypatch.setitem(prediction.EXACT_WORK, "cpu", torch.inf)
    exact, seen = reproject(network, combined), empty.sees_box
    assert len(sampled) == 1
    for told in near.accuracies:
        apart = (near.maps[told.technique.name] - exact.maps[told.technique.name])[seen]
        assert told.error == pytest.approx(float(apart.square().mean().sqrt()), rel=0.5)
    pixels, own = (told.entries for told in near.accuracies)
    assert (pixels["measured"], pixels["unit"], pixels["error_px"]) == ("displacement", "px", pixels["error"])
    assert (own["measured"], own["unit"]) == ("fringes", "1")
    assert "error_px" not in own
    assert " px rms" in near.accuracies[0].sentence
    assert "px" not in near.accuracies[1].sentence


def test_only_networks_on_many_pixels_take_the_short_way(network, empty, ball):
    """What takes seconds is exact."""
    weights = sum(p.numel() for p in network.network.parameters())
    assert prediction._work(network, empty.cameras) == weights * prediction.SAMPLES * 2 * 40 * 46
    assert prediction._work(ball, empty.cameras) == 0
    paper = NeuralField(Network(NetworkShape()), BOX, 1e-3)
    full = Ring(views=12, image_size=(1024, 1024)).cameras()
    assert prediction._work(paper, full) > prediction.EXACT_WORK["cpu"]


def test_the_file_keeps_how_it_was_predicted(network, empty, tmp_path):
    import xarray as xr

    told = (Accuracy(Deflection, "a spline", 0.01, 7),)
    views = replace(reproject(network, empty, ("70deg",)), accuracies=told)
    views.write(tmp_path / "r.nc")
    with xr.open_dataset(tmp_path / "r.nc", engine="h5netcdf") as kept:
        assert kept.attrs["predicted_by"] == "a spline"
        assert kept.attrs["predicted_error_px"] == kept["displacement"].attrs["predicted_error"] == 0.01
    back = Reprojection.read(tmp_path / "r.nc")
    assert back.withheld == ("70deg",)
    assert torch.equal(back.predicted, views.predicted)
    assert torch.equal(back.measurement.displacement, empty.displacement)
