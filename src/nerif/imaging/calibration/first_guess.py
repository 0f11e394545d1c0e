"""Initial cameras and target poses for bundle adjustment, perspective or telecentric.

Perspective cameras are solved one at a time, then linked through the target poses they share.

A telecentric camera sees an affine image of a flat target: the larger singular value is the scale of the camera, the
ratio of the singular values the cosine of the target's tilt. The sign of the tilt is ambiguous, so each image has two
rotations. Two cameras with common poses resolve it, up to the mirror image of the whole rig (`mirrored`).

Sources: Tomasi & Kanade, Shape and motion from image streams under orthography, Int. J. Comput. Vis. 9 (1992) 137;
Collins & Bartoli, Infinitesimal plane-based pose estimation, Int. J. Comput. Vis. 109 (2014) 252.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.geometry import PERSPECTIVE, TELECENTRIC, Projection
from nerif.imaging.calibration.bundle import COEFFICIENTS, Bundle, Observation, Pose
from nerif.imaging.calibration.targets import Detection, ViewImages

__all__ = [
    "DISAGREE",
    "Guess",
    "angles",
    "contradiction",
    "enough",
    "first_guess",
    "guess_perspective",
    "guess_telecentric",
    "mirrored",
    "next_camera",
]

DISAGREE = 5.0  # degrees by which two guesses of a rotation may differ


@dataclass(frozen=True)
class Guess:
    """Where cameras and targets are, to begin with.

    Parameters
    ----------
    intrinsics : (camera, 9) as those of a Bundle
    cameras : world to camera
    targets : target to world, of the poses that cameras share, by name
    laid : target to world, of each camera's images of the target on its background, by name
    """

    intrinsics: Float[np.ndarray, "camera 9"]
    cameras: tuple[Pose, ...]
    targets: Mapping[str, Pose]
    laid: tuple[Mapping[str, Pose], ...]


def enough(view: ViewImages, images: int) -> None:
    """Refuse fewer than three images of a target."""
    if images < 3:
        raise InputError(
            f"expected the target in 3 images at least (10 or more, tilted in different ways, "
            f"are good), found it in {images}",
            field=f"view '{view.name}'",
        )


def next_camera(
    views: Sequence[ViewImages], tied: Collection[int], targets: Collection[str], least: int
) -> tuple[int, list[str]]:
    """Return the camera, of those not tied to the others yet, that shares most target poses with them, and which.

    Parameters
    ----------
    views : what was found in the images of each camera
    tied : numbers of the cameras that are
    targets : names of the target poses that these have seen
    least : number of poses it has to share

    Raises
    ------
    InputError
        If there is none that shares as many.
    """
    shared = {i: [n for n in view.poses if n in targets] for i, view in enumerate(views) if i not in tied}
    chosen = max(shared, key=lambda i: len(shared[i]))
    if len(shared[chosen]) < least:
        number = "no target pose" if least == 1 else "fewer than two target poses"
        names = ", ".join(f"'{views[i].name}'" for i in shared)
        raise InputError(
            f"{number} shared with the other cameras, so there is no common frame; take "
            "images of one pose with neighbouring cameras at the same time, under the same number",
            field=f"view {names}",
        )
    return chosen, shared[chosen]


def angles(a: Float[np.ndarray, "*#n 3 3"], b: Float[np.ndarray, "*#n 3 3"]) -> Float[np.ndarray, "*n"]:
    """Return the angles between rotations, degrees."""
    cosine = ((a * b).sum(axis=(-2, -1)) - 1) / 2
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def contradiction(view: str, pose: str, degrees: float) -> InputError:
    """What to say of a camera that sees target poses otherwise than the others."""
    return InputError(
        f"its target poses contradict those of the other cameras (by {degrees:.0f} "
        f"degrees in '{pose}'); are its images mirrored (flip), or of other poses than their names say?",
        field=f"view '{view}'",
    )


FAR = 0.1  # share of the distance by which two guesses of a camera's place may differ

Alone = tuple[np.ndarray, dict[tuple[str, bool], Pose]]
"""Intrinsics of one camera, and target poses before it by name and whether the target lies on the background."""


def guess_perspective(views: Sequence[ViewImages], world: str) -> Guess:
    """Return intrinsics and poses in the frame of the target pose `world`.

    Raises
    ------
    InputError
        If a camera has too few poses, is not tied to the others by shared ones, or contradicts them.
    """
    alone = [_perspective_view(view) for view in views]
    cameras, targets = _perspective_rig(views, alone, world)
    return Guess(
        intrinsics=np.stack([k for k, _ in alone]),
        cameras=tuple(cameras[i] for i in range(len(views))),
        targets=targets,
        laid=tuple(
            {name: cameras[i].inverse @ found[name, True] for name in view.background}
            for i, (view, (_, found)) in enumerate(zip(views, alone, strict=True))
        ),
    )


def _perspective_view(view: ViewImages) -> Alone:
    """Focal length of one camera and the pose of each target before it, by name and whether it is on the background."""
    import cv2

    images = {(n, False): d for n, d in view.poses.items()} | {(n, True): d for n, d in view.background.items()}
    enough(view, len(images))
    height, width = view.size
    points = [d.points.astype(np.float32) for d in images.values()]
    pixels = [d.pixels.astype(np.float32) for d in images.values()]
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
            f"no camera explains its {len(images)} target images; check the number of squares "
            "and that the target was tilted differently in them",
            field=f"view '{view.name}'",
        )
    _, k, rotations, translations = best
    found = {
        key: Pose.of_vector(np.concatenate([r.ravel(), t.ravel()]))
        for key, r, t in zip(images, rotations, translations, strict=True)
    }
    return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], 0, 0, 0, 0, 0], dtype=np.float64), found


def _perspective_rig(
    views: Sequence[ViewImages], alone: Sequence[Alone], world: str
) -> tuple[dict[int, Pose], dict[str, Pose]]:
    """Poses of cameras (world to camera) and targets (to world), from camera to camera through shared poses."""
    targets = {world: Pose(np.eye(3), np.zeros(3))}
    cameras: dict[int, Pose] = {}
    while len(cameras) < len(views):
        i, shared = next_camera(views, cameras, targets, 1)
        guesses = {n: alone[i][1][n, False] @ targets[n].inverse for n in shared}
        cameras[i] = _agreed(guesses, views[i].name)
        for n in views[i].poses:
            targets.setdefault(n, cameras[i].inverse @ alone[i][1][n, False])
    return cameras, targets


def _agreed(guesses: dict[str, Pose], name: str) -> Pose:
    """The guess that agrees best with the others, if they agree at all."""
    every = list(guesses.values())
    rotations = np.stack([guess.rotation for guess in every])
    distances = angles(rotations[:, None], rotations)
    middle = int(np.argmin(np.median(distances, axis=1)))
    best = every[middle]
    far = np.array([np.linalg.norm(a.inverse.translation - best.inverse.translation) for a in every])
    reach = np.linalg.norm(best.translation)
    bad = (distances[middle] > DISAGREE) | (far > FAR * reach)
    if bad.sum() * 2 >= len(every) and len(every) > 1:
        worst = list(guesses)[int(np.argmax(distances[middle]))]
        raise contradiction(name, worst, float(distances[middle].max()))
    return best


FARTHEST = 3 * DISAGREE  # degrees: rotations further apart than this do not fit, no matter by how much
FLIP = np.diag([1.0, 1.0, -1.0])


def guess_telecentric(views: Sequence[ViewImages], world: str) -> Guess:
    """Return intrinsics and poses in the frame of the target pose `world`; images on the background are not used.

    Raises
    ------
    InputError
        If a camera has too few poses, is not tied to the others by shared ones, or contradicts them.
    """
    alone = [_telecentric_view(view) for view in views]
    cameras, targets = _telecentric_rig(views, alone, world)
    places, offsets = _places(alone, cameras, targets, world)
    return Guess(
        intrinsics=np.stack([[a.scale, a.scale, *a.middle, 0, 0, 0, 0, 0] for a in alone]),
        cameras=tuple(Pose(cameras[i], offsets[i]) for i in range(len(views))),
        targets={name: Pose(turn, places[name]) for name, turn in targets.items()},
        laid=({},) * len(views),
    )


def mirrored(bundle: Bundle) -> Bundle:
    """Return the rig mirrored at the world's plane z = 0, cameras looking the other way: it takes the same images."""

    def flipped(pose: Pose) -> Pose:
        return Pose(FLIP @ pose.rotation @ FLIP, FLIP @ pose.translation)

    return replace(bundle, cameras=tuple(map(flipped, bundle.cameras)), poses=tuple(map(flipped, bundle.poses)))


