"""Cameras of OpenCV's FileStorage, YAML or XML: one a file, several, or a stereo pair."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nerif.common.conventions import InputError
from nerif.imaging.calibration.cameras_file import (
    CalibratedCamera,
    check_distortion,
    check_model,
    five,
    flat,
    image_size,
    numbers,
    upright,
)

__all__ = ["ENDINGS", "read_opencv", "read_opencv_folder"]

ENDINGS = (".yml", ".yaml", ".xml")
WORDS = {
    "intrinsics": ("camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsics", "K", "M"),
    "distortion": ("distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "dist_coeffs", "dist_coeff",
                   "distortion", "dist", "kc", "D"),
    "rotation": ("rotation_matrix", "rotation", "rvec", "R", "om"),
    "translation": ("translation_vector", "translation", "tvec", "T", "t"),
}  # fmt: skip


MODELS = ("camera_model", "distortion_model", "calibration_model")
OTHER_MODELS = ("fisheye_model", "xi")  # a flag of OpenCV's calibration program; a parameter of omnidirectional cameras


def read_opencv_folder(folder: Path) -> list[CalibratedCamera]:
    """One file a camera, named by the file."""
    files = sorted(p for p in folder.iterdir() if p.suffix in ENDINGS)
    if not files:
        raise InputError(f"expected OpenCV files ({' '.join(ENDINGS)}), one a camera, found none", field=folder)
    cameras: dict[str, CalibratedCamera] = {}
    origins: dict[str, Path] = {}
    for file in files:
        own = read_opencv(file)
        for camera in [replace(own[0], name=file.stem)] if len(own) == 1 else own:
            if camera.name in cameras:
                raise InputError(
                    f"expected cameras of different names, got '{camera.name}' here and in "
                    f"{origins[camera.name].name}; rename one, or take its file out of the folder",
                    field=file,
                )
            cameras[camera.name], origins[camera.name] = camera, file
    return list(cameras.values())


def read_opencv(path: Path) -> list[CalibratedCamera]:
    """One camera, or several whose names carry numbers: K1, D1, R1, T1, K2 ... or a stereo pair with one R and T."""
    import cv2

    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        keys = storage.root().keys() if storage.isOpened() else []
    except (cv2.error, SystemError):
        keys = []
    if not keys:
        raise InputError("not a file written by OpenCV's FileStorage, or empty", field=path)
    values: dict[str, Any] = {}
    for key in keys:
        node = storage.getNode(key)
        try:
            value = node.mat() if node.isMap() else _plain(node)
        except cv2.error as error:
            raise InputError(f"{key}: expected a matrix as FileStorage writes it ({error.err})", field=path) from None
        values[key] = np.asarray(value, dtype=object) if isinstance(value, list) else value  # rows of any lengths
    storage.release()
    for key in MODELS:
        if values.get(key) is not None:
            check_model(values[key], f"{path}: {key}")
    for key in OTHER_MODELS:
        if np.any(values.get(key)):
            check_model(key, str(path))

    def key_of(what: str, suffix: str) -> str:
        return next((w + suffix for w in WORDS[what] if values.get(w + suffix) is not None), "")

    def find(what: str, suffix: str) -> Any:
        return values.get(key_of(what, suffix))

    suffixes = [s for s in ("", *map(str, range(1, 33))) if find("intrinsics", s) is not None]
    if not suffixes:
        raise InputError(
            f"no camera matrix; expected {', '.join(WORDS['intrinsics'])} (with a number behind each for "
            f"several cameras), got {', '.join(keys)}",
            field=path,
        )
    size = _size(values, str(path))
    check_distortion(keys, {*(key_of("distortion", s) for s in suffixes), *MODELS}, WORDS["distortion"], str(path))
    stereo = suffixes == ["1", "2"] and find("translation", "2") is None  # R1 and R2 may be stereoRectify's
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
                f"no pose; expected {', '.join(WORDS['rotation'])} and {', '.join(WORDS['translation'])} "
                f"beside the camera matrix, got {', '.join(keys)}",
                field=where,
            )
        rotation = np.asarray(rotation)
        if rotation.size == 3:
            rotation = cv2.Rodrigues(flat(rotation, f"{where}: rotation"))[0]
        distortion = find("distortion", suffix)
        cameras.append(
            CalibratedCamera(
                name=f"cam{suffix}" if suffix else path.stem,
                intrinsics=upright(np.asarray(find("intrinsics", suffix)).tolist(), f"{where}: camera matrix"),
                rotation=numbers(rotation.tolist(), (3, 3), f"{where}: rotation"),
                translation=numbers(np.ravel(translation).tolist(), (3,), f"{where}: translation"),
                distortion=five([] if distortion is None else distortion, f"{where}: distortion"),
                image_size=size,
            )
        )
    return cameras


def _plain(node: Any) -> Any:
    """The number, text or sequence of a node; None of any other."""
    if node.isSeq():
        return [_plain(node.at(i)) for i in range(node.size())]
    if node.isString():
        return node.string()
    return node.real() if node.isReal() or node.isInt() else None


def _size(values: dict[str, Any], where: str) -> tuple[int, int] | None:
    for width, height in (("image_width", "image_height"), ("Image_Width", "Image_Height"), ("width", "height")):
        if values.get(width) is not None and values.get(height) is not None:
            return image_size([values[height], values[width]], f"{where}: {height}, {width}")
    return None
