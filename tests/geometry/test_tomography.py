"""Cameras in the geometry of ASTRA and TIGRE: what these programs define projects as the cameras do, there and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nerif.data.geometry_export import export_geometry
from nerif.data.measurement import Measurement
from nerif.geometry import TELECENTRIC, Box, Camera, Grid, Lens
from nerif.geometry.astra import astra_of, camera_of, from_astra
from nerif.geometry.tigre import from_tigre, tigre_of
from nerif.imaging.calibration.importers.importers import import_cameras
from refusals import refused

F64 = torch.float64
SIZE = (130, 200)
BOX = Box((-20.0, -10.0, 5.0), (40.0, 35.0, 25.0))
GRID = Grid(BOX, (4, 5, 6))
POINTS = torch.rand(40, 3, dtype=F64, generator=torch.Generator().manual_seed(3)) * torch.tensor(BOX.edges, dtype=F64)
POINTS = POINTS + torch.tensor(BOX.lower, dtype=F64)


def rig(kind: str = "perspective", skew: float = 0.0) -> list[Camera]:
    """Four cameras in general position, with principal points off the centre and oblong pixels of one proportion."""
    cameras = []
    for i, vector in enumerate(np.random.default_rng(4).normal(0, 1.2, (4, 3))):
        rotation = torch.from_numpy(Rotation.from_rotvec(vector).as_matrix())
        focal = 1500.0 + 40 * i if kind == "perspective" else 3.0 + 0.1 * i
        k = [[focal, skew, 70.3 + i], [0.0, 0.97 * focal, 81.7 - i], [0.0, 0.0, 1.0]]
        towards = torch.tensor([4.0 * i, -7.0, 600.0 + 30 * i], dtype=F64)
        cameras.append(
            Camera(
                intrinsics=torch.tensor(k, dtype=F64),
                rotation=rotation,
                translation=towards - rotation @ torch.tensor(BOX.centre, dtype=F64),
                image_size=SIZE,
                background=None,
                distortion=torch.zeros(5, dtype=F64),
                name=f"cam{i}",
            )
        )
    return [replace(c, projection=TELECENTRIC) for c in cameras] if kind == "telecentric" else cameras


def astra_pixels(kind: str, row: np.ndarray, size: tuple[int, int], points: np.ndarray) -> np.ndarray:
    """Columns and rows where rays through points meet the detector, as ASTRA documents its vectors."""
    first, d, u, v = row.reshape(4, 3)
    corner = d - size[1] / 2 * u - size[0] / 2 * v
    pixels = []
    for point in points:
        ray = point - first if kind == "cone_vec" else first
        start = first if kind == "cone_vec" else point
        # start + s ray = corner + a u + b v
        _, a, b = np.linalg.solve(np.stack([ray, -u, -v], axis=1), corner - start)
        pixels.append((a - 0.5, b - 0.5))  # (0, 0) is the middle of the first pixel
    return np.array(pixels)


def tigre_ray(geometry: dict, view: int, column: int, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Source and pixel in the world: detector at the origin, turned, shifted, then rotated with the source."""
    pixel = [0.0, *(geometry["dDetector"] * (np.array([row, column]) - (geometry["nDetector"] - 1) / 2))[::-1]]
    roll_pitch_yaw = Rotation.from_euler("ZYX", geometry["rotDetector"][view][::-1])
    frame = Rotation.from_euler("ZYZ", geometry["angles"][view])
    off_v, off_u = geometry["offDetector"][view]
    source, detector = geometry["DSO"][view], geometry["DSD"][view]
    place = roll_pitch_yaw.apply(pixel) + np.array([source - detector, off_u, off_v])
    origin = geometry["origin_mm"]
    return origin + frame.apply([source, 0, 0]), origin + frame.apply(place)


@pytest.mark.parametrize(("kind", "skew"), [("perspective", 0.0), ("perspective", 1.3), ("telecentric", 2e-3)])
def test_astra_projects_as_the_cameras(kind, skew):
    cameras = rig(kind, skew)
    geometry = astra_of(cameras, SIZE, GRID)
    for camera, row in zip(cameras, geometry["Vectors"], strict=True):
        pixels = astra_pixels(geometry["type"], row, SIZE, POINTS.numpy())
        assert np.abs(pixels - camera.project(POINTS).numpy()).max() < 1e-9
        first, d = row[:3], row[3:6]
        if kind == "perspective":  # the detector lies behind the box
            assert all(float((d - first) @ (p - first)) < (d - first) @ (d - first) * 1.2 for p in POINTS.numpy())
    assert geometry["voxels"].tolist() == [5, 6, 4]  # y, x, z
    assert geometry["window"].tolist() == [-20, 40, -10, 35, 5, 25]