@dataclass(frozen=True)
class _TelecentricView:
    """One camera: px/mm, the middle of its image (px), and of each pose both rotations and the place (x, y) in mm."""

    scale: float
    middle: tuple[float, float]
    turns: Mapping[str, Float[np.ndarray, "2 3 3"]]
    places: Mapping[str, Float[np.ndarray, 2]]


def _telecentric_view(view: ViewImages) -> _TelecentricView:
    enough(view, len(view.poses))
    affine = {name: _affine(found) for name, found in view.poses.items()}
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
        {name: _both_turns(matrix / scale) for name, (matrix, _) in affine.items()},
        {name: (at - middle) / scale for name, (_, at) in affine.items()},
    )


def _affine(found: Detection) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, 2]]:
    """From the target's x, y (mm) to pixels: matrix and offset."""
    points = np.column_stack([found.points[:, :2], np.ones(len(found.points))])
    solution = np.linalg.lstsq(points, found.pixels, rcond=None)[0]
    return solution[:2].T, solution[2]


def _both_turns(block: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 3 3"]:
    """Both rotations that have this upper left block, as nearly as one can."""
    before, (_, least), after = np.linalg.svd(block)
    cosine = min(float(least), 1.0)
    sine = np.sqrt(1 - cosine**2)
    left, right = np.eye(3), np.eye(3)
    left[:2, :2], left[2, 2] = before, np.linalg.det(before)
    right[:2, :2], right[2, 2] = after, np.linalg.det(after)
    tilt = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    return np.stack([left @ t @ right for t in (tilt, tilt.T)])


def _telecentric_rig(
    views: Sequence[ViewImages], alone: Sequence[_TelecentricView], world: str
) -> tuple[dict[int, np.ndarray], dict[str, np.ndarray]]:
    """Rotations of cameras (from the world) and targets (to it): always the camera that shares most poses is next."""
    first = max(range(len(views)), key=lambda i: len(views[i].poses))
    cameras = {first: np.eye(3)}  # the frame until all are tied together
    targets = dict(alone[first].turns)  # each with both rotations or, once another camera has seen it, one
    while len(cameras) < len(views):
        i, shared = next_camera(views, cameras, targets, 2)
        cameras[i], apart = _turned_alike(alone[i].turns, targets, shared)
        if (apart > DISAGREE).sum() * 2 >= len(apart):
            raise contradiction(views[i].name, shared[int(apart.argmax())], float(apart.max()))
        for name, turns in alone[i].turns.items():
            if name not in targets:
                targets[name] = cameras[i].T @ turns
            else:
                left = angles(cameras[i] @ targets[name][:, None], turns).min(axis=1)
                if left.min() < DISAGREE:
                    targets[name] = targets[name][[left.argmin()]]
    if len(views) > 1 and len(targets[world]) > 1:
        raise InputError(f"expected a target pose that two cameras see, got '{world}'", field="world")
    to_world = targets[world][0].T
    turned = {name: to_world @ turns[0] for name, turns in targets.items()}
    return {i: camera @ to_world.T for i, camera in cameras.items()}, turned


def _turned_alike(
    turns: Mapping[str, np.ndarray], targets: Mapping[str, np.ndarray], shared: Sequence[str]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " pose"]]:
    """The rotation under which a camera's targets are turned as the others see them, and by how much they are not."""
    tried = np.concatenate([
        (turns[n][:, None] @ targets[n].transpose(0, 2, 1)[None]).reshape(-1, 3, 3) for n in shared
    ])  # fmt: skip
    apart = np.stack([
        angles(tried[:, None, None] @ targets[n][None, :, None], turns[n][None, None]).min(axis=(1, 2)) for n in shared
    ], axis=1)  # fmt: skip
    best = int(np.minimum(apart, FARTHEST).sum(axis=1).argmin())
    return tried[best], apart[best]


