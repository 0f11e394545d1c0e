"""Cameras of COLMAP's model as text: cameras.txt and images.txt.

cameras.txt   CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]                      # px; the first pixel is centred on 0.5, 0.5
images.txt    IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME               # world to camera; then a line of points

Source: COLMAP's documentation, Output Format and Camera Models.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera
from nerif.imaging.calibration.importers.names import named_by_images

__all__ = ["COLMAP", "read_colmap"]

COLMAP = ("cameras.txt", "images.txt", "cameras.bin", "images.bin")
MODELS = {
    "SIMPLE_PINHOLE": "f cx cy", "PINHOLE": "fx fy cx cy", "SIMPLE_RADIAL": "f cx cy k1", "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2", "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}  # fmt: skip
"""Parameters of the models that nerif's distortion covers."""
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def read_colmap(path: Path) -> list[CalibratedCamera]:
    """Read the cameras of the images, named by their paths, from the folder of a model or one of its files."""
    folder = path if path.is_dir() else path.parent
    intrinsics, images = (folder / name for name in COLMAP[:2])
    if not (intrinsics.is_file() and images.is_file()):
        raise InputError(
            "expected a model of COLMAP with cameras.txt and images.txt; of .bin files: "
            "colmap model_converter --input_path . --output_path . --output_type TXT",
            field=path,
        )
    models = {row[0]: row[1:] for row in _rows(intrinsics)}
    cameras, names = [], []
    for row in _rows(images):
        try:
            pose = [float(number) for number in row[1:8]]
        except ValueError:
            pose = []
        if len(row) < 10 or len(pose) != 7 or row[8] not in models:
            got = " ".join(row)
            raise InputError(f"expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {got}", field=images)
        name = " ".join(row[9:])
        cameras.append(_camera(f"{intrinsics}: camera {row[8]}", models[row[8]], f"{images}: {name}", pose))
        names.append(name)
    return named_by_images(cameras, names)


def _rows(path: Path) -> list[list[str]]:
    """Return the words of the lines of a file without comments and points, which are groups of three numbers."""
    text = path.read_text(encoding="utf-8", errors="replace")
    lines = [line.split() for line in text.splitlines() if not line.startswith("#")]
    return [w for w in lines if len(w) % 3 or any(word.strip("-+.eE0123456789") for word in w)]


def _camera(where: str, model: list[str], image: str, pose: list[float]) -> CalibratedCamera:
    kind, *words = model
    if kind not in MODELS:
        raise InputError(
            f"expected one of {', '.join(MODELS)}, got {kind}; undistort the images (colmap image_undistorter)",
            field=where,
        )
    keys = MODELS[kind].split()
    try:
        width, height, *parameters = (float(word) for word in words)
        values = dict(zip(keys, parameters, strict=True))
    except ValueError:
        raise InputError(f"expected WIDTH HEIGHT {' '.join(keys)}, got {' '.join(words)}", field=where) from None
    fx, fy = (values.get(key, values.get("f")) for key in ("fx", "fy"))
    w, x, y, z = np.array(pose[:4]) / (np.linalg.norm(pose[:4]) or np.nan)
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    k = [[fx, 0, values["cx"] - 0.5], [0, fy, values["cy"] - 0.5], [0, 0, 1]]
    distortion = [values.get(key, 0.0) for key in DISTORTION]
    return CalibratedCamera.from_values(image, "", k, rotation, pose[4:], distortion, (height, width))
