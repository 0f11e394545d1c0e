"""Calibration of a rendered rig.

Nine cameras with mild distortion, calibrated from target images alone: 640 x 512 px, lens of 50 mm on a 20 mm sensor,
700 mm to the middle, backgrounds 500 mm behind it. Each camera is turned by about a degree and displaced by
millimetres, its principal point is off by pixels and its background is oblique. Errors are taken against the rendered
rig, median and worst over the cameras: angle of rotation, largest component of the translation, position, largest
distance between the background planes in the image. Stated: standard deviations by `nerif calibrate`.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from benchmarks.runner import Settings
from nerif.geometry import Camera, Plane, Ring
from nerif.imaging.calibration.calibrate import calibrate
from nerif.imaging.calibration.calibration_settings import CalibrationSettings
from nerif.imaging.calibration.target_images import find_targets
from nerif.imaging.readers.views import find_views
from nerif.simulation.experiment import Experiment, background_scale, world_axes

ERRORS = {"rotation": "deg", "rotation_stated": "deg", "translation": "mm", "translation_stated": "mm",
"position": "mm",
          "plane": "mm"}  # fmt: skip
COLUMNS = {
    "cameras": "{views}", "pixels": "{pixels}", "poses": "{poses}", "images": "{images}", "rms [px]": "{rms:.4f}",
    **{f"{name.replace('_', ', ')} [{unit}]": f"{{{name}:.4f}}; {{{name}_worst:.4f}}" for name, unit in ERRORS.items()},
    "rendered [s]": "{rendered:.0f}", "targets [s]": "{detected:.0f}", "calibrated [s]": "{adjusted:.0f}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    yield {
        "views": 2 if quick else 9, "arc": 20.0 if quick else 170.0, "pixels": 320 if quick else 640, "sensor": 20.0,
        "poses": 8 if quick else 40, "backgrounds": 1 if quick else 5, "target": "charuco", "seed": 0,
    }  # fmt: skip


def rig(views: int, arc: float, pixels: int, sensor: float, seed: int) -> tuple[Camera, ...]:
    """Return cameras on a ring with random errors of pose, lens and background."""
    rng = np.random.default_rng(seed)
    ring = Ring(views=views, arc=(0.0, arc), pixel_pitch=sensor / pixels, image_size=(pixels * 4 // 5, pixels))

    def turn(sigma: float) -> torch.Tensor:
        return torch.from_numpy(Rotation.from_rotvec(rng.normal(0, sigma, 3)).as_matrix())

    cameras = []
    for camera in ring.cameras():
        rotation = turn(0.01) @ camera.rotation
        k = camera.intrinsics.clone()
        k[0, 2] += rng.normal(0, 0.005 * pixels)
        k[1, 2] += rng.normal(0, 0.005 * pixels)
        k[0, 0] *= 1 + rng.normal(0, 0.01)
        k[1, 1] = k[0, 0] * (1 + rng.normal(0, 0.001))
        changes: dict[str, Any] = {"rotation": rotation, "intrinsics": k}
        changes["translation"] = -rotation @ (camera.centre + torch.from_numpy(rng.normal(0, 5, 3)))
        changes["background"] = Plane(turn(0.03) @ camera.plane.normal, -500.0 + float(rng.normal(0, 5)))
        changes["distortion"] = torch.tensor([-0.15, 0.1, 0.0005, -0.0004, 0.0], dtype=torch.float64)
        cameras.append(replace(camera, **changes))
    return tuple(cameras)


def between_planes(camera: Camera, plane: Any) -> np.ndarray:
    """Return the distances (mm) of a plane from the true background over the image."""
    height, width = camera.image_size
    pixels = torch.cartesian_prod(torch.linspace(0, width - 1, 9), torch.linspace(0, height - 1, 9)).double()
    return camera.rays(pixels).end_points.numpy() @ np.array(plane.normal) - plane.offset


def measure(
    folder: Path, views: int, arc: float, pixels: int, sensor: float, poses: int, backgrounds: int, target: str,
    seed: int,
) -> dict[str, Any]:  # fmt: skip
    cameras = rig(views, arc, pixels, sensor, seed)
    experiment = Experiment(
        target=target, columns=12, rows=9, poses=poses, backgrounds=backgrounds, references=1, seed=seed
    )  # fmt: skip
    times = [time.perf_counter()]
    with tempfile.TemporaryDirectory(dir=folder) as images:
        experiment.write_targets(Path(images), cameras)
        times.append(time.perf_counter())
        board = experiment.target_for(cameras)
        large = board.scaled(background_scale(cameras))
        corners = [find_targets(view, board, print, on_background=large) for view in find_views(Path(images))]
        times.append(time.perf_counter())
        result = calibrate(corners, CalibrationSettings(world="0", axes=world_axes(cameras)))
        times.append(time.perf_counter())
    by_name = {c.name: c for c in cameras}
    errors: dict[str, list[float]] = {name: [] for name in ERRORS}
    for i, name in enumerate(result.names):
        camera, pose, plane = by_name[name], result.poses[i], result.backgrounds[i]
        rotation = Rotation.from_matrix(pose.rotation @ camera.rotation.numpy().T).magnitude()
        errors["rotation"].append(float(np.degrees(rotation)))
        errors["rotation_stated"].append(float(result.sigma_rotation[i]))
        errors["translation"].append(float(np.abs(pose.translation - camera.translation.numpy()).max()))
        errors["translation_stated"].append(float(result.sigma_translation[i]))
        errors["position"].append(float(np.linalg.norm(pose.inverse.translation - camera.centre.numpy())))
        errors["plane"].append(float(np.abs(between_planes(camera, plane)).max()))
    metrics = {name: float(np.median(values)) for name, values in errors.items()}
    metrics |= {f"{name}_worst": max(values) for name, values in errors.items()}
    metrics |= {"rms": result.rms(), "images": sum(e.used for e in result.errors)}
    return metrics | dict(zip(("rendered", "detected", "adjusted"), np.diff(times).tolist(), strict=True))
