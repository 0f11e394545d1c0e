"""What cameras of either projection see of a calibration target, found exactly or with noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from nerif.geometry import Camera
from nerif.imaging.calibration.bundle import Pose
from nerif.imaging.calibration.targets import CalibrationTarget, Detection, TargetDetections
from nerif.simulation.experiment import background_poses, target_poses


def detection(
    camera: Camera, target: CalibrationTarget, pose: Pose, noise: float, rng: np.random.Generator
) -> Detection:
    """The points of a target inside the image of a camera."""
    pixels = camera.project(torch.from_numpy(pose.apply(target.points))).numpy()
    height, width = camera.image_size
    inside = np.flatnonzero((pixels > 0).all(axis=1) & (pixels < (width - 1, height - 1)).all(axis=1))
    return Detection(inside, pixels[inside] + noise * rng.standard_normal((len(inside), 2)), target.points[inside])


def target_images(
    cameras: Sequence[Camera], target: CalibrationTarget, noise: float = 0.0, poses: int = 12, backgrounds: int = 3
) -> list[TargetDetections]:
    """What each camera sees of some poses in space and some on its background, noise in px."""
    rng = np.random.default_rng(7)
    free = target_poses(cameras, target, poses, seed=1)
    views = []
    for camera in cameras:
        facing = {}
        for j, pose in enumerate(free):
            if pose.rotation[:, 2] @ camera.sight(torch.from_numpy(pose.translation)).numpy() > 0.55:
                facing[str(j)] = detection(camera, target, pose, noise, rng)
        laid = {
            str(j): detection(camera, target, pose, noise, rng)
            for j, pose in enumerate(background_poses(camera, target, backgrounds) if backgrounds else [])
        }
        views.append(TargetDetections(camera.name, camera.image_size, facing, laid))
    return views
