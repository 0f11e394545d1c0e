"""The camera in general position: distorted, turned, with an oblique background."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from nerif.conventions import InputError
from nerif.geometry import Camera, Plane

F64 = torch.float64


@pytest.fixture
def camera(rotation_about) -> Camera:
    rotation = rotation_about((0.4, 1.0, -0.3), 0.7)
    centre = torch.tensor([-300.0, 120.0, -500.0], dtype=F64)
    forward = rotation[2]
    tilted = rotation_about((1.0, 0.2, 0.4), 0.4) @ forward
    return Camera(
        intrinsics=torch.tensor([[1800.0, 0.0, 95.3], [0.0, 1750.0, 61.7], [0.0, 0.0, 1.0]], dtype=F64),
        rotation=rotation,
        translation=-rotation @ centre,
        image_size=(130, 200),
        background=Plane(tilted, float(tilted @ (centre + 1100 * forward))),
        distortion=torch.tensor([-0.21, 0.09, 1.2e-3, -0.8e-3, 0.02], dtype=F64),
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


def test_sensitivity_ignores_movement_along_the_ray(camera, pixels):
    rays = camera.rays(pixels)
    along = torch.einsum("nij,nj->ni", rays.ends.sensitivity, rays.direction)
    assert float(along.abs().max()) < 1e-12 * float(rays.ends.sensitivity.abs().max())


def test_sensitivity_against_finite_differences_of_project(camera, pixels):
    rays = camera.rays(pixels)
    end = rays.end_points
    h = 1e-3  # mm
    for axis in range(3):
        shift = torch.zeros(3, dtype=F64)
        shift[axis] = h
        slope = -(camera.project(end + shift) - camera.project(end - shift)) / (2 * h)
        assert float((slope - rays.ends.sensitivity[..., axis]).abs().max()) < 1e-8


def test_projection_against_opencv_s_formula_written_out(camera):
    point = torch.tensor([10.0, -14.0, 22.0], dtype=F64)
    x, y, z = (camera.rotation @ point + camera.translation).tolist()
    x, y = x / z, y / z
    k1, k2, p1, p2, k3 = camera.distortion.tolist()
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = 1800 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 95.3
    v = 1750 * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 61.7
    assert camera.project(point).tolist() == pytest.approx([u, v], abs=1e-9)


def test_crop_sees_the_same_rays(camera, pixels):
    part = camera.view(row=20, column=30, height=50, width=60)
    assert part.image_size == (50, 60)
    whole, cropped = camera.rays(pixels), part.rays(pixels - torch.tensor([30.0, 20.0], dtype=F64))
    for name in ("origin", "direction", "end_points"):
        assert torch.allclose(getattr(whole, name), getattr(cropped, name), atol=1e-9)
    assert torch.allclose(whole.ends.sensitivity, cropped.ends.sensitivity, atol=1e-9)


def test_pixel_grid_is_column_then_row(camera):
    grid = camera.pixel_grid()
    assert grid.shape == (130, 200, 2)
    assert grid[7, 31].tolist() == [31.0, 7.0]


def test_mirrored_axis_swapped_axis_and_stretch_are_no_rotation(camera):
    flip = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=F64))
    for wrong in (flip @ camera.rotation, camera.rotation[[1, 0, 2]], 1.01 * camera.rotation):
        with pytest.raises(InputError, match="rotation of view 'camera'"):
            replace(camera, rotation=wrong)


def test_intrinsics_that_cannot_be_right(camera):
    negative = camera.intrinsics.clone()
    negative[1, 1] *= -1
    with pytest.raises(InputError, match="positive focal lengths"):
        replace(camera, intrinsics=negative)
    with pytest.raises(InputError, match="transposed"):
        replace(camera, intrinsics=camera.intrinsics.T)
    with pytest.raises(InputError, match="translation"):
        replace(camera, translation=camera.translation * math.nan)
    with pytest.raises(InputError, match="image_size"):
        replace(camera, image_size=(0, 10))


def test_distortion_that_folds_the_image_is_refused(camera, pixels):
    with pytest.raises(InputError, match="distortion"):
        replace(camera, distortion=torch.tensor([-900.0, 0, 0, 0, 0], dtype=F64)).rays(pixels)
