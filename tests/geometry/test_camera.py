"""The camera of either projection in general position: distorted, turned, with an oblique background; Scheimpflug."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerif.geometry import PROJECTIONS, Box, Camera, Plane, projection_named
from nerif.geometry.distortion import distort, fold, undistort
from refusals import refused

F64 = torch.float64

K = {
    "perspective": [[1800.0, 0.7, 95.3], [0.0, 1750.0, 61.7], [0.0, 0.0, 1.0]],
    "telecentric": [[0.81, 3e-4, 95.3], [0.0, 0.79, 61.7], [0.0, 0.0, 1.0]],
}
DISTORTION = {"perspective": [-0.21, 0.09, 1.2e-3, -0.8e-3, 0.02], "telecentric": [-4e-7, 2e-12, 3e-6, -2e-6, 1e-17]}


@pytest.fixture(params=[*sorted(PROJECTIONS), "scheimpflug"])
def camera(request, rotation_about) -> Camera:
    kind, angles = (request.param, (0.0, 0.0)) if request.param in PROJECTIONS else ("perspective", (6.0, -4.0))
    rotation = rotation_about((0.4, 1.0, -0.3), 0.7)
    centre = torch.tensor([-300.0, 120.0, -500.0], dtype=F64)
    forward = rotation[2]
    tilted = rotation_about((1.0, 0.2, 0.4), 0.4) @ forward
    return Camera(
        intrinsics=torch.tensor(K[kind], dtype=F64),
        rotation=rotation,
        translation=-rotation @ centre,
        image_size=(130, 200),
        background=Plane(tilted, float(tilted @ (centre + 1100 * forward))),
        distortion=torch.tensor(DISTORTION[kind], dtype=F64),
        projection=PROJECTIONS[kind],
        tilt=torch.tensor(angles, dtype=F64).deg2rad(),
    )


@pytest.fixture
def pixels() -> torch.Tensor:
    unit = torch.rand(300, 2, dtype=F64, generator=torch.Generator().manual_seed(2))
    return unit * torch.tensor([199.0, 129.0])


def test_ray_ends_on_the_background_where_the_pixel_sees_it(camera, pixels):
    rays = camera.rays(pixels)
    end = rays.end_points
    assert float((end @ camera.background.normal - camera.background.offset).abs().max()) < 1e-9
    assert float((camera.project(end) - pixels).abs().max()) < 1e-9
    assert torch.allclose(rays.direction.norm(dim=1), torch.ones(300, dtype=F64))
    assert float(rays.ends.distance.min()) > 0


def test_sensitivity_against_finite_differences_of_project(camera, pixels):
    """And 0 along the ray."""
    rays = camera.rays(pixels)
    end, sensitivity, h = rays.end_points, rays.ends.sensitivity, 1e-3  # mm
    for axis, shift in enumerate(h * torch.eye(3, dtype=F64)):
        slope = -(camera.project(end + shift) - camera.project(end - shift)) / (2 * h)
        assert float((slope - sensitivity[..., axis]).abs().max()) < 1e-8
    along = torch.einsum("nij,nj->ni", sensitivity, rays.direction)
    assert float(along.abs().max()) < 1e-12 * float(sensitivity.abs().max())


def test_projection_against_the_formulae_written_out(camera):
    point = torch.tensor([10.0, -14.0, 22.0], dtype=F64)
    x, y, z = (camera.rotation @ point + camera.translation).tolist()
    x, y = {"perspective": (x / z, y / z), "telecentric": (x, y)}[camera.projection.name]
    k1, k2, p1, p2, k3 = camera.distortion.tolist()
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    k, (a, b) = camera.intrinsics, camera.tilt.tolist()
    assert abs(xd - x) > 1e-3 * abs(x)  # the distortion counts
    across, down = [math.cos(b), math.sin(a) * math.sin(b), -math.cos(a) * math.sin(b)], [0, math.cos(a), math.sin(a)]
    xd, yd, _ = np.linalg.solve(np.transpose([across, down, [-xd, -yd, -1]]), [0, 0, -1])  # where the sensor is met
    u, v = float(k[0, 0]) * xd + float(k[0, 1]) * yd + 95.3, float(k[1, 1]) * yd + 61.7
    assert camera.project(point).tolist() == pytest.approx([u, v], abs=1e-9)


def around(camera: Camera) -> Box:
    """A box 600 mm before the middle of the camera's frame."""
    x, y, z = (camera.centre + 600 * camera.rotation[2]).tolist()
    return Box((x - 5, y - 4, z - 3), (x + 5, y + 4, z + 3))


