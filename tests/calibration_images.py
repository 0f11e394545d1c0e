"""What cameras of either projection see of a calibration target, found exactly or with noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from nerif.geometry import Camera, Plane
from nerif.imaging.calibration.bundle import Pose
from nerif.imaging.calibration.targets import CalibrationTarget, Detection, TargetDetections
from nerif.simulation.experiment import background_poses, place, target_poses
from nerif.simulation.experiment_settings import Sensor
from nerif.simulation.rendering import render


def camera_at_origin(distortion: Sequence[float] = (0.0,) * 5) -> Camera:
    """A camera that looks along z."""
    f64 = torch.float64
    return Camera(
        intrinsics=torch.tensor([[1500.0, 0, 163], [0, 1490.0, 118], [0, 0, 1]], dtype=f64),
        rotation=torch.eye(3, dtype=f64),
        translation=torch.zeros(3, dtype=f64),
        image_size=(240, 320),
        background=Plane(torch.tensor([0.0, 0, -1], dtype=f64), -900.0),
        distortion=torch.tensor(distortion, dtype=f64),
    )


def imaged(
    target: CalibrationTarget, camera: Camera, angles: tuple[float, float, float], bits: int = 12,
    filters: np.ndarray | float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """An image of the target 360 mm before the camera, through filters of its pixels, and where its points are."""
    pose = Pose(Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), np.array([-2.0, 1.5, 360.0]))
    light = np.asarray(render(camera, place(target, pose, camera)))
    image = Sensor(bits=bits).expose(torch.from_numpy(light * filters), seed=1)
    return image, camera.project(torch.from_numpy(pose.apply(target.points))).numpy()


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
