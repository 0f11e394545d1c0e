"""Cameras of transforms.json, the file of nerfstudio, instant-ngp and Blender's NeRF scenes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from nerif.common.conventions import InputError
from nerif.common.files import read_json
from nerif.data.cameras_file import CalibratedCamera, check_distortion, check_model, check_program, numbers
from nerif.imaging.calibration.importers.names import named_by_images

__all__ = ["read_transforms"]

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
OTHER_MODELS = ("is_fisheye", "ftheta_p0", "latlong", "equirectangular")
"""instant-ngp's keys of cameras that are not perspective; nerfstudio's key is camera_model."""


def read_transforms(path: Path) -> list[CalibratedCamera]:
    """Read a transforms.json.

    transform_matrix is camera to world with OpenGL's camera axes (x right, y up, z back); cx and cy count from the
    corner of the first pixel, whose centre is at 0.5. Entries of a frame override those above the frames. The paths of
    the images name the cameras.
    """
    content = read_json(path)
    check_program(content if isinstance(content, dict) else (), str(path))
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise InputError("expected NeRF's transforms.json with a list 'frames', got none", field=path)
    cameras = [_camera({**content, **frame}, f"{path}: frame {i}") for i, frame in enumerate(frames)]
    return named_by_images(cameras, [str(frame.get("file_path") or "") for frame in frames])


def _camera(entries: dict[str, Any], where: str) -> CalibratedCamera:
    entries = {key: value for key, value in entries.items() if value is not None}
    for model in (entries.get("camera_model", "perspective"), *(k for k in OTHER_MODELS if entries.get(k))):
        check_model(model, where)
    check_distortion(entries, COEFFICIENTS, COEFFICIENTS, where)

    def number(key: str, default: float = 0.0) -> float:
        return float(numbers(entries.get(key, default), (), f"{where}: {key}"))

    size = (number("h"), number("w")) if {"h", "w"} <= entries.keys() else None
    if "fl_x" in entries:
        fx = number("fl_x")
    elif "camera_angle_x" in entries and size is not None:
        fx = 0.5 * size[1] / math.tan(0.5 * number("camera_angle_x"))
    else:
        raise InputError("no focal length; expected fl_x, or camera_angle_x and w", field=where)
    if size is None and not {"cx", "cy"} <= entries.keys():
        raise InputError("no principal point; expected cx and cy, or w and h", field=where)
    height, width = size or (0, 0)
    fy, cx, cy = number("fl_y", fx), number("cx", width / 2) - 0.5, number("cy", height / 2) - 0.5
    to_world = numbers(entries.get("transform_matrix", []), (4, 4), f"{where}: transform_matrix")
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)) @ to_world[:3, :3].T
    k, coefficients = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], [number(key) for key in COEFFICIENTS]
    return CalibratedCamera.from_values(where, "", k, rotation, -rotation @ to_world[:3, 3], coefficients, size)
