"""Calibrations of other programs, written here as they write them, project like the camera they came from."""

from __future__ import annotations

import dataclasses
import json

import cv2
import h5py
import numpy as np
import pytest
import scipy.io
import tomli_w
import torch
from scipy.spatial.transform import Rotation

from nerif.cli.commands import calibrate
from nerif.common.conventions import InputError
from nerif.geometry import TELECENTRIC, Box, Camera, Lens, Plane
from nerif.imaging.calibration.cameras_file import CalibratedCamera, read_box, read_cameras, write_cameras
from nerif.imaging.calibration.importers.importers import ImportSettings, import_cameras, is_calibration
from refusals import refused

PLANE = Plane(torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64), -900.0)


def make(name: str, seed: int) -> Camera:
    """A camera in general position, with five coefficients of distortion."""
    rng = np.random.default_rng(seed)
    rotation = torch.from_numpy(Rotation.from_rotvec(rng.normal(0, 1, 3)).as_matrix())
    return Camera(
        intrinsics=torch.tensor([[1500.0 + seed, 0, 101.25], [0, 1480.0, 77.5], [0, 0, 1]], dtype=torch.float64),
        rotation=rotation,
        translation=torch.tensor([3.0, -4.0, 700.0], dtype=torch.float64),
        image_size=(160, 200),
        background=PLANE,
        distortion=torch.tensor([-0.1, 0.05, 0.001, -0.002, 0.01], dtype=torch.float64),
        name=name,
    )


ONE, TWO = make("one", 1), make("two", 2)
PARALLEL = dataclasses.replace(
    make("parallel", 3),
    intrinsics=torch.tensor([[4.1, 0, 101.25], [0, 4.0, 77.5], [0, 0, 1]], dtype=torch.float64),
    distortion=torch.tensor([-2e-5, 1e-8, 1e-5, -2e-5, 1e-12], dtype=torch.float64),
    projection=TELECENTRIC,
)


def same(got: CalibratedCamera, camera: Camera) -> bool:
    points = torch.from_numpy(np.random.default_rng(0).uniform(-25, 25, (20, 3)))
    whole = got.camera(image_size=camera.image_size, background=camera.background)
    return float((whole.project(points) - camera.project(points)).abs().max()) < 1e-6


def arrays(camera: Camera) -> dict[str, np.ndarray]:
    return {
        "K": camera.intrinsics.numpy(),
        "D": camera.distortion.numpy(),
        "R": camera.rotation.numpy(),
        "t": camera.translation.numpy(),
    }


# -- our own file --------------------------------------------------------------------------------------------------


def test_own_file_keeps_every_bit(tmp_path):
    path = tmp_path / "c.toml"
    cameras = [CalibratedCamera.from_camera(c) for c in (ONE, TWO, PARALLEL)]
    write_cameras(path, cameras, {"rms_px": 0.02})
    for got, camera in zip(import_cameras(path), (ONE, TWO, PARALLEL), strict=True):
        assert got.projection == got.camera().projection == camera.projection
        for name in ("intrinsics", "rotation", "translation", "distortion"):
            assert torch.equal(getattr(got, name), getattr(camera, name))
        assert got.image_size == camera.image_size
        assert got.background is not None
        assert torch.equal(got.background.normal, camera.background.normal)
        assert got.camera().name == camera.name
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("rotation", "rotatoin"), "camera 'one': unknown key 'rotatoin'; the nearest known one is 'rotation'"),
        (('name = "one"', ""), "camera 'camera 0': 'name' is missing"),
        (("offset = -900.0", 'offset = "far"'), "background: offset: expected a number"),
        (('name = "one"', 'name = "one"\nprojection = "fisheye"'), "'one': projection: expected one of perspective"),
        (('format = "nerif-calibration-1"', 'format = "other"'), "expected format = 'nerif-calibration-1'"),
        (("[[camera]]", "[[camera"), "not a TOML file"),
    ],
)
def test_own_file_errors_name_file_camera_and_key(tmp_path, change, words):
    path = tmp_path / "c.toml"
    write_cameras(path, [CalibratedCamera.from_camera(ONE)])
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(InputError, match=words) as error:
        read_cameras(path)
    assert str(path) in str(error.value)


def test_own_file_with_two_of_one_name_or_none(tmp_path):
    path = tmp_path / "c.toml"
    write_cameras(path, [CalibratedCamera.from_camera(ONE)] * 2)
    with pytest.raises(InputError, match="different names"):
        read_cameras(path)
    write_cameras(path, [])
    with pytest.raises(InputError, match="at least one table"):
        read_cameras(path)
    with pytest.raises(InputError, match="no such file"):
        read_cameras(tmp_path / "none.toml")


