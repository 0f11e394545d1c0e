"""Clipping, boxes, grids and rigs."""

from __future__ import annotations

import math

import pytest
import torch

from nerif.common.conventions import FACES, parse_faces
from nerif.geometry import TELECENTRIC, Box, Grid, Rays, Ring, paper_rig
from refusals import refused

F64 = torch.float64
BOX = Box((-1.0, -2.0, -3.0), (2.0, 4.0, 6.0))


def ray(origin: list[float], direction: list[float]) -> Rays:
    d = torch.tensor([direction], dtype=F64)
    one = torch.ones(1, dtype=F64)
    nothing = torch.zeros(1, 2, dtype=F64), torch.zeros(1, dtype=torch.int16), torch.zeros(1, dtype=F64)
    return Rays(torch.tensor([origin], dtype=F64), d / d.norm(), one, one, *nothing)


@pytest.mark.parametrize(
    ("origin", "direction", "near", "far"),
    [
        ([-10, 0, 0], [1, 0, 0], 9, 12),
        ([0, -10, 0], [0, 1, 0], 8, 14),
        ([0, 0, 20], [0, 0, -1], 14, 23),
        ([-4, 0, -3], [1, 0, 1], 3 * math.sqrt(2), 6 * math.sqrt(2)),
        ([0, 0, 0], [1, 0, 0], 0, 2),  # from inside
    ],
)
def test_chords(origin, direction, near, far):
    clipped = ray(origin, direction).clip(BOX)
    assert bool(clipped.crosses)
    assert [float(clipped.near), float(clipped.far)] == pytest.approx([near, far])


@pytest.mark.parametrize("origin", [[-10, 5, 0], [-10, 0, 7], [10, 0, 0]])
def test_misses(origin):
    assert not bool(ray(origin, [1, 0, 0]).clip(BOX).crosses)


def test_exit_faces():
    clipped = ray([-4, 0, -3.5], [1, 0, 1]).clip(BOX)  # in by x-, out by x+
    assert [bool(clipped.exit_faces(BOX, (f,))) for f in FACES] == [True, True, False, False, False, False]


def test_box_and_faces():
    assert BOX.edges == (3.0, 6.0, 9.0)
    assert BOX.centre == (0.5, 1.0, 1.5)
    unit = torch.rand(20, 2)
    for face in FACES:
        points = BOX.face_points(face, unit)
        axis = "xyz".index(face[0])
        assert torch.all(points[:, axis] == (BOX.lower, BOX.upper)[face[1] == "+"][axis])
        others = [a for a in range(3) if a != axis]
        assert float(points[:, others].std(dim=0).min()) > 0
        assert bool(((points >= torch.tensor(BOX.lower)) & (points <= torch.tensor(BOX.upper))).all())


def test_grid_is_indexed_z_y_x_at_voxel_centres():
    grid = Grid(BOX, (9, 3, 2))
    assert grid.spacing == (1.5, 2.0, 1.0)
    points = grid.points(F64)
    assert points.shape == (9, 3, 2, 3)
    assert points[4, 1, 1].tolist() == [1.25, 1.0, 1.5]
    assert points[0, 0, 0].tolist() == [-0.25, -1.0, -2.5]
    assert Grid.of_resolution(BOX, 27).shape == (27, 18, 9)


def test_paper_rig():
    cameras, box = paper_rig()
    assert box.edges == (50.0, 50.0, 50.0)
    assert [c.name for c in cameras] == [f"{170 / 8 * i:g}deg" for i in range(9)]
    for c in cameras:
        assert c.image_size == (200, 200)
        assert float(c.intrinsics[0, 0]) == float(c.intrinsics[1, 1]) == 2500.0
        origin, above = c.project(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 10.0]], dtype=F64))
        assert origin.tolist() == pytest.approx([99.5, 99.5])
        assert float(above[1]) < float(origin[1])  # up in the world is up in the image
        assert float(c.centre.norm()) == pytest.approx(700.0)
        assert float(c.rays(torch.tensor([[99.5, 99.5]], dtype=F64)).ends.distance) == pytest.approx(1200.0)
    first = cameras[0]
    corners = torch.tensor([[x, y, z] for x in (-25, 25) for y in (-25, 25) for z in (-25, 25)], dtype=F64)
    pixels = first.project(corners)
    assert 0 < float(pixels.min()) < float(pixels.max()) < 199  # the cube is seen whole
    assert first.centre.tolist() == pytest.approx([700.0, 0.0, 0.0])


