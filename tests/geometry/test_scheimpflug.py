"""Scheimpflug cameras: the tilt of the sensor against OpenCV, and against a camera of another K that sees the same."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.linalg import rq
from scipy.spatial.transform import Rotation

from nerif.geometry import TELECENTRIC, Camera, Lens, Plane, Ring
from nerif.geometry.distortion import distort, from_sensor, tilt
from nerif.reconstruction.field_files import _parts, digest
from nerif.simulation.simulate import simulate
from refusals import refused

F64 = torch.float64


def tilted(camera: Camera, *degrees: float) -> Camera:
    return replace(camera, tilt=torch.tensor(degrees, dtype=F64).deg2rad())


@pytest.mark.parametrize("seed", range(8))
def test_project_is_that_of_opencv_with_14_coefficients(seed):
    rng = np.random.default_rng(seed)
    k = np.array([[rng.uniform(800, 3000), 0, rng.uniform(200, 400)], [0, rng.uniform(800, 3000), 250], [0, 0, 1]])
    rotation, translation = rng.normal(0, 1, 3), np.array([*rng.uniform(-20, 20, 2), rng.uniform(400, 900)])
    coefficients = np.zeros(14)
    coefficients[:5] = rng.uniform(-1, 1, 5) * (0.2, 0.2, 2e-3, 2e-3, 0.2)
    coefficients[12:] = np.radians(rng.uniform(-10, 10, 2))
    points = rng.uniform(-40, 40, (200, 3))
    camera = Camera(
        *map(torch.from_numpy, (k, Rotation.from_rotvec(rotation).as_matrix(), translation)), (500, 600), None,
        torch.from_numpy(coefficients[:5].copy()), tilt=torch.from_numpy(coefficients[12:].copy()),
    )  # fmt: skip
    expected, jacobian = cv2.projectPoints(points, rotation, translation, k, coefficients)
    assert float((camera.project(torch.from_numpy(points)) - torch.from_numpy(expected[:, 0])).abs().max()) < 1e-9
    flat = cv2.projectPoints(points, rotation, translation, k, np.append(coefficients[:12], [0, 0]))[0]
    assert np.abs(flat - expected).max() > 0.05
    # d pixel / d X = d pixel / d t  R, and the derivatives by t are OpenCV's
    by_points = camera._project_jacobian(torch.from_numpy(points))[1]
    by_translation = torch.from_numpy(jacobian[:, 3:6]).unflatten(0, (-1, 2))
    assert float((by_points - by_translation @ camera.rotation).abs().max()) < 1e-9


def test_slopes_are_those_of_autograd():
    image = torch.tensor([[0.11, -0.07], [-0.2, 0.15]], dtype=F64)
    camera = tilted(Ring(views=1).cameras()[0], 9.0, -7.0)
    camera = replace(camera, distortion=torch.tensor([-0.2, 0.1, 1e-3, -2e-3, 0.05], dtype=F64))

    def on_sensor(point: torch.Tensor) -> torch.Tensor:
        x, y, _ = distort(*point, camera.distortion)
        return torch.stack(tilt(x, y, camera.tilt)[:2])

    depth = 700 * torch.ones(2, 1, dtype=F64)
    world = (torch.cat([depth * image, depth], dim=1) - camera.translation) @ camera.rotation
    for point, at, slope in zip(image, world, camera._project_jacobian(world)[1], strict=True):
        expected = camera.intrinsics[:2, :2] @ torch.autograd.functional.jacobian(on_sensor, point)
        across = torch.cat([torch.eye(2, dtype=F64), -point[:, None]], dim=1) / 700 @ camera.rotation
        assert torch.allclose(slope, expected @ across, atol=1e-12), at


@pytest.mark.parametrize("degrees", [(8.0, 0.0), (-5.0, 7.0)])
def test_a_tilted_camera_without_distortion_measures_as_one_of_another_k(ball, cameras, box, degrees):
    """K T = K' Q with Q a rotation, so the camera of K' that is turned by Q has the same rays and sensitivities."""
    scheimpflug, others = tuple(tilted(c, *degrees) for c in cameras), []
    a, b = np.radians(degrees)
    axes = [[np.cos(b), np.sin(a) * np.sin(b), -np.cos(a) * np.sin(b)], [0, np.cos(a), np.sin(a)], [0, 0, 1]]
    for camera in cameras:
        upper, turn = rq(camera.intrinsics.numpy() @ np.linalg.inv(np.transpose(axes)))
        signs = np.diag(np.sign(np.diag(upper)))
        upper, turn = (torch.from_numpy(np.ascontiguousarray(m)) for m in (upper @ signs, signs @ turn))
        upper /= upper[2, 2].clone()
        others.append(
            replace(camera, intrinsics=upper, rotation=turn @ camera.rotation, translation=turn @ camera.translation)
        )
    one, other = (simulate(ball, c, box, 1.00027, noise=0.0, steps=40).displacement for c in (scheimpflug, others))
    straight = simulate(ball, cameras, box, 1.00027, noise=0.0, steps=40).displacement
    assert float((one - other).abs().max()) < 1e-4 * float(one.abs().max())  # of single precision
    assert float((one - straight).abs().max()) > 0.01 * float(one.abs().max())


def test_points_that_the_sensor_does_not_meet_have_no_pixel_and_their_pixels_no_ray():
    """Tilted by 40 degrees, the sensor is parallel to the line of sight 50 degrees from the axis."""
    camera = tilted(Ring(views=1, focal_length=2.0).cameras()[0], 0.0, 40.0)
    angle = torch.tensor([-51.0, -49.0, 0.0, 60.0], dtype=F64).deg2rad()
    local = torch.stack([angle.sin(), 0 * angle, angle.cos()], dim=1)
    pixels = camera.project((500 * local - camera.translation) @ camera.rotation)
    assert pixels.isnan().any(dim=1).tolist() == [True, False, False, False]
    none = torch.zeros(5, dtype=F64)
    beyond = torch.tensor([[1.01, 0.0], [0.99, 0.0]], dtype=F64) / math.sin(math.radians(40))
    assert from_sensor(beyond, none, camera.tilt).isnan().any(dim=1).tolist() == [True, False]


def test_rays_of_a_lens_meet_on_the_background():
    """Which is in focus whatever its slope: the purpose of a Scheimpflug lens."""
    (camera,) = Ring(views=1, image_size=(10, 14), sensor_tilt=(5.0, -3.0)).cameras(f_number=8.0)
    oblique = torch.nn.functional.normalize(camera.plane.normal + torch.tensor([0.1, 0.5, 0.2], dtype=F64), dim=0)
    camera = replace(camera, background=Plane(oblique, camera.plane.offset))
    assert camera.lens == Lens(50.0 / 8)  # focal length over f-number, as of an upright sensor
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2))
    ends = rays.spread(4).end_points.unflatten(0, (-1, 4))
    assert torch.allclose(ends, rays.end_points[:, None].expand_as(ends), atol=1e-9)


def test_tilts_of_telecentric_cameras_and_of_rings_are_refused():
    for kind in ({"projection": "telecentric"}, {"sensor_tilt": (50.0, 0.0)}, {"sensor_tilt": (math.nan, 0.0)}):
        with refused("tilt of view '0deg'" if "projection" in kind else "sensor_tilt"):
            Ring(**{"views": 1, "sensor_tilt": (5.0, 0.0), **kind}).cameras()
    telecentric = Ring(views=1, projection="telecentric").cameras()[0]
    assert telecentric.projection == TELECENTRIC
    with refused("tilt of view '0deg'"):
        tilted(telecentric, 1.0, 0.0)


def test_a_checkpoint_is_of_the_tilt_and_the_projection_of_its_cameras(cameras):
    others = (tilted(cameras[0], 0, 0), tilted(cameras[0], 1, 0), replace(cameras[0], projection=TELECENTRIC))
    assert len({digest(_parts(c)) for c in (cameras[0], *others)}) == 3
