"""Cameras of transforms.json, the file of nerfstudio, instant-ngp and Blender's NeRF scenes."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from nerif.common.conventions import InputError
from nerif.imaging.calibration.cameras_file import (
    CalibratedCamera,
    check_distortion,
    check_model,
    five,
    image_size,
    numbers,
)

__all__ = ["read_transforms"]

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
OTHER_MODELS = ("is_fisheye", "ftheta_p0", "latlong", "equirectangular")
"""Keys by which instant-ngp tells a camera that is not perspective; nerfstudio has camera_model."""


def read_transforms(path: Path) -> list[CalibratedCamera]:
    """Read a transforms.json.

    transform_matrix is camera to world with OpenGL's camera (x right, y up, z back); cx and cy count from the corner of
    the first pixel, whose centre is at 0.5 there. What stands in a frame wins over what stands above the frames.

    Raises
    ------
    InputError
        If it is none, or a camera is of another model than Brown's (a fisheye, say).
    """
    try:
        whole = json.loads(path.read_text())
    except (ValueError, UnicodeDecodeError):
        raise InputError("not a JSON file, or truncated", field=path) from None
    frames = whole.get("frames") if isinstance(whole, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise InputError("expected NeRF's transforms.json with a list 'frames', got none", field=path)
    cameras = [_camera({**whole, **frame}, i, f"{path}: frame {i}") for i, frame in enumerate(frames)]
    if len({c.name for c in cameras}) < len(cameras):
        return [replace(c, name=f"cam{i}") for i, c in enumerate(cameras)]
    return cameras


def _camera(given: dict[str, Any], i: int, where: str) -> CalibratedCamera:
    """One frame, with what stands above all of them."""
    given = {key: value for key, value in given.items() if value is not None}
    for model in (given.get("camera_model", "perspective"), *(k for k in OTHER_MODELS if given.get(k))):
        check_model(model, where)
    check_distortion(given, COEFFICIENTS, COEFFICIENTS, where)

    def number(key: str) -> float:
        return float(numbers(given[key], (), f"{where}: {key}"))

    size = image_size([given["h"], given["w"]], f"{where}: h, w") if "h" in given and "w" in given else None
    if "fl_x" in given:
        fx = number("fl_x")
    elif "camera_angle_x" in given and size is not None:
        fx = 0.5 * size[1] / math.tan(0.5 * number("camera_angle_x"))
    else:
        raise InputError("no focal length; expected fl_x, or camera_angle_x and w", field=where)
    fy = number("fl_y") if "fl_y" in given else fx
    if size is None and not {"cx", "cy"} <= set(given):
        raise InputError("no principal point; expected cx and cy, or w and h", field=where)
    height, width = size or (0, 0)
    cx = (number("cx") if "cx" in given else width / 2) - 0.5
    cy = (number("cy") if "cy" in given else height / 2) - 0.5
    to_world = numbers(given.get("transform_matrix", []), (4, 4), f"{where}: transform_matrix")
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))  # OpenGL's camera to OpenCV's
    rotation = flip @ to_world[:3, :3].T
    return CalibratedCamera(
        name=Path(str(given.get("file_path", f"cam{i}"))).stem,
        intrinsics=torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64),
        rotation=rotation,
        translation=-rotation @ to_world[:3, 3],
        distortion=five([number(k) if k in given else 0.0 for k in COEFFICIENTS], where),
        image_size=size,
    )
