"""Can a rig be as its calibration says? Cameras outside the box, rays through it, backgrounds behind it, sizes in mm.

Where it cannot, errors that are common in calibrations (UNITS_AND_POSES) are undone one at a time; the first that makes
the rig a possible one is the likely cause.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError, Points
from nerif.common.findings import Finding
from nerif.geometry.camera import Camera, Plane
from nerif.geometry.grid import Box
from nerif.geometry.rays import Rays

__all__ = ["Suspect", "background_cuts", "likely_cause", "rays_on_lattice", "rig_findings", "suspects"]

LEAST, MOST = 1.0, 1e4  # mm, of the longest edge of a box that is plausible
ACROSS, ALONG = 33, 65  # pixels along an edge of an image that are traced, and points along each of their rays
COARSE = 9  # the same pixels where the points along their rays are projected into the other images
BESIDE = 0.1  # of the rays that cross the box, and of the box that is in the image: below both a camera looks past it
MARGIN = 0.1  # of the image that a point may be outside and still count as seen by two views


@dataclass(frozen=True)
class Suspect:
    """An error that may be in a calibration.

    Parameters
    ----------
    words : what it is
    undo : gives the camera without it
    undo_box : gives the box without it
    """

    words: str
    undo: Callable[[Camera], Camera] = lambda camera: camera
    undo_box: Callable[[Box], Box] = lambda box: box


def _moved(camera: Camera, factor: float, background: float = 1.0) -> Camera:
    plane = camera.background
    plane = None if plane is None else Plane(plane.normal, background * plane.offset)
    return replace(camera, translation=factor * camera.translation, background=plane)


def _inverse(camera: Camera) -> Camera:
    rotation = camera.rotation.T.contiguous()
    return replace(camera, rotation=rotation, translation=-rotation @ camera.translation)


def _of_opengl(camera: Camera) -> Camera:
    axes = camera.rotation.new_tensor([1.0, -1.0, -1.0])
    return replace(camera, rotation=axes[:, None] * camera.rotation, translation=axes * camera.translation)


def _scaled(box: Box, factor: float) -> Box:
    (a, b, c), (d, e, f) = box.lower, box.upper
    return Box((factor * a, factor * b, factor * c), (factor * d, factor * e, factor * f))


OPENGL = "axes of OpenGL or Blender (y up, z towards the camera), where y points down and z away from the camera"
CAMERA_TO_WORLD = "poses from camera to world, where rotation and translation map world to camera"

UNITS_AND_POSES = (
    Suspect("translation in metres, where mm are expected", lambda c: _moved(c, 1e3)),
    Suspect("translation and background_offset in metres, where mm are expected", lambda c: _moved(c, 1e3, 1e3)),
    Suspect("translation in centimetres, where mm are expected", lambda c: _moved(c, 10.0)),
    Suspect(CAMERA_TO_WORLD, _inverse),
    Suspect(
        "translation holds the position of the camera C, where -R C is expected",
        lambda c: replace(c, translation=-c.rotation @ c.translation),
    ),
    Suspect("rotation is transposed (MATLAB)", lambda c: replace(c, rotation=c.rotation.T.contiguous())),
    Suspect(OPENGL, _of_opengl),
    Suspect(f"{CAMERA_TO_WORLD}; and {OPENGL}", lambda c: _of_opengl(_inverse(c))),
    Suspect(f"{CAMERA_TO_WORLD}; and translation in metres", lambda c: _inverse(_moved(c, 1e3))),
    Suspect("box in metres, where mm are expected", undo_box=lambda box: _scaled(box, 1e3)),
    Suspect("box in micrometres, where mm are expected", undo_box=lambda box: _scaled(box, 1e-3)),
)
"""Errors of units and poses, the most common first."""


def suspects(
    cameras: Sequence[Camera], box: Box, which: Sequence[int] | None = None
) -> list[tuple[Suspect, tuple[Camera, ...], Box]]:
    """Return every suspect with the rig as it is without it, where that is a possible one.

    Parameters
    ----------
    which : numbers of the cameras that may have it; all by default
    """
    which, possible = range(len(cameras)) if which is None else which, []
    for suspect in UNITS_AND_POSES:
        try:
            undone = tuple(suspect.undo(c) if i in which else c for i, c in enumerate(cameras))
            other = suspect.undo_box(box)
        except InputError:  # lengths beyond all limits
            continue
        if all(_sound(undone[i], other) for i in which) and not _size(other):
            possible.append((suspect, undone, other))
    return possible


def likely_cause(cameras: Sequence[Camera], box: Box, which: Sequence[int] | None = None) -> str:
    """Return the words of the first suspect without which the rig is possible, or what to look at where none is."""
    found = suspects(cameras, box, which)
    return f"likely {found[0][0].words}" if found else "check units (mm), poses (world to camera) and names of views"


def rig_findings(cameras: Sequence[Camera], box: Box) -> list[Finding]:
    """Return what cannot be right in a rig, whatever the images show.

    Parameters
    ----------
    cameras : one a view
    box : Box, mm
    """
    found, total = [], len(cameras)
    if size := _size(box):
        longest = max(box.edges)
        found.append(Finding(size, f"the box is {longest:.3g} mm long: are its corners, and all of the rig, in mm?"))
    inside = [i for i, camera in enumerate(cameras) if _inside(camera, box)]
    if inside:
        names = tuple(cameras[i].name for i in inside)
        middle = torch.tensor(box.centre, dtype=torch.float64)
        far = max(float((cameras[i].centre.to(middle) - middle).norm()) for i in inside)
        what = f"inside the box, at most {far:.3g} mm from its middle; {likely_cause(cameras, box, inside)}"
        found.append(Finding("inside", f"{Finding.subject(names, total)}: the camera is {what}", names))
    beside = [i for i, camera in enumerate(cameras) if i not in inside and _looks_past(camera, box)]
    if beside:
        names = tuple(cameras[i].name for i in beside)
        what = f"the camera looks past the box; {likely_cause(cameras, box, beside)}"
        found.append(Finding("beside", f"{Finding.subject(names, total)}: {what}", names))
    rest = [i for i in range(total) if i not in (*inside, *beside)]
    alone = _without_company([cameras[i] for i in rest], box)
    if alone:
        names = tuple(cameras[rest[i]].name for i in alone)
        what = "its rays pass beside those of all others inside the box; check poses, crops and names of views"
        found.append(Finding("apart", f"{Finding.subject(names, total)}: {what}", names))
    return found


def rays_on_lattice(camera: Camera, box: Box, across: int = ACROSS) -> Rays:
    """Return the rays of some pixels, evenly over the image, clipped to the box."""
    u, v = (torch.linspace(0, n - 1, min(n, across), dtype=torch.float64) for n in reversed(camera.image_size))
    return camera.rays(torch.cartesian_prod(u, v).reshape(-1, 2), sensitivity=False).clip(box)


def background_cuts(camera: Camera, box: Box, rays: Rays) -> bool:
    """Whether the background is in front of the box or in it, as the rays that cross the box see it."""
    through = rays[rays.crosses]
    if camera.background is None or not len(through):
        return False
    normal = camera.background.normal.to(torch.float64)
    plane = _corners(box) @ normal - camera.background.offset
    sight = camera.sight((camera.background.offset * normal).to(camera.rotation))
    behind = -plane * float(sight.to(normal) @ normal)
    return float(behind.min()) <= 0 or not bool(through.unobstructed.all())


def _sound(camera: Camera, box: Box) -> bool:
    """Whether a camera is outside the box, near enough to look at it, and has its background behind it."""
    if _inside(camera, box) or _looks_past(camera, box):
        return False
    rays = rays_on_lattice(camera, box)
    return bool(rays.crosses.any()) and not background_cuts(camera, box, rays)


def _size(box: Box) -> str:
    """The code of a box that is too small or too large; nothing where it is plausible."""
    longest = max(box.edges)
    return "small_box" if longest < LEAST else "large_box" if longest > MOST else ""


def _inside(camera: Camera, box: Box) -> bool:
    """Whether a camera that has a place is inside the box."""
    inside = zip(box.lower, camera.centre.tolist(), box.upper, strict=True)
    return camera.projection.shows_depth and all(low < x < high for low, x, high in inside)


def _looks_past(camera: Camera, box: Box) -> bool:
    """Whether hardly a ray crosses the box, and hardly any of the box is in the image."""
    crossing = float(rays_on_lattice(camera, box).crosses.double().mean())
    return crossing < BESIDE and float(_in_image(camera, _points(box)).double().mean()) < BESIDE


def _in_image(camera: Camera, points: Points, margin: float = 0.0) -> Bool[Tensor, "*batch"]:
    """Which points a camera has in its image, or within that share of it outside."""
    points = points.to(camera.rotation)
    size = torch.tensor(camera.image_size[::-1], dtype=points.dtype)
    beyond = 0.5 + (margin * size).clamp_min(1.0) * (margin > 0)
    pixel = camera.project(points)
    seen = ((pixel >= -beyond) & (pixel <= size - 1 + beyond)).all(dim=-1)
    return seen & (camera.local(points)[..., 2] > 0) if camera.projection.shows_depth else seen


def _without_company(cameras: Sequence[Camera], box: Box) -> list[int]:
    """Numbers of the cameras that see no part of the box that another one sees."""
    if len(cameras) < 2:
        return []
    alone = []
    for i, camera in enumerate(cameras):
        rays = rays_on_lattice(camera, box, COARSE)
        rays = rays[rays.crosses]
        share = torch.linspace(0, 1, ALONG, dtype=torch.float64)
        points = rays.at(rays.near[:, None] + share * (rays.far - rays.near)[:, None]).reshape(-1, 3)
        others = (other for j, other in enumerate(cameras) if j != i)
        if len(points) and not any(bool(_in_image(other, points, MARGIN).any()) for other in others):
            alone.append(i)
    return alone


def _points(box: Box) -> Float[Tensor, "n 3"]:
    """Points all over a box, corners included, mm."""
    axes = (
        torch.linspace(low, high, COARSE, dtype=torch.float64) for low, high in zip(box.lower, box.upper, strict=True)
    )
    return torch.cartesian_prod(*axes)


def _corners(box: Box) -> Float[Tensor, "8 3"]:
    return torch.cartesian_prod(
        *(torch.tensor(pair, dtype=torch.float64) for pair in zip(box.lower, box.upper, strict=True))
    )