def test_tigre_projects_as_the_cameras():
    cameras, lines = rig(), []
    geometry = tigre_of(cameras, SIZE, GRID, lines.append)
    assert not lines
    for i, camera in enumerate(cameras):
        for column, row in ((0, 0), (199, 0), (57, 129)):
            source, pixel = tigre_ray(geometry, i, column, row)
            on_ray = torch.from_numpy(source + 0.6 * (pixel - source))
            assert np.allclose(camera.project(on_ray), [column, row], rtol=0, atol=1e-8)
            assert float(np.linalg.norm(source - camera.centre.numpy())) < 1e-9
    assert geometry["nVoxel"].tolist() == [4, 5, 6]  # z, y, x
    assert geometry["sVoxel"].tolist() == pytest.approx([20, 45, 60])
    assert geometry["sDetector"] == pytest.approx(geometry["dDetector"] * [130, 200])


def equal(camera: Camera, expected: Camera) -> bool:
    if expected.projection == TELECENTRIC:  # the principal point and the position along the axis have no effect
        return float((camera.project(POINTS) - expected.project(POINTS)).abs().max()) < 1e-9
    names = ("intrinsics", "rotation", "translation")
    errors = [(getattr(camera, name) - getattr(expected, name)).abs().max() for name in names]
    return float(max(errors)) < 1e-9


def test_rows_of_astra_have_twelve_numbers():
    entries = {**astra_of(rig("perspective"), SIZE, GRID)}
    with refused("Vectors"):
        from_astra({**entries, "Vectors": entries["Vectors"][:, :11]})


@pytest.mark.parametrize(
    ("program", "kind"), [("astra", "perspective"), ("astra", "telecentric"), ("tigre", "perspective")]
)
def test_a_rig_and_the_turned_rig_there_and_back(program, kind):
    turn = torch.from_numpy(Rotation.from_rotvec([0.3, -2.0, 0.8]).as_matrix())
    for matrix in (torch.eye(3, dtype=F64), turn):
        cameras = [replace(c, rotation=c.rotation @ matrix) for c in rig(kind)]
        centre = torch.tensor(BOX.centre, dtype=F64)  # the box is turned about its centre
        cameras = [replace(c, translation=c.translation + c.rotation @ (matrix.T @ centre - centre)) for c in cameras]
        if program == "astra":
            name, rows, size = from_astra(astra_of(cameras, SIZE, GRID))
        else:
            name, (rows, size) = "cone_vec", from_tigre(tigre_of(cameras, SIZE, GRID))
        for camera, row in zip(cameras, rows, strict=True):
            back, upside_down = camera_of(name, row, size, camera.name)
            assert not upside_down
            assert (back.image_size, back.projection) == (SIZE, camera.projection)
            assert equal(back, camera)


def test_a_detector_seen_from_behind_is_the_image_upside_down():
    """ASTRA's circular cone beam: source at -y, u along x, v along z."""
    row = torch.tensor([3.0, -500, 2, 0, 300, 0, 0.4, 0, 0, 0, 0, 0.5], dtype=F64)
    camera, upside_down = camera_of("cone_vec", row, SIZE, "v")
    columns, rows = astra_pixels("cone_vec", row.numpy(), SIZE, POINTS.numpy()).T
    assert upside_down
    assert np.allclose(camera.project(POINTS), np.stack([columns, SIZE[0] - 1 - rows], axis=1))
    with refused("type"):
        camera_of("cone", row, SIZE, "v")
    with refused("view 'v'"):
        camera_of("cone_vec", row * torch.tensor([1.0] * 9 + [0.0] * 3), SIZE, "v")


def test_tigres_circular_scan(tmp_path):
    """Attributes as TIGRE documents them, with one value for all views; rows count upwards."""
    path, lines = tmp_path / "geo.npz", []
    angles = np.array([0.0, 0.7])
    geometry = {
        "DSD": 1536.0, "DSO": 1000.0, "nDetector": np.array(SIZE), "dDetector": np.array([0.8, 0.6]), "accuracy": 0.5,
        "offDetector": np.array([3.0, -2.0]), "offOrigin": np.zeros(3), "rotDetector": np.zeros(3), "mode": "cone",
        "filter": None, "COR": 0.0,
    }  # fmt: skip
    np.savez(path, angles=angles, **geometry)
    cameras = import_cameras(path, say=lines.append)
    assert "unnamed1, unnamed2" in lines[0]
    assert "upside down" in lines[0]
    for angle, camera in zip(angles, cameras, strict=True):
        cos, sin = np.cos(angle), np.sin(angle)
        x, y, z = POINTS.numpy().T
        depth, across = 1000 - (cos * x + sin * y), cos * y - sin * x
        u, v = across * 1536 / depth + 2.0, z * 1536 / depth - 3.0
        pixels = np.stack([u / 0.6 + 99.5, SIZE[0] - 1 - (v / 0.8 + 64.5)], axis=1)
        assert np.allclose(camera.camera().project(POINTS), pixels)
    for change, words in (
        ({"COR": 2.0}, "COR"), ({"mode": "parallel"}, "mode"), ({"DSD": np.ones(5)}, "DSD"), ({"DSD": 1000.0}, "DSD"),
        ({"DSO": 1536.0, "DSD": 1000.0}, "DSD"), ({"DSO": np.array([1000.0, 1600.0])}, "DSD"), ({"DSO": -9.0}, "DSD"),
        ({"angles": np.array([0.0, 45.0])}, "angles"), ({"angles": np.array([[-30.0, 0, 0], [0, 0, 0]])}, "angles"),
        ({"angles": np.array([0.0, np.nan])}, "angles"), ({"rotDetector": np.array([0.0, 0, 90])}, "rotDetector"),
    ):  # fmt: skip
        np.savez(path, **{"angles": angles, **geometry, **change})
        with refused(words):
            import_cameras(path)


