"""Initial cameras and target poses for bundle adjustment, perspective or telecentric.

Perspective cameras are solved one at a time, then linked through the target poses they share.

A telecentric camera sees an affine image of a flat target: the larger singular value is the scale of the camera, the
ratio of the singular values the cosine of the target's tilt. The sign of the tilt is ambiguous, so each image has two
rotations. Two cameras with common poses resolve it, up to the mirror image of the whole rig (`mirror`).

Sources: Tomasi & Kanade, Shape and motion from image streams under orthography, Int. J. Comput. Vis. 9 (1992) 137;
Collins & Bartoli, Infinitesimal plane-based pose estimation, Int. J. Comput. Vis. 109 (2014) 252.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.geometry import PERSPECTIVE, TELECENTRIC, Projection
from nerif.imaging.calibration.bundle import INTRINSIC, CameraBundle, Pose, TargetObservation
from nerif.imaging.calibration.calibration_settings import COEFFICIENTS, TILT
from nerif.imaging.calibration.targets import Detection, TargetDetections

__all__ = ["first_guess", "mirror"]

MIN_IMAGES = 3
MAX_ANGLE = 5.0  # degrees between two estimates of one rotation
ANGLE_CAP = 3 * MAX_ANGLE  # degrees beyond which a rotation does not fit, no matter by how much
MAX_SHIFT = 0.1  # between two estimates of a camera's centre, over its distance
FOCAL_LENGTHS = (1.0, 3.0, 10.0)  # over the image width, to start from: too far off, the fit ends in another minimum
FLIP = np.diag([1.0, 1.0, -1.0])


class Guess(NamedTuple):
    """Initial parameters.

    intrinsics : (camera, 11) as those of a CameraBundle
    cameras : world to camera
    targets : target to world, of the poses that cameras share, by name
    on_background : target to world, of each camera's images of the target on its background, by name
    """

    intrinsics: Float[np.ndarray, "camera 11"]
    cameras: tuple[Pose, ...]
    targets: Mapping[str, Pose]
    on_background: tuple[Mapping[str, Pose], ...]


def first_guess(
    views: Sequence[TargetDetections], coefficients: Sequence[str], world: str = "",
    projection: Projection = PERSPECTIVE,
) -> tuple[CameraBundle, list[TargetObservation]]:  # fmt: skip
    """Return a bundle to adjust, in the frame of one target pose, and all observations.

    The principal point of a telecentric camera stays in the middle of the image: shifting it is equivalent to shifting
    the camera and, for the distortion, changing p1 and p2.

    Parameters
    ----------
    coefficients : of distortion (COEFFICIENTS) and tilt (TILT), to be adjusted
    world : name of the target pose that defines the world; the one that most cameras see if empty
    """
    counts = Counter(name for view in views for name in view.poses)
    if not counts:
        raise InputError("expected images of the target free in space in each view, got none", field="calibrate")
    names = sorted(counts)
    if world and world not in counts:
        raise InputError(
            f"expected a target pose with detections, one of {', '.join(names)}, got '{world}'", field="world"
        )
    world = world or max(names, key=lambda n: counts[n])
    guess = GUESSES[projection](views, world, any(name in coefficients for name in TILT))
    poses, observations = [guess.targets[n] for n in names], []
    for i, view in enumerate(views):
        for name, detection in view.poses.items():
            observations.append(TargetObservation(i, names.index(name), detection, name))
        for name, pose in guess.on_background[i].items():  # each image has its own pose
            poses.append(pose)
            observations.append(TargetObservation(i, len(poses) - 1, view.background[name], name, on_background=True))
    principal = projection.shows_depth
    bundle = CameraBundle(
        intrinsics=guess.intrinsics,
        cameras=guess.cameras,
        poses=tuple(poses),
        fixed=names.index(world),
        free=(True, True, principal, principal, *(c in coefficients for c in (*COEFFICIENTS, *TILT))),
        sizes=tuple(v.size for v in views),
        projection=projection,
    )
    return bundle, observations


def mirror(bundle: CameraBundle) -> CameraBundle:
    """Return the rig mirrored at the world's plane z = 0, cameras looking the other way: it takes the same images."""

    def flip(pose: Pose) -> Pose:
        return Pose(FLIP @ pose.rotation @ FLIP, FLIP @ pose.translation)

    return replace(bundle, cameras=tuple(map(flip, bundle.cameras)), poses=tuple(map(flip, bundle.poses)))