def test_rays_of_a_telecentric_camera_have_no_beginning_and_one_direction(camera, pixels):
    rays = camera.rays(pixels)
    local = camera.local(rays.origin)
    if camera.projection.shows_depth:
        assert rays.begin.tolist() == [0.0] * len(rays)
        assert float(local.abs().max()) < 1e-9  # all from the optical centre
    else:
        assert rays.begin.tolist() == [-math.inf] * len(rays)
        assert float(local[:, 2].abs().max()) < 1e-9
        assert float((rays.direction - camera.rotation[2]).abs().max()) < 1e-15
        box = around(camera)
        inside = replace(camera, translation=camera.translation - torch.tensor([0.0, 0.0, 600.0], dtype=F64))
        at = [c.rays(torch.tensor([[95.3, 61.7]], dtype=F64)).clip(box) for c in (camera, inside)]
        assert float(at[1].near) < 0 < float(at[1].far)  # the plane z_cam = 0 cuts the box, and not the rays
        for s in ("near", "far"):
            assert torch.allclose(*(r.at(getattr(r, s)[:, None]) for r in at), atol=1e-9)


def test_a_telecentric_camera_also_sees_a_box_behind_it(camera):
    box = around(camera)
    beyond = replace(camera, translation=camera.translation - torch.tensor([0.0, 0.0, 2000.0], dtype=F64))
    crosses = beyond.rays(beyond.pixel_grid().reshape(-1, 2)).clip(box).crosses
    assert bool(crosses.any()) != camera.projection.shows_depth


def test_turning_the_whole_rig_changes_nothing(camera, pixels, rotation_about):
    turn = rotation_about((1.0, -0.4, 0.2), 1.1)
    plane = camera.plane
    turned = replace(
        camera, rotation=camera.rotation @ turn.T, background=Plane(turn @ plane.normal, plane.offset)
    )  # fmt: skip
    one, other = camera.rays(pixels), turned.rays(pixels)
    assert torch.allclose(one.end_points @ turn.T, other.end_points, atol=1e-9)
    assert torch.allclose(one.direction @ turn.T, other.direction, atol=1e-12)
    assert torch.allclose(one.ends.distance, other.ends.distance, atol=1e-9)
    assert torch.allclose(one.ends.sensitivity @ turn.T, other.ends.sensitivity, atol=1e-9)


def test_sight_distance_and_pixel_size_of_points(camera):
    points = torch.tensor(around(camera).centre, dtype=F64) + torch.tensor([[5.0, -4.0, 2.0], [3.0, 30.0, -8.0]])
    middle = torch.tensor([[95.3, 61.7]], dtype=F64)
    along = camera.rays(camera.project(points)).direction
    assert torch.allclose(camera.sight(points), along, atol=1e-12)
    away = (points - camera.centre).norm(dim=-1)
    far = away if camera.projection.shows_depth else torch.full_like(away, math.inf)
    assert torch.allclose(camera.distance(points), far)
    on_axis = camera.rays(middle).end_points
    size = camera.pixel_size(on_axis)
    moved = camera.project(on_axis + size * camera.rotation[0]) - middle
    assert moved[0].tolist() == pytest.approx([1.0, 0.0], abs=0.01)


@pytest.mark.parametrize(("row", "column", "height", "width"), [(20, 30, 50, 60), (60, 0, 1, 200)])
def test_a_crop_sees_the_same_rays(camera, row, column, height, width):
    part = camera.view(row, column, height, width)
    assert part.image_size == (height, width)
    pixels = part.pixel_grid().reshape(-1, 2)
    whole, cropped = camera.rays(pixels + torch.tensor([column, row], dtype=F64)), part.rays(pixels)
    for name in ("origin", "direction", "end_points"):
        assert torch.allclose(getattr(whole, name), getattr(cropped, name), atol=1e-9)
    assert torch.allclose(whole.ends.sensitivity, cropped.ends.sensitivity, atol=1e-9)
    assert float((part.project(cropped.end_points) - pixels).abs().max()) < 1e-9


