"""Every kind of field: its gradient, its precision, its file, and the fused layers of networks; one table of fields."""

from __future__ import annotations

import pytest
import torch

from bodies import cuboid
from nerif.analysis.prediction import predict, reproject
from nerif.fields.field import Field
from nerif.fields.jets import AXISYMMETRIC
from nerif.fields.network import UNBOUNDED, NetworkShape, NeuralField
from nerif.fields.network_kinds import network_in
from nerif.fields.phantoms import Flame, GaussianBalls, Octahedron, make_phantom
from nerif.fields.sum import SumField
from nerif.fields.symmetric import SymmetricVoxels, symmetry_of_field
from nerif.fields.turbulence import Fire, TurbulentPlume
from nerif.fields.voxel_field import DEGREES, Boundary, VoxelField
from nerif.forward.path_integral import PathIntegral, project
from nerif.forward.registry import forward_models
from nerif.geometry import Box, Grid
from nerif.geometry.body import contained
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction.field_files import read_field, write_field
from nerif.reconstruction.neural import fused
from nerif.reconstruction.reconstructor import Outcome, Reconstruction
from refusals import refused

BOX = Box((-20.0, -25.0, -15.0), (24.0, 21.0, 33.0))
PLATE = cuboid((-10.0, -8.0, -0.25), (10.0, 8.0, 0.25), name="plate")
GENERATOR = torch.Generator().manual_seed(0)


def symmetry(text: str) -> Symmetry:
    return Symmetry.about(text, (1.0, 2.0, 0.0), (0.1, 1.0, 0.03) if text == "planar" else (0.1, 0.05, 1.0), 0.3)


def network(text: str = "", bounds: tuple[float, float] = UNBOUNDED, depth: int = 2, **options) -> NeuralField:
    torch.manual_seed(depth)
    shape = NetworkShape(depth=depth, width=24, octaves=2)
    net = network_in(BOX, shape, bounds, symmetry(text) if text else None, **options)
    return NeuralField(net.double().requires_grad_(False), BOX, 1e-4, 0.1)


def voxels(degree: int) -> VoxelField:
    values = torch.rand(5, 6, 7, dtype=torch.float64, generator=GENERATOR)
    return VoxelField.of(values, Grid(BOX, (5, 6, 7)), degree, Boundary(("x+",)))


def symmetric_voxels(text: str) -> SymmetricVoxels:
    grid, parts = Grid(symmetry(text).reduced_box(BOX, ()), (14, 2, 9)), []
    for _ in range(symmetry(text).angles):
        c = torch.randn(14, 1, 9, dtype=torch.float64, generator=GENERATOR).expand(14, 2, 9)
        parts.append(VoxelField.of(c, grid, 3, Boundary()))
    return SymmetricVoxels(parts, symmetry(text))


KINDS = ("axis", "planar", "axis+2")
PHANTOMS: dict[str, Field] = {
    "balls": GaussianBalls.random(BOX, 3), "flame": Flame(BOX, 2e-4, 1), "octahedron": Octahedron(BOX),
    "turbulence": TurbulentPlume(BOX, 2, shortest=0.1), "fire": Fire(BOX, 2, shortest=0.1),
    **{name: make_phantom(name, BOX) for name in AXISYMMETRIC},
}  # fmt: skip
NETWORKS = {
    **{f"{depth} layers": network(depth=depth) for depth in (1, 2, 4)},
    "bounded": network(bounds=(-0.05, 0.04)), "axis": network("axis"), "planar": network("planar"),
    "beside a plate": network(bodies=[PLATE]),
}  # fmt: skip
STORED: dict[str, Field] = {
    **NETWORKS, "axis+2": network("axis+2"), **{name: voxels(degree) for name, degree in DEGREES.items()},
    **{f"voxels, {text}": symmetric_voxels(text) for text in KINDS},
}  # fmt: skip
PARTS = STORED["2 layers"], STORED["cubic"]
STORED |= {"sum": SumField(*PARTS), "reverse sum": SumField(*PARTS[::-1])}


