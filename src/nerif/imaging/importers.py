"""Calibrations of other programs: MATLAB, OpenCV, NeRF-style transforms, plain CSV and TOML.

Everything ends as CalibratedCamera in the conventions of docs/conventions.md: OpenCV cameras, pixel (0, 0) the centre
of the first pixel, world to camera, mm.
"""

from __future__ import annotations

import csv
import difflib
import json
import math
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerif.conventions import InputError
from nerif.geometry import Plane
from nerif.imaging.cameras_file import FORMAT, CalibratedCamera, checked, five, numbers, read_cameras, upright
from nerif.imaging.matlab import read_matlab

__all__ = ["import_cameras"]

ENDINGS = (".toml", ".csv", ".yml", ".yaml", ".xml", ".json", ".mat")


def import_cameras(path: Path, scale_mm: float = 1.0, pose: int = 1) -> tuple[CalibratedCamera, ...]:
    """Read the cameras of a file, or of a folder with one OpenCV file a camera.

    Parameters
    ----------
    path : .toml, .csv, .yml, .yaml, .xml (OpenCV), .json (NeRF), .mat (MATLAB)
    scale_mm : millimetres in a unit of length of the file
    pose : which target picture is the world, for MATLAB calibrations that keep one pose a picture

    Raises
    ------
    InputError
        If it cannot be read; names the file, what was expected and what came.
    """
    path = Path(path)
    if not scale_mm > 0:
        raise InputError(f"scale_mm: expected a positive number, got {scale_mm}")
    if not path.exists():
        raise InputError(f"{path}: no such file; expected a calibration ({' '.join(ENDINGS)})")
    if path.is_dir():
        cameras = _opencv_folder(path)
    elif path.suffix == ".toml":
        cameras = _toml(path)
    elif path.suffix == ".csv":
        cameras = _csv(path)
    elif path.suffix in (".yml", ".yaml", ".xml"):
        cameras = _opencv(path)
    elif path.suffix == ".json":
        cameras = _transforms(path)
    elif path.suffix == ".mat":
        cameras = read_matlab(path, pose)
    else:
        raise InputError(f"{path}: expected a calibration ending in {' '.join(ENDINGS)}, got '{path.suffix}'")
    if not cameras:
        raise InputError(f"{path}: holds no camera")
    return tuple(checked(_scaled(c, scale_mm), str(path)) for c in cameras)


def _scaled(camera: CalibratedCamera, scale: float) -> CalibratedCamera:
    plane = camera.background
    return replace(
        camera,
        translation=scale * camera.translation,
        background=None if plane is None else Plane(plane.normal, scale * plane.offset),
    )


# -- TOML and CSV --------------------------------------------------------------------------------------------------


def _toml(path: Path) -> list[CalibratedCamera]:
    """Ours, or a table a camera: [cam1] K = ..., R = ..., t = ..., distortion = ..., image_size = [height, width]."""
    try:
        table = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a TOML file ({error})") from None
    if "format" in table or "camera" in table:
        return list(read_cameras(path))
    known = ("K", "R", "t", "distortion", "image_size", "normal", "offset")
    cameras = []
    for name, own in table.items():
        where = f"{path}: camera '{name}'"
        if not isinstance(own, dict):
            raise InputError(f"{path}: expected format = '{FORMAT}' or a table [{name}] with K, R and t, got {own!r}")
        for key in own:
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1, cutoff=0)[0]
                raise InputError(f"{where}: unknown key '{key}'; the nearest known one is '{near}'")
        for key in ("K", "R", "t"):
            if key not in own:
                raise InputError(f"{where}: '{key}' is missing")
        size = numbers(own["image_size"], (2,), f"{where}: image_size") if "image_size" in own else None
        cameras.append(
            CalibratedCamera(
                name=name,
                intrinsics=upright(own["K"], f"{where}: K"),
                rotation=numbers(own["R"], (3, 3), f"{where}: R"),
                translation=numbers(np.ravel(own["t"]).tolist(), (3,), f"{where}: t"),
                distortion=five(own.get("distortion", []), f"{where}: distortion"),
                image_size=None if size is None else (int(size[0]), int(size[1])),
                background=_plane(own.get("normal"), own.get("offset"), where),
            )
        )
    return cameras


def _plane(normal: Any, offset: Any, where: str) -> Plane | None:
    if normal is None or offset is None:
        return None
    n = numbers(normal, (3,), f"{where}: normal")
    length = float(n.norm())
    if not length > 0:
        raise InputError(f"{where}: normal: expected a direction, got {n.tolist()}")
    return Plane(n / length, float(numbers(offset, (), f"{where}: offset")) / length)


