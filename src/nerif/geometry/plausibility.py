"""Plausibility of a rig: cameras outside the box, rays through it, backgrounds behind it, sizes in mm.

For an implausible rig, common errors of calibrations (UNITS_AND_POSES) are undone one at a time; the first that makes
the rig plausible is the likely cause.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.arrays import Points
from nerif.common.conventions import InputError
from nerif.common.findings import Finding
from nerif.geometry.camera import Camera, Plane
from nerif.geometry.grid import Box
from nerif.geometry.rays import Rays

__all__ = [
    "Suspect",
    "background_cuts",
    "in_one_plane",
    "interface_cuts",
    "likely_cause",
    "rays_on_lattice",
    "rig_findings",
    "suspects",
]

FLAT = 0.05  # rms component of the optical axes across a plane, below which they lie in it
MIN_EDGE, MAX_EDGE = 1.0, 1e4  # mm, of the longest edge of a box
PIXELS, COARSE_PIXELS = 33, 9  # along an edge of an image that are traced, alone and for a comparison of views
RAY_POINTS = 65  # along a ray
BOX_POINTS = 9  # along an edge of the box
MIN_OVERLAP = 0.1  # of rays with the box, and of the box with the image: a camera with less of both looks past it
MARGIN = 0.1  # around an image, over its size, in which a point counts as visible to two views


def in_one_plane(cameras: Sequence[Camera]) -> str:
    """Return a note on cameras that look along one plane, the columns of their images across it; "" if they do not."""
    axes, columns = (torch.stack([camera.rotation[i] for camera in cameras]) for i in (2, 1))
    least, normals = torch.linalg.eigh(axes.T @ axes)
    upright = (columns @ normals[:, 0]).abs().min() > 1 - FLAT
    if len(axes) < 2 or float(least[0]) > FLAT**2 * len(axes) or not bool(upright):
        return ""
    return "the cameras look along one plane, so images that are all upside down agree as well: look at one of them"


@dataclass(frozen=True)
class Suspect:
    """A possible error of a calibration, and the camera and the box without it."""

    words: str
    undo: Callable[[Camera], Camera] = lambda camera: camera
    undo_box: Callable[[Box], Box] = lambda box: box


def _scaled(camera: Camera, factor: float, background: float = 1.0) -> Camera:
    plane = camera.background
    plane = None if plane is None else Plane(plane.normal, background * plane.offset)
    return replace(camera, translation=factor * camera.translation, background=plane)


def _inverse(camera: Camera) -> Camera:
    rotation = camera.rotation.T.contiguous()
    return replace(camera, rotation=rotation, translation=-rotation @ camera.translation)


def _of_opengl(camera: Camera) -> Camera:
    axes = camera.rotation.new_tensor([1.0, -1.0, -1.0])
    return replace(camera, rotation=axes[:, None] * camera.rotation, translation=axes * camera.translation)


def _scaled_box(box: Box, factor: float) -> Box:
    (a, b, c), (d, e, f) = box.lower, box.upper
    return Box((factor * a, factor * b, factor * c), (factor * d, factor * e, factor * f))


OPENGL = "axes of OpenGL or Blender (y up, z towards the camera), where y points down and z away from the camera"
CAMERA_TO_WORLD = "poses from camera to world, where rotation and translation map world to camera"

UNITS_AND_POSES = (
    Suspect("translation in metres, where mm are expected", lambda c: _scaled(c, 1e3)),
    Suspect("translation and background_offset in metres, where mm are expected", lambda c: _scaled(c, 1e3, 1e3)),
    Suspect("translation in centimetres, where mm are expected", lambda c: _scaled(c, 10.0)),
    Suspect(CAMERA_TO_WORLD, _inverse),
    Suspect(
        "translation holds the position of the camera C, where -R C is expected",
        lambda c: replace(c, translation=-c.rotation @ c.translation),
    ),
    Suspect("rotation is transposed (MATLAB)", lambda c: replace(c, rotation=c.rotation.T.contiguous())),
    Suspect(OPENGL, _of_opengl),
    Suspect(f"{CAMERA_TO_WORLD}; and {OPENGL}", lambda c: _of_opengl(_inverse(c))),
    Suspect(f"{CAMERA_TO_WORLD}; and translation in metres", lambda c: _inverse(_scaled(c, 1e3))),
    Suspect("box in metres, where mm are expected", undo_box=lambda box: _scaled_box(box, 1e3)),
    Suspect("box in micrometres, where mm are expected", undo_box=lambda box: _scaled_box(box, 1e-3)),
)
"""Errors of units and poses, the most common first."""


def suspects(
    cameras: Sequence[Camera], box: Box, which: Sequence[int] | None = None
) -> list[tuple[Suspect, tuple[Camera, ...], Box]]:
    """Return the errors without which the rig is plausible, each with the cameras and the box without it.

    Parameters
    ----------
    which : indices of the cameras that may have the error; all by default
    """
    which, possible = range(len(cameras)) if which is None else which, []
    for suspect in UNITS_AND_POSES:
        try:
            cameras_without = tuple(suspect.undo(c) if i in which else c for i, c in enumerate(cameras))
            box_without = suspect.undo_box(box)
        except InputError:  # lengths beyond all limits
            continue
        if all(_plausible(cameras_without[i], box_without) for i in which) and not _size(box_without):
            possible.append((suspect, cameras_without, box_without))
    return possible


def likely_cause(cameras: Sequence[Camera], box: Box, which: Sequence[int] | None = None) -> str:
    """Return the first error without which the rig is plausible, or what to check if there is none."""
    causes = suspects(cameras, box, which)
    return f"likely {causes[0][0].words}" if causes else "check units (mm), poses (world to camera) and names of views"


def rig_findings(cameras: Sequence[Camera], box: Box) -> list[Finding]:
    """Return the implausible properties of a rig, independent of the images."""
    findings, total = [], len(cameras)

    def report(code: str, indices: Sequence[int], text: str) -> None:
        if indices:
            names = tuple(cameras[i].name for i in indices)
            findings.append(Finding(code, f"{Finding.subject(names, total)}: {text}", names))

    if size := _size(box):
        longest = max(box.edges)
        findings.append(Finding(size, f"the box is {longest:.3g} mm long: are its corners, and all of the rig, in mm?"))
    inside = [i for i, camera in enumerate(cameras) if _inside(camera, box)]
    if inside:
        middle = torch.tensor(box.centre, dtype=torch.float64)
        distance = max(float((cameras[i].centre.to(middle) - middle).norm()) for i in inside)
        cause = likely_cause(cameras, box, inside)
        report("inside", inside, f"the camera is inside the box, at most {distance:.3g} mm from its middle; {cause}")
    beside = [i for i, camera in enumerate(cameras) if i not in inside and _looks_past(camera, box)]
    if beside:
        report("beside", beside, f"the camera looks past the box; {likely_cause(cameras, box, beside)}")
    rest = [i for i in range(total) if i not in (*inside, *beside)]
    alone = [rest[i] for i in _without_overlap([cameras[i] for i in rest], box)]
    report(
        "apart", alone, "its rays pass beside those of all others inside the box; check poses, crops and names of views"
    )
    return findings


def rays_on_lattice(camera: Camera, box: Box, pixels: int = PIXELS) -> Rays:
    """Return the rays of `pixels` x `pixels` pixels over the image, clipped to the box."""
    u, v = (torch.linspace(0, n - 1, min(n, pixels), dtype=torch.float64) for n in reversed(camera.image_size))
    return camera.rays(torch.cartesian_prod(u, v).reshape(-1, 2), sensitivity=False).clip(box)


def background_cuts(camera: Camera, box: Box, rays: Rays) -> bool:
    """Return whether the background is in front of the box or in it, along the rays that cross the box."""
    through = rays[rays.crosses]
    if camera.background is None or not len(through):
        return False
    normal = camera.background.normal.to(torch.float64)
    plane = _points(box, 2) @ normal - camera.background.offset
    sight = camera.sight((camera.background.offset * normal).to(camera.rotation))
    behind = -plane * float(sight.to(normal) @ normal)
    return float(behind.min()) <= 0 or not bool(through.unobstructed.all())


def interface_cuts(camera: Camera, box: Box) -> bool:
    """Return whether a part of the box is in front of an interface, as the camera sees it."""
    corners = _points(box, 2)
    for interface in camera.interfaces:
        normal = interface.normal
        normal = normal if float(camera.rotation[2].to(normal) @ normal) > 0 else -normal
        if float((corners @ normal).min() - interface.offset * (normal @ interface.normal)) < -1e-6 * max(box.edges):
            return True
    return False


def _plausible(camera: Camera, box: Box) -> bool:
    """Whether a camera is outside the box, looks at it, and has its background behind it."""
    if _inside(camera, box) or _looks_past(camera, box):
        return False
    rays = rays_on_lattice(camera, box)
    return bool(rays.crosses.any()) and not background_cuts(camera, box, rays)


def _size(box: Box) -> str:
    """Code of a box that is too small or too large, else empty."""
    longest = max(box.edges)
    return "small_box" if longest < MIN_EDGE else "large_box" if longest > MAX_EDGE else ""


def _inside(camera: Camera, box: Box) -> bool:
    """Whether a perspective camera is inside the box."""
    inside = zip(box.lower, camera.centre.tolist(), box.upper, strict=True)
    return camera.projection.shows_depth and all(low < x < high for low, x, high in inside)


def _looks_past(camera: Camera, box: Box) -> bool:
    crossing = float(rays_on_lattice(camera, box).crosses.double().mean())
    return crossing < MIN_OVERLAP and float(_in_image(camera, _points(box)).double().mean()) < MIN_OVERLAP


def _in_image(camera: Camera, points: Points, margin: float = 0.0) -> Bool[Tensor, "*batch"]:
    """Which points are in the image of a camera, or within a margin around it, over its size."""
    points = points.to(camera.rotation)
    size = torch.tensor(camera.image_size[::-1], dtype=points.dtype)
    beyond = 0.5 + (margin * size).clamp_min(1.0) * (margin > 0)
    pixel = camera.project(points)
    inside = ((pixel >= -beyond) & (pixel <= size - 1 + beyond)).all(dim=-1)
    return inside & (camera.local(points)[..., 2] > 0) if camera.projection.shows_depth else inside


def _without_overlap(cameras: Sequence[Camera], box: Box) -> list[int]:
    """Indices of the cameras that see no part of the box that another one sees."""
    if len(cameras) < 2:
        return []
    alone = []
    for i, camera in enumerate(cameras):
        rays = rays_on_lattice(camera, box, COARSE_PIXELS)
        rays = rays[rays.crosses]
        share = torch.linspace(0, 1, RAY_POINTS, dtype=torch.float64)
        points = rays.at(rays.near[:, None] + share * (rays.far - rays.near)[:, None]).reshape(-1, 3)
        others = (other for j, other in enumerate(cameras) if j != i)
        if len(points) and not any(bool(_in_image(other, points, MARGIN).any()) for other in others):
            alone.append(i)
    return alone


def _points(box: Box, count: int = BOX_POINTS) -> Float[Tensor, "n 3"]:
    """A lattice of points over a box, corners included, mm."""
    ends = zip(box.lower, box.upper, strict=True)
    return torch.cartesian_prod(*(torch.linspace(low, high, count, dtype=torch.float64) for low, high in ends))