def points(count: int, seed: int = 1) -> torch.Tensor:
    """Points in the middle of the box, where all phantoms vary, outside the plate."""
    unit = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 0.5
    p = torch.tensor(BOX.centre, dtype=torch.float64) + 0.75 * unit * torch.tensor(BOX.edges, dtype=torch.float64)
    p = p[~contained([PLATE], p)]
    return p[: len(p) // 2 * 2]


EXACT = {name: field for name, field in (PHANTOMS | STORED).items() if name != "bounded"}  # in float32


@pytest.mark.parametrize("field", EXACT.values(), ids=EXACT)
def test_the_gradient_is_that_of_differences(field):
    """Except where a kink or the border between a face and an edge of a body lies between the points."""
    p, step = points(200), 1e-5
    value, gradient = field.value_and_gradient(p.reshape(2, -1, 3))
    assert value.shape == (2, len(p) // 2)
    torch.testing.assert_close(field(p), value.flatten())
    shifts = step * torch.eye(3, dtype=torch.float64)
    differences = torch.stack([(field(p + e) - field(p - e)) / (2 * step) for e in shifts], dim=-1)
    largest = float(differences.abs().max())
    assert largest > 0
    wrong = ((gradient.reshape(-1, 3) - differences).abs() > 1e-6 * largest).any(dim=-1)
    assert float(wrong.double().mean()) < 0.02


@pytest.mark.parametrize("field", PHANTOMS.values(), ids=PHANTOMS)
def test_single_precision_is_close_to_double(field):
    p = points(1000)
    for double, single in zip(field.value_and_gradient(p), field.value_and_gradient(p.float()), strict=True):
        assert single.dtype == torch.float32
        close = (single - double).abs() < 1e-3 * float(double.abs().max())
        assert float(close.double().mean()) > 0.99  # a kink may lie between the two


@pytest.mark.parametrize("field", STORED.values(), ids=STORED)
def test_a_field_is_written_and_read(field, tmp_path):
    bodies = (PLATE,) if field is NETWORKS["beside a plate"] else ()
    write_field(tmp_path, Reconstruction(field, BOX, 1.00027, [], Outcome("converged", ""), {}, bodies=bodies))
    again, box, n_ambient = read_field(tmp_path)
    assert (box, n_ambient, type(again)) == (BOX, 1.00027, type(field))
    p = points(60).float()
    torch.testing.assert_close(again(p), field(p.double()).float(), rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize("field", NETWORKS.values(), ids=NETWORKS)
def test_fused_layers_are_those_of_the_plain_network(field, monkeypatch):
    """Value, gradient, and the derivatives of a loss of both by every weight."""
    monkeypatch.setattr(fused, "TILE", 64)  # of 150 points: two tiles and a part
    net, p = field.to("cpu").network.float().requires_grad_(True), field.normalise(points(300).float())[:150]
    results = []
    for value, gradient in (fused.value_and_gradient(net, p), net.value_and_gradient(p)[:2]):
        net.zero_grad()
        ((value - 0.3).square().mean() + (gradient - 0.1).square().mean()).backward()
        results.append([value.detach(), gradient.detach(), *(w.grad.clone() for w in net.parameters())])
    net.double().requires_grad_(False)
    for ours, plain in zip(*results, strict=True):
        assert ours.shape == plain.shape
        assert float((ours - plain).abs().max()) <= 5e-5 * float(plain.abs().max())


@pytest.mark.parametrize("name", ["axis", "voxels, axis"])
def test_values_around_the_axis_are_the_same(name):
    angles, one = torch.linspace(0, 6, 9, dtype=torch.float64), torch.ones(9, dtype=torch.float64)
    around = STORED[name](symmetry("axis").places(6 * one, angles, 3 * one))
    assert float(around.std()) < 1e-12 * float(around.abs().mean()) + 1e-16


def test_harmonics_change_around_the_axis_and_not_on_it():
    field, around = STORED["voxels, axis+2"], symmetry("axis+2")
    angles, zero = torch.linspace(0, 6, 40, dtype=torch.float64), torch.zeros(40, dtype=torch.float64)
    assert float(field(around.places(zero + 9, angles, zero)).std()) > 0.05
    assert float(field(around.places(zero, angles, zero)).std()) < 1e-12


def test_gradient_heads_with_harmonics_are_refused():
    with refused("gradient_head"):
        network_in(BOX, NetworkShape(depth=1, width=4, gradient_head=True), symmetry=symmetry("axis+1"))


def test_the_parts_of_a_sum_add_up():
    p, total = points(60), STORED["sum"].to("cpu")
    value, gradient = total.value_and_gradient(p)
    torch.testing.assert_close(value, sum(part(p) for part in PARTS))
    torch.testing.assert_close(gradient, sum(part.gradient(p) for part in PARTS))


@pytest.mark.parametrize("model", ["lever_arm", "curved"])
def test_views_of_a_sum_are_the_path_integrals_of_the_whole(measurement, model, monkeypatch):
    box, grid, measurement = measurement.box, Grid(measurement.box, (9, 11, 14)), measurement.select(("0deg", "72deg"))
    splines = VoxelField.through(make_phantom("gaussians", box, 3).sample(grid), grid)
    net = network_in(box, NetworkShape(width=16)).eval().requires_grad_(False)
    total = SumField(NeuralField(net, box, 2e-4), splines)
    assert symmetry_of_field(total) is None
    exact = PathIntegral(forward_models(measurement.techniques, measurement, model)[0], 250)
    rays = measurement.rays()[0]
    expected = project(exact, total, rays)
    views = reproject(total, measurement, model=model)
    inside = measurement.usable & measurement.sees_box
    scale = float(expected.square().mean().sqrt())
    assert float((views.predicted[inside] - expected).square().mean().sqrt()) < 0.003 * scale
    monkeypatch.setattr("nerif.analysis.prediction.EXACT_WORK", {"cpu": 0.0})
    sampled = reproject(total, measurement, model=model)
    assert float((sampled.predicted[inside] - expected).square().mean().sqrt()) < 0.02 * scale
    assert 0 < sampled.accuracies[0].error < 0.02 * scale
    ideal = predict(total, measurement.cameras, box, 1.00027, model).displacement[inside]
    assert float((ideal - expected).square().mean().sqrt()) < 0.003 * scale
