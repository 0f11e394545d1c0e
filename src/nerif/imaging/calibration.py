"""From target pictures of several cameras to intrinsics, poses in one world frame, and background planes.

1. a first guess of all poses in the world, which is the frame of one target pose (first_guess.py);
2. bundle adjustment of everything (bundle.py), after which pictures that do not fit are left out, once;
3. a plane through each camera's targets that lay on its background, and a look at what came out
   (calibration_result.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from nerif.conventions import InputError
from nerif.imaging.bundle import COEFFICIENTS, Bundle, Observation, Pose, adjust
from nerif.imaging.calibration_result import Calibration
from nerif.imaging.first_guess import first_guess
from nerif.imaging.targets import CalibrationTarget, ViewPictures
from nerif.imaging.views import View, find_targets

__all__ = ["CalibrationSettings", "calibrate", "calibrate_views", "target_pictures"]

GUESSED_NOISE, LEAST_NOISE = 0.1, 1e-4  # px, of a point: before it is known, and what nothing is better than


@dataclass(frozen=True)
class CalibrationSettings:
    """How cameras are calibrated."""

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

    def __post_init__(self) -> None:
        for name in self.distortion:
            if name not in COEFFICIENTS:
                raise InputError(f"distortion: expected coefficients out of {' '.join(COEFFICIENTS)}, got '{name}'")
        if not self.max_error > 0:
            raise InputError(f"max_error: expected a positive number of px, got {self.max_error}")
        if not np.isclose(np.linalg.det(self.rotation), 1):
            raise InputError(
                f"axes: expected three different axes of the target that make a right-handed world, such as x+ z+ y-, "
                f"got {' '.join(self.axes)}"
            )

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
    say: Callable[[str], None] = lambda text: None,
    on_picture: Callable[[], None] = lambda: None,
) -> Calibration:
    """Find a target in the pictures of all views, and calibrate their cameras by it.

    Parameters
    ----------
    views : of find_views
    target : free in space, in the pictures VIEW/target
    settings : of the calibration
    background_scale : the target laid on the backgrounds is the same one printed this many times larger
    say : told of pictures that are of no use
    on_picture : called after each picture (`target_pictures` of them in all)

    Raises
    ------
    InputError
        If pictures are missing, or as `calibrate`.
    """
    laid = target.scaled(background_scale)
    target_pictures(views)  # what is missing is said before the long work
    return calibrate([find_targets(view, target, say, on_picture, laid) for view in views], settings)


def target_pictures(views: Sequence[View]) -> int:
    """Return how many pictures of the target, in space and on the background, the views have."""
    return sum(len(view.open(s)) for view in views for s in ("target", "background") if s in ("target", *view.sources))


def calibrate(views: Sequence[ViewPictures], settings: CalibrationSettings = CalibrationSettings()) -> Calibration:
    """Calibrate all cameras from what was found in their pictures.

    Raises
    ------
    InputError
        If a camera has too few poses or is not tied to the others by shared ones, if guesses contradict one another
        (a mirrored picture, pictures of different poses under one name), or if the result can't be right.
    """
    if not views:
        raise InputError("calibrate: no view was found; expected one folder of target pictures a camera")
    bundle, observations = first_guess(views, settings.distortion, settings.world)
    bundle, _ = adjust(bundle, observations, GUESSED_NOISE)
    keep = _fitting(bundle, observations)
    kept = [o for o, k in zip(observations, keep, strict=True) if k]
    _check_poses(views, kept)
    noise = float(np.median([bundle.rms(o) for o in kept])) / np.sqrt(2)
    bundle, sigma = adjust(bundle, kept, max(noise, LEAST_NOISE))
    bundle = _to_world(bundle, settings)
    result = Calibration.of([v.name for v in views], bundle, sigma, observations, keep)
    result.check(settings.max_error)
    return result


def _fitting(bundle: Bundle, observations: Sequence[Observation]) -> list[bool]:
    """Which pictures fit: their rms is within five times the median of all, or a tenth of a pixel."""
    rms = [bundle.rms(o) for o in observations]
    limit = max(5 * float(np.median(rms)), 0.1)
    return [r <= limit for r in rms]


def _check_poses(views: Sequence[ViewPictures], kept: Sequence[Observation]) -> None:
    """Every camera has to keep half its pictures, or the fault is not in single pictures."""
    for i, view in enumerate(views):
        left = sum(o.camera == i for o in kept)
        whole = len(view.poses) + len(view.background)
        if left < max(3, whole / 2):
            raise InputError(
                f"view '{view.name}': {whole - left} of its {whole} target pictures do not fit together with the other "
                "cameras; is it mirrored (flip), did it move, or do its pictures show other poses than their names say?"
            )


def _to_world(bundle: Bundle, settings: CalibrationSettings) -> Bundle:
    """From the frame of the fixed target to the world that was asked for."""
    move = Pose(settings.rotation, np.array(settings.origin))
    cameras = tuple(c @ move.inverse for c in bundle.cameras)
    return replace(bundle, cameras=cameras, poses=tuple(move @ p for p in bundle.poses))
