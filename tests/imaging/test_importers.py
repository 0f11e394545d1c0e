"""Calibrations of other programs, written here in their formats, project like the camera they came from."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pymatreader
import pytest
import scipy.io
import tomli_w
import torch
import yaml
from scipy.spatial.transform import Rotation

from nerif.cli.commands import calibrate
from nerif.cli.commands.displacement import Displacement
from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera, read_box, read_cameras, write_cameras
from nerif.geometry import TELECENTRIC, Box, Camera, Lens, Plane
from nerif.imaging.calibration.calibration_settings import ImportSettings
from nerif.imaging.calibration.importers.importers import import_cameras, is_calibration
from refusals import refused

Write = Callable[[Path], Path]
"""A function that writes a file into a folder, and returns what to import."""
PLANE = Plane(torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64), -900.0)


def make(name: str, seed: int) -> Camera:
    """A camera in general position, with five coefficients of distortion."""
    rng = np.random.default_rng(seed)
    return Camera(
        intrinsics=torch.tensor([[1500.0 + seed, 0, 101.25], [0, 1480.0, 77.5], [0, 0, 1]], dtype=torch.float64),
        rotation=torch.from_numpy(Rotation.from_rotvec(rng.normal(0, 1, 3)).as_matrix()),
        translation=torch.tensor([3.0, -4.0, 700.0], dtype=torch.float64),
        image_size=(160, 200),
        background=PLANE,
        distortion=torch.tensor([-0.1, 0.05, 0.001, -0.002, 0.01], dtype=torch.float64),
        name=name,
    )


ONE, TWO = make("one", 1), make("two", 2)
TILTED = dataclasses.replace(make("tilted", 4), tilt=torch.tensor([0.08, -0.11], dtype=torch.float64))
PARALLEL = dataclasses.replace(
    make("parallel", 3),
    intrinsics=torch.tensor([[4.1, 0, 101.25], [0, 4.0, 77.5], [0, 0, 1]], dtype=torch.float64),
    distortion=torch.tensor([-2e-5, 1e-8, 1e-5, -2e-5, 1e-12], dtype=torch.float64),
    projection=TELECENTRIC,
)
POINTS = torch.from_numpy(np.random.default_rng(0).uniform(-25, 25, (20, 3)))
BARE = CalibratedCamera("one", ONE.intrinsics, ONE.rotation, ONE.translation, ONE.distortion)


def same(cameras: Any, *expected: Camera) -> bool:
    """Whether cameras project points to the same pixels."""
    errors = [
        (a.camera(image_size=b.image_size, background=b.background).project(POINTS) - b.project(POINTS)).abs().max()
        for a, b in zip(cameras, expected, strict=True)
    ]
    return float(max(errors)) < 1e-6


def arrays(camera: Camera) -> dict[str, np.ndarray]:
    names = {"K": "intrinsics", "D": "distortion", "R": "rotation", "t": "translation"}
    return {key: getattr(camera, name).numpy() for key, name in names.items()}


def write(path: Path, *cameras: Camera, **more: Any) -> None:
    write_cameras(path, [CalibratedCamera.from_camera(c) for c in cameras], **more)


def write_opencv(path: Path, values: dict[str, Any]) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()


def refuse(path: Path, words: str, pose: int = 1) -> None:
    """Expect an error that names the file and what is wrong."""
    with pytest.raises(InputError, match=words) as error:
        import_cameras(path, ImportSettings(pose=pose))
    assert str(path) in str(error.value)


# -- calibration file ----------------------------------------------------------------------------------------------


def test_calibration_file_keeps_every_bit(tmp_path):
    path = tmp_path / "c.toml"
    write(path, ONE, TWO, PARALLEL, TILTED, about={"rms_px": 0.02})
    for got, camera in zip(import_cameras(path), (ONE, TWO, PARALLEL, TILTED), strict=True):
        assert got.projection == got.camera().projection == camera.projection
        for name in ("intrinsics", "rotation", "translation", "distortion", "tilt"):
            assert torch.equal(getattr(got, name), getattr(camera, name))
        assert got.image_size == camera.image_size
        assert got.background is not None
        assert torch.equal(got.background.normal, camera.background.normal)
        assert got.camera().name == camera.name
    assert not list(tmp_path.glob("*.part"))
    assert [c.name for c in import_cameras(path, only=("two",))] == ["two"]
    with refused("views"):
        import_cameras(path, only=("three",))


def test_calibration_files_of_no_camera_and_of_two_with_one_name(tmp_path):
    path = tmp_path / "c.toml"
    for cameras in ((ONE, ONE), ()):
        write(path, *cameras)
        with refused(path):
            read_cameras(path)
    with refused(tmp_path / "none.toml"):
        read_cameras(tmp_path / "none.toml")


def test_lenses_of_a_file_are_overridden_by_those_of_the_settings(tmp_path):
    path = tmp_path / "c.toml"
    write(path, dataclasses.replace(ONE, lens=Lens(3.5)), dataclasses.replace(TWO, lens=Lens(4.0, 900.0)))
    for settings, lenses in (
        ({}, [Lens(3.5), Lens(4.0, 900.0)]),
        ({"aperture_diameter": 6.25}, [Lens(6.25), Lens(6.25, 900.0)]),
        ({"scale_mm": 10.0, "aperture_diameter": 6.25}, [Lens(6.25), Lens(6.25, 9000.0)]),
        ({"aperture_diameter": 6.25, "focus_distance": 800.0}, [Lens(6.25, 800.0)] * 2),
        ({"aperture_diameter": 0.0}, [None] * 2),
    ):
        assert [c.lens for c in import_cameras(path, ImportSettings(**settings))] == lenses
    assert [c.camera().lens for c in read_cameras(path)] == [Lens(3.5), Lens(4.0, 900.0)]
    path.write_text(path.read_text().replace("aperture_diameter = 3.5", "aperture_diameter = -3.5"))
    with refused("aperture_diameter"):
        read_cameras(path)


def test_a_command_adds_lenses_to_a_calibration_and_keeps_the_rest(tmp_path, monkeypatch):
    """docs/pixels.md."""
    monkeypatch.setattr(calibrate, "_draw", lambda *rig: None)
    path, out, thin = (tmp_path / f"{name}.toml" for name in ("calibration", "with_lenses", "thin"))
    before = (
        dataclasses.replace(ONE, pose_sigma=torch.arange(6).double()),
        dataclasses.replace(TWO, lens=Lens(4.0, 900.0)),
    )
    write(path, *before, box=Box((-1, -2, -3), (1, 2, 3)))
    calibrate.main([str(path), "--aperture-diameter", "6.25", "-o", str(out)])
    after = read_cameras(out)
    assert [camera.lens for camera in after] == [Lens(6.25), Lens(6.25, 900.0)]
    assert read_box(out) == Box((-1, -2, -3), (1, 2, 3))
    for got, camera in zip(after, before, strict=True):
        assert (got.name, got.image_size) == (camera.name, camera.image_size)
        assert (got.background.normal.tolist(), got.background.offset) == (PLANE.normal.tolist(), PLANE.offset)
        for name in ("intrinsics", "distortion", "rotation", "translation"):
            assert torch.equal(getattr(got, name), getattr(camera, name))
    assert after[0].pose_sigma.tolist() == [0, 1, 2, 3, 4, 5]
    assert after[1].pose_sigma is None
    calibrate.main([str(out), "--aperture-diameter", "0", "-o", str(thin)])
    assert [camera.lens for camera in read_cameras(thin)] == [None, None]


def test_pose_sigma_of_the_file_in_its_unit_or_of_the_settings(tmp_path):
    path = tmp_path / "c.toml"
    write(path, dataclasses.replace(ONE, pose_sigma=torch.arange(6).double()))
    (camera,) = import_cameras(path, ImportSettings(scale_mm=10.0))
    assert camera.pose_sigma.tolist() == [0, 1, 2, 30, 40, 50]
    (camera,) = import_cameras(path, ImportSettings(pose_sigma_mm=0.3, pose_sigma_deg=0.01))
    assert camera.pose_sigma.tolist() == pytest.approx([np.radians(0.01)] * 3 + [0.3] * 3)


def test_image_size_and_background_come_from_file_settings_or_caller(tmp_path):
    path, settings = tmp_path / "c.toml", ImportSettings(background_distance=400.0, image_size=(160, 200))
    write_cameras(path, [BARE])
    (bare,) = read_cameras(path)
    with pytest.raises(InputError, match="view 'one' has no image size"):
        bare.camera(background=PLANE)
    assert bare.camera(image_size=(10, 10)).background is None
    (got,) = import_cameras(path, settings)
    assert got.image_size == (160, 200)
    assert got.background.offset == -400.0
    assert float(got.background.normal @ ONE.rotation[2]) == pytest.approx(-1)  # towards the camera
    write(path, ONE)
    (got,) = import_cameras(path, dataclasses.replace(settings, image_size=(9, 9)))
    assert (got.background.offset, got.image_size) == (PLANE.offset, ONE.image_size)


# -- TOML and CSV --------------------------------------------------------------------------------------------------


def table_of(camera: Camera, scale: float = 1.0, **more: Any) -> dict[str, Any]:
    """A plain table, in a unit in mm."""
    a = arrays(camera)
    return {"K": a["K"].tolist(), "R": a["R"].tolist(), "t": (a["t"] / scale).tolist(), "distortion": a["D"].tolist(),
            **more}  # fmt: skip


def test_plain_toml(tmp_path):
    path, more = tmp_path / "plain.toml", {"image_size": [160, 200], "normal": [0.0, 0.0, -2.0], "offset": -180.0}
    path.write_text(tomli_w.dumps({c.name: table_of(c, 10, **more) for c in (ONE, TWO)}))
    got = import_cameras(path, ImportSettings(scale_mm=10.0))
    assert [c.name for c in got] == ["one", "two"]
    assert same(got, ONE, TWO)
    assert got[0].background.offset == pytest.approx(-900.0)
    path.write_text(path.read_text().replace("K = ", "k = "))
    refuse(path, "unknown key 'k'")
    path.write_text(tomli_w.dumps({"tilted": table_of(TILTED, **more, tilt=TILTED.tilt.tolist())}))
    assert same(import_cameras(path), TILTED)
    path.write_text(path.read_text() + 'projection = "telecentric"\n')
    refuse(path, "tilt of view 'tilted': expected none for a telecentric camera.*fx, fy and skew")


def row_of(camera: Camera, **more: Any) -> dict[str, Any]:
    k, r = camera.intrinsics.tolist(), camera.rotation.tolist()
    row: dict[str, Any] = {"name": camera.name, "fx": k[0][0], "fy": k[1][1], "cx": k[0][2], "cy": k[1][2]}
    row |= {f"r{i + 1}{j + 1}": r[i][j] for i in range(3) for j in range(3)}
    row |= dict(zip(("tx", "ty", "tz"), camera.translation.tolist(), strict=True))
    row |= dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion.tolist(), strict=True))
    row |= dict(zip(("tau_x", "tau_y"), camera.tilt.tolist(), strict=True))
    return row | {"height": 160, "width": 200, "nx": 0, "ny": 0, "nz": -1, "offset": -900} | more


SPREADSHEETS = {
    "Excel, German": (";", ",", "cp1252"), "Excel, Unicode text": ("\t", ",", "utf-16"), "Calc": ("\t", ".", "utf-8"),
    "Excel, English": (",", ".", "utf-8-sig"), "with its separator": ("sep", ",", "utf-8"),
    "a script": (";", ".", "utf-8"),
}  # fmt: skip


@pytest.mark.parametrize("program", SPREADSHEETS)
def test_csv_of_spreadsheets(tmp_path, program):
    """Decimal commas, tabs, UTF-16 and Windows-1252, capital letters, empty columns and rows."""
    (separator, comma, encoding), path = SPREADSHEETS[program], tmp_path / "Kameras.CSV"
    first = ["# Maße in mm"] if separator != "sep" else ["sep=|"]
    delimiter = separator.replace("sep", "|")
    rows = [[*map(str, row_of(c).values()), ""] for c in (TILTED, TWO)]
    cells = [[row[0], *(cell.replace(".", comma) for cell in row[1:])] for row in rows]
    table = [[*(name.upper() for name in row_of(ONE)), ""], *cells, [""] * len(rows[0])]
    path.write_bytes("\r\n".join([*first, *map(delimiter.join, table)]).encode(encoding))
    got = import_cameras(path)
    assert same(got, TILTED, TWO)
    assert [(c.name, c.image_size) for c in got] == [("tilted", (160, 200)), ("two", (160, 200))]
    assert [c.background.offset for c in got] == [-900.0] * 2


def test_telecentric_cameras_of_tables(tmp_path):
    """In units of the file: px per unit, and distortion of lengths in it."""
    ten = PARALLEL.intrinsics * torch.tensor([[10.0], [10.0], [1.0]], dtype=torch.float64)
    ten[:2, 2] /= 10
    distortion = PARALLEL.distortion * 10.0 ** torch.tensor([2.0, 4.0, 1.0, 1.0, 6.0], dtype=torch.float64)
    in_cm = dataclasses.replace(PARALLEL, intrinsics=ten, distortion=distortion, translation=PARALLEL.translation / 10)
    toml, table = tmp_path / "p.toml", tmp_path / "p.csv"
    toml.write_text(tomli_w.dumps({"parallel": table_of(in_cm, projection="telecentric")}))
    row = row_of(in_cm, offset=-90, projection="telecentric")
    table.write_text(",".join(row) + "\n" + ",".join(str(v) for v in row.values()) + "\n")
    for path in (toml, table):
        got = import_cameras(path, ImportSettings(scale_mm=10.0))
        assert got[0].projection == TELECENTRIC
        assert same(got, PARALLEL)
        path.write_text(path.read_text().replace("telecentric", "fisheye"))
        refuse(path, "projection: expected one of perspective, telecentric")


def test_anipose(tmp_path):
    """Rotation vectors, width before height, and the names of the cameras beside those of the tables."""
    path = tmp_path / "calibration.toml"
    tables: dict[str, Any] = {
        f"cam_{i}": {
            "name": c.name, "size": [200, 160], "translation": c.translation.tolist(),
            "matrix": c.intrinsics.tolist(), "distortions": c.distortion.tolist(),
            "rotation": cv2.Rodrigues(c.rotation.numpy())[0].ravel().tolist(),
        }
        for i, c in enumerate((ONE, TWO))
    }  # fmt: skip
    path.write_text(tomli_w.dumps({**tables, "metadata": {"adjusted": False, "error": 0.3}}))
    got = import_cameras(path)
    assert [(c.name, c.image_size) for c in got] == [("one", (160, 200)), ("two", (160, 200))]
    assert same(got, ONE, TWO)
    for change, words in (({"fisheye": True}, ".* got 'fisheye'"), ({"rotation": 0}, "rotation: expected 3 numbers")):
        path.write_text(tomli_w.dumps({**tables, "cam_1": tables["cam_1"] | change}))
        refuse(path, f"camera 'cam_1': {words}")
    path.write_text(tomli_w.dumps({**tables, "cam_1": {"name": "two"}}))
    refuse(path, "camera 'cam_1': expected distortions, matrix, .* as anipose writes them")


# -- OpenCV --------------------------------------------------------------------------------------------------------

BOTH = {f"{k}{i}": v for i, camera in ((1, ONE), (2, TWO)) for k, v in arrays(camera).items()}


@pytest.mark.parametrize("suffix", [".yml", ".yaml", ".xml", ".YML"])
@pytest.mark.parametrize("vector", [False, True])
def test_opencv_one_camera_per_file(tmp_path, suffix, vector):
    a, path = arrays(ONE), tmp_path / f"left{suffix}"
    pose = {"rvec": cv2.Rodrigues(a["R"])[0], "tvec": a["t"]} if vector else {"R": a["R"], "T": a["t"]}
    pose |= {"fisheye_model": 0, "distortion_model": "plumb_bob"} if vector else {}
    sizes = {"image_width": 200, "image_height": 160}
    write_opencv(path, {**sizes, "camera_matrix": a["K"], "distortion_coefficients": a["D"], **pose})
    (got,) = import_cameras(path)
    assert same([got], ONE)
    assert (got.name, got.image_size) == ("left", (160, 200))


def test_opencv_folders_and_numbered_cameras(tmp_path):
    for camera in (ONE, TWO):
        write_opencv(tmp_path / f"{camera.name}.yml", arrays(camera))
    got = import_cameras(tmp_path)
    assert [c.name for c in got] == ["one", "two"]
    assert same(got, ONE, TWO)
    write_opencv(tmp_path / "both.xml", BOTH)
    assert same(import_cameras(tmp_path / "both.xml"), ONE, TWO)
    write_opencv(tmp_path / "more.yml", BOTH)
    refuse(tmp_path, "more.yml: expected cameras of .*, got 'cam1' here and in both.xml")


@pytest.mark.parametrize("numbers", [("0", "1", "2"), ("_0", "_1", "_2"), ("01", "02", "03"), ("7", "40", "100")])
def test_opencv_cameras_are_counted_from_any_number(tmp_path, numbers):
    path, three = tmp_path / "rig.yml", (ONE, TWO, make("three", 5))
    write_opencv(path, {f"{k}{n}": v for n, c in zip(numbers, three, strict=True) for k, v in arrays(c).items()})
    got = import_cameras(path)
    assert [c.name for c in got] == [f"cam{n.strip('_')}" for n in numbers]
    assert same(got, *three)


def test_opencv_tilt_is_the_end_of_14_coefficients(tmp_path):
    path, table, values = tmp_path / "c.yml", tmp_path / "c.toml", arrays(TILTED)
    coefficients = np.concatenate([values["D"], np.zeros(7), TILTED.tilt.numpy()])
    for shape in ((1, 14), (14, 1)):
        write_opencv(path, {**values, "D": coefficients.reshape(shape)})
        assert same(import_cameras(path), TILTED)
    for i in (5, 9):  # k4, s2
        other = coefficients + 0.01 * (np.arange(14) == i)
        write_opencv(path, {**values, "D": other})
        refuse(path, "the tilt tau_x tau_y, got 14 with others that are not 0")
    write_opencv(path, {**values, "tauX": 0.08})
    refuse(path, "got 'tauX', which is not read")
    table.write_text(tomli_w.dumps({"a": table_of(TILTED, tilt=[0.0, 0.1]) | {"distortion": coefficients.tolist()}}))
    refuse(table, "camera 'a': tilt: expected it once")


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_opencv_distortion_as_a_plain_sequence(tmp_path, suffix):
    path, row = tmp_path / f"plain{suffix}", arrays(ONE)["D"].tolist()
    write_opencv(path, {**arrays(ONE), "D": 0})
    text = path.read_text().replace("D: 0", f"D: {row}").replace("<D>0<", f"<D>{' '.join(map(str, row))}<")
    path.write_text(text)
    assert same(import_cameras(path), ONE)
    path.write_text(text.replace(str(row[2]), '"far"'))
    refuse(path, "camera 1: distortion: expected numbers")


@pytest.mark.parametrize("key", ["dist_coeffs", "dist_coeff", "dist", "kc"])
def test_distortion_under_its_other_names(tmp_path, key):
    path, table = tmp_path / "c.yml", tmp_path / "c.mat"
    values = {{"D": key}.get(name, name): value for name, value in arrays(ONE).items()}
    write_opencv(path, values)
    assert same(import_cameras(path), ONE)
    if key != "dist_coeff":
        stacked = {name: np.stack([value, value], axis=-1) for name, value in values.items()}
        for content, count in ((values, 1), (stacked, 2)):
            scipy.io.savemat(table, content)
            assert same(import_cameras(table), *(ONE,) * count)


@pytest.mark.parametrize("key", ["distorsion", "DistCoefs", "D3", "dist_1"])
def test_unread_distortion_is_refused(tmp_path, key):
    path, table = tmp_path / "c.yml", tmp_path / "c.mat"
    values = {{"D": key}.get(name, name): value for name, value in arrays(ONE).items()}
    write_opencv(path, values)
    scipy.io.savemat(table, values)
    for file in (path, table):
        refuse(file, f"expected distortion coefficients as one of .* got '{key}'")
    write_opencv(path, {**arrays(ONE), "working_distance": 3.0, "undistorted": 0})
    assert same(import_cameras(path), ONE)


@pytest.mark.parametrize(("rectified", "first"), [(False, 1), (True, 1), (False, 0)])
def test_opencv_stereo_pair(tmp_path, rectified, first):
    """Maybe with what stereoRectify adds, of which R1 and R2 are no poses."""
    a, b, path = arrays(ONE), arrays(TWO), tmp_path / "stereo.yml"
    rotation = b["R"] @ a["R"].T
    pair = {"R": rotation, "T": b["t"] - rotation @ a["t"]}
    pair |= {f"{key}{first + i}": x[k] for i, x in enumerate((a, b)) for key, k in (("M", "K"), ("D", "D"))}
    more = {"R1": np.eye(3), "R2": np.eye(3), "P1": np.eye(3, 4), "P2": np.eye(3, 4), "Q": np.eye(4)}
    write_opencv(path, {**pair, **more} if rectified else pair)
    left, right = import_cameras(path)
    world = POINTS @ ONE.rotation.T + ONE.translation  # the first camera is the world
    assert torch.allclose(left.camera((160, 200), PLANE).project(world), ONE.project(POINTS))
    assert torch.allclose(right.camera((160, 200), PLANE).project(world), TWO.project(POINTS))


def beside(camera: Camera) -> Camera:
    """Another camera 120 mm to its right, turned a little."""
    turn = torch.from_numpy(Rotation.from_rotvec([0.01, -0.15, 0.03]).as_matrix())
    shift = torch.tensor([-120.0, 4.0, 7.0], dtype=torch.float64)
    return dataclasses.replace(
        make("right", 7), rotation=turn @ camera.rotation, translation=turn @ camera.translation + shift
    )


RIGHT = beside(ONE)


def rectified(unit: float = 1.0, **more: Any) -> tuple[np.ndarray, ...]:
    """R, T, R1, R2, P1, P2, Q of ONE and RIGHT by cv2.stereoRectify, in a unit in mm."""
    a, b = arrays(ONE), arrays(RIGHT)
    rotation = b["R"] @ a["R"].T
    shift = (b["t"] - rotation @ a["t"])[:, None] / unit
    result = cv2.stereoRectify(a["K"], a["D"], b["K"], b["D"], (200, 160), rotation, shift, **more)
    return rotation, shift, *result[:5]


def stereo_calib(folder: Path, ending: str = ".yml") -> torch.Tensor:
    """The files of OpenCV's samples/cpp/stereo_calib.cpp for ONE and RIGHT; return the points of the world."""
    a, b, names = arrays(ONE), arrays(RIGHT), ("R", "T", "R1", "R2", "P1", "P2", "Q")
    write_opencv(folder / f"intrinsics{ending}", {"M1": a["K"], "D1": a["D"], "M2": b["K"], "D2": b["D"]})
    write_opencv(folder / f"extrinsics{ending}", dict(zip(names, rectified(), strict=True)))
    return POINTS @ ONE.rotation.T + ONE.translation


