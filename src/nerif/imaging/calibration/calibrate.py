"""From target images of several cameras to intrinsics, poses in one world frame, and background planes.

1. a first guess of all poses in the world, which is the frame of one target pose (first_guess.py);
2. bundle adjustment of everything (bundle.py), after which images that do not fit are left out, once;
3. a plane through each camera's targets that lay on its background, and a look at what came out
   (result.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import FACES, InputError
from nerif.common.files import check_known
from nerif.geometry import Projection, projection_named
from nerif.imaging.calibration.bundle import COEFFICIENTS, Bundle, Observation, Pose, adjust, crossing
from nerif.imaging.calibration.first_guess import first_guess, mirrored
from nerif.imaging.calibration.result import Calibration
from nerif.imaging.calibration.target_images import find_targets, pose_names
from nerif.imaging.calibration.targets import CalibrationTarget, ViewImages
from nerif.imaging.readers.views import View

__all__ = ["CalibrationSettings", "calibrate", "calibrate_views", "target_images"]

ON_A_SIDE = 0.1  # of a unit vector towards a camera: what it has to be more on one side than its mirror image
FREE_OR_LAID = ("target", "background")
GUESSED_NOISE, LEAST_NOISE = 0.1, 1e-4  # px, of a point: before it is known, and what nothing is better than


@dataclass(frozen=True)
class CalibrationSettings:
    """How cameras are calibrated."""

    projection: str = "perspective"
    """Of all cameras: perspective, or telecentric."""
    distortion: tuple[str, ...] = ("k1", "k2", "p1", "p2")
    """Coefficients to find, out of k1 k2 p1 p2 k3; the others are 0."""
    world: str = ""
    """Name of the target pose that is the world frame; the one that most cameras see if not given."""
    axes: tuple[str, str, str] = ("x+", "z+", "y-")
    """World x, y, z along axes of the target in that pose (x right, y down, z into the page): z is up by default."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Middle of the target in that pose, in world coordinates, mm."""
    max_error: float = 1.0
    """Largest rms reprojection error to accept, px."""
    side: tuple[str, str] | None = None
    """Of telecentric cameras: one view and the side of the world that it stands on, such as cam1 x+. The images of
    flat targets fit a rig and its mirror image alike."""

    def __post_init__(self) -> None:
        for name in self.distortion:
            if name not in COEFFICIENTS:
                raise InputError(
                    f"expected coefficients out of {' '.join(COEFFICIENTS)}, got '{name}'", field="distortion"
                )
        if not self.max_error > 0:
            raise InputError(f"expected a positive number of px, got {self.max_error}", field="max_error")
        if not self.kind.shows_depth and (self.side is None or self.side[1] not in FACES):
            raise InputError(
                f"expected a view and the side of the world that it stands on ({' '.join(FACES)}), such as "
                "cam1 x+, since images of flat targets fit a telecentric rig and its mirror image alike; got "
                f"{self.side}",
                field="side",
            )
        if not np.isclose(np.linalg.det(self.rotation), 1):
            raise InputError(
                f"expected three different axes of the target that make a right-handed world, such as x+ z+ y-, "
                f"got {' '.join(self.axes)}",
                field="axes",
            )

    def check_names(self, names: Sequence[str]) -> None:
        """Refuse a view that is not among those of these names."""
        if self.side is not None and self.side[0] not in names:
            raise InputError(f"expected one of {', '.join(names)}, got '{self.side[0]}'", field="side")

    @property
    def kind(self) -> Projection:
        """The projection of the cameras."""
        return projection_named(self.projection)

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """From the target's axes to the world's."""
        unit = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
        rows = [np.array(unit.get(a.rstrip("+-"), (0, 0, 0))) * (-1 if a.endswith("-") else 1) for a in self.axes]
        return np.array(rows, dtype=np.float64)


def calibrate_views(
    views: Sequence[View],
    target: CalibrationTarget,
    settings: CalibrationSettings = CalibrationSettings(),
    background_scale: float = 1.0,
    background_distance: float | None = None,
    say: Callable[[str], None] = lambda text: None,
    on_image: Callable[[], None] = lambda: None,
    leave_out: Sequence[str] = (),
) -> Calibration:
    """Find a target in the images of all views, and calibrate their cameras by it.

    Parameters
    ----------
    views : of find_views
    target : free in space, in the images VIEW/target
    settings : of the calibration
    background_scale : the target laid on the backgrounds is the same one printed this many times larger
    background_distance : as `calibrate`
    say : told of images that are of no use
    on_image : called after each image (`target_images` of them in all)
    leave_out : images that are not used, such as cam1/target/7 or cam1/background/2: view, source and pose

    Raises
    ------
    InputError
        If images are missing, one to be left out is none of them, or as `calibrate`.
    """
    laid = target.scaled(background_scale)
    settings.check_names([view.name for view in views])
    target_images(views)  # what is missing is said before the long work
    there = [f"{v.name}/{s}/{p}" for v in views for s in FREE_OR_LAID if s in v.sources for p in pose_names(v.open(s))]
    check_known(leave_out, there, "leave_out", "image")
    found = [find_targets(view, target, say, on_image, laid).without(leave_out) for view in views]
    return calibrate(found, settings, background_distance)


