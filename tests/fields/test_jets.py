"""Phantoms around an axis: exact gradients, the same all around it, smooth on it, ambient at the sides."""

from __future__ import annotations

import math

import pytest
import torch

from nerif.fields.jets import AXISYMMETRIC, Axisymmetric
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid
from refusals import refused

CUBE = Box.cube(50.0)
SLAB = Box((-20.0, -25.0, -15.0), (24.0, 21.0, 33.0))
NAMES = tuple(AXISYMMETRIC)


def points(box: Box, count: int = 2000) -> torch.Tensor:
    """Within three quarters of the middle, where the flows are, at every height."""
    unit = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 0.5
    share = torch.tensor([0.75, 0.75, 1.0], dtype=torch.float64)
    return torch.tensor(box.centre, dtype=torch.float64) + unit * share * torch.tensor(box.edges, dtype=torch.float64)


def phantom(name: str, box: Box) -> Axisymmetric:
    field = make_phantom(name, box)
    assert isinstance(field, Axisymmetric)
    return field


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("box", [CUBE, SLAB])
def test_gradient_is_that_of_finite_differences(name, box):
    field, p, step = phantom(name, box), points(box), 1e-4
    _, gradient = field.value_and_gradient(p)
    for axis in range(3):
        move = torch.zeros(3, dtype=torch.float64)
        move[axis] = step
        difference = (field(p + move) - field(p - move)) / (2 * step)
        assert float((gradient[:, axis] - difference).abs().max()) < 1e-5 * float(gradient.abs().max())


@pytest.mark.parametrize("name", NAMES)
def test_gradient_is_exact(name):
    field = phantom(name, SLAB)
    p = points(SLAB).reshape(4, 500, 3).requires_grad_()
    value, gradient = field.value_and_gradient(p)
    assert value.shape == (4, 500)
    (expected,) = torch.autograd.grad(value.sum(), p)
    assert float((gradient - expected).detach().abs().max()) < 1e-12 * float(expected.abs().max())


@pytest.mark.parametrize("name", NAMES)
def test_single_precision_is_close_to_double(name):
    field, p = phantom(name, SLAB), points(SLAB)
    value, gradient = field.value_and_gradient(p)
    single, slope = field.value_and_gradient(p.float())
    assert single.dtype == slope.dtype == torch.float32
    assert float((single - value).abs().max()) < 1e-4 * float(value.abs().max())
    assert float((slope - gradient).abs().max()) < 3e-4 * float(gradient.abs().max())


@pytest.mark.parametrize("name", NAMES)
def test_is_the_same_all_around_the_axis(name):
    field, p = phantom(name, SLAB), points(SLAB)
    centre = torch.tensor(SLAB.centre, dtype=torch.float64)
    c, s = math.cos(1.1), math.sin(1.1)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    value, gradient = field.value_and_gradient(p)
    turned, slope = field.value_and_gradient((p - centre) @ turn.T + centre)
    assert float((turned - value).abs().max()) < 1e-12 * float(value.abs().max())
    assert float((slope - gradient @ turn.T).abs().max()) < 1e-11 * float(gradient.abs().max())


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("box", [CUBE, SLAB])
def test_side_faces_are_ambient(name, box):
    field = phantom(name, box)
    places = torch.rand(5000, 2, generator=torch.Generator().manual_seed(0))
    faces = torch.cat([box.face_points(f, places) for f in ("x-", "x+", "y-", "y+")])
    peak = float(field(points(box)).abs().max())
    assert float(field(faces).abs().max()) < 1e-4 * peak


@pytest.mark.parametrize("name", NAMES)
def test_is_smooth_on_the_axis(name):
    """Across the axis the gradient passes 0 in proportion to the distance, and nothing is not a number on it."""
    field = phantom(name, CUBE)
    heights = torch.linspace(-24.9, 24.9, 400, dtype=torch.float64)
    on_axis = torch.stack([torch.zeros_like(heights), torch.zeros_like(heights), heights], dim=-1)
    value, gradient = field.value_and_gradient(on_axis)
    assert bool(value.isfinite().all())
    assert float(gradient[:, :2].abs().max()) == 0
    shift = torch.tensor([1e-4, 0.0, 0.0], dtype=torch.float64)
    near, twice = (field.gradient(on_axis + k * shift)[:, 0] for k in (1, 2))
    steepest = float(field.gradient(points(CUBE)).norm(dim=-1).max())
    assert float((twice - 2 * near).abs().max()) < 1e-4 * float(twice.abs().max()) + 1e-9 * steepest


@pytest.mark.parametrize("name", NAMES)
def test_is_what_a_gas_can_be(name):
    values = phantom(name, CUBE).sample(Grid.of_resolution(CUBE, 80))
    assert -2.3e-4 < float(values.min()) < -0.7e-4
    if name == "underexpanded":
        assert 1.2e-4 < float(values.max()) < 2.0e-4
    else:
        assert float(values.max()) <= 0


def test_shock_cells_repeat_along_the_axis():
    """Fronts, where the index rises steeply upward, stand a cell apart."""
    field = phantom("underexpanded", CUBE)
    z = torch.linspace(-25, 25, 5001, dtype=torch.float64)
    slope = field.gradient(torch.stack([torch.zeros_like(z), torch.zeros_like(z), z], dim=-1))[:, 2]
    peaks = z[1:-1][(slope[1:-1] > slope[:-2]) & (slope[1:-1] > slope[2:]) & (slope[1:-1] > 0.2 * slope.max())]
    assert peaks.diff().tolist() == pytest.approx([50 / 3.5] * (len(peaks) - 1), abs=0.1)
    assert len(peaks) == 4


def test_names_are_told_when_one_is_unknown():
    with refused("phantom"):
        make_phantom("jet", CUBE)
