"""A pixel sees through the whole of a lens: its rays, where they meet, and how they are seen."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from nerif.geometry import PROJECTIONS, Box, Lens, Plane, Ring, spread_points
from refusals import refused

BOX = Box.cube(40.0)
RING = Ring(views=2, arc=(20.0, 70.0), elevation=6.0, image_size=(8, 10), pixel_pitch=0.2)


def camera(lens: Lens | None, projection: str = "perspective"):
    """One that looks at a tilted background."""
    result = replace(RING, projection=projection).cameras()[0]
    normal = torch.nn.functional.normalize(result.background.normal + torch.tensor([0.0, 0.1, 0.2]).double(), dim=0)
    return replace(result, background=Plane(normal, result.background.offset), lens=lens)


def spread(lens: Lens, projection: str = "perspective", each: int = 6):
    """The rays of all pixels, and those through points of the lens."""
    lensed = camera(lens, projection)
    rays = lensed.rays(lensed.pixel_grid().reshape(-1, 2), view=3).clip(BOX)
    return lensed, rays, rays.through(spread_points(len(rays), each))


@pytest.mark.parametrize("projection", sorted(PROJECTIONS))
@pytest.mark.parametrize("focus", [None, 500.0])
def test_rays_through_a_lens_meet_where_it_is_focused(focus, projection):
    lens = Lens(12.0, focus)
    lensed, rays, through = spread(lens, projection)
    assert len(through) == 6 * len(rays)
    axis = lensed.rotation[2]
    away = through.origin.reshape(-1, 6, 3) - rays.origin[:, None]
    assert float((away @ axis).abs().max()) < 1e-9  # across the optical axis
    assert float(away.norm(dim=-1).max()) <= 6.0
    depth = lensed.depth(lensed.plane) if focus is None else focus
    if focus is None:
        ends = through.end_points.reshape(-1, 6, 3)
        assert torch.allclose(ends, rays.end_points[:, None].expand_as(ends), atol=1e-8)
    else:
        start = through.origin - lensed.centre
        reach = (depth - start @ axis) / (through.direction @ axis)
        points = (through.origin + reach[:, None] * through.direction).reshape(-1, 6, 3)
        assert float((points - points[:, :1]).abs().max()) < 1e-8
        plane = lensed.plane
        assert torch.allclose(through.end_points @ plane.normal, torch.tensor(plane.offset).double(), atol=1e-8)
    assert torch.equal(through.view, torch.full((len(through),), 3, dtype=torch.int16))
    assert torch.equal(through.pixel, rays.pixel.repeat_interleave(6, 0))
    again = through.clip(BOX)
    assert torch.equal(again.near, through.near)
    assert through.lens is None


@pytest.mark.parametrize("projection", sorted(PROJECTIONS))
def test_all_rays_of_a_pixel_have_the_same_sensitivity_on_the_background(projection):
    """S' of a ray is S on the plane, and 0 along the ray."""
    lensed, rays, through = spread(Lens(20.0), projection, 4)
    normal = lensed.plane.normal
    along = torch.linalg.cross(normal, torch.tensor([0.3, 0.2, 0.9]).double())
    for vector in (along, torch.linalg.cross(normal, along)):
        each = (through.ends.sensitivity @ vector).reshape(-1, 4, 2)
        assert torch.allclose(each, (rays.ends.sensitivity @ vector)[:, None].expand_as(each), atol=1e-12)
    blind = torch.einsum("nij,nj->ni", through.ends.sensitivity, through.direction)
    assert float(blind.abs().max()) < 1e-12


@pytest.mark.parametrize(("count", "degree"), [(4, 3), (6, 3), (8, 3), (12, 5), (16, 7)])
def test_points_of_the_disc_have_its_mean(count, degree):
    """Source: moments of the unit disc, x^a y^b with a, b even: 2 / (a + b + 2) times the mean of cos^a sin^b."""
    points = spread_points(50, count, torch.Generator().manual_seed(1)).double()
    assert not torch.allclose(points[0], points[1])
    theta = torch.arange(64, dtype=torch.float64) * (2 * math.pi / 64)
    for a in range(degree + 1):
        for b in range(degree + 1 - a):
            around = (theta.cos() ** a * theta.sin() ** b).mean()
            expected = (2 / (a + b + 2) * around).expand(50)
            result = (points[..., 0] ** a * points[..., 1] ** b).mean(dim=1)
            assert torch.allclose(result, expected, atol=1e-6), (a, b)
    assert torch.equal(spread_points(5, 4), spread_points(5, 4))
    square = points[..., 2:]
    assert float(square.abs().max()) <= 1
    assert float(square.mean(dim=1).abs().max()) < 2 / count  # of 0, and a spread of 1/3
    assert float(square.square().mean()) == pytest.approx(1 / 3, rel=0.05)
    assert torch.equal(spread_points(3, 1), torch.zeros(3, 1, 4))


