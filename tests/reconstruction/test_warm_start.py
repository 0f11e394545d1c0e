"""Runs that start from another field, on whatever device.

Without a GPU the device is torch's `meta`, on which operations that mix devices fail as on CUDA.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from nerif.fields.field import Field
from nerif.fields.network import Network, NeuralField
from nerif.fields.network_shape import NetworkShape
from nerif.fields.symmetric import SymmetricNetwork
from nerif.fields.voxel_field import VoxelField
from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Box, Grid
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction.neural.losses import MixedPrecision
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.warm_start import copy_weights, fit_network
from nerif.reconstruction.voxels.tikhonov import Tikhonov

BOX = Box((-3.0, -2.0, -1.0), (3.0, 2.0, 1.0))
SHAPE = NetworkShape(depth=2, width=8, octaves=1)
META = torch.device("meta")
METHODS = [
    NeRIF(network=SHAPE, points_per_batch=256, max_steps=2, fit_steps=3, precision="float32"),
    Tikhonov(voxels=12, regularisation=1e-3, iterations=1),
]


@pytest.fixture
def field() -> NeuralField:
    torch.manual_seed(4)
    return NeuralField(Network(SHAPE), BOX, 1e-4, 0.2)


def fit(field: NeuralField, start: Field, steps: int, points: int, rate: float) -> None:
    network = MixedPrecision(field.network, torch.device("cpu"), "float32", "off")
    fit_network(field, network, start, steps, points, rate, torch.Generator().manual_seed(0))


class Elsewhere(Field):
    """A field that can be evaluated only on the device of its last `to`."""

    device = ""

    def to(self, device: torch.device | str) -> Elsewhere:
        self.device = str(device)
        return self

    def value_and_gradient(self, points):
        assert self.device == str(points.device)
        return 1e-4 * points[..., 0], 1e-4 * torch.ones_like(points)


def test_a_copy_of_the_network_is_moved(field):
    copy = field.to("meta")
    value, gradient = copy.value_and_gradient(torch.rand(5, 3, device=META))
    assert value.device.type == gradient.device.type == "meta"
    assert type(copy) is type(field)
    assert vars(copy).keys() == vars(field).keys()
    assert bool(torch.isfinite(field(torch.rand(5, 3))).all())
    assert field.to("cpu") is field


@pytest.mark.parametrize("text", ["axis", "axis+1", "axis+4"])
def test_the_weights_are_copied_whatever_the_azimuth_of_the_frame(text):
    straight = Symmetry.about(text, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1e-3)
    cosine, sine = math.cos(0.7), math.sin(0.7)
    turned = replace(straight, frame=((cosine, sine, 0.0), (-sine, cosine, 0.0), (0.0, 0.0, 1.0)))
    aside = replace(straight, point=(0.5, 0.0, 0.0))
    fields = [NeuralField(SymmetricNetwork(SHAPE, s), BOX, 1e-4) for s in (straight, turned, aside)]
    points = torch.rand(60, 3) * 4 - 2
    assert copy_weights(fields[0], fields[1])
    for before, after in zip(*(f.value_and_gradient(points) for f in fields[:2]), strict=True):
        torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-4 * float(before.detach().abs().max()))
    assert not copy_weights(fields[0], fields[2])


def test_the_network_is_fitted_to_a_field_on_another_device(field):
    copy = field.to(META)
    fit(copy, field, 2, 16, 1e-3)
    assert next(copy.network.parameters()).grad.device.type == "meta"


def test_the_network_is_fitted_to_a_zero_field(field):
    points = torch.rand(40, 3) * 4 - 2
    before = field.gradient(points).detach().norm()
    fit(field, VoxelField.through(torch.zeros(4, 5, 6), Grid(BOX, (4, 5, 6))), 100, 64, 1e-2)
    assert float(field.gradient(points).detach().norm() / before) < 0.3


def test_sampling_and_projecting_move_the_field_to_the_device(measurement):
    Elsewhere().sample(Grid(BOX, (3, 4, 5)))
    project(PathIntegral(MODELS["lever_arm"](1.0003), 8), Elsewhere(), measurement.rays()[0][:3])


@pytest.mark.parametrize("method", METHODS, ids=["network", "voxels"])
def test_every_method_moves_the_start_to_its_device(measurement, method):
    start = Elsewhere()
    replace(method, device="cpu")(measurement, start=start)
    assert start.device == "cpu"


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU here")
@pytest.mark.parametrize("method", METHODS)
def test_a_run_on_a_gpu_starts_from_a_network_on_the_cpu(measurement, method):
    start = NeuralField(Network(replace(SHAPE, width=12)), measurement.box, 1e-4)
    result = replace(method, device="cuda")(measurement, start=start)
    assert bool(torch.isfinite(result.field.to("cpu")(torch.rand(5, 3))).all())


def test_weights_are_copied_from_a_network_with_the_same_bounds():
    def bounded(scale: float, low: float) -> NeuralField:
        return NeuralField(Network(SHAPE, bounds=(low / scale, math.inf)), BOX, scale)

    points = torch.rand(40, 3) * 4 - 2
    before, after = bounded(2e-3, -1e-3), bounded(5e-3, -1e-3)
    assert copy_weights(before, after)
    assert torch.equal(after(points), before(points))
    assert not copy_weights(before, bounded(5e-3, -2e-3))