def test_a_calibration_keeps_the_lenses_and_is_given_some(tmp_path):
    path = tmp_path / "c.toml"
    two = dataclasses.replace(ONE, name="two", lens=Lens(4.0, 900.0))
    ones = (dataclasses.replace(ONE, lens=Lens(3.5)), two)
    write_cameras(path, [CalibratedCamera.from_camera(c) for c in ones])
    first, second = read_cameras(path)
    assert first.camera().lens == Lens(3.5)
    assert second.camera().lens == Lens(4.0, 900.0)
    given = import_cameras(path, ImportSettings(aperture_diameter=6.25))
    assert [camera.lens for camera in given] == [Lens(6.25), Lens(6.25, 900.0)]
    given = import_cameras(path, ImportSettings(scale_mm=10.0, aperture_diameter=6.25))
    assert [camera.lens for camera in given] == [Lens(6.25), Lens(6.25, 9000.0)]
    given = import_cameras(path, ImportSettings(aperture_diameter=6.25, focus_distance=800.0))
    assert {camera.lens for camera in given} == {Lens(6.25, 800.0)}
    assert {camera.lens for camera in import_cameras(path, ImportSettings(aperture_diameter=0.0))} == {None}
    assert [camera.lens for camera in import_cameras(path)] == [Lens(3.5), Lens(4.0, 900.0)]
    path.write_text(path.read_text().replace("aperture_diameter = 3.5", "aperture_diameter = -3.5"))
    with refused("aperture_diameter"):
        read_cameras(path)
    with refused("focus_distance"):
        ImportSettings(focus_distance=900.0)
    with refused("aperture_diameter"):
        ImportSettings(aperture_diameter=-1.0)


def test_lenses_are_added_to_a_calibration_that_keeps_the_rest(tmp_path, monkeypatch):
    """docs/pixels.md."""
    monkeypatch.setattr(calibrate, "_draw", lambda *rig: None)
    path, out, thin = (tmp_path / f"{name}.toml" for name in ("calibration", "with_lenses", "thin"))
    sure = dataclasses.replace(ONE, pose_sigma=torch.arange(6).double())
    wide = dataclasses.replace(TWO, lens=Lens(4.0, 900.0))
    before = [CalibratedCamera.from_camera(camera) for camera in (sure, wide)]
    write_cameras(path, before, box=Box((-1, -2, -3), (1, 2, 3)))
    calibrate.main([str(path), "--aperture-diameter", "6.25", "-o", str(out)])
    after = read_cameras(out)
    assert [camera.lens for camera in after] == [Lens(6.25), Lens(6.25, 900.0)]
    assert read_box(out) == Box((-1, -2, -3), (1, 2, 3))
    for got, camera in zip(after, before, strict=True):
        assert (got.name, got.image_size) == (camera.name, camera.image_size)
        assert got.background is not None
        assert torch.equal(got.background.normal, PLANE.normal)
        assert got.background.offset == PLANE.offset
        for name in ("intrinsics", "distortion", "rotation", "translation"):
            assert torch.equal(getattr(got, name), getattr(camera, name))
    assert after[0].pose_sigma is not None
    assert after[0].pose_sigma.tolist() == [0, 1, 2, 3, 4, 5]
    assert after[1].pose_sigma is None
    calibrate.main([str(out), "--aperture-diameter", "0", "-o", str(thin)])
    assert [camera.lens for camera in read_cameras(thin)] == [None, None]


def test_how_well_a_pose_is_known_is_said_or_taken_from_the_file_in_its_unit(tmp_path):
    path = tmp_path / "c.toml"
    write_cameras(path, [CalibratedCamera.from_camera(dataclasses.replace(ONE, pose_sigma=torch.arange(6).double()))])
    (own,) = import_cameras(path, ImportSettings(scale_mm=10.0))
    assert own.pose_sigma.tolist() == [0, 1, 2, 30, 40, 50]
    (said,) = import_cameras(path, ImportSettings(pose_sigma_mm=0.3, pose_sigma_deg=0.01))
    assert said.pose_sigma.tolist() == pytest.approx([np.radians(0.01)] * 3 + [0.3] * 3)
    with refused("pose_sigma_mm, pose_sigma_deg"):
        ImportSettings(pose_sigma_mm=0.3)
    with refused("pose_sigma_deg"):
        ImportSettings(pose_sigma_mm=0.3, pose_sigma_deg=-1.0)


def test_what_is_not_known_is_asked_for(tmp_path):
    path = tmp_path / "c.toml"
    bare = CalibratedCamera("one", ONE.intrinsics, ONE.rotation, ONE.translation, ONE.distortion)
    write_cameras(path, [bare])
    (got,) = read_cameras(path)
    with pytest.raises(InputError, match="view 'one' has no image size"):
        got.camera(background=PLANE)
    assert got.camera(image_size=(10, 10)).background is None


# -- TOML and CSV --------------------------------------------------------------------------------------------------


def test_plain_toml(tmp_path):
    path = tmp_path / "plain.toml"
    table = {}
    for camera in (ONE, TWO):
        a = arrays(camera)
        table[camera.name] = {
            "K": a["K"].tolist(), "R": a["R"].tolist(), "t": (a["t"] / 10).tolist(), "distortion": a["D"].tolist(),
            "image_size": [160, 200], "normal": [0.0, 0.0, -2.0], "offset": -180.0,
        }  # fmt: skip
    path.write_text(tomli_w.dumps(table))
    got = import_cameras(path, ImportSettings(scale_mm=10.0))
    assert [c.name for c in got] == ["one", "two"]
    assert all(same(c, camera) for c, camera in zip(got, (ONE, TWO), strict=True))
    assert got[0].background is not None
    assert got[0].background.offset == pytest.approx(-900.0)
    path.write_text(path.read_text().replace("K = ", "k = "))
    with pytest.raises(InputError, match="unknown key 'k'; the nearest known one is"):
        import_cameras(path)


