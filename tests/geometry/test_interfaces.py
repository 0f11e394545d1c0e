"""Windows and tanks: exact refraction, its inverse, and displacements through them against traced rays."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera, read_cameras, write_cameras
from nerif.data.measurement import Measurement
from nerif.fields.phantoms import GaussianBalls
from nerif.forward.deflection import LeverArm
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Box, Camera, Interface, Lens, Ring
from nerif.geometry.interfaces import Line
from nerif.geometry.pose import Corrections
from nerif.simulation.simulate import simulate
from refusals import refused

F64 = torch.float64
BOX = Box((-12.0, -14.0, -13.0), (12.0, 14.0, 13.0))
GLASS = 1.52


def plate(camera: Camera, depth: float, thickness: float, index: float, tilt: float = 20.0) -> tuple[Interface, ...]:
    """Return a plate of glass that is tilted against the camera's axis, before a medium."""
    axis, right = camera.rotation[2], camera.rotation[0]
    normal = math.cos(math.radians(tilt)) * axis + math.sin(math.radians(tilt)) * right
    front = float(normal @ (camera.centre + depth * axis))
    return Interface(normal, front, GLASS), Interface(-normal, -front - thickness, index)


def ring(views: int = 3, projection: str = "perspective") -> tuple[Camera, ...]:
    return Ring(
        views=views, arc=(0.0, 100.0), pixel_pitch=0.2, image_size=(14, 17), distance=200.0, background_distance=150.0,
        focal_length=20.0, elevation=7.0, projection=projection,
    ).cameras()  # fmt: skip


@pytest.fixture(params=["window", "tank", "three", "telecentric", "distorted"])
def camera(request) -> Camera:
    camera = ring(2, "telecentric" if request.param == "telecentric" else "perspective")[1]
    interfaces = plate(camera, 60.0, 20.0, 1.0 if request.param == "window" else 1.333)
    if request.param == "three":
        tilted = plate(camera, 120.0, 1.0, 1.2, -15.0)[0]
        interfaces = (*interfaces, replace(tilted, index=1.36))
    if request.param == "distorted":
        distortion = torch.tensor([-0.21, 0.09, 1.2e-3, -0.8e-3, 0.02], dtype=F64)
        camera = replace(camera, distortion=distortion, tilt=torch.tensor([0.05, -0.03], dtype=F64))
    return replace(camera, interfaces=interfaces)


def test_rays_obey_snells_law_by_angles_and_stay_in_the_plane_of_incidence(camera):
    plain, bent = (c.rays(camera.pixel_grid().reshape(-1, 2)) for c in (replace(camera, interfaces=()), camera))
    last = camera.interfaces[-1]
    if len(camera.interfaces) == 2:  # parallel planes: the glass changes no angle
        turned = torch.linalg.cross(bent.direction, last.normal.expand_as(bent.direction)) * last.index
        before = torch.linalg.cross(plain.direction, last.normal.expand_as(bent.direction))
        assert torch.allclose(turned, before, atol=1e-13)
    start = bent.at(bent.begin[:, None])[:, 0]
    assert float((start @ last.normal - last.offset).abs().max()) < 1e-9
    assert float((bent.direction.norm(dim=-1) - 1).abs().max()) < 1e-14


def test_shift_by_a_plate_against_the_formula():
    camera = ring(1)[0]
    camera = replace(camera, interfaces=plate(camera, 60.0, 20.0, 1.0))
    ray = camera.rays(torch.tensor([[8.0, 6.5]], dtype=F64))
    a = math.radians(20)
    expected = 20 * math.sin(a) * (1 - math.cos(a) / math.sqrt(GLASS**2 - math.sin(a) ** 2))
    shift = (ray.origin[0] - camera.centre) - (ray.origin[0] - camera.centre) @ ray.direction[0] * ray.direction[0]
    assert float(shift.norm()) == pytest.approx(expected, abs=1e-9)
    assert expected == pytest.approx(2.5, abs=0.1)


def test_a_tank_makes_the_world_nearer_by_its_index():
    camera = replace(ring(1)[0], interfaces=())
    window = (Interface(camera.rotation[2], float(camera.rotation[2] @ camera.centre) + 150.0, 1.333),)
    point = camera.centre[None] + 200 * camera.rotation[2]
    ratio = camera.pixel_size(point) / replace(camera, interfaces=window).pixel_size(point)
    assert float(ratio) == pytest.approx(200 / (150 + 50 / 1.333), rel=1e-9)


def test_project_inverts_rays(camera):
    pixels = camera.pixel_grid().reshape(-1, 2)
    rays = camera.rays(pixels)
    for share in (0.3, 1.0):
        points = rays.origin + share * rays.ends.distance[:, None] * rays.direction
        assert float((camera.project(points) - pixels).abs().max()) < 1e-9
        assert torch.allclose(camera.sight(points), rays.direction, atol=1e-12)
    assert camera.project(torch.full((1, 3), torch.nan, dtype=F64)).isnan().all()
    assert camera.project(torch.zeros(0, 3, dtype=F64)).shape == (0, 2)


