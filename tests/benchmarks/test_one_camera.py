"""Inverse Abel transforms of a displacement map: without noise and with nearly parallel rays they return the field."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from benchmarks.abel_peers import PEERS, HalfView, ParallelView, Revolution, attempts, pyabel, quadrature
from benchmarks.one_camera import BOX, EVALUATED, camera_of
from benchmarks.runner import N_AMBIENT, Unavailable
from nerif.analysis.metrics import volume_errors
from nerif.fields.jets import GaussianJet
from nerif.geometry import Box, Grid, Ring
from nerif.simulation.simulate import simulate

JET = GaussianJet(BOX)


@pytest.fixture(scope="module")
def jet():
    """Displacement of a jet in a distant camera, and its view."""
    camera = camera_of(1.0, 80)
    measurement = simulate(JET, [camera], BOX, N_AMBIENT, steps=60)
    return measurement.displacement[0].numpy(), ParallelView.of(camera, BOX.centre)


def test_the_camera_sees_the_box_whole():
    for half_angle in (1.0, 5.0, 10.0):
        camera = camera_of(half_angle, 100)
        corners = torch.tensor([[x, y, z] for x in (-25, 25) for y in (-25, 25) for z in (-25, 25)]).double()
        pixels = camera.project(corners)
        assert 0 < float(pixels.min()) < 4
        assert 95 < float(pixels.max()) < 99


def test_lengths_of_a_perspective_view_are_those_of_its_depths():
    camera = Ring(views=1, image_size=(60, 100), distance=800.0, background_distance=400.0).cameras()[0]
    view = ParallelView.of(camera, (0.0, 0.0, 0.0))
    scale = 50.0 / 0.02  # focal length in px
    assert (view.axis, view.horizon) == pytest.approx((49.5, 29.5))
    assert (view.pixel, view.lever, view.scale) == pytest.approx((800 / scale, 400, scale / 1200))
    assert view.heights(60)[0] == pytest.approx(29.5 * 800 / scale)


def test_the_projection_is_the_integral_along_rays(jet):
    """Of a Gaussian of width w it is sqrt(2 pi) w times the Gaussian."""
    displacement, view = jet
    half = HalfView(displacement, view, N_AMBIENT)
    row = 40
    height = torch.tensor([[0.0, 0.0, view.heights(80)[row]]], dtype=torch.float64)
    width = (JET.width + JET.spreading * (float(height[0, 2]) / 50 + 0.5)) * 25
    y = np.arange(half.count) * view.pixel
    expected = float(JET(height)) * np.sqrt(2 * np.pi) * width * np.exp(-0.5 * (y / width) ** 2)
    assert np.abs(half.projection()[row] - expected).max() < 0.005 * np.abs(expected).max()


@pytest.mark.parametrize("peer", PEERS, ids=lambda peer: peer.title)
def test_every_peer_reconstructs_the_jet(peer, jet):
    if peer.name != "quadrature":
        pytest.importorskip("abel", reason="pip install '.[benchmarks]'")
    displacement, view = jet
    grid = Grid.of_resolution(EVALUATED, 50)
    truth = JET.sample(grid).numpy()
    errors = []
    for _, index_map in attempts(peer, displacement, view, N_AMBIENT):
        turned = Revolution(view, index_map.shape, grid, order=3)
        errors.append(volume_errors(truth, turned(index_map), N_AMBIENT)["l2_variation"])
    assert min(errors) < 0.02
    assert max(errors) > min(errors)


def test_an_axis_beside_the_middle_of_the_image():
    box = Box((-25.0, -20.0, -25.0), (25.0, 30.0, 25.0))
    field, camera = GaussianJet(box), camera_of(1.0, 80)
    measurement = simulate(field, [camera], box, N_AMBIENT, steps=60)
    view = ParallelView.of(camera, box.centre)
    assert view.axis == pytest.approx(39.5 + 5 / view.pixel)
    index_map = quadrature(HalfView(measurement.displacement[0].numpy(), view, N_AMBIENT), 0.0)
    grid = Grid.of_resolution(Box((-15.0, -10.0, -20.0), (15.0, 20.0, 20.0)), 40)
    volume = Revolution(view, index_map.shape, grid, order=3)(index_map)
    assert volume_errors(field.sample(grid).numpy(), volume, N_AMBIENT)["l2_variation"] < 0.02


def test_an_absent_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "abel", None)
    with pytest.raises(Unavailable, match="PyAbel not installed"):
        pyabel()