def _places(
    alone: Sequence[_TelecentricView], cameras: Mapping[int, np.ndarray], targets: Mapping[str, np.ndarray], world: str
) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
    """Places of targets in the world and offsets of cameras (x, y, 0), mm, by least squares; unseen depths are 0."""
    names = [n for n in targets if n != world]
    size, count = 2 * len(alone) + 3 * len(names), sum(len(a.places) for a in alone)
    matrix, right = np.zeros((count, 2, size)), np.zeros((count, 2))
    rows = ((i, name, at) for i, a in enumerate(alone) for name, at in a.places.items())
    for row, (i, name, at) in enumerate(rows):
        matrix[row, :, 2 * i : 2 * i + 2], right[row] = np.eye(2), at
        if name != world:
            first = 2 * len(alone) + 3 * names.index(name)
            matrix[row, :, first : first + 3] = cameras[i][:2]
    found = np.linalg.lstsq(matrix.reshape(-1, size), right.ravel(), rcond=1e-9)[0]
    offsets = [np.append(found[2 * i : 2 * i + 2], 0.0) for i in range(len(alone))]
    places = dict(zip(names, found[2 * len(alone) :].reshape(-1, 3), strict=True))
    return {**places, world: np.zeros(3)}, offsets


GUESSES: dict[Projection, Callable[[Sequence[ViewImages], str], Guess]] = {
    PERSPECTIVE: guess_perspective,
    TELECENTRIC: guess_telecentric,
}