def table_of(camera: Camera) -> dict[str, float | str]:
    k, r, t, d = camera.intrinsics, camera.rotation, camera.translation, camera.distortion
    row: dict[str, float | str] = {"name": camera.name, "fx": float(k[0, 0]), "fy": float(k[1, 1])}
    row |= {"cx": float(k[0, 2]), "cy": float(k[1, 2])}
    row |= {f"r{i + 1}{j + 1}": float(r[i, j]) for i in range(3) for j in range(3)}
    row |= {f"t{a}": float(v) for a, v in zip("xyz", t, strict=True)}
    row |= {name: float(v) for name, v in zip(("k1", "k2", "p1", "p2", "k3"), d, strict=True)}
    return row | {"height": 160, "width": 200, "nx": 0, "ny": 0, "nz": -1, "offset": -900}


@pytest.mark.parametrize("delimiter", [",", ";"])
def test_csv(tmp_path, delimiter):
    path = tmp_path / "c.csv"
    rows = [table_of(c) for c in (ONE, TWO)]
    lines = ["# from the spreadsheet", delimiter.join(rows[0])]
    lines += [delimiter.join(str(v) for v in row.values()) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8-sig")
    got = import_cameras(path)
    assert all(same(c, camera) for c, camera in zip(got, (ONE, TWO), strict=True))
    assert got[1].image_size == (160, 200)
    assert got[0].background is not None
    path.write_text("\n".join(lines).replace("fx", "fxx"))
    with pytest.raises(InputError, match="unknown column 'fxx'; the nearest known one is 'fx'"):
        import_cameras(path)
    path.write_text("\n".join(lines).replace("700.0", "far"))
    with pytest.raises(InputError, match="line 2: 'tz': expected a number, got 'far'"):
        import_cameras(path)
    path.write_text("\n".join([*lines, lines[-1]]))
    with pytest.raises(InputError, match=r"c.csv: expected cameras of different names, got 2 named 'two'; rename"):
        import_cameras(path)
    path.write_text("name,fx\n")
    with pytest.raises(InputError, match="one line a camera"):
        import_cameras(path)
    path.write_text("name,fx\na,1\n")
    with pytest.raises(InputError, match="column 'fy' is missing"):
        import_cameras(path)


def test_telecentric_cameras_of_tables(tmp_path):
    """In units of the file: px per unit, and distortion of lengths in it."""
    ten = PARALLEL.intrinsics * torch.tensor([[10.0], [10.0], [1.0]], dtype=torch.float64)
    ten[:2, 2] /= 10
    distortion = PARALLEL.distortion * 10.0 ** torch.tensor([2.0, 4.0, 1.0, 1.0, 6.0], dtype=torch.float64)
    in_cm = dataclasses.replace(PARALLEL, intrinsics=ten, distortion=distortion, translation=PARALLEL.translation / 10)
    a = arrays(in_cm)
    plain = {"K": a["K"].tolist(), "R": a["R"].tolist(), "t": a["t"].tolist(), "distortion": a["D"].tolist()}
    toml, table = tmp_path / "p.toml", tmp_path / "p.csv"
    toml.write_text(tomli_w.dumps({"parallel": {**plain, "projection": "telecentric"}}))
    row = {**table_of(in_cm), "offset": -90, "projection": "telecentric"}
    table.write_text(",".join(row) + "\n" + ",".join(str(v) for v in row.values()) + "\n")
    for path in (toml, table):
        (got,) = import_cameras(path, ImportSettings(scale_mm=10.0))
        assert got.projection == TELECENTRIC
        assert same(got, PARALLEL)
        path.write_text(path.read_text().replace("telecentric", "fisheye"))
        with pytest.raises(InputError, match=r"'?parallel'?: projection: expected one of perspective, telecentric"):
            import_cameras(path)


# -- OpenCV --------------------------------------------------------------------------------------------------------


def write_opencv(path, values):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()


@pytest.mark.parametrize("suffix", [".yml", ".yaml", ".xml"])
@pytest.mark.parametrize("vector", [False, True])
def test_opencv_one_camera_a_file(tmp_path, suffix, vector):
    a = arrays(ONE)
    rotation = cv2.Rodrigues(a["R"])[0] if vector else a["R"]
    path = tmp_path / f"left{suffix}"
    write_opencv(
        path,
        {"image_width": 200, "image_height": 160, "camera_matrix": a["K"], "distortion_coefficients": a["D"],
         "rvec" if vector else "R": rotation, "tvec" if vector else "T": a["t"]},
    )  # fmt: skip
    (got,) = import_cameras(path)
    assert same(got, ONE)
    assert got.name == "left"
    assert got.image_size == (160, 200)


def test_opencv_folder_and_numbered_cameras(tmp_path):
    for camera in (ONE, TWO):
        a = arrays(camera)
        write_opencv(tmp_path / f"{camera.name}.yml", {"K": a["K"], "D": a["D"], "R": a["R"], "T": a["t"]})
    got = import_cameras(tmp_path)
    assert [c.name for c in got] == ["one", "two"]
    assert all(same(c, camera) for c, camera in zip(got, (ONE, TWO), strict=True))
    both = {f"{k}{i}": v for i, camera in ((1, ONE), (2, TWO)) for k, v in arrays(camera).items()}
    write_opencv(tmp_path / "both.xml", both)
    got = import_cameras(tmp_path / "both.xml")
    assert all(same(c, camera) for c, camera in zip(got, (ONE, TWO), strict=True))


def test_opencv_cameras_of_one_name_in_a_folder_are_refused(tmp_path):
    both = {f"{k}{i}": v for i, camera in ((1, ONE), (2, TWO)) for k, v in arrays(camera).items()}
    for name in ("left", "right"):
        write_opencv(tmp_path / f"{name}.yml", both)
    with pytest.raises(InputError, match=r"right.yml: expected cameras of .*, got 'cam1' here and in left.yml; rename"):
        import_cameras(tmp_path)


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_opencv_distortion_as_a_plain_sequence(tmp_path, suffix):
    a, path = arrays(ONE), tmp_path / f"plain{suffix}"
    write_opencv(path, {"K": a["K"], "R": a["R"], "t": a["t"], "D": 0})
    row = [float(k) for k in a["D"]]
    text = path.read_text().replace("D: 0", f"D: {row}").replace("<D>0<", f"<D>{' '.join(map(str, row))}<")
    path.write_text(text)
    assert same(import_cameras(path)[0], ONE)
    path.write_text(text.replace(str(row[2]), '"far"'))
    with pytest.raises(InputError, match=f"plain{suffix}: camera 1: distortion: expected numbers"):
        import_cameras(path)


@pytest.mark.parametrize("key", ["dist_coeffs", "dist_coeff", "dist", "kc"])
def test_distortion_under_its_other_names(tmp_path, key):
    a, path, table = arrays(ONE), tmp_path / "c.yml", tmp_path / "c.mat"
    values = {key: a["D"], "K": a["K"], "R": a["R"], "t": a["t"]}
    write_opencv(path, values)
    assert same(import_cameras(path)[0], ONE)
    if key != "dist_coeff":
        for content in (values, {name: np.stack([value, value], axis=-1) for name, value in values.items()}):
            scipy.io.savemat(table, content)
            assert all(same(camera, ONE) for camera in import_cameras(table))


@pytest.mark.parametrize("key", ["distorsion", "DistCoefs", "D3", "dist_1"])
def test_distortion_that_is_not_read_is_refused(tmp_path, key):
    a, path, table = arrays(ONE), tmp_path / "c.yml", tmp_path / "c.mat"
    pose = {"K": a["K"], "R": a["R"], "t": a["t"]}
    write_opencv(path, {**pose, key: a["D"]})
    scipy.io.savemat(table, {**pose, key: a["D"]})
    for file in (path, table):
        with pytest.raises(InputError, match=f"expected distortion coefficients as one of .* got '{key}'") as error:
            import_cameras(file)
        assert str(file) in str(error.value)
    write_opencv(path, {**pose, "D": a["D"], "working_distance": 3.0, "undistorted": 0})
    assert same(import_cameras(path)[0], ONE)


@pytest.mark.parametrize("rectified", [False, True])
def test_opencv_stereo_pair(tmp_path, rectified):
    """Maybe with what stereoRectify adds, of which R1 and R2 are no poses."""
    a, b = arrays(ONE), arrays(TWO)
    rotation = b["R"] @ a["R"].T
    translation = b["t"] - rotation @ a["t"]
    path = tmp_path / "stereo.yml"
    pair = {"M1": a["K"], "D1": a["D"], "M2": b["K"], "D2": b["D"], "R": rotation, "T": translation}
    more = {"R1": np.eye(3), "R2": np.eye(3), "P1": np.eye(3, 4), "P2": np.eye(3, 4), "Q": np.eye(4)}
    write_opencv(path, {**pair, **more} if rectified else pair)
    first, second = import_cameras(path)
    points = torch.from_numpy(np.random.default_rng(0).uniform(-25, 25, (9, 3)))
    world = points @ ONE.rotation.T + ONE.translation  # the first camera is the world
    assert torch.allclose(first.camera((160, 200), PLANE).project(world), ONE.project(points))
    assert torch.allclose(second.camera((160, 200), PLANE).project(world), TWO.project(points))


def test_opencv_errors(tmp_path):
    a, path = arrays(ONE), tmp_path / "bad.yml"
    write_opencv(path, {"K": a["K"], "D": a["D"]})
    with pytest.raises(InputError, match=r"bad.yml: camera 1: no pose"):
        import_cameras(path)
    write_opencv(path, {"K": a["K"], "D": np.arange(8.0), "R": a["R"], "T": a["t"]})
    with pytest.raises(InputError, match="at most 5 distortion coefficients"):
        import_cameras(path)
    write_opencv(path, {"R": a["R"], "T": a["t"]})
    path.write_text(path.read_text() + "K: [ [ 1, 2 ], [ 3 ] ]\n")
    with pytest.raises(InputError, match=r"bad.yml: camera 1: camera matrix: expected 3 x 3 numbers"):
        import_cameras(path)
    write_opencv(path, {"D": a["D"]})
    with pytest.raises(InputError, match="no camera matrix"):
        import_cameras(path)
    path.write_text("nothing of the kind")
    with pytest.raises(InputError, match="not a file written by OpenCV"):
        import_cameras(path)
    with pytest.raises(InputError, match="found none"):
        import_cameras(tmp_path.joinpath("empty").mkdir() or tmp_path / "empty")
    mirrored = np.diag([-1.0, 1, 1]) @ a["R"]
    write_opencv(path, {"K": a["K"], "R": mirrored, "T": a["t"]})
    with refused("rotation of view 'bad'"):
        import_cameras(path)


# -- NeRF ----------------------------------------------------------------------------------------------------------


def transforms(camera: Camera) -> dict:
    to_world = np.eye(4)
    to_world[:3, :3] = camera.rotation.numpy().T @ np.diag([1, -1, -1])  # x right, y up, z back
    to_world[:3, 3] = camera.centre.numpy() / 1000
    k = camera.intrinsics
    return {
        "file_path": f"images/{camera.name}.png", "transform_matrix": to_world.tolist(),
        "fl_x": float(k[0, 0]), "fl_y": float(k[1, 1]), "cx": float(k[0, 2]) + 0.5, "cy": float(k[1, 2]) + 0.5,
        **{n: float(v) for n, v in zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=True)},
    }  # fmt: skip