# -- both projections ----------------------------------------------------------------------------------------------


def _check_count(view: TargetDetections, images: int) -> None:
    if images < MIN_IMAGES:
        raise InputError(
            f"expected the target in at least {MIN_IMAGES} images (better 10 or more, tilted in different ways), "
            f"got {images}{view.diagnosis and '; '}{view.diagnosis}",
            field=f"view '{view.name}'",
        )


def _next_camera(
    views: Sequence[TargetDetections], cameras: Collection[int], targets: Collection[str], minimum: int
) -> tuple[int, list[str]]:
    """The camera that shares most target poses with those in `cameras`, which see `targets`, and these poses."""
    shared = {i: [n for n in view.poses if n in targets] for i, view in enumerate(views) if i not in cameras}
    best = max(shared, key=lambda i: len(shared[i]))
    if len(shared[best]) < minimum:
        names = ", ".join(f"'{views[i].name}'" for i in shared)
        raise InputError(
            f"expected at least {minimum} in common with the other cameras, got {len(shared[best])} target poses; "
            "take images of one pose with neighbouring cameras at the same time, under the same number",
            field=f"view {names}",
        )
    return best, shared[best]


def _angles(a: Float[np.ndarray, "*#n 3 3"], b: Float[np.ndarray, "*#n 3 3"]) -> Float[np.ndarray, "*n"]:
    """Angles between rotations, degrees."""
    cosine = ((a * b).sum(axis=(-2, -1)) - 1) / 2
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _contradiction(view: str, pose: str, degrees: float) -> InputError:
    return InputError(
        f"its target poses contradict those of the other cameras (by {degrees:.0f} "
        f"degrees in '{pose}'); are its images mirrored (flip), or of other poses than their names say?",
        field=f"view '{view}'",
    )


# -- perspective ---------------------------------------------------------------------------------------------------

Poses = dict[tuple[str, bool], Pose]
"""Target to camera, by name and whether the target is on the background."""


def _guess_perspective(views: Sequence[TargetDetections], world: str, tilted: bool) -> Guess:
    intrinsics, local = zip(*(_perspective_view(view, tilted) for view in views), strict=True)
    targets = {world: Pose(np.eye(3), np.zeros(3))}
    cameras: dict[int, Pose] = {}
    while len(cameras) < len(views):
        i, shared = _next_camera(views, cameras, targets, 1)
        estimates = {n: local[i][n, False] @ targets[n].inverse for n in shared}
        cameras[i] = _consensus(estimates, views[i].name)
        for n in views[i].poses:
            targets.setdefault(n, cameras[i].inverse @ local[i][n, False])
    return Guess(
        np.stack(intrinsics),
        tuple(cameras[i] for i in range(len(views))),
        targets,
        tuple({n: cameras[i].inverse @ local[i][n, True] for n in view.background} for i, view in enumerate(views)),
    )


def _perspective_view(view: TargetDetections, tilted: bool) -> tuple[np.ndarray, Poses]:
    """Intrinsics of one camera, of which only the focal length and a tilt are fitted, and its target poses."""
    import cv2

    images = {(n, False): d for n, d in view.poses.items()} | {(n, True): d for n, d in view.background.items()}
    _check_count(view, len(images))
    height, width = view.size
    points = [d.points.astype(np.float32) for d in images.values()]
    pixels = [d.pixels.astype(np.float32) for d in images.values()]
    # principal point and distortion are left to the bundle adjustment: one camera alone hardly determines them
    flags = cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
    flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS
    flags |= cv2.CALIB_TILTED_MODEL if tilted else 0
    best = None
    for focal in FOCAL_LENGTHS:
        k = np.array([[focal * width, 0, (width - 1) / 2], [0, focal * width, (height - 1) / 2], [0, 0, 1]])
        rms, k, coefficients, rotations, translations = cv2.calibrateCamera(
            points, pixels, (width, height), k, np.zeros(14 if tilted else 5), flags=flags
        )
        in_front = all(float(t.ravel()[2]) > 0 for t in translations)
        if np.isfinite(rms) and in_front and (best is None or rms < best[0]):
            best = (rms, k, coefficients.ravel(), rotations, translations)
    if best is None:
        raise InputError(
            f"no camera explains its {len(images)} target images; check the number of squares "
            "and that the target was tilted differently in them",
            field=f"view '{view.name}'",
        )
    _, k, coefficients, rotations, translations = best
    vectors = (np.concatenate([r.ravel(), t.ravel()]) for r, t in zip(rotations, translations, strict=True))
    poses = dict(zip(images, map(Pose.of_vector, vectors), strict=True))
    tilt = coefficients[12:] if tilted else np.zeros(len(TILT))
    return np.concatenate([k.diagonal()[:2], k[:2, 2], np.zeros(len(COEFFICIENTS)), tilt]), poses