def first_guess(
    views: Sequence[ViewImages], distortion: Sequence[str], world: str = "", projection: Projection = PERSPECTIVE
) -> tuple[Bundle, list[Observation]]:
    """Return a bundle to adjust, in the frame of one target pose, and all points found.

    The principal point of a camera that shows no depth stays in the middle of the image: moving it is moving the
    camera and, for the distortion, p1 and p2.

    Parameters
    ----------
    views : what was found in the images of each camera
    distortion : coefficients to be adjusted
    world : name of the target pose that is the world frame; the one that most cameras see if empty
    projection : of all cameras

    Raises
    ------
    InputError
        If a camera has too few poses, is not tied to the others by shared ones, or contradicts them.
    """
    poses, world = _pose_names(views, world)
    guess = GUESSES[projection](views, world)
    every, observations = [guess.targets[n] for n in poses], []
    for i, view in enumerate(views):
        for name, seen in view.poses.items():
            observations.append(Observation(i, poses.index(name), seen, name))
        for name, pose in guess.laid[i].items():  # each a pose of its own
            every.append(pose)
            observations.append(Observation(i, len(every) - 1, view.background[name], name, on_background=True))
    principal = projection.shows_depth
    bundle = Bundle(
        intrinsics=guess.intrinsics,
        cameras=guess.cameras,
        poses=tuple(every),
        fixed=poses.index(world),
        free=(True, True, principal, principal, *(c in distortion for c in COEFFICIENTS)),
        sizes=tuple(v.size for v in views),
        projection=projection,
    )
    return bundle, observations


def _pose_names(views: Sequence[ViewImages], world: str) -> tuple[list[str], str]:
    """All shared poses, and the one that is the world."""
    seen: dict[str, int] = {}
    for view in views:
        for name in view.poses:
            seen[name] = seen.get(name, 0) + 1
    if not seen:
        raise InputError("no image with the target free in space; expected some in every view", field="calibrate")
    if world and world not in seen:
        raise InputError(
            f"expected a target pose that was found, one of {', '.join(sorted(seen))}, got '{world}'", field="world"
        )
    names = sorted(seen)
    return names, world or max(names, key=lambda n: seen[n])
