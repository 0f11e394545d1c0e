"""A first guess of telecentric cameras from flat targets.

Along parallel lines a camera sees an affine picture of the target, whose larger singular value is the camera's scale,
and whose ratio of singular values is the cosine of the target's tilt. The sign of the tilt does not show: each picture
has two rotations. Two cameras that see the same poses decide between them, up to the mirror image of the whole rig
(`mirrored`).

Sources: Tomasi & Kanade, Shape and motion from image streams under orthography, Int. J. Comput. Vis. 9 (1992) 137;
Collins & Bartoli, Infinitesimal plane-based pose estimation, Int. J. Comput. Vis. 109 (2014) 252.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.imaging.calibration.bundle import Bundle, Pose
from nerif.imaging.calibration.targets import Detection, ViewPictures
from nerif.imaging.guess import DISAGREE, Guess, angles, contradiction, enough, next_camera

__all__ = ["guess_telecentric", "mirrored"]

FARTHEST = 3 * DISAGREE  # degrees: rotations further apart than this do not fit, no matter by how much
FLIP = np.diag([1.0, 1.0, -1.0])


def guess_telecentric(views: Sequence[ViewPictures], world: str) -> Guess:
    """Return intrinsics and poses in the frame of the target pose `world`; pictures on the background are not used.

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
    """Return the rig mirrored at the world's plane z = 0, cameras looking the other way: it takes the same pictures."""

    def flipped(pose: Pose) -> Pose:
        return Pose(FLIP @ pose.rotation @ FLIP, FLIP @ pose.translation)

    return replace(bundle, cameras=tuple(map(flipped, bundle.cameras)), poses=tuple(map(flipped, bundle.poses)))


@dataclass(frozen=True)
class _TelecentricView:
    """One camera: px/mm, the middle of its picture (px), and of each pose both rotations and the place (x, y) in mm."""

    scale: float
    middle: tuple[float, float]
    turns: Mapping[str, Float[np.ndarray, "2 3 3"]]
    places: Mapping[str, Float[np.ndarray, 2]]


def _telecentric_view(view: ViewPictures) -> _TelecentricView:
    enough(view, len(view.poses))
    affine = {name: _affine(found) for name, found in view.poses.items()}
    for name, (matrix, _) in affine.items():
        if not np.linalg.det(matrix) > 0:
            raise InputError(f"view '{view.name}': sees the target of '{name}' from behind; is it mirrored (flip)?")
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
    views: Sequence[ViewPictures], alone: Sequence[_TelecentricView], world: str
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
        raise InputError(f"world: expected a target pose that two cameras see, got '{world}'")
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
