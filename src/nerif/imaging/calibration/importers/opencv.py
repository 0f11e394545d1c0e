"""Cameras of OpenCV's FileStorage, YAML or XML: one per file, several, or a stereo pair."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.files import reading
from nerif.data.cameras_file import CalibratedCamera, check_distortion, check_model, check_program, flat

__all__ = ["read_opencv", "read_storage"]

KEYS = {
    "intrinsics": ("camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsics", "K", "M"),
    "distortion": ("distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "dist_coeffs", "dist_coeff",
                   "distortion", "dist", "kc", "D"),
    "rotation": ("rotation_matrix", "rotation", "rvec", "R", "om"),
    "translation": ("translation_vector", "translation", "tvec", "T", "t"),
}  # fmt: skip
SIZES = (("image_height", "image_width"), ("Image_Height", "Image_Width"), ("height", "width"))
MODELS = ("camera_model", "distortion_model", "calibration_model")
OTHER_MODELS = ("fisheye_model", "xi")  # a flag of OpenCV's calibration program; a parameter of omnidirectional cameras
INTRINSICS, EXTRINSICS = "intrinsics", "extrinsics"
PARTNER = {INTRINSICS: EXTRINSICS, EXTRINSICS: INTRINSICS}
CONTENT = {INTRINSICS: "the camera matrices M1, D1, M2, D2", EXTRINSICS: "the pose R, T of the second camera"}
"""Content of the two files of a stereo pair; R1, R2, P1, P2 beside the pose are the rectification, and not read."""


def read_opencv(
    files: Mapping[Path, dict[str, Any]], beside: Callable[[], dict[Path, dict[str, Any]]], say: Callable[[str], None]
) -> list[CalibratedCamera]:
    """Read the cameras of a file, or of several with one camera each, named by the file.

    `beside` returns the other files in the folder, for the second one of a stereo pair, which is reported.
    """
    cameras: dict[str, CalibratedCamera] = {}
    origins: dict[str, Path] = {}
    for file, values in _joined(files, beside, say).items():
        content = _cameras(file, values)
        for camera in [replace(content[0], name=file.stem)] if len(content) == 1 < len(files) else content:
            if camera.name in cameras:
                raise InputError(
                    f"expected cameras of different names, got '{camera.name}' here and in "
                    f"{origins[camera.name].name}; rename one, or remove its file from the folder",
                    field=file,
                )
            cameras[camera.name], origins[camera.name] = camera, file
    return list(cameras.values())


def _joined(
    files: Mapping[Path, dict[str, Any]], beside: Callable[[], dict[Path, dict[str, Any]]], say: Callable[[str], None]
) -> dict[Path, dict[str, Any]]:  # fmt: skip
    """Return the files with the two of a stereo pair as one: camera matrices, and the pose of the second camera."""
    halves = [path for path, values in files.items() if _half(values)]
    if not halves:
        return dict(files)
    everything = {**files, **beside()}
    joined = {path: values for path, values in files.items() if path not in halves}
    for path in halves:
        half = _half(everything[path])
        partners = [p for p, values in everything.items() if _half(values) == PARTNER[half]]
        if len(partners) != 1:
            names = ", ".join(p.name for p in partners) or "none"
            raise InputError(
                f"holds {CONTENT[half]}, but not {CONTENT[PARTNER[half]]}, which OpenCV's program stereo_calib writes "
                f"to {PARTNER[half]}.yml; expected that file beside it, got {names}",
                field=path,
            )
        first, second = (path, partners[0]) if half == INTRINSICS else (partners[0], path)
        if first not in joined:
            say(f"{first.name}: read together with {second.name}")
        joined[first] = everything[second] | everything[first]
    return joined


def _half(values: dict[str, Any]) -> str:
    """Return which of the two files of a stereo pair this is, empty if neither."""
    matrices = {suffix for suffix in ("", "1", "2") if _key(values, "intrinsics", suffix)}
    shifts = any(_key(values, "translation", suffix) for suffix in ("", "1", "2"))
    if {"1", "2"} <= matrices and not shifts:
        return INTRINSICS
    pose = _key(values, "rotation") and _key(values, "translation")
    return EXTRINSICS if pose and not matrices and not _key(values, "distortion") else ""


def _key(values: dict[str, Any], quantity: str, suffix: str = "") -> str:
    """Return the key of a quantity, empty if there is none."""
    return next((word + suffix for word in KEYS[quantity] if values.get(word + suffix) is not None), "")


def _cameras(path: Path, values: dict[str, Any]) -> list[CalibratedCamera]:
    """Return one camera, several with numbered keys (K0, D0, R0, T0, K1 ...), or a stereo pair with one R and T."""
    import cv2

    for key in MODELS:
        if values.get(key) is not None:
            check_model(values[key], f"{path}: {key}")
    for key in OTHER_MODELS:
        if np.any(values.get(key)):
            check_model(key, str(path))

    def find(quantity: str, suffix: str) -> Any:
        return values.get(_key(values, quantity, suffix))

    words = "|".join(KEYS["intrinsics"])
    numbered = (re.fullmatch(rf"(?:{words})(_?\d+|)", key) for key, value in values.items() if value is not None)
    suffixes = sorted({match[1] for match in numbered if match}, key=lambda s: int(s.strip("_") or -1))
    if not suffixes:
        raise InputError(
            f"no camera matrix; expected {', '.join(KEYS['intrinsics'])} (with a number appended for "
            f"several cameras), got {', '.join(values)}",
            field=path,
        )
    check_distortion(
        values, {*(_key(values, "distortion", s) for s in suffixes), *MODELS}, KEYS["distortion"], str(path)
    )
    sizes = ([values.get(key) for key in pair] for pair in SIZES)
    size = next((pair for pair in sizes if all(x is not None for x in pair)), None)
    # R1 and R2 may be stereoRectify's
    stereo = len(suffixes) == 2 and "" not in suffixes and find("translation", suffixes[1]) is None
    cameras = []
    rotation: Any
    translation: Any
    for suffix in suffixes:
        where = f"{path}: camera {suffix or 1}"
        if stereo and suffix == suffixes[0]:  # the first camera is the world, x2 = R x1 + T
            rotation, translation = np.eye(3), np.zeros(3)
        else:
            rotation, translation = (find(q, "" if stereo else suffix) for q in ("rotation", "translation"))
        if rotation is None or translation is None:
            raise InputError(
                f"no pose; expected {', '.join(KEYS['rotation'])} and {', '.join(KEYS['translation'])} "
                f"beside the camera matrix, got {', '.join(values)}",
                field=where,
            )
        if np.size(rotation) == 3:
            if np.linalg.norm(flat(rotation, f"{where}: rotation")) > 2 * np.pi:
                raise InputError(f"expected a rotation vector in rad, got {np.ravel(rotation)}", field=where)
            rotation = cv2.Rodrigues(flat(rotation, f"{where}: rotation"))[0]
        name = f"cam{suffix.strip('_')}" if suffix else path.stem
        intrinsics, distortion = find("intrinsics", suffix), find("distortion", suffix)
        cameras.append(CalibratedCamera.from_values(where, name, intrinsics, rotation, translation, distortion, size))
    return cameras


def read_storage(path: Path) -> dict[str, Any]:
    """Read all entries: matrices, sequences as arrays of objects, texts and numbers; None for anything else."""
    import cv2

    with reading("not a file of OpenCV's FileStorage, ROS or kalibr, or empty", path):
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        keys = storage.root().keys() if storage.isOpened() else []
        if not keys:
            raise ValueError("no entries")
    check_program(keys, str(path))
    values: dict[str, Any] = {}
    for key in keys:
        with reading(f"{key}: expected a matrix as FileStorage writes it", path):
            node = storage.getNode(key)
            value = node.mat() if node.isMap() else _plain(node)
        values[key] = np.asarray(value, dtype=object) if isinstance(value, list) else value  # rows may differ in length
    storage.release()
    return values


def _plain(node: Any) -> Any:
    if node.isSeq():
        return [_plain(node.at(i)) for i in range(node.size())]
    if node.isString():
        return node.string()
    return node.real() if node.isReal() or node.isInt() else None
