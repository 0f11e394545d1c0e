"""A first guess of a whole rig, by the way that its projection needs, as a bundle to adjust."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from nerif.common.conventions import InputError
from nerif.geometry import PERSPECTIVE, TELECENTRIC, Projection
from nerif.imaging.calibration.bundle import COEFFICIENTS, Bundle, Observation
from nerif.imaging.calibration.targets import ViewPictures
from nerif.imaging.guess import Guess
from nerif.imaging.perspective_guess import guess_perspective
from nerif.imaging.telecentric_guess import guess_telecentric

__all__ = ["first_guess"]

GUESSES: dict[Projection, Callable[[Sequence[ViewPictures], str], Guess]] = {
    PERSPECTIVE: guess_perspective,
    TELECENTRIC: guess_telecentric,
}


def first_guess(
    views: Sequence[ViewPictures], distortion: Sequence[str], world: str = "", projection: Projection = PERSPECTIVE
) -> tuple[Bundle, list[Observation]]:
    """Return a bundle to adjust, in the frame of one target pose, and all points found.

    The principal point of a camera that shows no depth stays in the middle of the picture: moving it is moving the
    camera and, for the distortion, p1 and p2.

    Parameters
    ----------
    views : what was found in the pictures of each camera
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


def _pose_names(views: Sequence[ViewPictures], world: str) -> tuple[list[str], str]:
    """All shared poses, and the one that is the world."""
    seen: dict[str, int] = {}
    for view in views:
        for name in view.poses:
            seen[name] = seen.get(name, 0) + 1
    if not seen:
        raise InputError("calibrate: no picture with the target free in space; expected some in every view")
    if world and world not in seen:
        raise InputError(
            f"world: expected a target pose that was found, one of {', '.join(sorted(seen))}, got '{world}'"
        )
    names = sorted(seen)
    return names, world or max(names, key=lambda n: seen[n])