def test_sensitivity_against_finite_differences_of_project(camera):
    rays, h = camera.rays(camera.pixel_grid().reshape(-1, 2)), 1e-3
    for axis, shift in enumerate(h * torch.eye(3, dtype=F64)):
        slope = -(camera.project(rays.end_points + shift) - camera.project(rays.end_points - shift)) / (2 * h)
        assert float((slope - rays.ends.sensitivity[..., axis]).abs().max()) < 1e-7
    along = (rays.ends.sensitivity * rays.direction[:, None]).sum(-1)
    assert float(along.abs().max()) < 1e-12


def test_interfaces_without_effect_change_no_ray():
    for camera in (ring(1)[0], ring(1, "telecentric")[0]):
        same = replace(camera, interfaces=tuple(replace(p, index=1.0) for p in plate(camera, 60.0, 20.0, 1.0)))
        rays, other = (c.rays(c.pixel_grid().reshape(-1, 2)) for c in (camera, same))
        points = rays.origin + 190.0 * rays.direction
        assert torch.allclose(camera.project(points), same.project(points), atol=1e-9)
        assert torch.allclose(rays.ends.sensitivity, other.ends.sensitivity, atol=1e-10)
        assert torch.allclose(rays.end_points, other.end_points, atol=1e-9)
        if camera.projection.shows_depth:
            assert torch.allclose(rays.origin, other.origin, atol=1e-9)


@pytest.mark.parametrize("medium", [1.00027, 1.333])
def test_model_and_traced_rays_agree_through_windows(medium):
    """And not without the windows."""
    field = GaussianBalls.random(BOX, 2)
    cameras = tuple(replace(c, interfaces=plate(c, 60.0, 20.0, medium)) for c in ring())
    data = simulate(field, cameras, BOX, medium, steps=60)
    rays, values, _ = data.rays()
    integral = PathIntegral(LeverArm(medium), 60)
    error = (project(integral, field, rays) - values).norm() / values.norm()
    assert float(error) < 2e-3
    plain = replace(data, cameras=ring())
    rays, values, _ = plain.rays()
    assert float((project(integral, field, rays) - values).norm() / values.norm()) > 0.03


def test_poses_move_cameras_and_not_windows():
    cameras = ring()
    cameras = (cameras[0], *(replace(c, interfaces=plate(c, 60.0, 20.0, 1.333)) for c in cameras[1:]))
    values = 1e-3 * torch.arange(24, dtype=F64).reshape(3, 8)
    corrections = Corrections(cameras, values)
    for camera, corrected in zip(cameras, corrections.corrected, strict=True):
        assert camera.interfaces == corrected.interfaces
    tracing = [[c.rays(c.pixel_grid().reshape(-1, 2)[::7], view=v) for v, c in enumerate(which)]
               for which in (cameras, corrections.corrected)]  # fmt: skip
    before, after = (type(rays[0]).concatenate(rays).clip(BOX) for rays in tracing)
    moved = corrections.apply(before, BOX)
    assert torch.equal(moved.view, before.view)
    for name in ("direction", "near", "far"):
        assert torch.allclose(getattr(moved, name), getattr(after, name), atol=1e-6)
    assert torch.allclose(moved.ends.sensitivity, after.ends.sensitivity, atol=1e-6)


def test_files_hold_interfaces(tmp_path):
    cameras = ring()
    cameras = (replace(cameras[0], interfaces=plate(cameras[0], 60.0, 20.0, 1.0)), *cameras[1:])
    zero = torch.zeros(3, 14, 17, 2)
    data, plain = (Measurement(c, zero, BOX, 1.0003) for c in (cameras, ring()))
    paths = tmp_path / "windows.nc", tmp_path / "plain.nc"
    for measurement, path, version in zip((data, plain), paths, ("BOST-1.3", "BOST-1.0"), strict=True):
        measurement.write(path)
        assert measurement.to_dataset().attrs["Conventions"] == version
    assert Measurement.read(paths[1]).cameras[0].interfaces == ()
    write_cameras(tmp_path / "c.toml", [CalibratedCamera.from_camera(c) for c in cameras])
    for other in (Measurement.read(paths[0]).cameras, read_cameras(tmp_path / "c.toml")):
        assert [len(c.interfaces) for c in other] == [2, 0, 0]
        for a, b in zip(cameras[0].interfaces, other[0].interfaces, strict=True):
            assert np.allclose([*a.normal, a.offset, a.index], [*b.normal, b.offset, b.index], rtol=1e-15)