def test_nerf_transforms(tmp_path):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"w": 200, "h": 160, "frames": [transforms(ONE), transforms(TWO)]}))
    got = import_cameras(path, ImportSettings(scale_mm=1000.0))
    assert [c.name for c in got] == ["one", "two"]
    assert all(same(c, camera) for c, camera in zip(got, (ONE, TWO), strict=True))
    assert got[0].image_size == (160, 200)


def test_nerf_angle_of_view(tmp_path):
    path = tmp_path / "transforms.json"
    matrix = transforms(ONE)["transform_matrix"]
    path.write_text(json.dumps({"w": 200, "h": 160, "camera_angle_x": 0.2, "frames": [{"transform_matrix": matrix}]}))
    (got,) = import_cameras(path)
    assert float(got.intrinsics[0, 0]) == pytest.approx(100 / np.tan(0.1))
    assert float(got.intrinsics[0, 2]) == pytest.approx(99.5)


@pytest.mark.parametrize(
    ("above", "frame", "words"),
    [
        ({"camera_model": "OPENCV_FISHEYE"}, {}, "OPENCV_FISHEYE"),
        ({"camera_model": "OPENCV"}, {"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE"),
        ({"camera_model": "EQUIRECTANGULAR"}, {}, "EQUIRECTANGULAR"),
        ({"is_fisheye": True}, {}, "is_fisheye"),
        ({"camera_model": "ORTHOPHOTO"}, {}, "ORTHOPHOTO"),
        ({"k4": 0.01}, {}, "at most 5 distortion coefficients"),
        ({"distortion_params": [-0.1, 0, 0, 0, 0, 0]}, {}, "got 'distortion_params', which is not read"),
    ],
)
def test_nerf_cameras_of_other_models_are_refused(tmp_path, above, frame, words):
    """Their coefficients bear the same names as Brown's, k1 to k4, and bend the rays otherwise."""
    path = tmp_path / "transforms.json"
    frames = [transforms(ONE), {**transforms(TWO), **frame}]
    path.write_text(json.dumps({"w": 200, "h": 160, **above, "frames": frames}))
    with pytest.raises(InputError, match=words) as error:
        import_cameras(path)
    assert f"transforms.json: frame {int(bool(frame))}: expected" in str(error.value)


@pytest.mark.parametrize("model", ["OPENCV", "PINHOLE", "SIMPLE_RADIAL"])
def test_nerf_cameras_of_browns_models_are_read(tmp_path, model):
    path = tmp_path / "transforms.json"
    more = {"camera_model": model, "is_fisheye": False, "k4": 0.0}
    path.write_text(json.dumps({"w": 200, "h": 160, **more, "frames": [transforms(ONE)]}))
    assert same(import_cameras(path, ImportSettings(scale_mm=1000.0))[0], ONE)


@pytest.mark.parametrize(
    ("key", "value"), [("fisheye_model", 1), ("distortion_model", "equidistant"), ("camera_model", "omni"), ("xi", 0.8)]
)
def test_opencv_cameras_of_other_models_are_refused(tmp_path, key, value):
    a, path = arrays(ONE), tmp_path / "fisheye.yml"
    write_opencv(path, {key: value, "K": a["K"], "D": a["D"][:4], "R": a["R"], "T": a["t"]})
    with pytest.raises(InputError, match=r"fisheye.yml.*undistort the images"):
        import_cameras(path)


def test_opencv_matrices_where_numbers_belong_are_refused(tmp_path):
    a, path = arrays(ONE), tmp_path / "odd.yml"
    write_opencv(path, {**a, "image_width": np.ones((2, 2)), "image_height": 160})
    with pytest.raises(InputError, match=r"odd.yml: image_height, image_width: expected 2 numbers"):
        import_cameras(path)
    write_opencv(path, {**a, "xi": np.ones((1, 1))})
    with pytest.raises(InputError, match=r"odd.yml.*undistort the images"):
        import_cameras(path)


def test_more_coefficients_than_there_is_a_place_for_are_refused(tmp_path):
    path = tmp_path / "c.mat"
    scipy.io.savemat(path, {**camera_parameters(1, "R2022b"), "RadialDistortion": np.ones(5)})
    with pytest.raises(InputError, match="at most 3 radial and 2 tangential coefficients, got 5 and 2"):
        import_cameras(path)


def test_opencv_cameras_of_browns_model_are_read(tmp_path):
    a, path = arrays(ONE), tmp_path / "brown.yml"
    more = {"fisheye_model": 0, "distortion_model": "plumb_bob"}
    write_opencv(path, {**more, "K": a["K"], "D": a["D"], "R": a["R"], "T": a["t"]})
    assert same(import_cameras(path)[0], ONE)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "not a JSON file"),
        ('{"frames": [3]}', "a list 'frames'"),
        ('{"frames": [{"fl_x": "wide", "w": 4, "h": 4}]}', "frame 0: fl_x: expected a number, got 'wide'"),
        ('{"frames": [{"fl_x": 3, "w": -4, "h": 4}]}', "frame 0: h, w: expected height and width"),
        ('{"frames": []}', "a list 'frames'"),
        ('{"frames": [{"fl_x": 3, "w": 4, "h": 4}]}', "frame 0: transform_matrix: expected 4 x 4 numbers"),
        ('{"frames": [{"w": 4, "h": 4}]}', "no focal length"),
        ('{"frames": [{"fl_x": 3}]}', "no principal point"),
    ],
)
def test_nerf_errors(tmp_path, content, words):
    path = tmp_path / "transforms.json"
    path.write_text(content)
    with pytest.raises(InputError, match=words):
        import_cameras(path)