def _consensus(estimates: dict[str, Pose], name: str) -> Pose:
    """The estimate of a camera's pose that agrees best with the others, if at least half of them agree."""
    poses = list(estimates.values())
    rotations = np.stack([pose.rotation for pose in poses])
    distances = _angles(rotations[:, None], rotations)
    middle = int(np.argmin(np.median(distances, axis=1)))
    best = poses[middle]
    shifts = np.array([np.linalg.norm(a.inverse.translation - best.inverse.translation) for a in poses])
    outliers = (distances[middle] > MAX_ANGLE) | (shifts > MAX_SHIFT * np.linalg.norm(best.translation))
    if outliers.sum() * 2 >= len(poses) and len(poses) > 1:
        worst = list(estimates)[int(np.argmax(distances[middle]))]
        raise _contradiction(name, worst, float(distances[middle].max()))
    return best


# -- telecentric ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _TelecentricView:
    """One camera: px/mm, the middle of its image (px), and of each pose both rotations and the place (x, y) in mm."""

    scale: float
    middle: tuple[float, float]
    rotations: Mapping[str, Float[np.ndarray, "2 3 3"]]
    places: Mapping[str, Float[np.ndarray, 2]]


def _guess_telecentric(views: Sequence[TargetDetections], world: str, _tilted: bool) -> Guess:
    """Images of the target on the background are not used, nor is a tilt, which fx and fy describe."""
    local = [_telecentric_view(view) for view in views]
    cameras, targets = _telecentric_rotations(views, local, world)
    places, offsets = _telecentric_places(local, cameras, targets, world)
    return Guess(
        np.stack([[a.scale, a.scale, *a.middle, *np.zeros(INTRINSIC - 4)] for a in local]),
        tuple(Pose(cameras[i], offsets[i]) for i in range(len(views))),
        {name: Pose(rotation, places[name]) for name, rotation in targets.items()},
        ({},) * len(views),
    )


def _telecentric_view(view: TargetDetections) -> _TelecentricView:
    _check_count(view, len(view.poses))
    affine = {name: _affine(detection) for name, detection in view.poses.items()}
    for name, (matrix, _) in affine.items():
        if not np.linalg.det(matrix) > 0:
            raise InputError(
                f"sees the target of '{name}' from behind; is it mirrored (flip)?", field=f"view '{view.name}'"
            )
    scale = float(np.median([np.linalg.norm(matrix, 2) for matrix, _ in affine.values()]))
    middle = ((view.size[1] - 1) / 2, (view.size[0] - 1) / 2)
    return _TelecentricView(
        scale,
        middle,
        {name: _both_rotations(matrix / scale) for name, (matrix, _) in affine.items()},
        {name: (at - middle) / scale for name, (_, at) in affine.items()},
    )


def _affine(detection: Detection) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, 2]]:
    """From the target's x, y (mm) to pixels: matrix and offset."""
    points = np.column_stack([detection.points[:, :2], np.ones(len(detection.points))])
    solution = np.linalg.lstsq(points, detection.pixels, rcond=None)[0]
    return solution[:2].T, solution[2]


