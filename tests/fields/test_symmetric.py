"""Fields of (r, h): symmetry, gradients, files."""

from __future__ import annotations

import pytest
import torch

from nerif.fields.network import NeuralField
from nerif.fields.network_shape import NetworkShape
from nerif.fields.symmetric import SymmetricNetwork, SymmetricVoxels
from nerif.fields.voxel_field import Boundary, VoxelField
from nerif.geometry import Box, Grid
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction.field_files import read_field, write_field
from nerif.reconstruction.neural.fused import value_and_gradient
from nerif.reconstruction.reconstructor import Outcome, Reconstruction
from refusals import refused

BOX = Box.cube(40.0)
KINDS = ["axis", "planar", "axis+2"]


def about(text):
    direction = (0.1, 1.0, 0.03) if text == "planar" else (0.1, 0.05, 1.0)
    return Symmetry.about(text, (1.0, 2.0, 0.0), direction, 0.3)


def network(text, **shape):
    torch.manual_seed(0)
    net = SymmetricNetwork(NetworkShape(depth=2, width=16, **shape), about(text).in_units(BOX.centre, 20.0))
    return NeuralField(net.double().requires_grad_(False), BOX, 1e-4)


def voxels(text):
    symmetry, random = about(text), torch.Generator().manual_seed(0)
    grid = Grid(symmetry.reduced_box(BOX, ()), (14, 2, 9))
    parts = []
    for _ in range(symmetry.angles):
        c = torch.randn(14, 1, 9, dtype=torch.float64, generator=random).expand(14, 2, 9)
        parts.append(VoxelField.of(c, grid, 3, Boundary()))
    return SymmetricVoxels(parts, symmetry)


@pytest.mark.parametrize("text", KINDS)
@pytest.mark.parametrize("make", [network, voxels])
def test_gradient_is_that_of_differences(text, make):
    field, points = make(text), 30 * torch.rand(100, 3, dtype=torch.float64) - 15
    points[0] = torch.tensor([1.0, 2.0, 0.0])
    step = 1e-5 * torch.eye(3, dtype=torch.float64)
    expected = torch.stack([(field(points + e) - field(points - e)) / 2e-5 for e in step], dim=-1)
    torch.testing.assert_close(field.gradient(points), expected, rtol=0, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.parametrize("make", [network, voxels])
def test_values_around_the_axis_are_the_same(make):
    field, symmetry = make("axis"), about("axis")
    r, h = torch.tensor(6.0, dtype=torch.float64), torch.tensor(3.0, dtype=torch.float64)
    angles = torch.linspace(0, 6, 9, dtype=torch.float64)
    around = field(symmetry.places(r.expand(9), angles, h.expand(9)))
    assert float(around.std()) < 1e-12 * float(around.abs().mean()) + 1e-16


def test_harmonics_change_around_the_axis_and_not_on_it():
    field, symmetry = voxels("axis+2"), about("axis+2")
    angles, zero = torch.linspace(0, 6, 40, dtype=torch.float64), torch.zeros(40, dtype=torch.float64)
    assert float(field(symmetry.places(zero + 9, angles, zero)).std()) > 0.05
    assert float(field(symmetry.places(zero, angles, zero)).std()) < 1e-12


def test_fused_layers_are_the_plain_ones():
    net = SymmetricNetwork(NetworkShape(depth=2, width=16), about("axis").in_units(BOX.centre, 20.0))
    p = 2 * torch.rand(50, 3) - 1
    for fused, plain in zip(value_and_gradient(net, p), net.value_and_gradient(p)[:2], strict=True):
        torch.testing.assert_close(fused, plain, rtol=1e-3, atol=1e-3)


def test_gradient_heads_with_harmonics_are_refused():
    with refused("gradient_head"):
        network("axis+1", gradient_head=True)


@pytest.mark.parametrize("text", KINDS)
@pytest.mark.parametrize("make", [network, voxels])
def test_files_store_the_field(tmp_path, text, make):
    field = make(text)
    write_field(tmp_path, Reconstruction(field, BOX, 1.00027, [], Outcome("steps", ""), {"model": "auto"}))
    again, box, _ = read_field(tmp_path)
    points = (30 * torch.rand(20, 3) - 15).double()
    again = again if isinstance(again, SymmetricVoxels) else NeuralField(again.network.double(), box, again.scale)
    torch.testing.assert_close(again(points), field(points), rtol=1e-5, atol=1e-9)
    assert box == BOX