# -- MATLAB --------------------------------------------------------------------------------------------------------


def bouguet(camera: Camera) -> dict[str, np.ndarray]:
    a = arrays(camera)
    return {
        "fc": a["K"][[0, 1], [0, 1]][:, None], "cc": a["K"][:2, 2:], "alpha_c": np.zeros((1, 1)), "kc": a["D"][:, None],
        "nx": np.array([[200.0]]), "ny": np.array([[160.0]]), "Rc_2": a["R"], "Tc_2": a["t"][:, None],
        "omc_2": cv2.Rodrigues(a["R"])[0],
    }  # fmt: skip


def rotation_vector_to_matrix(vector: np.ndarray) -> np.ndarray:
    """As documented for MATLAB's rotationVectorToMatrix: pi/2 about z is [0 1 0; -1 0 0; 0 0 1], for row vectors."""
    x, y, z = vector / np.linalg.norm(vector)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.linalg.norm(vector)
    return (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross).T


def world_to_image(struct: dict[str, np.ndarray], pose: int, points: np.ndarray) -> np.ndarray:
    """As documented for MATLAB's worldToImage: w [x y 1] = [X Y Z 1] [R; t] K with K its transposed, from pixel 1."""
    seen = points @ rotation_vector_to_matrix(struct["RotationVectors"][pose - 1])
    seen = seen + struct["TranslationVectors"][pose - 1]
    x, y = (seen[:, :2] / seen[:, 2:]).T
    r2 = x**2 + y**2
    k, (p1, p2) = [*struct["RadialDistortion"], 0][:3], struct["TangentialDistortion"]
    radial = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    intrinsics = struct["IntrinsicMatrix"] if "IntrinsicMatrix" in struct else struct["K"].T
    return (np.stack([u, v, np.ones_like(u)], axis=1) @ intrinsics)[:, :2]


