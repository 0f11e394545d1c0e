"""Cameras of kalibr's camchain.yaml: a chain of poses, each relative to the camera before, in m.

cam1:
  camera_model: pinhole
  intrinsics: [fx, fy, cx, cy]                      # px
  distortion_model: radtan
  distortion_coeffs: [k1, k2, p1, p2]
  resolution: [width, height]                       # px
  T_cn_cnm1: [[r, r, r, t], ..., [0, 0, 0, 1]]      # x_cam1 = T x_cam0, m

Source: kalibr's documentation, Yaml formats.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera, check_model, flat, numbers

__all__ = ["is_kalibr", "read_kalibr"]

CAMERA = re.compile(r"cam(\d+)")


def is_kalibr(values: Mapping[str, Any]) -> bool:
    """Return whether the entries of a file are those of a camchain."""
    return any(CAMERA.fullmatch(k) and isinstance(v, dict) and "intrinsics" in v for k, v in values.items())


def read_kalibr(
    files: Mapping[Path, dict[str, Any]], beside: Callable[[], object], say: Callable[[str], None]
) -> list[CalibratedCamera]:  # fmt: skip
    """Read a camchain of two cameras or more, in m; the first one is the world."""
    if len(files) > 1:
        names = ", ".join(file.name for file in files)
        raise InputError(f"expected one camchain, got {names}; give one of them", field=next(iter(files)).parent)
    ((path, values),) = files.items()
    chain = sorted((key for key in values if CAMERA.fullmatch(key)), key=lambda key: int(key.removeprefix("cam")))
    if len(chain) < 2:
        raise InputError(
            f"no pose; expected the chain of two cameras or more (T_cn_cnm1), got {chain[0]} alone; calibrate all "
            "cameras together",
            field=path,
        )
    pose = np.eye(4)
    cameras: list[CalibratedCamera] = []
    for name in chain:
        where, entries = f"{path}: {name}", values[name]
        for key in ("camera_model", "intrinsics", "distortion_coeffs", *(["T_cn_cnm1"] if cameras else [])):
            if not isinstance(entries, dict) or key not in entries:
                raise InputError(f"'{key}' is missing", field=where)
        check_model(entries["camera_model"], f"{where}: camera_model")
        coefficients = flat(entries["distortion_coeffs"], f"{where}: distortion_coeffs")
        if entries.get("distortion_model") != "none":
            check_model(entries.get("distortion_model"), f"{where}: distortion_model")
        fx, fy, cx, cy = _numbers(entries, "intrinsics", 4, where)
        if cameras:
            pose = _numbers(entries, "T_cn_cnm1", 16, where).reshape(4, 4) @ pose
        size = entries.get("resolution")
        cameras.append(
            CalibratedCamera.from_values(
                where, name, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pose[:3, :3], pose[:3, 3], coefficients,
                None if size is None else flat(size, f"{where}: resolution")[::-1].copy(),
            )
        )  # fmt: skip
    return cameras


def _numbers(entries: Mapping[str, Any], key: str, count: int, where: str) -> np.ndarray:
    """Return the numbers of an entry in one row; YAML 1.1 reads some, such as 1e-05, as texts."""
    return numbers(flat(entries[key], f"{where}: {key}"), (count,), f"{where}: {key}").numpy()
