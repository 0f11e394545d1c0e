"""Calibration of cameras from target images: intrinsics, poses in one world frame, and background planes.

1. initial poses in the frame of one target pose, which defines the world (first_guess.py);
2. bundle adjustment (bundle.py), repeated once without the images that do not fit;
3. a plane through the targets on each camera's background, and checks of the result (result.py).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.common.files import check_known
from nerif.geometry.interfaces import Interface
from nerif.imaging.calibration.bundle import CameraBundle, Pose, TargetObservation, adjust, crossing
from nerif.imaging.calibration.calibration_settings import CalibrationSettings
from nerif.imaging.calibration.first_guess import first_guess, mirror
from nerif.imaging.calibration.result import Calibration
from nerif.imaging.calibration.target_images import find_targets, pose_names
from nerif.imaging.calibration.targets import CalibrationTarget, TargetDetections
from nerif.imaging.readers.views import View

__all__ = ["calibrate", "calibrate_views", "target_images"]

MIN_SIDE_DIFFERENCE = 0.1  # between a rig and its mirror image, of the component of a camera's direction along `side`
SOURCES = ("target", "background")
STANDARD = CalibrationSettings()
INITIAL_NOISE, MIN_NOISE = 0.1, 1e-4  # px, of a point: before it is estimated; lower bound of the estimate


def calibrate_views(
    views: Sequence[View],
    target: CalibrationTarget,
    settings: CalibrationSettings = STANDARD,
    background_scale: float = 1.0,
    background_distance: float | None = None,
    say: Callable[[str], None] = lambda text: None,
    on_image: Callable[[], None] = lambda: None,
    leave_out: Sequence[str] = (),
    interfaces: Mapping[str, tuple[Interface, ...]] = {},
) -> Calibration:  # fmt: skip
    """Detect a target in the images of all views, and calibrate their cameras.

    Parameters
    ----------
    target : free in space, in the images VIEW/target
    background_scale : size of the target on the backgrounds over that of `target`
    background_distance : as in `calibrate`
    say : receives a note on each image without a detection
    on_image : called after each of the `target_images`
    interfaces : as in `calibrate`
    leave_out : images not to use, such as cam1/target/7 or cam1/background/2: view, source and pose
    """
    background_target = target.scaled(background_scale)
    settings.check_names([view.name for view in views])
    _check_perspective(settings, interfaces)
    target_images(views)  # reports missing images before the long work
    images = [f"{v.name}/{s}/{p}" for v in views for s in SOURCES if s in v.sources for p in pose_names(v.open(s))]
    check_known(leave_out, images, "leave_out", "image")
    detections = [find_targets(view, target, say, on_image, background_target).without(leave_out) for view in views]
    return calibrate(detections, settings, background_distance, interfaces)


def target_images(views: Sequence[View]) -> int:
    """Return the number of images of the target, in space and on the background."""
    return sum(len(view.open(s)) for view in views for s in SOURCES if s in ("target", *view.sources))


def calibrate(
    views: Sequence[TargetDetections],
    settings: CalibrationSettings = STANDARD,
    background_distance: float | None = None,
    interfaces: Mapping[str, tuple[Interface, ...]] = {},
) -> Calibration:  # fmt: skip
    """Calibrate all cameras from the detections in their images.

    Refused are cameras with too few poses or none in common with the others, initial poses that contradict one another
    (a mirrored image, different poses under one name), and results that are impossible.

    Parameters
    ----------
    background_distance : of backgrounds without images of a target on them (telecentric cameras: of all), from the
        origin and across the optical axis, mm; None: unknown planes
    interfaces : windows through which cameras saw the targets, by the cameras' names, in the world of the settings
    """
    if not views:
        raise InputError("expected one folder of target images per camera, got no view", field="calibrate")
    names = [v.name for v in views]
    settings.check_names(names)
    _check_perspective(settings, interfaces)
    if not settings.kind.shows_depth:
        views = [replace(v, background={}) for v in views]
    bundle, observations = first_guess(views, settings.coefficients, settings.world, settings.kind)
    bundle, _ = adjust(bundle, observations, INITIAL_NOISE)
    if interfaces:
        bundle = _behind(bundle, interfaces, names, settings)
        _check_windows(bundle, observations, names)
        bundle, _ = adjust(bundle, observations, INITIAL_NOISE)
        _check_windows(bundle, observations, names)
    fits = _fits(bundle, observations)
    consistent = [o for o, fit in zip(observations, fits, strict=True) if fit]
    _check_counts(views, consistent)
    noise = float(np.median([bundle.rms(o) for o in consistent])) / np.sqrt(2)
    bundle, covariance = adjust(bundle, consistent, max(noise, MIN_NOISE))
    bundle, covariance = _to_world(_on_side(bundle, settings, names), covariance, settings)
    bundle = replace(bundle, interfaces=tuple(interfaces.get(name, ()) for name in names) if interfaces else ())
    result = Calibration.of(names, bundle, covariance, observations, fits, background_distance)
    result.check(settings.max_error)
    return result


def _check_perspective(settings: CalibrationSettings, interfaces: Mapping[str, tuple[Interface, ...]]) -> None:
    if interfaces and not settings.kind.shows_depth:
        raise InputError(
            f"expected perspective cameras for windows in front of targets, got {settings.projection}",
            field="interfaces",
        )


def _check_windows(bundle: CameraBundle, observations: Sequence[TargetObservation], names: Sequence[str]) -> None:
    """Refuse windows that are not between a camera and its targets."""
    for o in observations:
        if not bundle.crosses_windows(o):
            source = "background" if o.on_background else "target"
            raise InputError(
                f"expected planes between the camera and its targets, in order from the camera, got others: rays to "
                f"{names[o.camera]}/{source}/{o.image} do not cross them so; check normal, offset (mm) and order, in "
                "the world frame",
                field=f"interfaces of view '{names[o.camera]}'",
            )


def _behind(
    bundle: CameraBundle, interfaces: Mapping[str, tuple[Interface, ...]], names: Sequence[str],
    settings: CalibrationSettings,
) -> CameraBundle:  # fmt: skip
    """The bundle with windows, in the frame of the fixed target, which the result moves to the world."""
    rotation, origin = torch.from_numpy(settings.rotation), torch.tensor(settings.origin, dtype=torch.float64)
    moved = tuple(
        tuple(
            Interface(rotation.T @ plane.normal, plane.offset - float(plane.normal @ origin), plane.index)
            for plane in interfaces.get(name, ())
        )
        for name in names
    )
    return replace(bundle, interfaces=moved)


def _fits(bundle: CameraBundle, observations: Sequence[TargetObservation]) -> list[bool]:
    """Which images have an rms of at most 5 times the median of all, or 0.1 px."""
    rms = [bundle.rms(o) for o in observations]
    limit = max(5 * float(np.median(rms)), 0.1)
    return [r <= limit for r in rms]


def _check_counts(views: Sequence[TargetDetections], consistent: Sequence[TargetObservation]) -> None:
    """Refuse a camera of which more than half the images do not fit: then the fault is not in single images."""
    for i, view in enumerate(views):
        count = sum(o.camera == i for o in consistent)
        total = len(view.poses) + len(view.background)
        if count < max(3, total / 2):
            raise InputError(
                f"{total - count} of its {total} target images do not fit together with the other "
                "cameras; is it mirrored (flip), did it move, or do its images show other poses than their names say?",
                field=f"view '{view.name}'",
            )


def _on_side(bundle: CameraBundle, settings: CalibrationSettings, names: Sequence[str]) -> CameraBundle:
    """The bundle, or its mirror image if only that has the view of `side` on its side."""
    if settings.side is None or bundle.projection.shows_depth:
        return bundle
    name, face = settings.side
    axis, sign = settings.rotation["xyz".index(face[0])], 1 if face[1] == "+" else -1
    other = mirror(bundle)
    here, there = (-sign * float(axis @ b.cameras[names.index(name)].rotation[2]) for b in (bundle, other))
    if abs(here - there) < MIN_SIDE_DIFFERENCE:
        raise InputError(
            f"expected a side that distinguishes the rig from its mirror image, but view '{name}' stands on the side "
            f"{face} in both; name another view or axis",
            field="side",
        )
    return bundle if here > there else other


def _to_world(
    bundle: CameraBundle, covariance: Float[np.ndarray, "camera 17 17"], settings: CalibrationSettings
) -> tuple[CameraBundle, Float[np.ndarray, "camera 17 17"]]:
    """From the frame of the fixed target to the world of the settings; an unconstrained depth is 0 there."""
    move, shows = Pose(settings.rotation, np.array(settings.origin)), np.diag([1, 1, bundle.projection.shows_depth])
    cameras, blocks = [], []
    for camera, block in zip(bundle.cameras, covariance, strict=True):
        pose = camera @ move.inverse
        jacobian = np.eye(len(block))  # t' = t + R m, which turns with the camera
        jacobian[-3:, -6:-3] = -shows @ crossing(pose.translation - camera.translation)
        jacobian[-3:, -3:] = shows
        cameras.append(replace(pose, translation=shows @ pose.translation))
        blocks.append(jacobian @ block @ jacobian.T)
    poses = tuple(move @ p for p in bundle.poses)
    return replace(bundle, cameras=tuple(cameras), poses=poses), np.stack(blocks)