def _both_rotations(block: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 3 3"]:
    """Both rotations whose upper left block is nearest to this one."""
    before, (_, smaller), after = np.linalg.svd(block)
    cosine = min(float(smaller), 1.0)
    sine = np.sqrt(1 - cosine**2)
    left, right = np.eye(3), np.eye(3)
    left[:2, :2], left[2, 2] = before, np.linalg.det(before)
    right[:2, :2], right[2, 2] = after, np.linalg.det(after)
    tilt = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    return np.stack([left @ t @ right for t in (tilt, tilt.T)])


def _telecentric_rotations(
    views: Sequence[TargetDetections], local: Sequence[_TelecentricView], world: str
) -> tuple[dict[int, np.ndarray], dict[str, np.ndarray]]:
    """Rotations of cameras (from the world) and targets (to it), beginning with the camera that has most poses."""
    first = max(range(len(views)), key=lambda i: len(views[i].poses))
    cameras = {first: np.eye(3)}  # the frame until all cameras are linked
    targets = dict(local[first].rotations)  # each with both rotations or, once another camera has resolved it, one
    while len(cameras) < len(views):
        i, shared = _next_camera(views, cameras, targets, 2)
        cameras[i], errors = _best_rotation(local[i].rotations, targets, shared)
        if (errors > MAX_ANGLE).sum() * 2 >= len(errors):
            raise _contradiction(views[i].name, shared[int(errors.argmax())], float(errors.max()))
        for name, rotations in local[i].rotations.items():
            if name not in targets:
                targets[name] = cameras[i].T @ rotations
            else:
                errors = _angles(cameras[i] @ targets[name][:, None], rotations).min(axis=1)
                if errors.min() < MAX_ANGLE:
                    targets[name] = targets[name][[errors.argmin()]]
    if len(views) > 1 and len(targets[world]) > 1:
        raise InputError(f"expected a target pose that two cameras see, got '{world}'", field="world")
    to_world = targets[world][0].T
    return (
        {i: camera @ to_world.T for i, camera in cameras.items()},
        {name: to_world @ rotations[0] for name, rotations in targets.items()},
    )


def _best_rotation(
    rotations: Mapping[str, np.ndarray], targets: Mapping[str, np.ndarray], shared: Sequence[str]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " pose"]]:
    """The rotation of a camera that fits its target poses best to those of the others, and its error of each, deg."""
    candidates = np.concatenate([
        (rotations[n][:, None] @ targets[n].transpose(0, 2, 1)[None]).reshape(-1, 3, 3) for n in shared
    ])  # fmt: skip
    errors = np.stack([
        _angles(candidates[:, None, None] @ targets[n][None, :, None], rotations[n][None, None]).min(axis=(1, 2))
        for n in shared
    ], axis=1)  # fmt: skip
    best = int(np.minimum(errors, ANGLE_CAP).sum(axis=1).argmin())
    return candidates[best], errors[best]


def _telecentric_places(
    local: Sequence[_TelecentricView], cameras: Mapping[int, np.ndarray], targets: Mapping[str, np.ndarray], world: str
) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
    """Places of targets and offsets of cameras (x, y, 0), mm, by least squares; unconstrained depths are 0."""
    names = [n for n in targets if n != world]
    size, count = 2 * len(local) + 3 * len(names), sum(len(a.places) for a in local)
    matrix, right = np.zeros((count, 2, size)), np.zeros((count, 2))
    rows = ((i, name, at) for i, a in enumerate(local) for name, at in a.places.items())
    for row, (i, name, at) in enumerate(rows):
        matrix[row, :, 2 * i : 2 * i + 2], right[row] = np.eye(2), at
        if name != world:
            first = 2 * len(local) + 3 * names.index(name)
            matrix[row, :, first : first + 3] = cameras[i][:2]
    solution = np.linalg.lstsq(matrix.reshape(-1, size), right.ravel(), rcond=1e-9)[0]
    offsets = [np.append(solution[2 * i : 2 * i + 2], 0.0) for i in range(len(local))]
    places = dict(zip(names, solution[2 * len(local) :].reshape(-1, 3), strict=True))
    return {**places, world: np.zeros(3)}, offsets


GUESSES: dict[Projection, Callable[[Sequence[TargetDetections], str, bool], Guess]] = {
    PERSPECTIVE: _guess_perspective,
    TELECENTRIC: _guess_telecentric,
}