def is_pair(cameras: Any, points: torch.Tensor) -> bool:
    """Whether the first camera, which is the world, projects as ONE and the second as RIGHT."""
    pixels = [camera.camera((160, 200), PLANE).project(points) for camera in cameras]
    return all(torch.allclose(p, c.project(POINTS), atol=1e-6) for p, c in zip(pixels, (ONE, RIGHT), strict=True))


@pytest.mark.parametrize("ending", [".yml", ".XML"])
def test_the_two_files_of_opencvs_stereo_calib(tmp_path, ending):
    points, first, second = stereo_calib(tmp_path, ending), *(tmp_path / f"{n}trinsics{ending}" for n in ("in", "ex"))
    write_opencv(tmp_path / "settings.yml", {"board_width": 9})
    for path in (first, second):
        lines: list[str] = []
        assert is_pair(import_cameras(path, say=lines.append), points)
        assert lines == [f"intrinsics{ending}: read together with extrinsics{ending}"]
    (tmp_path / "settings.yml").unlink()
    assert is_calibration(tmp_path)
    assert is_pair(import_cameras(tmp_path), points)
    words = [str(first), "--image-size", "160", "200", "-o", str(tmp_path / "c.toml")]
    calibrate.main(words)  # draws the rig, whose first camera stands in the origin
    assert is_pair(read_cameras(tmp_path / "c.toml"), points)
    third = second.rename(second.with_name(f"pair{ending}"))  # found by its content
    assert is_pair(import_cameras(first), points)
    (tmp_path / f"old{ending}").write_bytes(third.read_bytes())
    refuse(first, f"expected that file beside it, got old{ending}, pair{ending}")
    (tmp_path / f"old{ending}").unlink()
    lone = first.rename(tmp_path / "lone")
    refuse(third, "holds the pose R, T .*, but not the camera matrices M1, .* to intrinsics.yml; .* got none")
    third.unlink()
    refuse(lone.rename(first), "holds the camera matrices M1, .*, but not the pose R, T .* to extrinsics.yml")


