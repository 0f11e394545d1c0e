"""Calibrations of other programs, written here as they write them, project like the camera they came from."""

from __future__ import annotations

import json

import cv2
import h5py
import numpy as np
import pytest
import scipy.io
import tomli_w
import torch
from scipy.spatial.transform import Rotation

from nerif.conventions import InputError
from nerif.geometry import Camera, Plane
from nerif.imaging.cameras_file import CalibratedCamera, read_cameras, write_cameras
from nerif.imaging.importers import import_cameras

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
    cameras = [CalibratedCamera.from_camera(ONE), CalibratedCamera.from_camera(TWO)]
    write_cameras(path, cameras, {"rms_px": 0.02})
    for got, camera in zip(import_cameras(path), (ONE, TWO), strict=True):
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
        (("offset = -900.0", 'offset = "far"'), "background offset: expected one numbers"),
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


def test_what_is_not_known_is_asked_for(tmp_path):
    path = tmp_path / "c.toml"
    bare = CalibratedCamera("one", ONE.intrinsics, ONE.rotation, ONE.translation, ONE.distortion)
    write_cameras(path, [bare])
    (got,) = read_cameras(path)
    with pytest.raises(InputError, match="view 'one' has no image size"):
        got.camera(background=PLANE)
    with pytest.raises(InputError, match="view 'one' has no background plane"):
        got.camera(image_size=(10, 10))


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
    got = import_cameras(path, scale_mm=10.0)
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
    path.write_text("name,fx\n")
    with pytest.raises(InputError, match="one line a camera"):
        import_cameras(path)
    path.write_text("name,fx\na,1\n")
    with pytest.raises(InputError, match="column 'fy' is missing"):
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


def test_opencv_stereo_pair(tmp_path):
    a, b = arrays(ONE), arrays(TWO)
    rotation = b["R"] @ a["R"].T
    translation = b["t"] - rotation @ a["t"]
    path = tmp_path / "stereo.yml"
    write_opencv(path, {"M1": a["K"], "D1": a["D"], "M2": b["K"], "D2": b["D"], "R": rotation, "T": translation})
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
    with pytest.raises(InputError, match=r"bad.yml.*mirrored axis"):
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
    got = import_cameras(path, scale_mm=1000.0)
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
    ("content", "words"),
    [
        ("{", "not a JSON file"),
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


def parameters(camera: Camera) -> dict[str, np.ndarray]:
    a = arrays(camera)
    k = a["K"].copy()
    k[:2, 2] += 1  # MATLAB's pixels start at 1
    d = a["D"]
    return {
        "IntrinsicMatrix": k.T, "RadialDistortion": d[[0, 1, 4]], "TangentialDistortion": d[2:4],
        "ImageSize": np.array([160.0, 200.0]), "RotationMatrices": np.stack([np.eye(3), a["R"].T], axis=-1),
        "TranslationVectors": np.stack([np.zeros(3), a["t"]]),
    }  # fmt: skip


def test_bouguets_toolbox(tmp_path):
    path = tmp_path / "Calib_Results.mat"
    scipy.io.savemat(path, bouguet(ONE))
    (got,) = import_cameras(path, pose=2)
    assert same(got, ONE)
    assert got.image_size == (160, 200)
    with pytest.raises(InputError, match=r"pose of picture 1 .* got Rc_2"):
        import_cameras(path)


def test_camera_parameters_as_structs(tmp_path):
    path = tmp_path / "plain.mat"
    scipy.io.savemat(path, parameters(ONE))
    (got,) = import_cameras(path, pose=2)
    assert same(got, ONE)
    assert got.image_size == (160, 200)
    scipy.io.savemat(path, {"left": parameters(ONE), "right": parameters(TWO)})
    got = import_cameras(path, pose=2)
    assert [c.name for c in got] == ["left", "right"]
    assert same(got[1], TWO)
    with pytest.raises(InputError, match="pose of picture 7"):
        import_cameras(path, pose=7)


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
    with pytest.raises(InputError, match="scale_mm"):
        import_cameras(odd, scale_mm=0.0)
