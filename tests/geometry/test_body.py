"""Bodies: closed meshes, what is inside, what rays meet, and which pixels see one."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bodies import ball, cuboid
from nerif.geometry import Box, Ring
from nerif.geometry.body import Body, check_place, contained, hidden_pixels, is_thin
from nerif.geometry.pose import rotation_matrix
from nerif.geometry.rays import Rays
from refusals import refused

BOX = Box.cube(40.0)


def points(count: int, edge: float, seed: int = 0) -> torch.Tensor:
    return (torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5) * edge


def test_volume_and_extent_of_a_cuboid_and_of_a_ball():
    body = cuboid((-1.0, 0.0, 2.0), (3.0, 2.0, 2.5))
    assert body.volume == pytest.approx(4 * 2 * 0.5)
    assert [e.tolist() for e in body.extent] == [[-1, 0, 2], [3, 2, 2.5]]
    assert ball(6.0).volume == pytest.approx(4 / 3 * math.pi * 216, rel=3e-3)
    assert torch.allclose(body.normals.abs().sum(dim=1), torch.ones(12, dtype=torch.float64))


def test_points_of_a_cuboid_are_inside_and_have_the_distance_of_the_cuboid():
    body, x = cuboid((-5.0, -3.0, -1.0), (5.0, 3.0, 1.0)), points(4000, 16.0)
    half = torch.tensor([5.0, 3.0, 1.0], dtype=torch.float64)
    beyond = x.abs() - half
    expected = beyond.clamp(min=0).norm(dim=-1) + beyond.amax(dim=-1).clamp(max=0)
    assert torch.equal(body.contains(x), (beyond < 0).all(dim=-1))
    torch.testing.assert_close(body.distance(x), expected)


def test_the_closest_points_of_a_ball_are_on_the_way_to_its_centre():
    body, x = ball(6.0, (1.0, -2.0, 0.5), rings=120), points(500, 40.0)
    centre = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    distance = (x - centre).norm(dim=-1) - 6
    torch.testing.assert_close(body.distance(x), distance, atol=0.01, rtol=0)
    where, face = body.closest(x)
    outwards = ((where - centre) / 6 * body.normals[face]).sum(dim=-1)
    assert float(outwards.min()) > 0.999


def test_rays_meet_a_body_where_they_enter_it_and_only_before_their_background():
    body, generator = cuboid(), torch.Generator().manual_seed(3)
    origin = torch.nn.functional.normalize(torch.randn(2000, 3, generator=generator, dtype=torch.float64), dim=1) * 30
    direction = torch.nn.functional.normalize(points(2000, 14.0, 1) - origin, dim=1)
    zero = torch.zeros(2000, dtype=torch.float64)
    rays = Rays(origin, direction, zero, zero, zero[:, None].expand(-1, 2), zero.to(torch.int16), zero)
    clipped = rays.clip(Box.cube(10.0))
    expected = torch.where(clipped.crosses, clipped.near, torch.inf)
    torch.testing.assert_close(body.hits(rays), expected)
    assert 0.3 < float(expected.isfinite().double().mean()) < 0.9


def test_a_cavity_is_outside_and_overlapping_parts_are_inside():
    outer, inner = cuboid(), cuboid((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))
    hollow = Body(torch.cat([outer.vertices, inner.vertices]), torch.cat([outer.faces, inner.faces.flip(1) + 8]))
    x = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [6.0, 0.0, 0.0]])
    assert hollow.contains(x).tolist() == [False, True, False]
    moved = outer.moved(torch.eye(3), torch.tensor([4.0, 0.0, 0.0]))
    both = Body(torch.cat([outer.vertices, moved.vertices]), torch.cat([outer.faces, moved.faces + 8]))
    assert both.contains(x).tolist() == [True, True, True]
    assert contained([outer, moved], x).tolist() == [True, True, True]


def test_triangles_that_face_inwards_are_turned():
    body = cuboid()
    turned = replace(body, faces=body.faces.flip(1))
    assert turned.volume == pytest.approx(1000.0)
    assert torch.equal(turned.contains(points(100, 14.0)), body.contains(points(100, 14.0)))
    mirrored = replace(body, vertices=body.vertices * torch.tensor([-1.0, 1.0, 1.0]))
    assert mirrored.volume == pytest.approx(1000.0)


def test_a_moved_body_contains_the_moved_points():
    body, x = cuboid((-5.0, -3.0, -1.0), (5.0, 3.0, 1.0)), points(1000, 14.0, 5)
    rotation = rotation_matrix(torch.tensor([0.3, -0.8, 0.2], dtype=torch.float64))
    shift = torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64)
    assert torch.equal(body.moved(rotation, shift).contains(x @ rotation.T + shift), body.contains(x))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda b: {"faces": b.faces[1:]}, "3 edges without the neighbouring triangle"),
        (lambda b: {"faces": torch.cat([b.faces[:1].flip(1), b.faces[1:]])}, "3 edges whose triangles face opposite"),
        (lambda b: {"vertices": b.vertices * torch.tensor([1.0, 1.0, 0.0])}, "without a volume"),
        (lambda b: {"vertices": b.vertices * torch.nan}, "finite vertices"),
        (lambda b: {"faces": b.faces + 1}, "vertices 0 to 7"),
        (lambda b: {"faces": b.faces[:2]}, "at least four triangles"),
    ],
)
def test_a_mesh_that_is_no_body_is_refused(change, words):
    body = cuboid(name="wing")
    with refused("wing") as error:
        replace(body, **change(body))
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (cuboid((-0.005,) * 3, (0.005,) * 3, "m.stl"), "may be in m: --unit m"),
        (cuboid((-0.4,) * 3, (0.39,) * 3, "in.stl"), None),
        (cuboid((60.0, 0.0, 0.0), (70.0, 5.0, 5.0), "away.stl"), "give its place"),
        (cuboid((-500.0,) * 3, (500.0,) * 3, "large.stl"), "suits the box"),
    ],
)
def test_a_body_that_is_not_in_the_box_is_refused_with_the_likely_cause(body, words):
    if words is None:
        check_place(body, BOX)
        return
    with refused(body.name) as error:
        check_place(body, BOX)
    assert words in str(error.value)
    if "unit" in words:
        check_place(body, BOX, unit_stated=True)


def test_a_body_beside_the_box_is_refused_with_the_axes_that_would_place_it_there():
    box = Box((0.0, 0.0, 0.0), (10.0, 20.0, 60.0))
    with refused("m.stl") as error:
        check_place(cuboid((-8.0, 2.0, 20.0), (-2.0, 9.0, 50.0), "m.stl"), box)
    assert "axes as (-x, y, z)" in str(error.value)


@pytest.mark.parametrize("telecentric", [False, True])
def test_pixels_see_a_ball_where_their_ray_passes_its_centre_within_its_radius(telecentric):
    centre, radius = torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64), 5.0
    kind = "telecentric" if telecentric else "perspective"
    ring = Ring(views=3, image_size=(48, 64), pixel_pitch=0.03, projection=kind)
    body = ball(radius, tuple(centre.tolist()), rings=150)
    for camera in ring.cameras():
        rays = camera.rays(camera.pixel_grid().reshape(-1, 2))
        along = ((centre - rays.origin) * rays.direction).sum(dim=-1, keepdim=True)
        passes = (rays.origin + along * rays.direction - centre).norm(dim=-1).reshape(48, 64)
        hidden = hidden_pixels(camera, [body])
        clear = (passes - radius).abs() > 0.01
        assert torch.equal(hidden[clear], (passes < radius)[clear])
        assert 0.01 < float(hidden.double().mean()) < 0.9


def test_a_lens_and_a_margin_hide_more_pixels_all_around():
    ring, body = Ring(views=1, image_size=(60, 60), pixel_pitch=0.03), ball(5.0)
    thin, wide = (hidden_pixels(ring.cameras(f_number)[0], [body]) for f_number in (0.0, 2.0))
    with_margin = hidden_pixels(ring.cameras()[0], [body], margin=2)
    assert bool((thin <= wide).all())
    assert int(thin.sum()) < int(wide.sum())
    assert bool((thin <= with_margin).all())
    grown = torch.nn.functional.max_pool2d(thin[None].float(), 5, 1, 2)[0] > 0
    assert torch.equal(with_margin, grown)


def test_a_body_behind_the_background_hides_nothing():
    camera = Ring(views=1, image_size=(40, 40)).cameras()[0]
    away = camera.plane.normal * (camera.plane.offset + 30 * (1 if camera.plane.offset > 0 else -1))
    assert not bool(hidden_pixels(camera, [ball(5.0, tuple(away.tolist()))]).any())


def test_plates_are_thin_and_balls_are_not():
    plate = cuboid((-10.0, -8.0, -0.25), (10.0, 8.0, 0.25))
    assert is_thin(plate, 1.0)
    assert not is_thin(plate, 0.4)
    assert not is_thin(ball(6.0), 2.0)
    assert is_thin(ball(6.0), 13.0)