# -- ROS and kalibr ------------------------------------------------------------------------------------------------


def camera_info(camera: Camera, rotation: np.ndarray, projection: np.ndarray, **more: Any) -> dict[str, Any]:
    """What camera_calibration writes of a camera."""

    def matrix(a: np.ndarray) -> dict[str, Any]:
        return {"rows": a.shape[0], "cols": a.shape[1], "data": a.ravel().tolist()}

    values = {"image_width": 200, "image_height": 160, "camera_name": f"stereo/{camera.name}"}
    values |= {"camera_matrix": matrix(camera.intrinsics.numpy()), "distortion_model": "plumb_bob"}
    values |= {"distortion_coefficients": matrix(camera.distortion.numpy()[None])}
    return {**values, "rectification_matrix": matrix(rotation), "projection_matrix": matrix(projection), **more}


def stereo_info(zero_disparity: bool = True, **more: Any) -> tuple[dict[str, Any], dict[str, Any], torch.Tensor]:
    """The files of ONE and RIGHT, in m, and the points of the world in mm."""
    _, _, r1, r2, p1, p2, _ = rectified(1000.0, flags=cv2.CALIB_ZERO_DISPARITY if zero_disparity else 0)
    points = POINTS @ ONE.rotation.T + ONE.translation
    return camera_info(ONE, r1, p1, **more), camera_info(RIGHT, r2, p2, **more), points