def camera_parameters(seed: int, release: str, radial: int = 3) -> dict:
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


def sees(got: CalibratedCamera, struct: dict, pose: int) -> bool:
    """Whether a camera projects as MATLAB does, pixel 1 of which is ours of number 0."""
    points = np.random.default_rng(0).uniform(-25, 25, (20, 3))
    ours = got.camera(background=PLANE).project(torch.from_numpy(points)).numpy()
    return float(np.abs(ours - (world_to_image(struct, pose, points) - 1)).max()) < 1e-6


def test_the_rotations_here_are_those_of_matlabs_example():
    assert np.allclose(rotation_vector_to_matrix(np.array([0, 0, np.pi / 2])), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])


@pytest.mark.parametrize("release", ["R2021a", "R2022b"])
@pytest.mark.parametrize("radial", [2, 3])
@pytest.mark.parametrize("pose", [1, 2])
def test_camera_parameters_by_to_struct(tmp_path, release, radial, pose):
    path = tmp_path / "plain.mat"
    struct = camera_parameters(1, release, radial)
    scipy.io.savemat(path, struct)
    (got,) = import_cameras(path, ImportSettings(pose=pose))
    assert sees(got, struct, pose)
    assert got.image_size == (160, 200)
    with pytest.raises(InputError, match=r"pose of image 7.* got 3 and 3 poses"):
        import_cameras(path, ImportSettings(pose=7))