def target_images(views: Sequence[View]) -> int:
    """Return how many images of the target, in space and on the background, the views have."""
    return sum(len(view.open(s)) for view in views for s in FREE_OR_LAID if s in ("target", *view.sources))


def calibrate(
    views: Sequence[ViewImages],
    settings: CalibrationSettings = CalibrationSettings(),
    background_distance: float | None = None,
) -> Calibration:
    """Calibrate all cameras from what was found in their images.

    Parameters
    ----------
    views : what was found. Images of the target on the background say where it is unless the camera is telecentric
    settings : of the calibration
    background_distance : of backgrounds without such images: across the optical axis, so far behind the origin, mm

    Raises
    ------
    InputError
        If a camera has too few poses or is not tied to the others by shared ones, if guesses contradict one another
        (a mirrored image, images of different poses under one name), or if the result can't be right.
    """
    if not views:
        raise InputError("no view was found; expected one folder of target images a camera", field="calibrate")
    names = [v.name for v in views]
    settings.check_names(names)
    if not settings.kind.shows_depth:
        views = [replace(v, background={}) for v in views]
    bundle, observations = first_guess(views, settings.distortion, settings.world, settings.kind)
    bundle, _ = adjust(bundle, observations, GUESSED_NOISE)
    keep = _fitting(bundle, observations)
    kept = [o for o, k in zip(observations, keep, strict=True) if k]
    _check_poses(views, kept)
    noise = float(np.median([bundle.rms(o) for o in kept])) / np.sqrt(2)
    bundle, covariance = adjust(bundle, kept, max(noise, LEAST_NOISE))
    bundle, covariance = _to_world(_on_the_right_side(bundle, settings, names), covariance, settings)
    result = Calibration.of(names, bundle, covariance, observations, keep, background_distance)
    result.check(settings.max_error)
    return result


def _fitting(bundle: Bundle, observations: Sequence[Observation]) -> list[bool]:
    """Which images fit: their rms is within five times the median of all, or a tenth of a pixel."""
    rms = [bundle.rms(o) for o in observations]
    limit = max(5 * float(np.median(rms)), 0.1)
    return [r <= limit for r in rms]


def _check_poses(views: Sequence[ViewImages], kept: Sequence[Observation]) -> None:
    """Every camera has to keep half its images, or the fault is not in single images."""
    for i, view in enumerate(views):
        left = sum(o.camera == i for o in kept)
        whole = len(view.poses) + len(view.background)
        if left < max(3, whole / 2):
            raise InputError(
                f"{whole - left} of its {whole} target images do not fit together with the other "
                "cameras; is it mirrored (flip), did it move, or do its images show other poses than their names say?",
                field=f"view '{view.name}'",
            )


def _on_the_right_side(bundle: Bundle, settings: CalibrationSettings, names: Sequence[str]) -> Bundle:
    """The bundle, or its mirror image if only that has the view that `side` names on its side."""
    if settings.side is None or bundle.projection.shows_depth:
        return bundle
    name, face = settings.side
    axis, sign = settings.rotation["xyz".index(face[0])], 1 if face[1] == "+" else -1
    other = mirrored(bundle)
    here, there = (-sign * float(axis @ b.cameras[names.index(name)].rotation[2]) for b in (bundle, other))
    if abs(here - there) < ON_A_SIDE:
        raise InputError(
            f"view '{name}' stands as much on the side {face} in the mirror image of the rig, so this does not "
            "tell the two apart; name another view or axis",
            field="side",
        )
    return bundle if here > there else other


def _to_world(
    bundle: Bundle, covariance: Float[np.ndarray, "camera 15 15"], settings: CalibrationSettings
) -> tuple[Bundle, Float[np.ndarray, "camera 15 15"]]:
    """From the frame of the fixed target to the world that was asked for; a depth that does not show is 0 there."""
    move, shows = Pose(settings.rotation, np.array(settings.origin)), np.diag([1, 1, bundle.projection.shows_depth])
    cameras, moved = [], []
    for camera, block in zip(bundle.cameras, covariance, strict=True):
        there = camera @ move.inverse
        follows = np.eye(len(block))  # t' = t + R m, which turns with the camera
        follows[-3:, -6:-3] = -shows @ crossing(there.translation - camera.translation)
        follows[-3:, -3:] = shows
        cameras.append(replace(there, translation=shows @ there.translation))
        moved.append(follows @ block @ follows.T)
    poses = tuple(move @ p for p in bundle.poses)
    return replace(bundle, cameras=tuple(cameras), poses=poses), np.stack(moved)
