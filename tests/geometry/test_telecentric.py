"""From parallel rays to a field: telecentric cameras, and images of one row, on the whole way."""

from __future__ import annotations

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from nerif.analysis.consistency import binned
from nerif.analysis.prediction import _interpolated, reproject
from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera, read_cameras, write_cameras
from nerif.data.measurement import Measurement, measurement_of
from nerif.data.volume import Volume
from nerif.fields.voxel_field import Boundary
from nerif.forward.absorption import Absorption
from nerif.forward.deflection import LeverArm
from nerif.forward.path_integral import PathIntegral
from nerif.forward.ray_tracing import background_points
from nerif.forward.registry import TECHNIQUES, forward_model
from nerif.geometry import PROJECTIONS, TELECENTRIC, Camera, Grid, Rays, Ring
from nerif.physics.gas import GasSettings
from nerif.physics.medium import derive
from nerif.reconstruction.bins import binned_rays
from nerif.reconstruction.gauge import visual_hull
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.report.rig_figure import draw_rig, image_corners
from nerif.report.scene import scene_of
from nerif.results.directory import Result
from nerif.simulation.simulate import simulate, view_displacement
from refusals import refused

AMBIENT = 1.00027


def ring(kind: str = "telecentric", rows: int = 20) -> tuple[Camera, ...]:
    return Ring(
        views=5, arc=(0.0, 144.0), elevation=8.0 if rows > 1 else 0.0, image_size=(rows, 26), pixel_pitch=0.11,
        distance=700.0, background_distance=450.0, projection=kind,
    ).cameras()  # fmt: skip


def through_the_origin(camera: Camera) -> Camera:
    """The same camera with the plane z_cam = 0 through the box."""
    return replace(camera, translation=camera.translation * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64))


CAMERAS = ring()


@pytest.fixture(scope="module")
def simulated(ball, box) -> Measurement:
    return simulate(ball, tuple(through_the_origin(c) for c in CAMERAS), box, AMBIENT, noise=0.02, seed=5, steps=60)


def test_where_a_telecentric_camera_is_along_its_axis_does_not_matter(ball, box):
    for camera in CAMERAS[:2]:
        moved = []
        for c in (camera, through_the_origin(camera)):
            rays = c.rays(c.pixel_grid().reshape(-1, 2)).clip(box)
            moved.append(background_points(ball, rays[rays.crosses], 60, AMBIENT))
        assert float(moved[0].norm(dim=-1).max()) > 0.1
        assert float((moved[0] - moved[1]).norm() / moved[0].norm()) < 1e-10


def test_straight_and_traced_rays_agree(ball, box):
    camera = through_the_origin(CAMERAS[1])
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(box)
    assert float(rays.near[rays.crosses].median()) < 0 < float(rays.far[rays.crosses].median())
    straight = torch.zeros(len(rays), 2, dtype=torch.float64)
    straight[rays.crosses] = PathIntegral(LeverArm(AMBIENT))(ball, rays[rays.crosses])
    traced = view_displacement(ball, camera, box, AMBIENT).reshape(-1, 2)
    assert float((straight - traced).norm() / traced.norm()) < 2e-3


@pytest.mark.parametrize(
    ("kind", "technique", "rows"), [("perspective", "deflection", 1), ("telecentric", "deflection", 20),
                                    ("telecentric", "interferometry", 1)],
)  # fmt: skip
def test_the_adjoint_of_the_voxel_operator_is_exact(simulated, box, kind, technique, rows):
    model = forward_model(TECHNIQUES[technique], replace(simulated, wavelength_nm=532.0))
    rays = Rays.concatenate([c.rays(c.pixel_grid().reshape(-1, 2)).clip(box) for c in ring(kind, rows)])
    a = VoxelOperator(
        rays[rays.crosses], Grid(box, (9, 11, 13)), model, boundary=Boundary(("x-", "y+")), dtype=torch.float64
    )  # fmt: skip
    generator = torch.Generator().manual_seed(0)
    c = torch.randn(a.domain_shape, dtype=torch.float64, generator=generator)
    d = torch.randn(a.range_shape, dtype=torch.float64, generator=generator)
    forward, back = a(c), a.T(d)
    assert float(forward.norm()) > 0
    assert abs(float((forward * d).sum() - (c * back).sum())) <= 1e-12 * float(forward.norm() * d.norm())


