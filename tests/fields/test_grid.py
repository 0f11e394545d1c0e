"""Voxel fields: interpolation, boundaries, gradient."""

from __future__ import annotations

import pytest
import torch

from nerif.common.conventions import FACES
from nerif.fields import voxel_field as grid
from nerif.fields.voxel_field import Boundary, VoxelField, spline_weights
from nerif.geometry import Box, Grid
from refusals import refused

BOX = Box((-12.0, -10.0, -8.0), (12.0, 10.0, 8.0))
GRID = Grid(BOX, (5, 6, 7))


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("degree", [1, 3])
@pytest.mark.parametrize("faces", [(), ("x-", "z+"), FACES])
def test_fold_is_the_adjoint_of_extend(degree, faces):
    layers, boundary = (degree + 1) // 2, Boundary(faces)
    c, e = random(*GRID.shape), random(*(n + 2 * layers for n in GRID.shape), seed=1)
    there, back = (boundary.extend(c, layers) * e).sum(), (c * boundary.fold(e, layers)).sum()
    assert float(there - back) == pytest.approx(0, abs=1e-13)


@pytest.mark.parametrize("degree", [1, 3])
def test_field_is_zero_on_ambient_faces_and_flat_at_the_others(degree):
    faces = ("x-", "y+", "z-")
    field = VoxelField(Boundary(faces).extend(random(*GRID.shape), (degree + 1) // 2), GRID, degree)
    unit = 0.1 + 0.8 * random(40, 2, seed=2)
    for face in FACES:
        value, gradient = field.value_and_gradient(BOX.face_points(face, unit))
        if face in faces:
            assert float(value.abs().max()) < 1e-14
        else:
            assert float(value.abs().max()) > 0.1
            if degree == 3:
                assert float(gradient[:, "xyz".index(face[0])].abs().max()) < 1e-14


def test_fields_interpolate_their_values():
    values, centres = random(*GRID.shape), GRID.points(torch.float64)
    for field in (VoxelField(Boundary().extend(values, 1), GRID, 1), VoxelField.through(values, GRID)):
        assert torch.allclose(field(centres), values, atol=1e-13)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("degree", [1, 3])
def test_the_compiled_kernel_equals_its_readable_twin(degree, dtype, monkeypatch):
    field = VoxelField(Boundary(("x+",)).extend(random(*GRID.shape), (degree + 1) // 2).to(dtype), GRID, degree)
    points = 1.3 * (2 * random(30_000, 3, seed=4) - 1) * torch.tensor(BOX.upper)  # some of them outside
    points[:6, 0], points[6:9] = points.new_tensor([-12, 12, -12, 12, torch.inf, -torch.inf]), GRID.points()[0, 0, :3]
    points = points.to(dtype).reshape(3, -1, 3)
    results = field.value_and_gradient(points)
    monkeypatch.setattr(grid, "MANY_POINTS", 1 << 30)
    twin = VoxelField(field.coefficients.double(), GRID, degree)  # the kernel is in double precision
    for result, expected in zip(results, twin.value_and_gradient(points.double()), strict=True):
        assert (result.dtype, result.shape) == (dtype, expected.shape)
        assert torch.allclose(result.double(), expected, rtol=1e-6 if dtype == torch.float32 else 0, atol=1e-13)


def test_a_place_that_is_not_a_number_has_no_value():
    points = torch.full((5000, 3), 1.0, dtype=torch.float64)
    points[7, 1] = torch.nan
    value, gradient = VoxelField.through(random(*GRID.shape), GRID).value_and_gradient(points)
    assert bool(value[7].isnan())
    assert bool(gradient[7].isnan().all())
    assert int(value.isnan().sum()) == 1


def test_derivatives_by_many_points_are_there():
    field = VoxelField.through(random(*GRID.shape), GRID)
    points = (random(5000, 3, seed=3) * 10).requires_grad_(True)
    value, gradient = field.value_and_gradient(points)
    (expected,) = torch.autograd.grad(value.sum(), points)
    assert torch.allclose(gradient, expected, atol=1e-12)


@pytest.mark.parametrize("degree", [1, 3])
def test_weights_sum_to_one(degree):
    weights, slopes = spline_weights(random(50), degree)
    assert torch.allclose(weights.sum(-1), torch.ones(50, dtype=torch.float64))
    assert torch.allclose(slopes.sum(-1), torch.zeros(50, dtype=torch.float64), atol=1e-15)


def test_single_precision_and_another_device_keep_the_field():
    field = VoxelField(Boundary().extend(random(*GRID.shape).float(), 2), GRID, 3)
    assert field(GRID.points()).dtype == torch.float32
    assert torch.equal(field.to("cpu")(GRID.points()), field(GRID.points()))
    assert field.to("meta").coefficients.device.type == "meta"


@pytest.mark.usefixtures("unchecked")
def test_invalid_fields_are_refused():
    with refused("coefficients"):
        VoxelField(torch.zeros(5, 6, 7), GRID, 1)
    with refused("degree"):
        VoxelField(torch.zeros(5, 6, 7), GRID, 2)
    with refused("volume"):
        VoxelField.through(torch.zeros(4, 6, 7), GRID)
    with refused("ambient_faces"):
        Boundary(("top",))
    with refused("grid"):
        Boundary().extend(torch.zeros(1, 6, 7), 2)
