"""A first guess of a rig, of either projection: what it holds, and why there is none."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.imaging.calibration.bundle import Pose
from nerif.imaging.calibration.targets import ViewPictures

__all__ = ["DISAGREE", "Guess", "angles", "contradiction", "enough", "next_camera"]

DISAGREE = 5.0  # degrees by which two guesses of a rotation may differ


@dataclass(frozen=True)
class Guess:
    """Where cameras and targets are, to begin with.

    Parameters
    ----------
    intrinsics : (camera, 9) as those of a Bundle
    cameras : world to camera
    targets : target to world, of the poses that cameras share, by name
    laid : target to world, of each camera's pictures of the target on its background, by name
    """

    intrinsics: Float[np.ndarray, "camera 9"]
    cameras: tuple[Pose, ...]
    targets: Mapping[str, Pose]
    laid: tuple[Mapping[str, Pose], ...]


def enough(view: ViewPictures, pictures: int) -> None:
    """Refuse fewer than three pictures of a target."""
    if pictures < 3:
        raise InputError(
            f"view '{view.name}': expected the target in 3 pictures at least (10 or more, tilted in different ways, "
            f"are good), found it in {pictures}"
        )


def next_camera(
    views: Sequence[ViewPictures], tied: Collection[int], targets: Collection[str], least: int
) -> tuple[int, list[str]]:
    """Return the camera, of those not tied to the others yet, that shares most target poses with them, and which.

    Parameters
    ----------
    views : what was found in the pictures of each camera
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
            f"view {names}: {number} shared with the other cameras, so there is no common frame; take "
            "pictures of one pose with neighbouring cameras at the same time, under the same number"
        )
    return chosen, shared[chosen]


def angles(a: Float[np.ndarray, "*#n 3 3"], b: Float[np.ndarray, "*#n 3 3"]) -> Float[np.ndarray, "*n"]:
    """Return the angles between rotations, degrees."""
    cosine = ((a * b).sum(axis=(-2, -1)) - 1) / 2
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def contradiction(view: str, pose: str, degrees: float) -> InputError:
    """What to say of a camera that sees target poses otherwise than the others."""
    return InputError(
        f"view '{view}': its target poses contradict those of the other cameras (by {degrees:.0f} "
        f"degrees in '{pose}'); are its pictures mirrored (flip), or of other poses than their names say?"
    )