@pytest.mark.parametrize("zero_disparity", [True, False])
def test_a_stereo_pair_of_ros(tmp_path, zero_disparity):
    """The pose of the second camera follows from the rectification and the baseline in m."""
    *infos, points = stereo_info(zero_disparity)
    left, right = (tmp_path / name for name in ("left.yaml", "right.yaml"))
    for path, info in zip((left, right), infos, strict=True):
        path.write_text(yaml.safe_dump(info))
    for path in (left, right, tmp_path):
        lines: list[str] = []
        cameras = import_cameras(path, say=lines.append)
        assert is_pair(cameras, points)
        assert [(c.name, c.image_size) for c in cameras] == [("left", (160, 200)), ("right", (160, 200))]
        assert len(lines) == (path != tmp_path)
    half = import_cameras(left, ImportSettings(scale_mm=500.0))[1].translation
    assert torch.allclose(half, import_cameras(left)[1].translation / 2)
    (tmp_path / "notes.yaml").write_text("a: 3\n")
    refuse(tmp_path, "expected files of one program, got")
    right.unlink()
    refuse(left, "no pose in a camera_info of ROS; .* left.yaml and right.yaml.* beside it: no other")
    right.write_text(yaml.safe_dump(infos[0]))
    refuse(left, "expected one camera without a shift in projection_matrix, .* got left.yaml, right.yaml without")


def camchain(*cameras: Camera, **more: Any) -> dict[str, Any]:
    """kalibr's chain of cameras: each pose is relative to the camera before, in m."""
    chain: dict[str, Any] = {}
    before = np.eye(4)
    for i, camera in enumerate(cameras):
        k, pose = camera.intrinsics.numpy(), np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.rotation.numpy(), camera.translation.numpy() / 1000
        relative = {"T_cn_cnm1": (pose @ np.linalg.inv(before)).tolist()} if i else {}
        chain[f"cam{i}"] = {
            "camera_model": "pinhole", "intrinsics": k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), "resolution": [200, 160],
            "distortion_model": "radtan", "distortion_coeffs": camera.distortion[:4].tolist(), "cam_overlaps": [1],
            "rostopic": f"/cam{i}/image_raw", **relative, **more,
        }  # fmt: skip
        before = pose
    return chain


def test_kalibrs_chain_of_cameras(tmp_path):
    """Block sequences and numbers such as 1e-05, which YAML 1.1 reads as texts."""
    path = tmp_path / "camchain.yaml"
    scale = torch.tensor([1, 1, 1e-3, 1, 0], dtype=torch.float64)
    cameras = [dataclasses.replace(c, distortion=c.distortion * scale) for c in (ONE, TWO, make("three", 3))]
    path.write_text(yaml.safe_dump(camchain(*cameras)).replace("1.0e-06", "1e-06"))
    assert "- 1e-06" in path.read_text()
    got = import_cameras(path)
    assert [(c.name, c.image_size) for c in got] == [(f"cam{i}", (160, 200)) for i in range(3)]
    world = POINTS @ ONE.rotation.T + ONE.translation
    for camera, expected in zip(got, cameras, strict=True):
        assert torch.allclose(camera.camera(background=PLANE).project(world), expected.project(POINTS), atol=1e-6)


# -- NeRF ----------------------------------------------------------------------------------------------------------


def transforms(camera: Camera) -> dict[str, Any]:
    to_world = np.eye(4)
    to_world[:3, :3] = camera.rotation.numpy().T @ np.diag([1, -1, -1])  # x right, y up, z back
    to_world[:3, 3] = camera.centre.numpy() / 1000
    k = camera.intrinsics
    return {
        "file_path": f"images/{camera.name}.png", "transform_matrix": to_world.tolist(),
        "fl_x": float(k[0, 0]), "fl_y": float(k[1, 1]), "cx": float(k[0, 2]) + 0.5, "cy": float(k[1, 2]) + 0.5,
        **{n: float(v) for n, v in zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=True)},
    }  # fmt: skip


@pytest.fixture
def nerf(tmp_path):
    """Write a transforms.json."""
    path = tmp_path / "transforms.json"

    def write_frames(*frames: dict[str, Any], **above: Any) -> Path:
        path.write_text(json.dumps({"w": 200, "h": 160, **above, "frames": frames}))
        return path

    return write_frames


def test_nerf_transforms(nerf):
    got = import_cameras(nerf(transforms(ONE), transforms(TWO)), ImportSettings(scale_mm=1000.0))
    assert [c.name for c in got] == ["one", "two"]
    assert same(got, ONE, TWO)
    assert got[0].image_size == (160, 200)


def test_nerf_angle_of_view(nerf):
    matrix = transforms(ONE)["transform_matrix"]
    (got,) = import_cameras(nerf({"transform_matrix": matrix}, camera_angle_x=0.2))
    assert float(got.intrinsics[0, 0]) == pytest.approx(100 / np.tan(0.1))
    assert float(got.intrinsics[0, 2]) == pytest.approx(99.5)


@pytest.mark.parametrize(
    ("images", "names"),
    [
        (("images/cam1/0001.png", "images/cam2/0001.png", "images/cam3/0001.png"), "cam1 cam2 cam3"),
        ((".\\cam_3\\rgb\\7.png", ".\\cam_1\\rgb\\7.png", ".\\cam_2\\rgb\\8.png"), "cam_3 cam_1 cam_2"),
        (("cam2/b.png", "cam1/a.png", "cam3/c.png"), "cam2 cam1 cam3"),
        (("b/left_01.tif", "b/top_01.tif", "b/right_01.tif"), "left top right"),
        (("b/cam_1.tif", "b/cam_2.tif", "b/cam_4.tif"), "cam_1 cam_2 cam_4"),
        (("001/cam7.png", "002/cam5.png", "003/cam6.png"), "cam7 cam5 cam6"),
        (("train/0003.png", "train/0001.png", "val/0002.png"), "0003 0001 0002"),
        (("a/x.png", "b/x.png", "b/x.png"), "unnamed1 unnamed2 unnamed3"),
        ((None, "b/x.png", "b/y.png"), "unnamed1 unnamed2 unnamed3"),
    ],
)
def test_folders_and_files_of_images_name_the_cameras(nerf, images, names):
    cameras = [make("", seed) for seed in range(3)]
    frames = [{**transforms(c), "file_path": image} for c, image in zip(cameras, images, strict=True)]
    got = import_cameras(nerf(*frames), ImportSettings(scale_mm=1000.0))
    assert " ".join(c.name for c in got) == names
    assert same(got, *cameras)