def test_ring_settings():
    ring = Ring(views=3, arc=(0, 90), extra_angles=(10,), elevation=30, distance=100, image_size=(20, 30))
    assert ring.angles == (0, 45, 90, 10)
    assert ring.cameras()[0].centre.tolist() == pytest.approx([100 * math.cos(math.pi / 6), 0, 50])
    with refused("views"):
        Ring(views=3, arc=(0, 90), extra_angles=(45,)).cameras()


def test_a_telecentric_ring_sees_as_much_as_its_lens_magnifies():
    plain, parallel = Ring(image_size=(20, 30)), Ring(image_size=(20, 30), projection="telecentric")
    origin, above = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=F64)
    for one, other in zip(plain.cameras(), parallel.cameras(), strict=True):  # as large at the origin
        assert torch.allclose(one.project(origin), other.project(origin), atol=1e-9)
        assert torch.allclose(one.project(above), other.project(above), atol=1e-9)
        assert torch.allclose(one.rotation, other.rotation)
    for camera in Ring(projection="telecentric", magnification=0.2, pixel_pitch=0.01).cameras():
        assert camera.projection == TELECENTRIC
        assert float(camera.intrinsics[0, 0]) == pytest.approx(20.0)  # px/mm
        assert float(camera.pixel_size(above + 30.0)) == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"projection": "fisheye"}, "projection"),
        ({"magnification": 0.1}, "magnification"),
        ({"magnification": -0.1, "projection": "telecentric"}, "magnification"),
        ({"views": 0}, "views"),
        ({"distance": -1.0}, "distance"),
        ({"focal_length": math.inf}, "focal_length"),
        ({"elevation": math.nan}, "elevation"),
        ({"image_size": (0, 4)}, "image_size"),
    ],
)
def test_rings_that_cannot_be(settings, field, unchecked):
    with refused(field):
        Ring(**settings)


@pytest.mark.parametrize(
    ("lower", "upper"),
    [((0, 0, 0), (1, 0, 1)), ((0, 0, 0), (1, -1, 1)), ((0, 0, 0), (1, 1, math.nan)), ((1e6, 0, 0), (1e6 + 1, 1, 1)),
     ((0, 0, 0), (1e9, 1, 1))],
)  # fmt: skip
def test_boxes_that_cannot_be(lower, upper):
    with refused("box"):
        Box(lower, upper)


def test_grids_and_faces_that_cannot_be(unchecked):
    for shape in ((0, 3, 2), (1.5, 2, 2)):
        with refused("grid"):
            Grid(BOX, shape)
    with refused("voxels"):
        Grid.of_resolution(BOX, 0)
    with refused("ambient_faces"):
        parse_faces("x- up")


def test_a_box_around_the_origin_and_what_it_holds():
    box = Box.around_origin((4.0, 6.0, 8.0))
    assert (box.lower, box.upper) == ((-2.0, -3.0, -4.0), (2.0, 3.0, 4.0))
    assert Box.cube(2.0) == Box.around_origin((2.0, 2.0, 2.0))
    assert box.holds(box)
    assert box.holds(Box((-2.0, 0.0, 0.0), (2.0, 3.0 + 1e-7, 1.0)))
    assert not box.holds(Box((-2.0, 0.0, 0.0), (2.0, 3.1, 1.0)))
    assert not box.holds(Box((-2.1, 0.0, 0.0), (2.0, 3.0, 1.0)))
