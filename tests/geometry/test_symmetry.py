"""Coordinates of symmetric fields, and the box in them."""

from __future__ import annotations

import math
from dataclasses import asdict

import pytest
import torch

from nerif.geometry import Box
from nerif.geometry.symmetry import Symmetry
from nerif.geometry.symmetry_names import parse_symmetry
from refusals import refused

BOX = Box((-20.0, -20.0, -30.0), (20.0, 20.0, 30.0))
SIDES = ("x-", "x+", "y-", "y+")


def about(text="axis", point=(1.0, 2.0, 0.0), direction=(0.1, -0.05, 1.0), rounding=0.1):
    rounded = Symmetry.about(text, point, direction, rounding)
    assert rounded is not None
    return rounded


@pytest.mark.parametrize(("text", "parsed"), [("none", None), ("axis", ("axis", 0)), ("axis+3", ("axis", 3))])
def test_names_are_parsed(text, parsed):
    assert parse_symmetry(text) == parsed


@pytest.mark.parametrize("text", ["axes", "axis+", "axis+9", "planar+1", ""])
def test_other_names_are_refused(text):
    with refused("symmetry"):
        parse_symmetry(text)


def test_an_axis_without_a_direction_is_refused():
    with refused("axis_direction"):
        about(direction=(0.0, 0.0, 0.0))


def test_coordinates_do_not_depend_on_the_azimuth():
    symmetry, angle = about(rounding=1e-6), torch.tensor(1.1, dtype=torch.float64)
    r, h = torch.tensor([0.0, 3.0, 9.0], dtype=torch.float64), torch.tensor([-4.0, 0.0, 11.0], dtype=torch.float64)
    for turn in (0.0, 0.4, 2.0):
        rounded = symmetry.reduced(symmetry.places(r, angle + turn, h))
        assert torch.allclose(rounded, torch.stack([r, torch.zeros(3), h], dim=1).double(), atol=1e-5)


def test_coordinates_of_a_planar_field_are_constant_along_its_direction():
    symmetry = about("planar", direction=(0.0, 1.0, 0.2))
    p = torch.rand(9, 3, dtype=torch.float64)
    along = torch.tensor(symmetry.direction, dtype=torch.float64)
    assert torch.allclose(symmetry.reduced(p), symmetry.reduced(p + 7.3 * along), atol=1e-12)


@pytest.mark.parametrize("text", ["axis+1", "axis+3"])
def test_shares_add_up_to_one_and_are_those_of_single_angles_far_from_the_axis(text):
    symmetry = about(text, rounding=1e-4)
    angles = 2 * math.pi * torch.arange(symmetry.angles, dtype=torch.float64) / symmetry.angles
    far = torch.full_like(angles, 8.0)
    share, _ = symmetry.shares(symmetry.local(symmetry.places(far, angles, far)))
    assert torch.allclose(share, torch.eye(symmetry.angles, dtype=torch.float64), atol=1e-7)
    anywhere, rise = symmetry.shares(20 * torch.rand(50, 3, dtype=torch.float64) - 10)
    assert torch.allclose(anywhere.sum(1), torch.ones(50, dtype=torch.float64))
    assert torch.allclose(rise.sum(1), torch.zeros(50, 3, dtype=torch.float64), atol=1e-9)


def test_the_reduced_box_ends_at_the_nearest_ambient_face():
    straight = about(direction=(0.0, 0.0, 1.0))
    assert straight.reduced_box(BOX, SIDES).upper[0] == pytest.approx(18.0)
    assert straight.reduced_box(BOX, ()).upper[0] == pytest.approx(math.hypot(21.0, 22.0))
    assert straight.reduced_box(BOX, SIDES).lower[2] == pytest.approx(-30.0)
    with refused("axis_point"):
        about(point=(25.0, 0.0, 0.0), direction=(0.0, 0.0, 1.0)).reduced_box(BOX, SIDES)


def test_faces_of_the_box_are_named_as_those_of_the_reduced_one():
    assert about().faces((*SIDES, "z-")) == ("x+", "z-")
    assert about(direction=(0.0, 0.0, -1.0)).faces(("z-",)) == ("z+",)
    planar = about("planar", direction=(0.0, 1.0, 0.0))
    assert planar.faces(("x-", "y+", "z+")) == ("x-", "z+")


def test_moving_an_axis_there_and_back_leaves_it_where_it_was():
    start = about()
    there = start.move((0.5, -0.2), (0.01, 0.02))
    still = there.move((0.0, 0.0), (0.0, 0.0))
    assert (still.matrix - there.matrix).abs().max() < 1e-12
    lean = torch.tensor(there.direction, dtype=torch.float64) @ start.matrix.T
    assert (lean[:2] / lean[2]).tolist() == pytest.approx([0.01, 0.02])
    assert (there.matrix @ there.matrix.T - torch.eye(3)).abs().max() < 1e-12


def test_a_symmetry_comes_back_from_its_entries():
    symmetry = about("axis+2")
    assert Symmetry.from_entries(asdict(symmetry)) == symmetry