def test_images_of_one_camera_are_one_camera(nerf):
    images = [(ONE, "cam1/a.png"), (TWO, "cam2/a.png"), (ONE, "cam1/b.png"), (TWO, "cam2/b.png")]
    path = nerf(*({**transforms(camera), "file_path": image} for camera, image in images))
    got = import_cameras(path, ImportSettings(scale_mm=1000.0))
    assert [c.name for c in got] == ["cam1", "cam2"]
    assert same(got, ONE, TWO)


@pytest.mark.parametrize("imported", [False, True])
def test_cameras_without_names_are_assigned_by_order_to_as_many_views(tmp_path, nerf, capsys, monkeypatch, imported):
    """Of 0003.png, 0001.png, 0002.png the first by number is that of the first view; cam10 stands behind cam9."""
    folder, cameras = tmp_path / "experiment", [make("", seed) for seed in range(3)]
    path = nerf(*({**transforms(c), "file_path": f"{n}.png"} for c, n in zip(cameras, (30, 9, 10), strict=True)))
    monkeypatch.setattr(calibrate, "_draw", lambda *rig: None)
    if imported:
        calibrate.main([str(path), "--image-size", "160", "200", "-o", str(path := tmp_path / "c.toml")])
        assert "3 cameras imported from" in capsys.readouterr().out

    def recorded(*views: str, only: tuple[str, ...] = ()) -> list[int]:
        """The number of the camera of each view."""
        for name in views:
            (folder / name / "flow").mkdir(parents=True, exist_ok=True)
        box: Any = {"lower": (-1.0, -1.0, -1.0), "upper": (1.0, 1.0, 1.0)}
        recording = Displacement(folder, path, tmp_path / "m.nc", views=only, **box).recording()
        got = [recording.cameras[view.name] for view in recording.views]
        assert [camera.name for camera in got] == [view.name for view in recording.views]
        return [int(camera.intrinsics[0, 0]) - 1500 for camera in got]

    with pytest.raises(InputError, match=r"3 cameras have numbers instead of names \(.*2 views \(cam9, cam10\)"):
        recorded("cam9", "cam10")
    assert recorded("cam11") == [1, 2, 0]
    assert "in order (cam9: 9, cam10: 10, cam11: 30)" in capsys.readouterr().out
    assert recorded(only=("cam10",)) == [2]
    path.write_text(path.read_text().replace('"30.png"', '"cam11.png"').replace('"30"', '"cam11"'))
    with pytest.raises(InputError, match="no camera named 'cam9', only"):
        recorded()


@pytest.mark.parametrize("model", ["OPENCV", "PINHOLE", "SIMPLE_RADIAL"])
def test_nerf_cameras_of_browns_models_are_read(nerf, model):
    path = nerf(transforms(ONE), camera_model=model, is_fisheye=False, k4=0.0)
    assert same(import_cameras(path, ImportSettings(scale_mm=1000.0)), ONE)


# -- MATLAB --------------------------------------------------------------------------------------------------------


def rotation_vector_to_matrix(vector: np.ndarray) -> np.ndarray:
    """As documented for MATLAB's rotationVectorToMatrix: pi/2 about z is [0 1 0; -1 0 0; 0 0 1], for row vectors."""
    x, y, z = vector / np.linalg.norm(vector)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.linalg.norm(vector)
    return (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross).T


def world_to_image(struct: dict[str, Any], pose: int, points: np.ndarray) -> np.ndarray:
    """As documented for MATLAB's worldToImage: w [x y 1] = [X Y Z 1] [R; t] K with K its transposed, from pixel 1."""
    local = points @ rotation_vector_to_matrix(struct["RotationVectors"][pose - 1])
    local = local + struct["TranslationVectors"][pose - 1]
    x, y = (local[:, :2] / local[:, 2:]).T
    r2 = x**2 + y**2
    k, (p1, p2) = [*struct["RadialDistortion"], 0][:3], struct["TangentialDistortion"]
    radial = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    intrinsics = struct["IntrinsicMatrix"] if "IntrinsicMatrix" in struct else struct["K"].T
    return (np.stack([u, v, np.ones_like(u)], axis=1) @ intrinsics)[:, :2]


def camera_parameters(seed: int, release: str, radial: int = 3) -> dict[str, Any]:
    """What toStruct gives of a cameraParameters object: the fields that MathWorks documents, and no others."""
    rng = np.random.default_rng(seed)
    k = np.array([[1500.0 + seed, 0.7, 101.25], [0, 1480.0, 77.5], [0, 0, 1]])
    return {
        **({"K": k} if release == "R2022b" else {"IntrinsicMatrix": k.T}),
        "RadialDistortion": np.array([-0.1, 0.05, 0.01])[:radial], "TangentialDistortion": np.array([0.001, -0.002]),
        "ImageSize": np.array([160.0, 200.0]), "RotationVectors": rng.normal(0, 0.8, (3, 3)),
        "TranslationVectors": np.array([[0, 0, 600.0], [3, -4, 700.0], [5, 6, 800.0]]),
        "WorldPoints": rng.uniform(0, 50, (54, 2)), "WorldUnits": "millimeters", "EstimateSkew": True,
        "NumRadialDistortionCoefficients": float(radial), "EstimateTangentialDistortion": True,
        "ReprojectionErrors": rng.normal(0, 0.1, (54, 2, 3)),
        "Version": {"Name": "Computer Vision Toolbox", "Version": "10.3", "Release": f"({release})", "Date": ""},
        **({"DetectedKeypoints": np.ones((54, 3), dtype=bool)} if release == "R2022b" else {}),
    }  # fmt: skip


def matches(camera: CalibratedCamera, struct: dict, pose: int, world: torch.Tensor = POINTS) -> bool:
    """Whether a camera projects as MATLAB does, whose pixel 1 is number 0 here; `world` are the points of the pose."""
    pixels = camera.camera(background=PLANE).project(world).numpy()
    return float(np.abs(pixels - (world_to_image(struct, pose, POINTS.numpy()) - 1)).max()) < 1e-6


@pytest.fixture
def mat(tmp_path):
    """Write a .mat file."""
    path = tmp_path / "plain.mat"

    def savemat(content: dict[str, Any]) -> Path:
        scipy.io.savemat(path, content)
        return path

    return savemat


