"""A first guess of perspective cameras: each one alone, then from camera to camera through the poses they share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nerif.common.conventions import InputError
from nerif.imaging.calibration.bundle import Pose
from nerif.imaging.calibration.targets import ViewPictures
from nerif.imaging.guess import DISAGREE, Guess, angles, contradiction, enough, next_camera

__all__ = ["guess_perspective"]

FAR = 0.1  # share of the distance by which two guesses of a camera's place may differ

Alone = tuple[np.ndarray, dict[tuple[str, bool], Pose]]
"""Intrinsics of one camera, and target poses before it by name and whether the target lies on the background."""


def guess_perspective(views: Sequence[ViewPictures], world: str) -> Guess:
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


def _perspective_view(view: ViewPictures) -> Alone:
    """Focal length of one camera and the pose of each target before it, by name and whether it is on the background."""
    import cv2

    pictures = {(n, False): d for n, d in view.poses.items()} | {(n, True): d for n, d in view.background.items()}
    enough(view, len(pictures))
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


def _perspective_rig(
    views: Sequence[ViewPictures], alone: Sequence[Alone], world: str
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
