"""From target pictures of several cameras to intrinsics, poses in one world frame, and background planes.

1. every camera alone: focal length and target poses, by OpenCV;
2. the graph of cameras and target poses that they share gives a first guess of all poses in the world, which is the
   frame of one target pose;
3. bundle adjustment of everything (bundle.py), after which pictures that do not fit are left out, once;
4. a plane through each camera's targets that lay on its background.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nerif.conventions import InputError
from nerif.imaging.bundle import Bundle, Observation, Pose, adjust
from nerif.imaging.targets import Detection

__all__ = ["Calibration", "CalibrationSettings", "ImageError", "Plan", "ViewPictures", "calibrate"]

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
GUESSED_NOISE, LEAST_NOISE = 0.1, 1e-4  # px, of a point: before it is known, and what nothing is better than
DISAGREE = (5.0, 0.1)  # degrees, and share of the distance, by which two guesses of a camera pose may differ


@dataclass(frozen=True)
class ViewPictures:
    """What was found in the pictures of one camera.

    Parameters
    ----------
    name : of the camera
    size : (height, width) of its pictures, px
    poses : the target free in space, by the name of the pose, which cameras share
    background : the target laid on the background, by the name of the picture
    """

    name: str
    size: tuple[int, int]
    poses: Mapping[str, Detection]
    background: Mapping[str, Detection]


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
        _axes(self.axes)


@dataclass(frozen=True)
class ImageError:
    """Reprojection error of one picture: rms over `points` points, px."""

    camera: str
    picture: str
    rms: float
    points: int
    used: bool
    background: bool


@dataclass(frozen=True)
class Plan:
    """A background plane normal . x = offset (mm), and the rms distance (mm) of the target points from it."""

    normal: tuple[float, float, float]
    offset: float
    rms: float


@dataclass(frozen=True)
class Calibration:
    """Calibrated cameras and how well they fit.

    Parameters
    ----------
    names, sizes : of the cameras and their pictures (height, width)
    intrinsics : (camera, 9) fx, fy, cx, cy (px), k1, k2, p1, p2, k3
    poses : world to camera, mm
    backgrounds : plane of each camera, or None
    errors : one a picture
    sigma_rotation, sigma_translation : (camera,) standard deviations from noise alone, degrees and mm
    sigma_focal : (camera,) share of the focal length
    residuals : (camera) arrays (n, 4) of u, v and the residual in u, v, px: to be drawn
    notes : what a user should know
    """

    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    intrinsics: np.ndarray
    poses: tuple[Pose, ...]
    backgrounds: tuple[Plan | None, ...]
    errors: tuple[ImageError, ...]
    sigma_rotation: np.ndarray
    sigma_translation: np.ndarray
    sigma_focal: np.ndarray
    residuals: tuple[np.ndarray, ...]
    notes: tuple[str, ...]

    def rms(self, camera: str | None = None) -> float:
        """Rms reprojection error over the pictures used, of one camera or all, px."""
        chosen = [e for e in self.errors if e.used and camera in (None, e.camera)]
        return float(np.sqrt(np.average([e.rms**2 for e in chosen], weights=[e.points for e in chosen])))


def calibrate(views: Sequence[ViewPictures], settings: CalibrationSettings) -> Calibration:
    """Calibrate all cameras from what was found in their pictures.

    Raises
    ------
    InputError
        If a camera has too few poses or is not tied to the others by shared ones, if guesses contradict one another
        (a mirrored picture, pictures of different poses under one name), or if the result can't be right.
    """
    if not views:
        raise InputError("calibrate: no view was found; expected one folder of target pictures a camera")
    alone = [_alone(view) for view in views]
    poses, world = _pose_names(views, settings)
    cameras, found = _tie_together(views, alone, poses, world)
    bundle, observations, pictures = _bundle(views, alone, cameras, found, poses, world, settings)
    bundle, _ = adjust(bundle, observations, GUESSED_NOISE)
    keep = _fitting(bundle, observations)
    kept = [o for o, k in zip(observations, keep, strict=True) if k]
    _check_poses(views, kept)
    noise = float(np.median([_rms(bundle, o) for o in kept])) / np.sqrt(2)
    bundle, sigma = adjust(bundle, kept, max(noise, LEAST_NOISE))
    bundle = _to_world(bundle, settings)
    return _result(views, bundle, sigma, observations, pictures, keep, settings)


# -- step 1 ----------------------------------------------------------------------------------------------------------


def _alone(view: ViewPictures) -> tuple[np.ndarray, dict[tuple[str, bool], Pose]]:
    """Focal length of one camera and the pose of each target before it, by name and whether it is on the background."""
    import cv2

    pictures = {(n, False): d for n, d in view.poses.items()} | {(n, True): d for n, d in view.background.items()}
    if len(pictures) < 3:
        raise InputError(
            f"view '{view.name}': expected the target in 3 pictures at least (10 or more, tilted in different ways, "
            f"are good), found it in {len(pictures)}"
        )
    height, width = view.size
    points = [d.points.astype(np.float32) for d in pictures.values()]
    pixels = [d.pixels.astype(np.float32) for d in pictures.values()]
    # principal point and distortion wait for the bundle adjustment: one camera alone cannot tell them well
    flags = cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
    flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
    best = None
    for focal in (1.0, 3.0, 10.0):  # times the width: a guess too far off ends elsewhere
        k = np.array([[focal * width, 0, (width - 1) / 2], [0, focal * width, (height - 1) / 2], [0, 0, 1]])
        rms, k, _, rotations, translations = cv2.calibrateCamera(
            points, pixels, (width, height), k, np.zeros(5), flags=flags
        )
        in_front = all(float(t.ravel()[2]) > 0 for t in translations)
        if np.isfinite(rms) and in_front and (best is None or rms < best[0]):
            best = (rms, k, rotations, translations)
    if best is None:
        raise InputError(
            f"view '{view.name}': no camera explains its {len(pictures)} target pictures; check the number of squares "
            "and that the target was tilted differently in them"
        )
    _, k, rotations, translations = best
    found = {
        key: Pose.of_vector(np.concatenate([r.ravel(), t.ravel()]))
        for key, r, t in zip(pictures, rotations, translations, strict=True)
    }
    return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], 0, 0, 0, 0, 0], dtype=np.float64), found


# -- step 2 ----------------------------------------------------------------------------------------------------------


def _pose_names(views: Sequence[ViewPictures], settings: CalibrationSettings) -> tuple[list[str], str]:
    """All shared poses, and the one that is the world."""
    seen: dict[str, int] = {}
    for view in views:
        for name in view.poses:
            seen[name] = seen.get(name, 0) + 1
    if not seen:
        raise InputError("calibrate: no picture with the target free in space; expected some in every view")
    if settings.world and settings.world not in seen:
        raise InputError(
            f"world: expected a target pose that was found, one of {', '.join(sorted(seen))}, got '{settings.world}'"
        )
    names = sorted(seen)
    return names, settings.world or max(names, key=lambda n: seen[n])


def _tie_together(
    views: Sequence[ViewPictures], alone: list, poses: list[str], world: str
) -> tuple[dict[int, Pose], dict[str, Pose]]:  # fmt: skip
    """Poses of cameras (world to camera) and targets (to world), from camera to camera through shared poses."""
    targets = {world: Pose(np.eye(3), np.zeros(3))}
    cameras: dict[int, Pose] = {}
    while len(cameras) < len(views):
        counts = {
            i: sum((n in targets) for n in view.poses) for i, view in enumerate(views) if i not in cameras
        }  # fmt: skip
        i = max(counts, key=lambda c: counts[c])
        if not counts[i]:
            missing = ", ".join(f"'{views[c].name}'" for c in counts)
            raise InputError(
                f"view {missing}: no target pose shared with the other cameras, so there is no common frame; take "
                "pictures of one pose with neighbouring cameras at the same time, under the same number"
            )
        guesses = {n: alone[i][1][n, False] @ targets[n].inverse for n in views[i].poses if n in targets}
        cameras[i] = _agreed(guesses, views[i].name)
        for n in views[i].poses:
            targets.setdefault(n, cameras[i].inverse @ alone[i][1][n, False])
    return cameras, targets


def _agreed(guesses: dict[str, Pose], name: str) -> Pose:
    """The guess that agrees best with the others, if they agree at all."""
    every = list(guesses.values())
    distances = np.array([[_angle(a, b) for b in every] for a in every])
    middle = int(np.argmin(np.median(distances, axis=1)))
    best = every[middle]
    far = np.array([np.linalg.norm(a.inverse.translation - best.inverse.translation) for a in every])
    reach = np.linalg.norm(best.translation)
    bad = (distances[middle] > DISAGREE[0]) | (far > DISAGREE[1] * reach)
    if bad.sum() * 2 >= len(every) and len(every) > 1:
        worst = list(guesses)[int(np.argmax(distances[middle]))]
        raise InputError(
            f"view '{name}': its target poses contradict those of the other cameras (by {distances[middle].max():.0f} "
            f"degrees in '{worst}'); are its pictures mirrored (flip), or of other poses than their names say?"
        )
    return best


def _angle(a: Pose, b: Pose) -> float:
    """Angle between two rotations, degrees."""
    cosine = (np.trace(a.rotation @ b.rotation.T) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


# -- step 3 ----------------------------------------------------------------------------------------------------------


def _bundle(
    views: Sequence[ViewPictures], alone: list, cameras: dict[int, Pose], found: dict[str, Pose],
    poses: list[str], world: str, settings: CalibrationSettings,
) -> tuple[Bundle, list[Observation], list[tuple[str, bool]]]:  # fmt: skip
    """Everything as one bundle; each background picture is a pose of its own."""
    every = [found[n] for n in poses]
    observations, pictures = [], []
    for i, view in enumerate(views):
        for name, seen in view.poses.items():
            observations.append(Observation(i, poses.index(name), seen))
            pictures.append((name, False))
        for name, seen in view.background.items():
            every.append(cameras[i].inverse @ alone[i][1][name, True])
            observations.append(Observation(i, len(every) - 1, seen))
            pictures.append((name, True))
    bundle = Bundle(
        intrinsics=np.stack([a[0] for a in alone]),
        cameras=tuple(cameras[i] for i in range(len(views))),
        poses=tuple(every),
        fixed=poses.index(world),
        free=(True, True, True, True, *(c in settings.distortion for c in COEFFICIENTS)),
        sizes=tuple(v.size for v in views),
    )
    return bundle, observations, pictures


def _fitting(bundle: Bundle, observations: Sequence[Observation]) -> list[bool]:
    """Which pictures fit: their rms is within five times the median of all, or a tenth of a pixel."""
    rms = [_rms(bundle, o) for o in observations]
    limit = max(5 * float(np.median(rms)), 0.1)
    return [r <= limit for r in rms]


def _rms(bundle: Bundle, seen: Observation) -> float:
    return float(np.sqrt((bundle.residual(seen) ** 2).sum(axis=1).mean()))


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


def _axes(axes: tuple[str, str, str]) -> np.ndarray:
    """Rotation from the target's axes to the world's."""
    unit = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
    rows = [np.array(unit.get(a.rstrip("+-"), (0, 0, 0))) * (-1 if a.endswith("-") else 1) for a in axes]
    rotation = np.array(rows, dtype=np.float64)
    if not np.isclose(np.linalg.det(rotation), 1):
        raise InputError(
            f"axes: expected three different axes of the target that make a right-handed world, such as x+ z+ y-, "
            f"got {' '.join(axes)}"
        )
    return rotation


def _to_world(bundle: Bundle, settings: CalibrationSettings) -> Bundle:
    """From the frame of the fixed target to the world that was asked for."""
    move = Pose(_axes(settings.axes), np.array(settings.origin))
    cameras = tuple(c @ move.inverse for c in bundle.cameras)
    return replace(bundle, cameras=cameras, poses=tuple(move @ p for p in bundle.poses))


# -- step 4, and the result ------------------------------------------------------------------------------------------


def _result(
    views: Sequence[ViewPictures], bundle: Bundle, sigma: np.ndarray, observations: Sequence[Observation],
    pictures: list[tuple[str, bool]], keep: list[bool], settings: CalibrationSettings,
) -> Calibration:  # fmt: skip
    errors, notes = [], []
    for o, (picture, background), used in zip(observations, pictures, keep, strict=True):
        name = views[o.camera].name
        errors.append(ImageError(name, picture, _rms(bundle, o), len(o.detection.points), used, background))
        if not used:
            notes.append(f"{name}/{picture}: left out, its reprojection error of {errors[-1].rms:.2f} px does not fit")
    residuals, backgrounds = [], []
    for i, view in enumerate(views):
        own = [o for o, k in zip(observations, keep, strict=True) if k and o.camera == i]
        residuals.append(np.concatenate([np.hstack([o.detection.pixels, bundle.residual(o)]) for o in own]))
        laid = [
            o for o, k, (_, b) in zip(observations, keep, pictures, strict=True) if k and b and o.camera == i
        ]  # fmt: skip
        backgrounds.append(_plane(bundle, i, laid) if laid else None)
        notes += _doubts(view, residuals[-1], sigma[i], bundle.intrinsics[i], settings)
        if not laid:
            notes.append(f"{view.name}: no target on the background was found, so its plane is not known")
    result = Calibration(
        names=tuple(v.name for v in views),
        sizes=bundle.sizes,
        intrinsics=bundle.intrinsics,
        poses=bundle.cameras,
        backgrounds=tuple(backgrounds),
        errors=tuple(errors),
        sigma_rotation=np.degrees(np.linalg.norm(sigma[:, 9:12], axis=1)),
        sigma_translation=np.linalg.norm(sigma[:, 12:], axis=1),
        sigma_focal=sigma[:, 0] / bundle.intrinsics[:, 0],
        residuals=tuple(residuals),
        notes=tuple(notes),
    )
    _refuse(result, settings)
    return result


def _plane(bundle: Bundle, camera: int, laid: Sequence[Observation]) -> Plan:
    """The plane through all target points on the background, its normal towards the camera."""
    poses = [bundle.poses[o.pose] for o in laid]
    points = np.concatenate(
        [o.detection.points @ p.rotation.T + p.translation for o, p in zip(laid, poses, strict=True)]
    )
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    centre = bundle.cameras[camera].inverse.translation
    normal = normal if normal @ (centre - middle) > 0 else -normal
    rms = float(np.sqrt((((points - middle) @ normal) ** 2).mean()))
    return Plan((float(normal[0]), float(normal[1]), float(normal[2])), float(normal @ middle), rms)


def _doubts(
    view: ViewPictures, residuals: np.ndarray, sigma: np.ndarray, intrinsics: np.ndarray, settings: CalibrationSettings
) -> list[str]:
    """What may be wrong with a camera, short of refusing it."""
    height, width = view.size
    covered = np.ptp(residuals[:, 0]) * np.ptp(residuals[:, 1]) / (height * width)
    notes = []
    if covered < 0.4:
        notes.append(f"{view.name}: the targets cover {covered:.0%} of the picture; distortion is a guess beyond them")
    if sigma[0] > 0.01 * intrinsics[0]:
        notes.append(
            f"{view.name}: the focal length is known to {sigma[0] / intrinsics[0]:.1%} only; tilt the target more"
        )
    return notes


def _refuse(result: Calibration, settings: CalibrationSettings) -> None:
    """Refuse what can't be right."""
    for i, name in enumerate(result.names):
        rms, (height, width) = result.rms(name), result.sizes[i]
        if not rms <= settings.max_error:
            worst = max((e for e in result.errors if e.camera == name and e.used), key=lambda e: e.rms)
            raise InputError(
                f"view '{name}': reprojection error {rms:.2f} px, expected {settings.max_error:g} px or less; the "
                f"worst picture is {worst.picture} ({worst.rms:.2f} px). Check pitch and number of squares, and that "
                "pictures under one name show one pose; or raise --max-error"
            )
        fx, fy, cx, cy = result.intrinsics[i, :4]
        if not (0.8 < fx / fy < 1.25 and -0.5 * width < cx < 1.5 * width and -0.5 * height < cy < 1.5 * height):
            raise InputError(
                f"view '{name}': got fx = {fx:.5g}, fy = {fy:.5g}, cx = {cx:.5g}, cy = {cy:.5g} px, which no camera "
                "has; take more target pictures, tilted in different ways and filling the picture"
            )
        plane = result.backgrounds[i]
        if plane is not None and plane.rms > 0.005 * np.linalg.norm(result.poses[i].translation):
            raise InputError(
                f"view '{name}': the targets on its background lie {plane.rms:.2f} mm rms off one plane; did the "
                "background move, or does a picture show the target off it?"
            )