def test_camera_parameters_of_several_cameras_or_one_pose(tmp_path):
    path = tmp_path / "rig.mat"
    left, right = camera_parameters(1, "R2022b"), camera_parameters(2, "R2021a")
    single = {k: v[:1] if k in ("RotationVectors", "TranslationVectors") else v for k, v in left.items()}
    scipy.io.savemat(path, {"left": left, "right": right, "single": single})
    got = import_cameras(path)
    assert [c.name for c in got] == ["left", "right", "single"]
    assert all(sees(c, struct, 1) for c, struct in zip(got, (left, right, left), strict=True))


def test_camera_parameters_without_target_images(tmp_path):
    path = tmp_path / "plain.mat"
    scipy.io.savemat(path, {**camera_parameters(1, "R2022b"), "RotationVectors": np.zeros((0, 3))})
    with pytest.raises(InputError, match=r"pose of image 1 in RotationVectors.* got 0 and 3 poses"):
        import_cameras(path)


def test_rotation_matrices_of_the_toolbox_multiply_row_vectors(tmp_path):
    path = tmp_path / "plain.mat"
    struct = camera_parameters(1, "R2021a")
    vectors = struct.pop("RotationVectors")
    matrices = np.stack([rotation_vector_to_matrix(v) for v in vectors], axis=-1)
    scipy.io.savemat(path, {**struct, "RotationMatrices": matrices})
    (got,) = import_cameras(path, ImportSettings(pose=2))
    assert sees(got, {**struct, "RotationVectors": vectors}, 2)


@pytest.mark.parametrize("images", [True, False])
def test_stereo_parameters_by_to_struct(tmp_path, images):
    """x_2 = x_1 RotationOfCamera2 + TranslationOfCamera2; the poses of camera 2 are those of camera 1, so moved."""
    path = tmp_path / "stereo.mat"
    one, two = camera_parameters(1, "R2021a"), camera_parameters(2, "R2021a")
    turn, shift = rotation_vector_to_matrix(np.array([0.1, -0.3, 0.05])), np.array([-120.0, 5.0, 8.0])
    for i in range(3):
        matrix = rotation_vector_to_matrix(one["RotationVectors"][i]) @ turn
        two["RotationVectors"][i] = cv2.Rodrigues(matrix.T)[0].ravel()
        two["TranslationVectors"][i] = one["TranslationVectors"][i] @ turn + shift
    stereo = {"CameraParameters1": one, "CameraParameters2": two, "RotationOfCamera2": turn,
              "TranslationOfCamera2": shift, "Version": one["Version"]}  # fmt: skip
    none = {"RotationVectors": np.zeros((0, 3)), "TranslationVectors": np.zeros((0, 3))}
    if not images:
        stereo |= {"CameraParameters1": one | none, "CameraParameters2": two | none}
    scipy.io.savemat(path, stereo)
    first, second = import_cameras(path, ImportSettings(pose=2 if images else 1))
    if images:
        assert sees(first, one, 2)
        assert sees(second, two, 2)
        return
    points = np.random.default_rng(0).uniform(-25, 25, (20, 3))
    seen = points @ rotation_vector_to_matrix(one["RotationVectors"][1]) + one["TranslationVectors"][1]
    for got, struct in ((first, one), (second, two)):
        ours = got.camera(background=PLANE).project(torch.from_numpy(seen)).numpy()  # camera 1 is the world
        assert np.abs(ours - (world_to_image(struct, 2, points) - 1)).max() < 1e-6


def test_stereo_parameters_of_two_pairs(tmp_path):
    """Their cameras bear the names of their structs; without poses each pair would be a world of its own."""
    path, pairs, known = tmp_path / "pairs.mat", {}, {}
    for i, name in enumerate(("low", "high")):
        one, two = camera_parameters(2 * i, "R2021a"), camera_parameters(2 * i + 1, "R2022b")
        pairs[name] = {"CameraParameters1": one, "CameraParameters2": two, "RotationOfCamera2": np.eye(3),
                       "TranslationOfCamera2": np.array([-120.0, 5.0, 8.0])}  # fmt: skip
        known |= {f"{name}_cam1": one, f"{name}_cam2": two}
    scipy.io.savemat(path, pairs)
    got = import_cameras(path, ImportSettings(pose=2))
    assert [camera.name for camera in got] == list(known)
    assert all(sees(camera, struct, 2) for camera, struct in zip(got, known.values(), strict=True))
    for pair in pairs.values():
        pair["CameraParameters1"]["RotationVectors"] = np.zeros((0, 3))
    scipy.io.savemat(path, pairs)
    with pytest.raises(InputError, match=r"pairs.mat: expected cameras in one world frame, got low_cam1, high_cam1"):
        import_cameras(path)


def test_fisheye_parameters_are_refused(tmp_path):
    path = tmp_path / "fisheye.mat"
    intrinsics = {"MappingCoefficients": np.array([880.0, -3e-4, 0, 0]), "DistortionCenter": np.array([100.0, 80.0])}
    scipy.io.savemat(path, {"Intrinsics": intrinsics, "RotationVectors": np.eye(3), "TranslationVectors": np.eye(3)})
    with pytest.raises(InputError, match=r"fisheye.mat.*got 'fisheyeParameters'"):
        import_cameras(path)