def measurement(cameras: list[Camera]) -> Measurement:
    height, width = (max(c.image_size[i] for c in cameras) for i in (0, 1))
    maps = {"absorbance": torch.zeros(len(cameras), height, width)}
    return Measurement(tuple(cameras), None, BOX, 1.0, maps=maps)


@pytest.mark.parametrize("program", ["astra", "tigre"])
def test_exports_are_imported_as_they_were(tmp_path, program):
    path, lines = tmp_path / "geometry.NPZ", []
    cameras = [replace(c, lens=Lens(3.0, 500.0)) for c in rig()]
    cameras[1] = replace(cameras[1], image_size=(101, 150))
    export_geometry(path, measurement(cameras), GRID, program, lines.append)
    assert lines == ["apertures and windows are no part of the geometry, whose rays are thin: cam0, cam1, cam2, cam3"]
    back = import_cameras(path, say=lines.append)
    assert len(lines) == 1
    assert [(c.name, c.image_size) for c in back] == [(c.name, c.image_size) for c in cameras]
    assert all(equal(a.camera(), b) for a, b in zip(back, cameras, strict=True))


def test_cameras_that_a_geometry_cannot_hold(tmp_path):
    path, (first, *others) = tmp_path / "g.npz", rig()
    distorted = replace(first, distortion=torch.tensor([0, 0, 0, 1e-6, 0], dtype=F64))
    for program in ("astra", "tigre"):
        with refused("distortion of view 'cam0'"):
            export_geometry(path, measurement([distorted, *others]), GRID, program)
    with refused("projection"):
        astra_of([replace(first, projection=TELECENTRIC), *others], SIZE, GRID)
    for cameras in (rig("telecentric"), rig(skew=1.0)):
        with refused("view 'cam0'"):
            tigre_of(cameras, SIZE, GRID)
    for factor, lines in ((1.0004, ["rows are off by up to 0.0"]), (1.01, None)):
        wider, notes = first.intrinsics.clone(), []
        wider[0, 0] *= factor
        cameras = [replace(first, intrinsics=wider), *others]
        if lines is None:
            with refused("intrinsics of view 'cam0'"):
                tigre_of(cameras, SIZE, GRID)
        else:
            geometry = tigre_of(cameras, SIZE, GRID, notes.append)
            assert lines[0] in notes[0]
            source, pixel = tigre_ray(geometry, 0, 199, 0)
            off = cameras[0].project(torch.from_numpy(source + 0.6 * (pixel - source))) - torch.tensor([199.0, 0.0])
            assert 0.005 < float(off.abs().max()) < float(notes[0].split()[-2]) * 1.01


def test_other_files_of_numpy_are_refused(tmp_path):
    path = tmp_path / "other.npz"
    np.savez(path, density=np.zeros(3))
    with refused("") as error:
        import_cameras(path)
    assert f"{path}: expected type, " in str(error.value)
    path.write_bytes(b"PK broken")
    with refused(path):
        import_cameras(path)


def test_a_tilted_sensor_is_part_of_the_steps_of_astra():
    tilted = [replace(c, tilt=torch.tensor([0.12, -0.08], dtype=F64)) for c in rig(skew=3.0)]
    rows = astra_of(tilted, SIZE, GRID)["Vectors"]
    for camera, row in zip(tilted, rows, strict=True):
        pixels = astra_pixels("cone_vec", row, SIZE, POINTS.numpy())
        np.testing.assert_allclose(pixels, camera.project(POINTS).numpy(), atol=1e-8)
        upright, _ = camera_of("cone_vec", torch.from_numpy(row), SIZE, "upright")  # the same rays without a tilt
        np.testing.assert_allclose(upright.project(POINTS).numpy(), pixels, atol=1e-8)
    with refused("view 'cam0'"):
        tigre_of([replace(c, intrinsics=rig()[0].intrinsics) for c in tilted], SIZE, GRID)