def test_the_file_keeps_the_projection_of_each_view(simulated, tmp_path):
    mixed = replace(simulated, cameras=(*ring("perspective")[:1], *simulated.cameras[1:]))
    mixed.write(tmp_path / "m.nc")
    again = Measurement.read(tmp_path / "m.nc")
    assert [c.projection for c in again.cameras] == [c.projection for c in mixed.cameras]
    assert again.cameras[1].projection == TELECENTRIC
    for a, b in zip(again.cameras, mixed.cameras, strict=True):
        assert torch.equal(a.rays(a.pixel_grid()[3]).origin, b.rays(b.pixel_grid()[3]).origin)
    dataset = mixed.to_dataset()
    dataset["projection"] = (("view",), ["fisheye"] * 5)
    with refused("projection of view '0deg'"):
        Measurement.from_dataset(dataset)
    dataset["projection"] = (("row",), ["telecentric"] * 20)
    with refused("variable 'projection'"):
        Measurement.from_dataset(dataset)
    assert dataset.attrs["Conventions"] == "BOST-1.1"  # a reader of BOST-1.0 would take them for pinholes


@pytest.mark.parametrize("characters", [True, False])
def test_names_in_characters_or_of_fixed_length_are_read(simulated, tmp_path, characters):
    dataset = simulated.to_dataset()
    dataset["projection"] = (("view",), np.array([b"telecentric"] * len(CAMERAS)))
    dataset["view"] = (("view",), np.array([c.name.encode() for c in CAMERAS]))
    dataset.to_netcdf(tmp_path / "m.nc", engine="h5netcdf")  # as arrays of characters
    if not characters:
        with h5py.File(tmp_path / "m.nc", "r+") as file:
            del file["projection"]
            file["projection"] = np.array([b"telecentric   "] * len(CAMERAS), dtype="S14")
            file["projection"].dims[0].attach_scale(file["translation"].dims[0][0])
    again = Measurement.read(tmp_path / "m.nc")
    assert [c.projection for c in again.cameras] == [TELECENTRIC] * len(CAMERAS)
    assert again.names == tuple(c.name for c in CAMERAS)


def test_scales_are_in_pixels_a_millimetre(simulated):
    dataset = simulated.to_dataset()
    assert dataset["intrinsics"].attrs["units"] == "px mm-1"
    for unit in ("px", "px/mm"):
        dataset["intrinsics"].attrs["units"] = unit
        assert Measurement.from_dataset(dataset).cameras[0].projection == TELECENTRIC
    dataset["intrinsics"].attrs["units"] = "px/m"
    with refused("variable 'intrinsics'"):
        Measurement.from_dataset(dataset)
    pinholes = dataset.drop_vars("projection")
    pinholes["intrinsics"].attrs["units"] = "px/mm"
    with refused("variable 'intrinsics'"):
        Measurement.from_dataset(pinholes)


def test_a_field_comes_back_and_is_seen_again(simulated, ball, box):
    result = Tikhonov(voxels=14, device="cpu")(simulated)
    grid = Grid.of_resolution(box, 14)
    truth, estimate = ball.sample(grid).double(), result.field.sample(grid).double()
    assert float((truth - estimate).norm() / truth.norm()) < 0.28  # 0.255, as of perspective cameras
    again = reproject(result.field, simulated)
    usable = simulated.usable
    left = (again.predicted - simulated.displacement)[usable]
    assert float(left.norm() / simulated.displacement[usable].norm()) < 0.07  # 0.057


def test_a_background_before_the_box_is_refused(simulated):
    plane = simulated.cameras[2].plane
    for offset in (-plane.offset, 3.0):
        wrong = replace(simulated.cameras[2], background=replace(plane, offset=offset))
        with pytest.raises(InputError, match="background of view '72deg': expected a plane behind the box"):
            replace(simulated, cameras=(*simulated.cameras[:2], wrong, *simulated.cameras[3:]))


def test_one_row_is_a_image(ball, box):
    """Line scans: rays, hull, bins, a reconstruction in their plane, and the images it would give."""
    row = simulate(ball, ring(rows=1), box, AMBIENT, noise=0.0, steps=40)
    assert row.displacement.shape == (5, 1, 26, 2)
    grid = Grid.of_resolution(box, 13)
    masked = replace(row, flow_mask=row.displacement.abs().amax(dim=-1) > 1e-3)
    inside = visual_hull(masked, grid)
    planes = (inside != inside.any()).flatten(1).any(dim=1)  # what the line sees; beyond it nothing is carved away
    assert 1 <= int(planes.sum()) < grid.shape[0]
    rays, d, _ = binned_rays(row, row.observations[0], 2)
    assert len(rays) == len(d) > 20
    result = Tikhonov(voxels=13, device="cpu")(row)
    again = reproject(result.field, row)
    assert float((again.predicted - row.displacement)[row.sees_box].norm() / row.displacement.norm()) < 0.2


