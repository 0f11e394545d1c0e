"""Axisymmetric phantoms: symmetry, smoothness on the axis, ambient sides, shock cells."""

from __future__ import annotations

import pytest
import torch

from nerif.fields.jets import AXISYMMETRIC
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid

CUBE = Box.cube(50.0)
SLAB = Box((-20.0, -25.0, -15.0), (24.0, 21.0, 33.0))


def points(box: Box, count: int = 2000) -> torch.Tensor:
    """Points in the middle three quarters, at all heights."""
    unit = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 0.5
    share = torch.tensor([0.75, 0.75, 1.0], dtype=torch.float64)
    return torch.tensor(box.centre, dtype=torch.float64) + unit * share * torch.tensor(box.edges, dtype=torch.float64)


@pytest.mark.parametrize("name", AXISYMMETRIC)
def test_rotation_about_the_axis_changes_nothing(name, rotation_about):
    field, p, turn = make_phantom(name, SLAB), points(SLAB), rotation_about((0.0, 0.0, 1.0), 1.1)
    centre = torch.tensor(SLAB.centre, dtype=torch.float64)
    value, gradient = field.value_and_gradient(p)
    turned, slope = field.value_and_gradient((p - centre) @ turn.T + centre)
    assert float((turned - value).abs().max()) < 1e-12 * float(value.abs().max())
    assert float((slope - gradient @ turn.T).abs().max()) < 1e-11 * float(gradient.abs().max())


@pytest.mark.parametrize("name", AXISYMMETRIC)
@pytest.mark.parametrize("box", [CUBE, SLAB])
def test_side_faces_are_ambient(name, box):
    field, places = make_phantom(name, box), torch.rand(5000, 2, generator=torch.Generator().manual_seed(0))
    faces = torch.cat([box.face_points(f, places) for f in ("x-", "x+", "y-", "y+")])
    assert float(field(faces).abs().max()) < 1e-4 * float(field(points(box)).abs().max())


@pytest.mark.parametrize("name", AXISYMMETRIC)
def test_fields_are_smooth_on_the_axis(name):
    """The transverse gradient is proportional to the distance."""
    field = make_phantom(name, CUBE)
    heights = torch.linspace(-24.9, 24.9, 400, dtype=torch.float64)
    axis = torch.stack([torch.zeros_like(heights), torch.zeros_like(heights), heights], dim=-1)
    value, gradient = field.value_and_gradient(axis)
    assert bool(value.isfinite().all())
    assert float(gradient[:, :2].abs().max()) == 0
    shift = torch.tensor([1e-4, 0.0, 0.0], dtype=torch.float64)
    near, twice = (field.gradient(axis + k * shift)[:, 0] for k in (1, 2))
    steepest = float(field.gradient(points(CUBE)).norm(dim=-1).max())
    assert float((twice - 2 * near).abs().max()) < 1e-4 * float(twice.abs().max()) + 1e-9 * steepest


@pytest.mark.parametrize("name", AXISYMMETRIC)
def test_values_are_those_of_a_gas(name):
    values = make_phantom(name, CUBE).sample(Grid.of_resolution(CUBE, 80))
    assert -2.3e-4 < float(values.min()) < -0.7e-4
    low, high = (1.2e-4, 2.0e-4) if name == "underexpanded" else (-1e-9, 0.0)
    assert low < float(values.max()) <= high


def test_shock_cells_repeat_along_the_axis():
    """Fronts, where the index rises steeply upward, are a cell apart."""
    field = make_phantom("underexpanded", CUBE)
    z = torch.linspace(-25, 25, 5001, dtype=torch.float64)
    slope = field.gradient(torch.stack([torch.zeros_like(z), torch.zeros_like(z), z], dim=-1))[:, 2]
    peaks = z[1:-1][(slope[1:-1] > slope[:-2]) & (slope[1:-1] > slope[2:]) & (slope[1:-1] > 0.2 * slope.max())]
    assert peaks.diff().tolist() == pytest.approx([50 / 3.5] * (len(peaks) - 1), abs=0.1)
    assert len(peaks) == 4
