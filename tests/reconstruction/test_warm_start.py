"""A run that starts from another field asks it where the run computes, wherever the field was read to.

Without a GPU the device is torch's `meta`, which knows shapes and devices but no numbers: an operation that mixes it
with the CPU fails there as it would on CUDA. What comes out on a GPU, the tests marked `cuda` see.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from nerif.fields.base import Field
from nerif.fields.grid import VoxelField
from nerif.fields.network import Network, NetworkShape, NeuralField
from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Box, Grid
from nerif.reconstruction.neural.losses import MixedPrecision
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.warm_start import copy_weights, fit_network
from nerif.reconstruction.voxels.tikhonov import Tikhonov

BOX = Box((-3.0, -2.0, -1.0), (3.0, 2.0, 1.0))
SHAPE = NetworkShape(depth=2, width=8, octaves=1)
META = torch.device("meta")
QUICK = NeRIF(network=SHAPE, points_per_batch=256, max_steps=2, fit_steps=3, precision="float32")


def neural() -> NeuralField:
    torch.manual_seed(4)
    return NeuralField(Network(SHAPE), BOX, 1e-4, 0.2)


class Elsewhere(Field):
    """A field that is on no device until it is asked to one, and must be asked there only."""

    def __init__(self, device: str | None = None) -> None:
        self.device = device
        self.moved: list[Elsewhere] = []

    def to(self, device: torch.device | str) -> Elsewhere:
        self.moved.append(Elsewhere(str(device)))
        return self.moved[-1]

    def value_and_gradient(self, points):
        assert self.device == str(points.device)
        return 1e-4 * points[..., 0], 1e-4 * torch.ones_like(points)


def test_a_network_goes_to_the_device_and_the_field_stays_where_it_is():
    field = neural()
    moved = field.to("meta")
    value, gradient = moved.value_and_gradient(torch.rand(5, 3, device=META))
    assert value.device.type == gradient.device.type == "meta"
    assert type(moved) is type(field)
    assert vars(moved).keys() == vars(field).keys()
    assert bool(torch.isfinite(field(torch.rand(5, 3))).all())
    assert field.to("cpu") is field


def test_the_network_is_fitted_to_a_field_on_another_device():
    field = neural().to(META)
    fit_network(
        field, MixedPrecision(field.network, torch.device("cpu"), "float32", "off"), neural(), 2, 16, 1e-3,
        torch.Generator().manual_seed(0),
    )  # fmt: skip
    assert next(field.network.parameters()).grad.device.type == "meta"


def test_the_network_is_fitted_to_a_field_that_is_zero():
    field = neural()
    network = MixedPrecision(field.network, torch.device("cpu"), "float32", "off")
    start = VoxelField.through(torch.zeros(4, 5, 6), Grid(BOX, (4, 5, 6)))
    points = torch.rand(40, 3) * 4 - 2
    before = field.gradient(points).detach().norm()
    fit_network(field, network, start, 100, 64, 1e-2, torch.Generator().manual_seed(0))
    assert float(field.gradient(points).detach().norm() / before) < 0.3


def test_sampling_and_projecting_ask_the_field_to_the_device(measurement):
    field = Elsewhere()
    field.sample(Grid(BOX, (3, 4, 5)))
    rays, _, _ = measurement.rays()
    project(PathIntegral(MODELS["lever_arm"](1.0003), 8), field, rays[:3])
    assert [m.device for m in field.moved] == ["cpu", "cpu"]


@pytest.mark.parametrize(
    "method", [replace(QUICK, device="cpu"), Tikhonov(voxels=12, regularisation=1e-3, iterations=1, device="cpu")],
    ids=["network", "voxels"],
)  # fmt: skip
def test_every_method_asks_the_start_to_its_device(measurement, method):
    start = Elsewhere()
    method(measurement, start=start)
    assert start.moved


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU here")
@pytest.mark.parametrize("method", [QUICK, Tikhonov(voxels=12, regularisation=1e-3, iterations=1)])
def test_a_run_on_a_gpu_starts_from_a_network_on_the_cpu(measurement, method):
    start = NeuralField(Network(replace(SHAPE, width=12)), measurement.box, 1e-4)
    result = replace(method, device="cuda")(measurement, start=start)
    assert bool(torch.isfinite(result.field.to("cpu")(torch.rand(5, 3))).all())


def test_a_bounded_network_starts_from_one_of_the_same_bounds_in_its_own_scale():
    def field(scale: float, low: float) -> NeuralField:
        return NeuralField(Network(SHAPE, bounds=(low / scale, math.inf)), BOX, scale)

    points = torch.rand(40, 3) * 4 - 2
    before, after = field(2e-3, -1e-3), field(5e-3, -1e-3)
    assert copy_weights(before, after)
    assert torch.equal(after(points), before(points))
    assert not copy_weights(before, field(5e-3, -2e-3))