def test_calibrate_adds_windows_to_a_calibration(tmp_path):
    from nerif.imaging.calibration.calibration_settings import ImportSettings
    from nerif.imaging.calibration.importers.importers import import_cameras

    source, planes = tmp_path / "c.toml", tmp_path / "interfaces.toml"
    write_cameras(source, [CalibratedCamera.from_camera(c) for c in ring()])
    names = [c.name for c in ring()]
    planes.write_text(
        "[[interface]]\nnormal = [0, 0, 1]\noffset = 3\nindex = 1.52\n"
        f'[[interface]]\nnormal = [0, 0, 1]\noffset = 5\nindex = 1.333\nviews = ["{names[0]}"]\n'
    )
    # the cameras look down, and cross z = 5 mm before z = 3 mm
    with pytest.raises(InputError, match="interfaces"):
        import_cameras(source, ImportSettings(interfaces=planes))
    x, y, z = ring()[0].rotation[2].tolist()
    planes.write_text(
        f'[[interface]]\nnormal = [{x}, {y}, {z}]\noffset = -100\nindex = 1.52\nviews = ["{names[0]}"]\n'
        f'[[interface]]\nnormal = [{x}, {y}, {z}]\noffset = -90\nindex = 1.333\nviews = ["{names[0]}"]\n'
    )
    cameras = import_cameras(source, ImportSettings(interfaces=planes))
    assert [[p.index for p in c.interfaces] for c in cameras] == [[1.52, 1.333], [], []]
    planes.write_text(planes.read_text().replace(names[0], "no camera"))
    with refused(f"{planes}: interface 1: views"):
        import_cameras(source, ImportSettings(interfaces=planes))


def test_bad_interfaces_are_refused():
    camera = ring(1)[0]
    axis, window = camera.rotation[2], plate(camera, 60.0, 20.0, 1.0)
    for arguments, field in (
        ((axis, 0.0, 0.9), "index"), ((axis, 0.0, 4.1), "index"), ((axis, 0.0, math.nan), "index"),
        ((2 * axis, 0.0, 1.5), "normal"), ((0 * axis, 0.0, 1.5), "normal"), ((axis, math.inf, 1.5), "offset"),
    ):  # fmt: skip
        with refused(f"interface {field}"):
            Interface(*arguments)
    with refused(f"interfaces of view '{camera.name}'"):
        replace(camera, interfaces=(*window, *window))
    with refused(f"aperture_diameter of view '{camera.name}'"):
        replace(camera, interfaces=window, lens=Lens(5.0))
    data = Measurement((camera,), torch.zeros(1, 14, 17, 2), BOX, 1.0003)
    far, cutting = plate(camera, 260.0, 20.0, 1.0), plate(camera, 190.0, 20.0, 1.0)
    wedge = window[0], replace(plate(camera, 80.0, 20.0, 1.0, -35.0)[0], index=1.0)  # 55 degrees in glass
    for planes in (far, cutting, window[::-1], wedge, window[:1], plate(camera, 60.0, 20.0, 1.333)):
        with refused(f"interfaces of view '{camera.name}'"):
            replace(data, cameras=(replace(camera, interfaces=planes),))


@pytest.mark.parametrize("tilt", [0.0, 15.0])
def test_a_far_window_acts_as_a_pattern_that_is_nearer(tilt):
    """By thickness (1 - 1/n), docs/windows.md: a ray deflected at path length s, exactly through the far glass."""
    camera = ring(1)[0]
    far = replace(camera, interfaces=plate(camera, 260.0, 20.0, 1.0, tilt))
    pixels, angle, s = camera.pixel_grid().reshape(-1, 2), 1e-4, 200.0
    plain = replace(camera, background=replace(camera.plane, offset=camera.plane.offset + 20 * (1 - 1 / GLASS)))
    rays = plain.rays(pixels)
    down = camera.rotation[1].expand_as(rays.direction)
    shift = angle * torch.nn.functional.normalize(torch.linalg.cross(rays.direction, down), dim=-1)
    none = torch.zeros(2, 3, dtype=F64)
    bent = Line.of(rays.origin + s * rays.direction, rays.direction + shift, none, none)
    bent = bent.behind(far.interfaces, True)
    reach = (camera.plane.offset - bent.origin @ camera.plane.normal) / (bent.direction @ camera.plane.normal)
    exact = pixels - far.project(bent.origin + reach[:, None] * bent.direction)
    model = ((rays.ends.distance - s)[:, None, None] * rays.ends.sensitivity @ shift[..., None])[..., 0]
    assert float((model - exact).norm() / exact.norm()) < 5e-3
    there = camera.rays(pixels)
    ignored = ((there.ends.distance - s)[:, None, None] * there.ends.sensitivity @ shift[..., None])[..., 0]
    assert float((ignored - exact).norm() / exact.norm()) > 0.02