@pytest.mark.parametrize(("release", "radial", "pose"), [("R2021a", 2, 1), ("R2021a", 3, 2), ("R2022b", 3, 1)])
def test_camera_parameters_by_to_struct(mat, release, radial, pose):
    assert np.allclose(rotation_vector_to_matrix(np.array([0, 0, np.pi / 2])), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    struct = camera_parameters(1, release, radial)
    path = mat(struct)
    (got,) = import_cameras(path, ImportSettings(pose=pose))
    assert matches(got, struct, pose)
    assert got.image_size == (160, 200)
    refuse(path, r"pose of image 7.* got 3 and 3 poses", pose=7)
    refuse(mat({**struct, "RotationVectors": np.zeros((0, 3))}), "pose of image 1 .* got 0 and 3 poses")
    refuse(mat({**struct, "RadialDistortion": np.ones(5)}), "at most 3 radial and 2 tangential .*, got 5 and 2")


@pytest.mark.parametrize(("unit", "mm"), [("meters", 1000.0), ("inches", 25.4), ("m", 1000.0), ("millimeters", 1.0)])
def test_world_units_of_the_toolbox(mat, unit, mm):
    struct = camera_parameters(3, "R2022b")
    (plain,) = import_cameras(mat(struct), ImportSettings())
    (camera,) = import_cameras(mat({**struct, "WorldUnits": unit}), ImportSettings())
    np.testing.assert_allclose(camera.translation, np.asarray(plain.translation) * mm)
    refuse(mat({**struct, "WorldUnits": "furlongs"}), "WorldUnits: expected one of .* got 'furlongs'")


def test_camera_parameters_of_several_cameras_or_one_pose(mat):
    left, right = camera_parameters(1, "R2022b"), camera_parameters(2, "R2021a")
    single = {k: v[:1] if k in ("RotationVectors", "TranslationVectors") else v for k, v in left.items()}
    got = import_cameras(mat({"left": left, "right": right, "single": single}))
    assert [c.name for c in got] == ["left", "right", "single"]
    assert all(matches(c, struct, 1) for c, struct in zip(got, (left, right, left), strict=True))


def test_rotation_matrices_of_the_toolbox_multiply_row_vectors(mat):
    struct = camera_parameters(1, "R2021a")
    vectors = struct.pop("RotationVectors")
    matrices = np.stack([rotation_vector_to_matrix(v) for v in vectors], axis=-1)
    (got,) = import_cameras(mat({**struct, "RotationMatrices": matrices}), ImportSettings(pose=2))
    assert matches(got, {**struct, "RotationVectors": vectors}, 2)


@pytest.mark.parametrize("images", [True, False])
def test_stereo_parameters_by_to_struct(mat, images):
    """x_2 = x_1 RotationOfCamera2 + TranslationOfCamera2, which also relate the poses of the two cameras."""
    one, two = camera_parameters(1, "R2021a"), camera_parameters(2, "R2021a")
    turn, shift = rotation_vector_to_matrix(np.array([0.1, -0.3, 0.05])), np.array([-120.0, 5.0, 8.0])
    for i in range(3):
        matrix = rotation_vector_to_matrix(one["RotationVectors"][i]) @ turn
        two["RotationVectors"][i] = cv2.Rodrigues(matrix.T)[0].ravel()
        two["TranslationVectors"][i] = one["TranslationVectors"][i] @ turn + shift
    world, none = POINTS, {}
    if not images:  # camera 1 is the world
        none = {"RotationVectors": np.zeros((0, 3)), "TranslationVectors": np.zeros((0, 3))}
        turned = POINTS.numpy() @ rotation_vector_to_matrix(one["RotationVectors"][1])
        world = torch.from_numpy(turned + one["TranslationVectors"][1])
    stereo = {"CameraParameters1": one | none, "CameraParameters2": two | none, "RotationOfCamera2": turn,
              "TranslationOfCamera2": shift, "Version": one["Version"]}  # fmt: skip
    got = import_cameras(mat(stereo), ImportSettings(pose=2 if images else 1))
    assert all(matches(camera, struct, 2, world) for camera, struct in zip(got, (one, two), strict=True))


def test_stereo_parameters_of_two_pairs(mat):
    """Their cameras have the names of their structs; without poses each pair would have its own world."""
    pairs, structs = {}, {}
    for i, name in enumerate(("low", "high")):
        one, two = camera_parameters(2 * i, "R2021a"), camera_parameters(2 * i + 1, "R2022b")
        pairs[name] = {"CameraParameters1": one, "CameraParameters2": two, "RotationOfCamera2": np.eye(3),
                       "TranslationOfCamera2": np.array([-120.0, 5.0, 8.0])}  # fmt: skip
        structs |= {f"{name}_cam1": one, f"{name}_cam2": two}
    got = import_cameras(mat(pairs), ImportSettings(pose=2))
    assert [camera.name for camera in got] == list(structs)
    assert all(matches(camera, struct, 2) for camera, struct in zip(got, structs.values(), strict=True))
    for pair in pairs.values():
        pair["CameraParameters1"]["RotationVectors"] = np.zeros((0, 3))
    refuse(mat(pairs), "expected cameras in one world frame, got low_cam1, high_cam1")


def test_bouguets_toolbox(mat):
    a = arrays(ONE)
    path = mat({
        "fc": a["K"][[0, 1], [0, 1]][:, None], "cc": a["K"][:2, 2:], "alpha_c": np.zeros((1, 1)), "kc": a["D"][:, None],
        "nx": np.array([[200.0]]), "ny": np.array([[160.0]]), "Rc_2": a["R"], "Tc_2": a["t"][:, None],
        "omc_2": cv2.Rodrigues(a["R"])[0],
    })  # fmt: skip
    got = import_cameras(path, ImportSettings(pose=2))
    assert same(got, ONE)
    assert got[0].image_size == (160, 200)
    refuse(path, "pose of image 1 .* got Rc_2")


def test_plain_arrays_one_stacked_and_transposed(mat):
    one, two = arrays(ONE), arrays(TWO)
    assert same(import_cameras(mat(one)), ONE)
    assert same(import_cameras(mat({**one, "K": one["K"].T})), ONE)
    assert same(import_cameras(mat({k: np.stack([one[k], two[k]], axis=-1) for k in one})), ONE, TWO)


def write_7_3(path: Path, **values: tuple[np.ndarray, str]) -> Path:
    with h5py.File(path, "w", userblock_size=512) as file:
        for key, (value, kind) in values.items():
            file.create_dataset(key, data=value).attrs["MATLAB_class"] = np.bytes_(kind)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return path


def test_version_7_3(tmp_path):
    values = {key: (np.atleast_2d(value).T, "double") for key, value in arrays(ONE).items()}
    assert same(import_cameras(write_7_3(tmp_path / "new.mat", **values)), ONE)
    stereo = np.zeros((1, 6), dtype=np.uint32), "stereoParameters"
    refuse(write_7_3(tmp_path / "object.mat", stereo=stereo), "holds a MATLAB object 'stereo'")


def test_an_error_explains_how_to_export_an_object(mat, monkeypatch):
    """What SciPy makes of a saved cameraParameters object: nothing but its function workspace."""
    path = mat({"x": 1.0})
    monkeypatch.setattr(scipy.io, "whosmat", lambda p: [("params", (1, 1), "opaque")])
    monkeypatch.setattr(pymatreader, "read_mat", lambda p: {"__header__": b"", "__function_workspace__": np.zeros(3)})
    refuse(path, r"holds a MATLAB object 'params'.*toStruct\(params\)")


# -- COLMAP and OpenPTV --------------------------------------------------------------------------------------------

COLMAP = {
    "SIMPLE_PINHOLE": "900.0 101.3 79.1", "PINHOLE": "900.0 880.0 101.3 79.1",
    "SIMPLE_RADIAL": "900.0 101.3 79.1 -0.12", "RADIAL": "900.0 101.3 79.1 -0.12 0.05",
    "OPENCV": "900.0 880.0 101.3 79.1 -0.12 0.05 0.002 -0.001",
    "FULL_OPENCV": "900.0 880.0 101.3 79.1 -0.12 0.05 0.002 -0.001 0.3 0 0 0",
}  # fmt: skip


def colmap_pixels(model: str, words: str, quaternion: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """As COLMAP documents: x_cam = R x + t, distorted, times f, plus the principal point, from the first corner."""
    x, y, z = (Rotation.from_quat(np.roll(quaternion, -1)).as_matrix() @ POINTS.numpy().T) + shift[:, None]
    u, v = x / z, y / z
    p, r2 = [float(word) for word in words.split()], (x**2 + y**2) / z**2
    if model.startswith(("SIMPLE", "RADIAL")):
        p.insert(0, p[0])
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = [*p, *[0.0] * 5][:9]
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    du, dv = 2 * p1 * u * v + p2 * (r2 + 2 * u**2), 2 * p2 * u * v + p1 * (r2 + 2 * v**2)
    return np.stack([fx * (u * radial + du) + cx, fy * (v * radial + dv) + cy], axis=1)


def write_colmap(folder: Path, models: dict[str, str], points: str = "12.5 13.5 -1 90 80 17") -> list[np.ndarray]:
    """A model with one image by each camera, and the pixels of POINTS in them."""
    rng, images, pixels = np.random.default_rng(5), ["# Image list with two lines of data per image:"], []
    cameras = ["# Camera list with one line of data per camera:"]
    for i, (model, words) in enumerate(models.items(), 1):
        quaternion, shift = Rotation.random(random_state=rng).as_quat(), np.array([3.0, -4.0, 400.0 + i])
        cameras.append(f"{7 * i} {model} 200 160 {words}")
        pose = " ".join(map(str, [*2.0 * quaternion, *shift]))  # scaled quaternions are rotations too
        images += [f"{i} {pose} {7 * i} cam{i}/first image.png", points]
        pixels.append(colmap_pixels(model, words, quaternion, shift))
    (folder / "cameras.txt").write_text("\n".join(cameras))
    (folder / "images.txt").write_text("\n".join(images))
    return pixels


@pytest.mark.parametrize("points", ["", "12.5 13.5 -1 90 80 17"])
def test_a_model_of_colmap(tmp_path, points):
    expected, lines = write_colmap(tmp_path, COLMAP, points), []
    assert is_calibration(tmp_path)
    for path in (tmp_path, tmp_path / "cameras.txt", tmp_path / "images.txt"):
        cameras = import_cameras(path, say=lines.append)
        assert [c.name for c in cameras] == [f"cam{i}" for i in range(1, 7)]
        for camera, pixels in zip(cameras, expected, strict=True):
            assert camera.image_size == (160, 200)
            np.testing.assert_allclose(camera.camera(background=PLANE).project(POINTS), pixels - 0.5, atol=1e-9)
    assert "--scale-mm" in lines[0]
    assert torch.allclose(
        import_cameras(tmp_path, ImportSettings(scale_mm=20.0))[0].translation, 20 * cameras[0].translation
    )


PTV = "3\n{}1\n0\n1\n200\n160\n0.017\n0.016\n0\n1.0\n1.0\n1.0\n0.0\n"


def openptv_pixels(ori: list[float], added: list[float]) -> np.ndarray:
    """As liboptv documents: collinearity with y up, Brown's distortion about the middle of the sensor, mm to pixels."""
    position, (omega, phi, kappa), (xh, yh, cc) = np.array(ori[:3]), ori[3:6], ori[15:18]
    k1, k2, k3, p1, p2, scx, she = added
    dm = Rotation.from_rotvec([omega, 0, 0]) * Rotation.from_rotvec([0, phi, 0]) * Rotation.from_rotvec([0, 0, kappa])
    a, b, c = dm.as_matrix().T @ (POINTS.numpy() - position).T
    x, y = xh - cc * a / c, yh - cc * b / c
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    x, y = (x * radial + p1 * (r2 + 2 * x**2) + 2 * p2 * x * y, y * radial + p2 * (r2 + 2 * y**2) + 2 * p1 * x * y)
    x, y = scx * x - np.sin(she) * y, np.cos(she) * y
    return np.stack([x / 0.017 + 200 / 2, 160 / 2 - y / 0.016], axis=1)  # a pixel is centred on 0.5


def write_openptv(folder: Path, ori: list[float], added: list[float] | None, name: str) -> Path:
    path = folder / "cal" / f"{name}.ori"
    dm = Rotation.from_euler("XYZ", ori[3:6]).as_matrix()
    rows = [ori[:3], ori[3:6], *dm.tolist(), ori[15:17], ori[17:18], [0.0001, 0.00001, 150.0]]
    for inner in ("cal", "parameters"):
        (folder / inner).mkdir(exist_ok=True)
    path.write_text("\n".join(" ".join(map(str, row)) for row in rows))
    if added is not None:
        path.with_suffix(".addpar").write_text(" ".join(map(str, added)))
    (folder / "parameters" / "ptv.par").write_text(PTV.format("img/cam1\ncal/cam1.tif\n" * 3))
    return path


@pytest.mark.parametrize(
    ("shift", "added", "error"),
    [
        ((0.0, 0.0), None, 1e-9), ((0.0, 0.0), [4e-4, -2e-5, 1e-6, 3e-4, -2e-4, 1.002, 0.003], 1e-6),
        ((0.12, -0.07), [4e-4, 0, 0, 0, 0, 1.0, 0.0], 0.005), ((0.12, -0.07), [0, 0, 0, 0, 0, 0.99, -0.01], 1e-6),
    ],
)  # fmt: skip
def test_cameras_of_openptv(tmp_path, shift, added, error):
    """With a principal point beside the middle of the sensor the distortion is that of OpenCV to a few thousandths."""
    expected = {}
    for name, pose in (("cam1", [30.0, 20, 420, -0.05, 0.07, 0.3]), ("cam2", [-420.0, 9, 3, 0.1, -1.57, 2])):
        ori = [*pose, *[0.0] * 9, *shift, 20.0]
        path = write_openptv(tmp_path, ori, added, f"{name}.tif")
        expected[name] = openptv_pixels(ori, added or [0, 0, 0, 0, 0, 1, 0]) - 0.5
    assert is_calibration(tmp_path / "cal")
    cameras = import_cameras(tmp_path / "cal")
    assert [c.name for c in cameras] == ["cam1", "cam2"]
    for camera in (*cameras, *import_cameras(path)):
        assert camera.image_size == (160, 200)
        pixels = expected[camera.name]
        inside = ((pixels > 0) & (pixels < (199, 159))).all(axis=1)
        assert inside.sum() >= 5
        got = camera.camera(background=PLANE).project(POINTS).numpy()
        assert np.abs(got - pixels)[inside].max() < error


def test_openptv_that_is_refused(tmp_path):
    ori = [0.0, 0.0, 400.0, *[0.0] * 12, 0.0, 0.0, 20.0]
    path, sensor = write_openptv(tmp_path, ori, None, "cam1"), tmp_path / "parameters" / "ptv.par"
    text = sensor.read_text()
    for change, words in (
        (("1.0\n0.0\n", "1.33\n5.0\n"), "one medium, got interlaced = 0, n = 1.0, 1.0, 1.33; .* without water"),
        (("\n0\n1.0", "\n1\n1.0"), "whole frames and one medium, got interlaced = 1"),
        (("200", "wide"), "a number a line"),
    ):
        sensor.write_text(text.replace(*change))
        with pytest.raises(InputError, match=words):
            import_cameras(path)
    sensor.write_text(text)
    path.with_suffix(".addpar").write_text("0.02 0 0 0 0 1 0")
    write_openptv(tmp_path, [*ori[:15], 1.1, -0.6, 20.0], [0.03, 0, 0, 0, 0, 1, 0], "cam1")
    refuse(path, r"a distortion that OpenCV's covers within 0.05 px, got .* undistort the images")
    path.write_text("0 0 400\n0 0 0\n")
    refuse(path, "expected 18 numbers of OpenPTV, got 6 words")
    sensor.unlink()
    with pytest.raises(InputError, match=r"parameters/ptv.par beside the folder of the cameras, got none"):
        import_cameras(path)


# -- refused -------------------------------------------------------------------------------------------------------


def calibration(old: str, new: str) -> Write:
    """A calibration file of ONE with a change."""

    def write_changed(folder: Path) -> Path:
        write(folder / "c.toml", ONE)
        return text("c.toml", (folder / "c.toml").read_text().replace(old, new))(folder)

    return write_changed


def text(name: str, content: str) -> Write:
    return lambda folder: (folder / name, (folder / name).write_text(content))[0]


def table(delimiter: str = ",", old: str = "", new: str = "", rows: int = 1, **change: Any) -> Write:
    """A table of ONE with a change of its text or of some cells."""
    row = {**row_of(ONE), **change}
    lines = [delimiter.join(row), *[delimiter.join(map(str, row.values()))] * rows]
    return text("c.csv", "\n".join(lines).replace(old, new, 1))


def opencv(**change: Any) -> Write:
    """A file of ONE with other entries, or without those that are None."""
    values = {key: value for key, value in {**arrays(ONE), **change}.items() if value is not None}
    return lambda folder: (folder / "bad.yml", write_opencv(folder / "bad.yml", values))[0]


def ros(**change: Any) -> Write:
    def write_pair(folder: Path) -> Path:
        for name, info in zip(("left.yaml", "right.yaml"), stereo_info(**change)[:2], strict=True):
            (folder / name).write_text(yaml.safe_dump(info))
        return folder

    return write_pair


def kalibr(*cameras: Camera, missing: str = "", **change: Any) -> Write:
    chain = camchain(*(cameras or (ONE, TWO)), **change)
    return text("c.yaml", yaml.safe_dump({k: {n: x for n, x in v.items() if n != missing} for k, v in chain.items()}))


def nerf_of(frame: dict[str, Any] = {}, **above: Any) -> Write:  # noqa: B006
    frames = [transforms(ONE), {**transforms(TWO), **frame}]
    return text("transforms.json", json.dumps({"w": 200, "h": 160, **above, "frames": frames}))


def colmap(model: str = "PINHOLE", words: str = "900 880 100 80", old: str = "", new: str = "") -> Write:
    def write_model(folder: Path) -> Path:
        write_colmap(folder, {model: words} if model else {})
        path = folder / "images.txt"
        path.write_text(path.read_text().replace(old, new, 1) if old else path.read_text())
        if new == "bin":
            path.rename(folder / "images.bin")
        return folder

    return write_model


def matlab(**content: Any) -> Write:
    return lambda folder: (folder / "c.mat", scipy.io.savemat(folder / "c.mat", content))[0]


NAME, UNDISTORT, FOUR_BY_FOUR = 'name = "one"', "undistort the images", '"w": 4, "h": 4'
FISHEYE = {"MappingCoefficients": np.array([880.0, -3e-4, 0, 0]), "DistortionCenter": np.array([100.0, 80.0])}
POSES = {"RotationVectors": np.eye(3), "TranslationVectors": np.eye(3)}
NOT_READ = "which nerif does not read; write .* K, R .* into a .toml"
REFUSED: list[tuple[Write, str]] = [
    (calibration("rotation", "rotatoin"), "camera 'one': unknown key 'rotatoin'"),
    (calibration(NAME, ""), "camera 'camera 0': 'name' is missing"),
    (calibration("offset = -900.0", 'offset = "far"'), "background: offset: expected a number"),
    (calibration(NAME, f'{NAME}\nprojection = "fisheye"'), "'one': projection: expected one of perspective"),
    (calibration('format = "nerif-calibration-1"', 'format = "other"'), "expected format = 'nerif-calibration-1'"),
    (calibration("[[camera]]", "[[camera"), "not a TOML file"),
    (calibration(NAME, f"{NAME}\ntilt = [5.0, 0.0]"), "tilt of view 'one': .* below 45 degrees, in rad"),
    (calibration(NAME, f"{NAME}\ntilt = 0.1"), "camera 'one': tilt: expected 2 numbers, got a single number"),
    (table(old="fx", new="fxx"), "unknown column 'fxx'"),
    (table(old="700.0", new="far"), "line 2: 'tz': expected a number, got 'far'"),
    (table(old="ny", new="s"), "line 2: background: normal"),
    (table(rows=2), "got 2 named 'one'"),
    (text("c.csv", "name,fx\n"), "one line a camera"),
    (text("c.csv", "name,fx\na,1\n"), "column 'fy' is missing"),
    (table(fx='"1500,5"'), "commas in quotes"),
    (table(fx="1500,5"), "line 2: expected 30 columns, got 31; separate them by semicolons"),
    (table(";", fx="1.500,5"), "got commas and points"),
    (table(";", width="640.5"), "image_size: expected height and width, whole numbers"),
    (table(";", FX="3"), "expected each column once, got 'fx' twice"),
    (text("cameras.yml", "%YAML:1.0\n---\nnb_camera: 2\ncamera_0:\n   img_width: 200\n"),
     f"a calibration of MC-Calib, {NOT_READ}"),
    (text("18.xml", '<?xml version="1.0"?>\n<opencv_storage>\n<CameraMatrix>1 0</CameraMatrix>\n'
          "<Intrinsics>3</Intrinsics>\n</opencv_storage>\n"), f"a calibration of OpenPose, {NOT_READ}"),
    (text("calibration.json", '{"cameras": {"cam1": {"K": []}}, "camera_poses": {"cam1": {"R": []}}}'),
     f"a calibration of multical, {NOT_READ}"),
    (opencv(R=None, t=None), "bad.yml: camera 1: no pose"),
    (opencv(D=np.arange(8.0)), "at most 5 distortion coefficients"),
    (opencv(K=None), "no camera matrix"),
    (opencv(R=np.array([0.0, 30.0, 0.0])), "bad.yml: camera 1: expected a rotation vector in rad"),
    (opencv(R=np.diag([-1.0, 1, 1]) @ arrays(ONE)["R"]), "bad.yml: rotation of view 'bad'"),
    (opencv(image_width=np.ones((2, 2)), image_height=160), "image_size: expected 2 numbers"),
    *((opencv(**{key: value}), UNDISTORT) for key, value in (
        ("xi", np.ones((1, 1))), ("xi", 0.8), ("fisheye_model", 1), ("distortion_model", "equidistant"),
        ("camera_model", "omni"))),
    (text("bad.yml", "%YAML:1.0\n---\nR: 1\nt: 1\nK: [ [ 1, 2 ], [ 3 ] ]\n"), "camera 1: intrinsics: expected 3 x 3"),
    (text("bad.yml", "nothing of the kind"), "not a file of OpenCV"),
    (lambda folder: folder, "got none"),
    (ros(distortion_model="equidistant"), UNDISTORT),
    (ros(distortion_model="rational_polynomial", distortion_coefficients={"data": [0.1] * 8}), "at most 5"),
    (ros(rectification_matrix={"data": [1.0, 0.0]}), "rectification_matrix: expected 3 x 3 numbers, got 2"),
    (ros(projection_matrix=None), "projection_matrix: expected 3 x 4 numbers, got 0"),
    (ros(image_height=160.5), "whole numbers of px"),
    (kalibr(ONE), "no pose; expected the chain of two cameras or more"),
    (kalibr(distortion_model="equidistant"), f"cam0: distortion_model: .* {UNDISTORT}"),
    (kalibr(camera_model="omni"), f"cam0: camera_model: .* {UNDISTORT}"),
    (kalibr(intrinsics=[1, 2, 3]), "cam0: intrinsics: expected 4 numbers"),
    (kalibr(missing="T_cn_cnm1"), "cam1: 'T_cn_cnm1' is missing"),
    # coefficients of other models have the same names as Brown's, k1 to k4, and another meaning
    (nerf_of(camera_model="OPENCV_FISHEYE"), "frame 0: .*OPENCV_FISHEYE"),
    (nerf_of({"camera_model": "OPENCV_FISHEYE"}, camera_model="OPENCV"), "frame 1: .*OPENCV_FISHEYE"),
    (nerf_of(camera_model="EQUIRECTANGULAR"), "frame 0: .*EQUIRECTANGULAR"),
    (nerf_of(is_fisheye=True), "frame 0: .*is_fisheye"),
    (nerf_of(camera_model="ORTHOPHOTO"), "frame 0: .*ORTHOPHOTO"),
    (nerf_of(k4=0.01), "frame 0: .*at most 5 distortion coefficients"),
    (nerf_of(distortion_params=[-0.1, 0, 0, 0, 0, 0]), "frame 0: .*got 'distortion_params', which is not read"),
    (nerf_of(w=-4), "image_size: expected height and width"),
    *((text("transforms.json", content), words) for content, words in (
        ("{", "not a JSON file"), ('{"frames": [3]}', "a list 'frames'"), ('{"frames": []}', "a list 'frames'"),
        (f'{{"frames": [{{"fl_x": "wide", {FOUR_BY_FOUR}}}]}}', "frame 0: fl_x: expected a number, got 'wide'"),
        (f'{{"frames": [{{"fl_x": 3, {FOUR_BY_FOUR}}}]}}', "frame 0: transform_matrix: expected 4 x 4 numbers"),
        (f'{{"frames": [{{{FOUR_BY_FOUR}}}]}}', "no focal length"),
        ('{"frames": [{"fl_x": 3}]}', "no principal point"))),
    (colmap("FOV", "900 880 100 80 0.9"), "camera 7: expected one of SIMPLE_PINHOLE, .* got FOV; undistort"),
    (colmap("FULL_OPENCV", "9 8 1 8 0 0 0 0 0 0.1 0 0"), "at most 5 distortion coefficients"),
    (colmap("OPENCV"), "expected WIDTH HEIGHT fx fy cx cy k1 k2 p1 p2, got 200 160 900"),
    (colmap(old=" 7 cam1", new=" 8 cam1"), "images.txt: expected IMAGE_ID QW .* got 1 "),
    (colmap(old="1 ", new="1 far "), "images.txt: expected IMAGE_ID QW .* got 1 far"),
    (colmap(""), "holds no camera"), (colmap(new="bin"), "colmap model_converter"),
    (matlab(Intrinsics=FISHEYE, **POSES), "'fisheyeParameters'"), (matlab(unrelated=np.eye(3)), "got unrelated"),
    (matlab(cam={"K": np.eye(3)}), "expected R and t beside K"),
    (text("c.mat", "not a MATLAB file at all"), "not a readable MATLAB file"),
    (lambda folder: folder / "none.csv", "no such file"), (text("c.docx", ""), "ending in .toml .csv"),
]  # fmt: skip


@pytest.mark.parametrize(("made", "words"), REFUSED)
def test_calibrations_that_are_refused(tmp_path, made, words):
    """The error names file, camera and key."""
    refuse(made(tmp_path), words)


def test_calibrations_are_distinguished_from_images(tmp_path):
    opencv, images, both = (tmp_path / name for name in ("opencv", "images", "both"))
    for folder in (opencv, images, both):
        folder.mkdir()
    for folder in (opencv, both):
        (folder / "left.yml").touch()
    (images / "views.toml").touch()
    (both / "cam1").mkdir()
    assert [is_calibration(p) for p in (opencv, opencv / "left.yml", images, both)] == [True, True, False, False]
