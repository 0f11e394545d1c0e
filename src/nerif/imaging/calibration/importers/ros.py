"""Stereo cameras of ROS: one camera_info file per camera, as camera_calibration writes it (left.yaml, right.yaml).

camera_matrix             K (3, 3), px                distortion_model          plumb_bob or rational_polynomial
rectification_matrix      R (3, 3)                    distortion_coefficients   k1 k2 p1 p2 k3 ...
projection_matrix         P (3, 4) of the rectified images

A file has no pose. The rectified cameras of a pair have one orientation, and P holds their distance,

    x_rectified = R x_cam,    x_rectified of camera i = x_rectified of the first + (P_14 / P_11, P_24 / P_22, 0),   m

so that in the frame of the first camera, x_i = R_i^T (R_1 x_1 + shift_i).

Source: ROS, sensor_msgs/CameraInfo.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera, check_model, flat

__all__ = ["is_ros", "read_ros"]

PAIR = "the two files of a stereo calibration, left.yaml and right.yaml, in one folder"


def is_ros(values: Mapping[str, Any]) -> bool:
    """Return whether the entries of a file are those of a camera_info."""
    matrix = values.get("camera_matrix")
    return isinstance(matrix, dict) and "data" in matrix and {"distortion_model", "image_width"} <= values.keys()


def read_ros(
    files: Mapping[Path, dict[str, Any]], beside: Callable[[], dict[Path, dict[str, Any]]], say: Callable[[str], None]
) -> list[CalibratedCamera]:
    """Read a stereo pair, or more cameras of one rectification, in m; the camera without a shift is the world."""
    path = next(iter(files))
    if len(files) == 1:
        others = beside()
        if len(others) != 1:
            names = ", ".join(p.name for p in others) or "no other"
            raise InputError(f"no pose in a camera_info of ROS; expected {PAIR}; beside it: {names}", field=path)
        files = {**files, **others}
        say(f"{path.name}: read together with {next(iter(others)).name}")
    shifts = {p: _shift(p, values) for p, values in files.items()}
    first = [p for p, shift in shifts.items() if not shift.any()]
    if len(first) != 1:
        names = ", ".join(p.name for p in first) or "none"
        raise InputError(
            f"expected one camera without a shift in projection_matrix, and others with one, got {names} without; "
            f"expected {PAIR}, calibrated together",
            field=path,
        )
    world = _matrix(files[first[0]], "rectification_matrix", (3, 3), str(first[0]))
    cameras = []
    for p in sorted(files, key=lambda p: p != first[0]):
        values, where = files[p], str(p)
        if values["distortion_model"] != "rational_polynomial":  # its coefficients after the fifth have to be 0
            check_model(values["distortion_model"], f"{where}: distortion_model")
        turn = _matrix(values, "rectification_matrix", (3, 3), where).T
        coefficients = values.get("distortion_coefficients", {})
        cameras.append(
            CalibratedCamera.from_values(
                where, p.stem, _matrix(values, "camera_matrix", (3, 3), where), turn @ world, turn @ shifts[p],
                coefficients.get("data") if isinstance(coefficients, dict) else coefficients,
                (values.get("image_height"), values["image_width"]),
            )
        )  # fmt: skip
    return cameras


def _matrix(values: Mapping[str, Any], key: str, shape: tuple[int, int], where: str) -> np.ndarray:
    """Return a matrix of a file, from its rows in one list."""
    data = values[key].get("data", []) if isinstance(values.get(key), dict) else []
    vector = flat(data, f"{where}: {key}")
    if vector.size != shape[0] * shape[1]:
        raise InputError(f"expected {shape[0]} x {shape[1]} numbers, got {vector.size}", field=f"{where}: {key}")
    return vector.reshape(shape)


def _shift(path: Path, values: Mapping[str, Any]) -> np.ndarray:
    """Shift of the rectified camera, m."""
    projection = _matrix(values, "projection_matrix", (3, 4), str(path))
    fx, fy = projection[0, 0], projection[1, 1]
    if not (fx > 0 and fy > 0):
        raise InputError(f"expected focal lengths above 0, got {fx} and {fy}", field=f"{path}: projection_matrix")
    return np.array([projection[0, 3] / fx, projection[1, 3] / fy, 0.0])