NEEDED = ("fx", "fy", "cx", "cy", *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)), "tx", "ty", "tz")
COLUMNS = ("name", *NEEDED, "s", "k1", "k2", "p1", "p2", "k3", "width", "height", "nx", "ny", "nz", "offset")


def _csv(path: Path) -> list[CalibratedCamera]:
    """One row a camera under the names of COLUMNS, separated by comma or semicolon."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file") from None
    lines = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if len(lines) < 2:
        raise InputError(f"{path}: expected a line of column names and one line a camera, got {len(lines)} lines")
    rows = list(csv.DictReader(lines, delimiter=";" if ";" in lines[0] else ",", skipinitialspace=True))
    names = [str(n).strip() for n in rows[0]]
    for column in names:
        if column not in COLUMNS:
            near = difflib.get_close_matches(column, COLUMNS, n=1, cutoff=0)[0]
            raise InputError(f"{path}: unknown column '{column}'; the nearest known one is '{near}'")
    for column in NEEDED:
        if column not in names:
            raise InputError(f"{path}: column '{column}' is missing")
    cameras = []
    for i, row in enumerate(rows):
        given = {str(k).strip(): str(v).strip() for k, v in row.items() if v is not None and str(v).strip()}
        name = given.pop("name", f"cam{i + 1}")

        def number(key: str, default: float | None = None, given: dict = given, line: int = i + 2) -> float:
            try:
                return float(given[key]) if key in given or default is None else default
            except (KeyError, ValueError):
                raise InputError(
                    f"{path}: line {line}: '{key}': expected a number, got '{given.get(key, '')}'"
                ) from None

        rotation = [[number(f"r{r}{c}") for c in (1, 2, 3)] for r in (1, 2, 3)]
        plane = [number(k) for k in ("nx", "ny", "nz")] if "nx" in given and "offset" in given else None
        cameras.append(
            CalibratedCamera(
                name=name,
                intrinsics=torch.tensor(
                    [[number("fx"), number("s", 0.0), number("cx")], [0, number("fy"), number("cy")], [0, 0, 1]],
                    dtype=torch.float64,
                ),
                rotation=torch.tensor(rotation, dtype=torch.float64),
                translation=torch.tensor([number("tx"), number("ty"), number("tz")], dtype=torch.float64),
                distortion=five([number(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3")], f"{path}: {name}"),
                image_size=(int(number("height")), int(number("width"))) if "width" in given else None,
                background=_plane(plane, number("offset") if plane else None, f"{path}: line {i + 2}"),
            )
        )
    return cameras


# -- OpenCV --------------------------------------------------------------------------------------------------------

WORDS = {
    "intrinsics": ("camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsics", "K", "M"),
    "distortion": ("distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "distortion", "dist", "D"),
    "rotation": ("rotation_matrix", "rotation", "rvec", "R", "om"),
    "translation": ("translation_vector", "translation", "tvec", "T", "t"),
}


def _opencv_folder(folder: Path) -> list[CalibratedCamera]:
    """One file a camera, named by the file."""
    files = sorted(p for p in folder.iterdir() if p.suffix in (".yml", ".yaml", ".xml"))
    if not files:
        raise InputError(f"{folder}: expected OpenCV files (.yml .yaml .xml), one a camera, found none")
    cameras = []
    for file in files:
        own = _opencv(file)
        cameras += [replace(own[0], name=file.stem)] if len(own) == 1 else own
    return cameras


def _opencv(path: Path) -> list[CalibratedCamera]:
    """One camera, or several whose names carry numbers: K1, D1, R1, T1, K2 ... or a stereo pair with one R and T."""
    import cv2

    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        keys = storage.root().keys() if storage.isOpened() else []
    except (cv2.error, SystemError):
        keys = []
    if not keys:
        raise InputError(f"{path}: not a file written by OpenCV's FileStorage, or empty")
    values: dict[str, Any] = {}
    for key in keys:
        node = storage.getNode(key)
        values[key] = node.mat() if node.isMap() else (node.real() if node.isReal() or node.isInt() else None)
    storage.release()

    def find(what: str, suffix: str) -> Any:
        return next((values[w + suffix] for w in WORDS[what] if values.get(w + suffix) is not None), None)

    suffixes = [s for s in ("", *map(str, range(1, 33))) if find("intrinsics", s) is not None]
    if not suffixes:
        raise InputError(
            f"{path}: no camera matrix; expected {', '.join(WORDS['intrinsics'])} (with a number behind each for "
            f"several cameras), got {', '.join(keys)}"
        )
    size = _opencv_size(values)
    stereo = suffixes == ["1", "2"] and find("rotation", "2") is None
    cameras = []
    for suffix in suffixes:
        where = f"{path}: camera {suffix or 1}"
        rotation, translation = find("rotation", suffix), find("translation", suffix)
        if stereo:  # OpenCV's stereo pair: the first camera is the world, x2 = R x1 + T
            first = suffix == "1"
            rotation = np.eye(3) if first else find("rotation", "")
            translation = np.zeros(3) if first else find("translation", "")
        if rotation is None or translation is None:
            raise InputError(
                f"{where}: no pose; expected {', '.join(WORDS['rotation'])} and {', '.join(WORDS['translation'])} "
                f"beside the camera matrix, got {', '.join(keys)}"
            )
        rotation = np.asarray(rotation, dtype=np.float64)
        if rotation.size == 3:
            rotation = cv2.Rodrigues(rotation.reshape(3))[0]
        distortion = find("distortion", suffix)
        cameras.append(
            CalibratedCamera(
                name=f"cam{suffix}" if suffix else path.stem,
                intrinsics=upright(find("intrinsics", suffix).tolist(), f"{where}: camera matrix"),
                rotation=numbers(rotation.tolist(), (3, 3), f"{where}: rotation"),
                translation=numbers(np.ravel(translation).tolist(), (3,), f"{where}: translation"),
                distortion=five([] if distortion is None else distortion, f"{where}: distortion"),
                image_size=size,
            )
        )
    return cameras


def _opencv_size(values: dict[str, Any]) -> tuple[int, int] | None:
    for width, height in (("image_width", "image_height"), ("Image_Width", "Image_Height"), ("width", "height")):
        if values.get(width) and values.get(height):
            return int(values[height]), int(values[width])
    return None


# -- NeRF ----------------------------------------------------------------------------------------------------------


def _transforms(path: Path) -> list[CalibratedCamera]:
    """transforms.json of Blender, nerfstudio and instant-ngp.

    transform_matrix is camera to world with OpenGL's camera (x right, y up, z back); cx and cy count from the corner of
    the first pixel, whose centre is at 0.5 there.
    """
    try:
        whole = json.loads(path.read_text())
    except (ValueError, UnicodeDecodeError):
        raise InputError(f"{path}: not a JSON file, or truncated") from None
    frames = whole.get("frames") if isinstance(whole, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: expected NeRF's transforms.json with a list 'frames', got none")
    cameras = []
    for i, frame in enumerate(frames):
        where = f"{path}: frame {i}"

        def get(key: str, default: Any = None, frame: dict = frame) -> Any:
            return frame.get(key, whole.get(key, default))

        width, height = get("w"), get("h")
        fx = get("fl_x")
        if fx is None and get("camera_angle_x") is not None and width is not None:
            fx = 0.5 * float(width) / math.tan(0.5 * float(get("camera_angle_x")))
        if fx is None:
            raise InputError(f"{where}: no focal length; expected fl_x, or camera_angle_x and w")
        fy, cx, cy = get("fl_y", fx), get("cx"), get("cy")
        if (cx is None or cy is None) and (width is None or height is None):
            raise InputError(f"{where}: no principal point; expected cx and cy, or w and h")
        cx, cy = float(width / 2 if cx is None else cx) - 0.5, float(height / 2 if cy is None else cy) - 0.5
        matrix = frame.get("transform_matrix")
        to_world = numbers(matrix if matrix is not None else [], (4, 4), f"{where}: transform_matrix")
        flip = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))  # OpenGL's camera to OpenCV's
        rotation = flip @ to_world[:3, :3].T
        name = Path(str(frame.get("file_path", f"cam{i}"))).stem
        cameras.append(
            CalibratedCamera(
                name=name,
                intrinsics=torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64),
                rotation=rotation,
                translation=-rotation @ to_world[:3, 3],
                distortion=five([get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3")], where),
                image_size=(int(height), int(width)) if width is not None and height is not None else None,
            )
        )
    return _with_different_names(cameras)


def _with_different_names(cameras: list[CalibratedCamera]) -> list[CalibratedCamera]:
    names = [c.name for c in cameras]
    rename: Callable[[int, str], str] = (lambda i, n: n) if len(set(names)) == len(names) else (lambda i, n: f"cam{i}")
    return [replace(c, name=rename(i, c.name)) for i, c in enumerate(cameras)]