@pytest.mark.parametrize("diameter", [0.0, 12.0])
@pytest.mark.parametrize("projection", sorted(PROJECTIONS))
def test_rays_over_a_window_are_those_of_its_pixels(projection, diameter):
    lensed, rays, through = spread(Lens(diameter, window=5.0), projection, 6)
    ends, middle = lensed.project(through.end_points).reshape(-1, 6, 2), rays.pixel[:, None]
    assert float((ends - middle).abs().max()) < 2.5 * 1.01  # the step to them is linear
    pixels = middle + 2.5 * spread_points(len(rays), 6)[..., 2:].double()
    assert torch.allclose(ends, pixels, atol=1e-2)
    thin = replace(lensed, lens=None).rays(pixels.reshape(-1, 2)).clip(BOX)
    if diameter == 0:
        assert torch.allclose(through.direction, thin.direction, atol=1e-4)
        assert torch.allclose(through.ends.distance, thin.ends.distance, rtol=1e-4)
    blind = torch.einsum("nij,nj->ni", through.ends.sensitivity, through.direction)
    assert float(blind.abs().max()) < 1e-12
    wide = rays.half_width(0.5 * (rays.near + rays.far))
    at = lensed.pixel_size(rays.origin + 0.5 * (rays.near + rays.far)[:, None] * rays.direction)
    assert float(wide.min()) >= 0.9 * 2.5 * float(at.min())
    assert lensed.without_window.lens.window == 0


def test_rays_that_end_in_front_of_the_box_have_no_weight():
    """A background that cuts the box before some of the rays have left it."""
    _, rays, through = spread(Lens(30.0), each=4)
    ends = replace(through.ends, distance=torch.where(torch.arange(len(through)) % 4 == 0, 1.0, through.ends.distance))
    cut = replace(through, background=ends)
    shares = cut.shares(4).reshape(-1, 4)
    crossing = cut.crosses.reshape(-1, 4).all(dim=1)
    assert torch.equal(shares[crossing], torch.tensor([0, 1, 1, 1]).double().div(3).expand(int(crossing.sum()), 4))
    lensed = torch.arange(4.0).repeat(len(rays))[:, None].double()
    assert torch.allclose(cut.mean_of(4, lensed)[crossing], torch.tensor(2.0).double())
    assert torch.allclose(through.mean_of(4, lensed), torch.tensor(1.5).double())


def test_a_lens_by_its_f_number():
    # the image of the background is sharp: the distance of the image from the lens over the f-number
    assert RING.cameras(f_number=8.0)[0].lens.diameter == pytest.approx(RING.focal_length / 8.0)
    assert RING.cameras()[0].lens is None
    with refused("f_number"):
        RING.cameras(f_number=-1.0)


def test_the_focus_of_a_lens_does_not_need_a_background():
    bare = camera(Lens(5.0)).without_background
    assert bare.background is None
    assert bare.lens.focus == pytest.approx(camera(None).depth(camera(None).plane))
    with refused("focus_distance of view '20deg'"):
        replace(camera(Lens(5.0)), background=None)
    with refused("focus_distance of view '20deg'"):
        camera(Lens(3.0, -500.0))  # behind a perspective camera
    thin = replace(camera(Lens(0.0)), background=None)  # among views with a lens
    assert float(thin.rays(torch.zeros(1, 2).double()).lens.radius) == 0


@pytest.mark.parametrize(
    ("wrong", "field"),
    [((-1.0,), "aperture_diameter"), ((math.inf,), "aperture_diameter"), ((1.0, 0.0), "focus_distance"),
     ((1.0, math.inf), "focus_distance"),
     ((1.0, None, 0), "points"), ((1.0, None, 4, -2.0), "window"), ((1.0, None, 4, math.nan), "window")],
)  # fmt: skip
def test_lenses_that_cannot_be(wrong, field):
    with refused(field):
        Lens(*wrong)


def test_thin_rays_pass_no_lens():
    lensed = camera(None)
    with refused("aperture_diameter"):
        lensed.rays(lensed.pixel_grid().reshape(-1, 2)).through(torch.zeros(80, 1, 4))


def test_where_a_telecentric_camera_counts_its_depth_from_changes_nothing():
    """z_cam = 0 before, in and behind the flow, the diameter of the cone there with it."""
    depth = camera(None).depth(camera(None).plane)
    lensed, disc = camera(Lens(12.0, depth), "telecentric"), torch.tensor([[[0.6, -0.3, 0.0, 0.0], [0.0] * 4]]).double()
    pixel = torch.tensor([[4.0, 3.0]], dtype=torch.float64)
    first = lensed.rays(pixel).clip(BOX).through(disc)
    for shift in (700.0, depth + 300.0):
        moved = replace(lensed, translation=lensed.translation - torch.tensor([0.0, 0.0, shift]).double())
        moved = replace(moved, lens=Lens(12.0 * abs(1 - shift / depth), depth - shift))
        turned = disc if shift < depth else -disc  # beyond the focus the cone is upside down
        other = moved.rays(pixel).clip(BOX).through(turned)
        assert torch.allclose(other.direction, first.direction, atol=1e-9)
        enter = [r.origin + r.near[:, None] * r.direction for r in (first, other)]
        assert torch.allclose(*enter, atol=1e-6)
        assert torch.allclose(other.end_points, first.end_points, atol=1e-6)
        assert bool(other.unobstructed.all())
