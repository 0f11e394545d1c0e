"""Symmetric flows: operator, axis, methods, harmonics, planar flows."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from nerif.common.arrays import Points
from nerif.fields.field import Field
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, Ring, paper_rig
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.symmetry_axis import (
    axis_of,
    better_direction,
    check_views,
    find_axis,
    symmetry_of,
    too_few_views,
)  # fmt: skip
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.simulation.simulate import simulate
from refusals import refused

SIDES = ("x-", "x+", "y-", "y+")


@pytest.fixture(scope="module")
def jet():
    cameras, box = paper_rig(28)
    return simulate(make_phantom("gaussian-jet", box, 0), cameras[:2], box, 1.00027, 0.03, 0, steps=30)


def one_view(measurement):
    return measurement.select(measurement.names[:1])


def error(result, box, truth=None):
    grid = Grid.of_resolution(box, 32)
    values = (truth or make_phantom("gaussian-jet", box, 0)).sample(grid)
    return float((result.field.sample(grid) - values).norm() / values.norm())


@pytest.mark.parametrize(
    ("method", "most"),
    [(Tikhonov(voxels=28), 0.03), pytest.param(TotalVariation(voxels=40), 0.03, marks=pytest.mark.slow),
     pytest.param(Landweber(voxels=40), 0.06, marks=pytest.mark.slow),
     pytest.param(NeRIF(max_steps=120), 0.03, marks=pytest.mark.slow)],
)  # fmt: skip
def test_one_view_is_enough(jet, method, most):
    result = replace(method, symmetry="axis")(one_view(jet))
    assert error(result, jet.box) < most
    assert result.axis.constrained == (True, False, True, False)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [(1.0, -0.7, 0.0), pytest.param((-1.5, 0.4, 2.0), marks=pytest.mark.slow)])
def test_one_view_determines_the_axis_in_the_image_plane_only(jet, shift):
    symmetry = Symmetry.about("axis", shift, (0.03, -0.02, 1.0), 0.1)
    one = find_axis(one_view(jet), symmetry, (2.0, math.radians(3.0)), SIDES)
    look = one_view(jet).cameras[0].rotation[2].double()
    e1 = torch.tensor(one.symmetry.frame[0], dtype=torch.float64)
    assert abs(float(e1 @ look)) < 0.1
    place = torch.tensor(one.symmetry.point, dtype=torch.float64)
    across = place - (place @ look) * look
    lean = torch.tensor(one.symmetry.direction, dtype=torch.float64)
    beside = across - across[2] / lean[2] * lean  # where it crosses z = 0
    assert abs(float(beside @ e1)) < 0.05
    assert abs(float(lean @ torch.linalg.cross(look, torch.tensor([0.0, 0.0, 1.0]).double()))) < 0.003
    assert one.constrained == (True, False, True, False)
    assert one.posterior_sigma[1] == one.prior_sigma[1]


@pytest.mark.slow
def test_two_views_determine_the_axis():
    cameras, box = paper_rig(40)
    measured = simulate(make_phantom("gaussian-jet", box, 0), [cameras[0], cameras[4]], box, 1.00027, 0.03, 0)
    axis = find_axis(measured, Symmetry.about("axis", (1.0, -0.7, 0.0), (0.03, -0.02, 1.0), 0.1), (2.0, 0.05), SIDES)
    assert all(axis.constrained)
    x, y, z = axis.symmetry.point
    along = axis.symmetry.direction
    assert math.hypot(x - z * along[0] / along[2], y - z * along[1] / along[2]) < 0.1
    assert math.hypot(*along[:2]) < 0.005


@pytest.mark.parametrize(("along", "stated", "better"), [
    ("x", None, (1.0, 0.0, 0.0)), ("z", None, ()), ("x", (0.0, 0.0, 1.0), ()),
])  # fmt: skip
def test_a_jet_along_another_edge_of_the_box_is_noticed(along, stated, better):
    box = Box.cube(50.0)
    ring = Ring(views=1, arc=(90.0, 90.0), image_size=(14, 16), pixel_pitch=0.25)
    measurement = simulate(make_phantom("plume", box), ring.cameras(), box, 1.00027, 0.02, steps=30)
    if along == "x":  # the rig is turned about y instead
        turn = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]], dtype=torch.float64)
        (camera,) = measurement.cameras
        plane = replace(camera.background, normal=turn.T @ camera.background.normal)
        turned = replace(camera, rotation=camera.rotation @ turn, background=plane)
        measurement = replace(measurement, cameras=(turned,))
    settings = Tikhonov(symmetry="axis", axis_direction=stated, axis_sigma_mm=1e-3, axis_sigma_deg=1e-3)
    assert better_direction(settings, measurement, axis_of(settings, measurement)) == better


def test_the_axis_can_be_fixed(jet):
    fixed = Tikhonov(voxels=16, symmetry="axis", axis_sigma_mm=0.0, axis_sigma_deg=0.0)
    assert fixed(one_view(jet)).axis.symmetry == symmetry_of(fixed, one_view(jet))


class Bent(Field):
    """A column off the axis."""

    def value_and_gradient(self, points: Points):
        centre = points.new_tensor([1.0, 0.0, 0.0])
        off = (points - centre) * points.new_tensor([1.0, 1.0, 0.0])
        value = -2e-4 * torch.exp(-off.square().sum(-1) / 50)
        return value, -2 / 50 * value[..., None] * off


@pytest.mark.slow
@pytest.mark.parametrize("method", [Tikhonov(voxels=20), pytest.param(NeRIF(max_steps=100), marks=pytest.mark.slow)])
def test_harmonics_reduce_the_error_of_a_flow_off_the_axis(method):
    box = Box.cube(50.0)
    measured = simulate(Bent(), paper_rig(24)[0][::4], box, 1.00027, 0.02, 0)
    fixed = replace(method, axis_sigma_mm=0.0, axis_sigma_deg=0.0)
    none, two = (error(replace(fixed, symmetry=text)(measured), box, Bent()) for text in ("axis", "axis+2"))
    assert none > 0.1
    assert two < 0.4 * none


@pytest.mark.parametrize(
    ("text", "views", "instead"),
    [("axis+2", 1, "axis"), ("axis+3", 3, "axis+1"), ("axis+2", 2, "axis"), ("axis+4", 4, "axis+1")],
)
def test_more_harmonics_than_views_can_determine_are_refused(text, views, instead):
    few = SimpleNamespace(cameras=[None] * views)
    with refused("symmetry") as error:
        check_views(NeRIF(symmetry=text), few)
    assert str(error.value).endswith(f"give --symmetry {instead}")
    for settings in (NeRIF(symmetry=instead), NeRIF()):
        check_views(settings, few)
        assert not too_few_views(settings, few)


@pytest.mark.parametrize(
    ("text", "views", "words"),
    [
        ("axis+4", 5, r"5 views are too few for 4 harmonics, which need 9; .* Give --symmetry axis\+2"),
        ("axis+1", 2, "which need 3; .* Give --symmetry axis$"),
        ("axis+2", 4, r"Give --symmetry axis\+1"),
        ("axis+2", 5, "^$"),
        ("planar", 1, "^$"),
    ],
)
def test_harmonics_that_the_views_do_not_determine_are_named(text, views, words):
    assert re.search(words, too_few_views(NeRIF(symmetry=text), SimpleNamespace(cameras=[None] * views)))


class Sheet(Field):
    """A flow between windows, uniform along y."""

    def value_and_gradient(self, points: Points):
        off = points * points.new_tensor([1.0, 0.0, 0.3])
        value = -2e-4 * torch.exp(-(points[..., 0].square() + 0.3 * points[..., 2].square()) / 40)
        return value, -2 / 40 * value[..., None] * off


@pytest.mark.parametrize("method", [Tikhonov(voxels=20), pytest.param(NeRIF(max_steps=100), marks=pytest.mark.slow)])
def test_a_planar_flow_from_the_view_along_it(method):
    box = Box.around_origin((50.0, 20.0, 50.0))
    camera = paper_rig(24)[0][4:5]  # the one that looks along y
    measured = simulate(Sheet(), camera, box, 1.00027, 0.02, 0, steps=30)
    result = replace(method, symmetry="planar")(replace(measured, ambient_faces=("x-", "x+")))
    assert abs(result.axis.symmetry.direction[1]) > 0.99
    assert error(result, box, Sheet()) < 0.05


def test_one_view_of_a_symmetric_flow_has_more_samples(jet):
    alone = one_view(jet)
    assert NeRIF(symmetry="axis").resolved_by(alone).samples == (24, 48)
    assert NeRIF(symmetry="axis").resolved_by(jet).samples == NeRIF().resolved_by(alone).samples == (12, 24)
    assert NeRIF(symmetry="axis", samples=(16, 20)).resolved_by(alone).samples == (16, 20)


def test_invalid_axes_are_refused(jet):
    for wrong in ({"symmetry": "round"}, {"axis_sigma_mm": -1.0}, {"axis_sigma_deg": -1.0}):
        with refused(next(iter(wrong))):
            Tikhonov(**wrong)
    with refused("axis_point"):
        Tikhonov(symmetry="axis", axis_point=(99.0, 0.0, 0.0), voxels=16)(one_view(jet))