def test_lines_are_binned_along_themselves_only(ball, box):
    row = simulate(ball, ring(rows=1), box, AMBIENT, noise=0.0, steps=40)
    small = binned(row, 13)
    assert small.displacement.shape == (5, 1, 13, 2)
    k, whole = small.cameras[0].intrinsics, row.cameras[0].intrinsics
    assert k.diagonal().tolist() == pytest.approx([float(whole[0, 0]) / 2, float(whole[1, 1]), 1.0])
    mean = row.displacement.reshape(5, 1, 13, 2, 2).mean(dim=3)
    assert torch.allclose(small.displacement, mean / torch.tensor([2.0, 1.0]), atol=1e-7)


@pytest.mark.parametrize("size", [(1, 26), (9, 26), (20, 1)])
@pytest.mark.parametrize("step", [1, 3, 8])
def test_images_of_few_rows_are_interpolated(box, size, step):
    camera = CAMERAS[0].view((20 - size[0]) // 2, (26 - size[1]) // 2, *size)

    def see(rays: Rays) -> torch.Tensor:
        return torch.stack([rays.pixel @ rays.pixel.new_tensor([0.3, -0.1]), rays.pixel[:, 0] + 2], dim=-1)

    view = _interpolated(camera, box, step, see)
    expected = camera.pixel_grid() @ torch.tensor([[0.3, 1.0], [-0.1, 0.0]], dtype=torch.float64)
    assert torch.allclose(view.double(), expected + torch.tensor([0.0, 2.0]), atol=1e-5)


@pytest.mark.parametrize("background", [True, False])
@pytest.mark.parametrize("kind", sorted(PROJECTIONS))
def test_cameras_are_drawn_before_what_they_look_at(kind, background):
    from matplotlib.figure import Figure

    cameras = [through_the_origin(c) if not c.projection.shows_depth else c for c in ring(kind)]
    cameras = cameras if background else [replace(c, background=None) for c in cameras]
    for camera in cameras:
        corners, axis = image_corners(camera, np.zeros(3)), camera.rotation[2].numpy()
        assert (corners.start @ axis).max() < -20  # mm; the image is 40 mm wide there
        assert (corners.end @ axis).min() > (400 if background else -1)
        assert np.allclose(np.cross(corners.end - corners.start, corners.direction), 0, atol=1e-6)
        spread = np.ptp(corners.start, axis=0).max()
        assert (spread > 20) != camera.projection.shows_depth  # a beam, or an optical centre
    axes = Figure().add_subplot(projection="3d")
    names = {text.get_text() for text in draw_rig(axes, cameras).texts}
    assert {c.name for c in cameras} < names


@pytest.mark.parametrize("background", [True, False])
def test_the_page_draws_beams_that_end(simulated, tmp_path, background):
    """What the 3-D view of the report is given: json that a browser reads, so no infinite number."""
    m = simulated
    if not background:
        cameras = tuple(replace(c, background=None) for c in simulated.cameras)
        m = measurement_of({Absorption: torch.zeros(5, 20, 26, 1)}, cameras, simulated.box, AMBIENT)
    values, grid = torch.linspace(-1e-4, 0, 4**3).reshape(4, 4, 4), Grid(simulated.box, (4, 4, 4))
    excess = Volume(values, grid, attributes={"n_ambient": AMBIENT})
    volumes = {"index_excess": excess, "n": derive(excess, "n", GasSettings())}
    scene, _ = scene_of(Result(tmp_path, measurement=m, volumes=volumes))
    assert scene is not None
    plain = json.loads(json.dumps(scene, allow_nan=False))
    assert plain["backgrounds"] == background
    assert len(plain["cameras"]) == 5
    for camera, original in zip(plain["cameras"], m.cameras, strict=True):
        starts, ends, directions = (np.array(camera[k]) for k in ("starts", "ends", "directions"))
        axis = original.rotation[2].numpy()
        assert np.allclose(directions, axis, atol=1e-5)  # a beam
        assert np.ptp(starts, axis=0).max() > 20  # mm
        assert (starts @ axis).max() < -20
        assert ((ends - starts) @ axis).min() > 20
        assert np.abs(np.array([starts, ends])).max() < 1e4


def test_a_calibration_without_backgrounds_is_a_rig_that_is_drawn(tmp_path, capsys):
    cameras = [CalibratedCamera.from_camera(replace(through_the_origin(c), background=None)) for c in CAMERAS]
    write_cameras(tmp_path / "c.toml", cameras)
    assert [c.camera().background for c in read_cameras(tmp_path / "c.toml")] == [None] * len(CAMERAS)
    assert main(["calibrate", str(tmp_path / "c.toml"), "--check", "-o", str(tmp_path / "drawn.toml")]) == 0
    assert "not drawn" not in capsys.readouterr().out
    assert (tmp_path / "drawn.rig.png").stat().st_size > 20_000