def test_pixel_grid_is_column_then_row(camera):
    grid = camera.pixel_grid()
    assert grid.shape == (130, 200, 2)
    assert grid[7, 31].tolist() == [31.0, 7.0]


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("rotation", lambda c: torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=F64)) @ c.rotation),
        ("rotation", lambda c: c.rotation[[1, 0, 2]]),
        ("rotation", lambda c: 1.01 * c.rotation),
        ("intrinsics", lambda c: c.intrinsics * torch.tensor([[1.0], [-1.0], [1.0]], dtype=F64)),
        ("intrinsics", lambda c: c.intrinsics.T),
        ("translation", lambda c: c.translation * math.nan),
        ("image_size", lambda c: (0, 10)),
        ("pose_sigma", lambda c: -torch.ones(6, dtype=F64)),
        ("tilt", lambda c: torch.tensor([5.0, 0.0], dtype=F64)),  # degrees
        ("tilt", lambda c: torch.tensor([math.nan, 0.0], dtype=F64)),
    ],
)
def test_cameras_that_cannot_be(camera, name, change):
    with refused(f"{name} of view 'camera'"):
        replace(camera, **{name: change(camera)})


def test_unknown_projections_and_distortion_that_folds_the_image(camera):
    with refused("view 'a': projection"):
        projection_named("fish", "view 'a': projection")
    with refused("distortion of view 'camera'"):
        replace(camera, distortion=torch.tensor([-900.0, 0, 0, 0, 0], dtype=F64)).check_distortion()


@pytest.mark.parametrize("k", [(-0.6, 0.0, 0.0, 0.0, 0.0), (-1.2, 0.9, 4e-3, -3e-3, -0.1), (0.5, -0.9, 0.0, 2e-3, 0.0)])
def test_pixels_beyond_the_fold_of_a_distortion_have_no_ray(k):
    """Each ray has the one root before the fold, or there is none: the polynomial, tried everywhere, says which."""
    coefficients = torch.tensor(k, dtype=F64)
    radius = torch.linspace(0, fold(coefficients), 400, dtype=F64)
    angle = torch.linspace(0, 2 * math.pi, 90, dtype=F64)[:, None]
    x, y = radius * angle.cos(), radius * angle.sin()
    xd, yd, (xx, cross, yy) = distort(x, y, coefficients)
    assert bool((xx + yy > 0).all())
    assert bool((xx * yy - cross * cross > -1e-9).all())
    undistorted = undistort(torch.stack([xd, yd], dim=-1)[:, :-1], coefficients)
    assert torch.allclose(undistorted, torch.stack([x, y], dim=-1)[:, :-1], atol=1e-5)
    beyond = torch.stack([xd, yd], dim=-1)[:, -1] * torch.tensor([1.02, 1.2, 3.0], dtype=F64)[:, None, None]
    assert bool(undistort(beyond, coefficients).isnan().all())


def test_points_beyond_the_fold_are_not_in_the_image():
    intrinsics = torch.tensor([[100.0, 0, 100], [0, 100, 100], [0, 0, 1]], dtype=F64)
    camera = Camera(
        intrinsics, torch.eye(3, dtype=F64), torch.tensor([0.0, 0, 100], dtype=F64), (201, 201),
        Plane(torch.tensor([0.0, 0, 1], dtype=F64), 50.0), torch.tensor([-0.4, 0, 0, 0, 0], dtype=F64),
    )  # fmt: skip
    end = 100 * fold(camera.distortion)  # mm from the axis
    assert end == pytest.approx(100 / math.sqrt(1.2))
    points = torch.tensor([[0.99, 0, 0], [1.01, 0, 0], [1.6, 0, 0], [0, -2.0, 0]], dtype=F64) * end
    assert camera.project(points).isnan().any(dim=-1).tolist() == [False, True, True, True]
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(Box.cube(60.0))
    inside = (rays.pixel - 100).norm(dim=-1) < 100 * 2 / 3 / math.sqrt(1.2)
    assert bool((rays.direction.isfinite().all(dim=-1) == inside).all())
    assert bool((rays.crosses <= inside).all())
    assert camera.unseen == pytest.approx(1 - float(inside.double().mean()), abs=0.03)