def test_bouguets_toolbox(tmp_path):
    path = tmp_path / "Calib_Results.mat"
    scipy.io.savemat(path, bouguet(ONE))
    (got,) = import_cameras(path, ImportSettings(pose=2))
    assert same(got, ONE)
    assert got.image_size == (160, 200)
    with pytest.raises(InputError, match=r"pose of image 1 .* got Rc_2"):
        import_cameras(path)


def test_plain_arrays_one_and_stacked(tmp_path):
    path = tmp_path / "plain.mat"
    scipy.io.savemat(path, arrays(ONE))
    assert same(import_cameras(path)[0], ONE)
    stacked = {k: np.stack([arrays(ONE)[k], arrays(TWO)[k]], axis=-1) for k in arrays(ONE)}
    scipy.io.savemat(path, stacked)
    got = import_cameras(path)
    assert same(got[0], ONE)
    assert same(got[1], TWO)


def test_transposed_k_is_turned_back(tmp_path):
    path = tmp_path / "plain.mat"
    scipy.io.savemat(path, {**arrays(ONE), "K": arrays(ONE)["K"].T})
    assert same(import_cameras(path)[0], ONE)


def test_version_7_3(tmp_path):
    path = tmp_path / "new.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for key, value in arrays(ONE).items():
            item = file.create_dataset(key, data=np.atleast_2d(value).T)
            item.attrs["MATLAB_class"] = np.bytes_("double")
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    with path.open("r+b") as raw:
        raw.write(head)
    assert same(import_cameras(path)[0], ONE)


def test_an_opaque_object_says_how_to_export_it(tmp_path, monkeypatch):
    """What SciPy makes of a saved cameraParameters object: nothing but its function workspace."""
    path = tmp_path / "object.mat"
    scipy.io.savemat(path, {"x": 1.0})
    monkeypatch.setattr(scipy.io, "whosmat", lambda p: [("params", (1, 1), "opaque")])
    import pymatreader

    monkeypatch.setattr(pymatreader, "read_mat", lambda p: {"__header__": b"", "__function_workspace__": np.zeros(3)})
    with pytest.raises(InputError, match=r"object.mat: holds a MATLAB object 'params'.*toStruct\(params\)"):
        import_cameras(path)


def test_an_opaque_object_in_version_7_3(tmp_path):
    path = tmp_path / "object.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        item = file.create_dataset("stereo", data=np.zeros((1, 6), dtype=np.uint32))
        item.attrs["MATLAB_class"] = np.bytes_("stereoParameters")
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    with pytest.raises(InputError, match="holds a MATLAB object 'stereo'"):
        import_cameras(path)


def test_matlab_errors(tmp_path):
    path = tmp_path / "bad.mat"
    path.write_bytes(b"not a MATLAB file at all")
    with pytest.raises(InputError, match=r"bad.mat: not a readable MATLAB file"):
        import_cameras(path)
    scipy.io.savemat(path, {"unrelated": np.eye(3)})
    with pytest.raises(InputError, match="got unrelated"):
        import_cameras(path)
    scipy.io.savemat(path, {"cam": {"K": np.eye(3)}})
    with pytest.raises(InputError, match="expected R and t beside K"):
        import_cameras(path)


def test_other_errors(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        import_cameras(tmp_path / "none.csv")
    odd = tmp_path / "c.docx"
    odd.write_text("x")
    with pytest.raises(InputError, match=r"ending in .toml .csv"):
        import_cameras(odd)
    with refused("scale_mm"):
        ImportSettings(scale_mm=0.0)


def test_calibrations_are_told_from_images(tmp_path):
    opencv, images, both = (tmp_path / name for name in ("opencv", "images", "both"))
    for folder in (opencv, images, both):
        folder.mkdir()
    for folder in (opencv, both):
        (folder / "left.yml").touch()
    (images / "views.toml").touch()
    (both / "cam1").mkdir()
    assert is_calibration(opencv)
    assert is_calibration(opencv / "left.yml")
    assert not is_calibration(images)
    assert not is_calibration(both)


def test_only_the_cameras_asked_for(tmp_path):
    path = tmp_path / "c.toml"
    write_cameras(path, [CalibratedCamera.from_camera(c) for c in (ONE, TWO)])
    assert [c.name for c in import_cameras(path, only=("two",))] == ["two"]
    with refused("views"):
        import_cameras(path, only=("three",))


def test_what_a_file_does_not_say_is_put_in(tmp_path):
    path = tmp_path / "c.toml"
    bare = CalibratedCamera("one", ONE.intrinsics, ONE.rotation, ONE.translation, ONE.distortion)
    write_cameras(path, [bare])
    (got,) = import_cameras(path, ImportSettings(background_distance=400.0, image_size=(160, 200)))
    assert got.image_size == (160, 200)
    assert got.background is not None
    assert got.background.offset == -400.0
    assert float(got.background.normal @ ONE.rotation[2]) == pytest.approx(-1)  # towards the camera
    write_cameras(path, [CalibratedCamera.from_camera(ONE)])
    (known,) = import_cameras(path, ImportSettings(background_distance=400.0, image_size=(9, 9)))
    assert known.background is not None
    assert known.background.offset == PLANE.offset
    assert known.image_size == ONE.image_size
