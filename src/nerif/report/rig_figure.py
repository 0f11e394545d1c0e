"""The rig in three dimensions: cameras, their fields of view, box and background planes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float

from nerif.common.files import atomic
from nerif.geometry import Box, Camera
from nerif.plotting.drawing import plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

__all__ = ["ImageCorners", "box_edges", "draw_rig", "draw_two_sides", "image_corners", "save_rig"]

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")  # Okabe & Ito


def draw_rig(axes: Axes3D, cameras: Sequence[Camera], box: Box | None = None) -> Axes3D:
    """Draw cameras as pyramids or telecentric beams, backgrounds, box and world axes; mm.

    A thick edge marks the top of the image.
    """
    from matplotlib.ticker import MaxNLocator

    corners = [image_corners(c, np.zeros(3) if box is None else np.array(box.centre)) for c in cameras]
    centres = np.stack([c.start.mean(axis=0) for c in corners])
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    extent = spread or float(np.linalg.norm(centres[0])) or 1.0
    points = [centres]
    rank = np.argsort(np.argsort(np.arctan2(*(centres - centres.mean(axis=0)).T[1::-1])))
    for i, (camera, corner, centre) in enumerate(zip(cameras, corners, centres, strict=True)):
        colour = COLOURS[i % len(COLOURS)]
        line = {"color": colour, "linewidth": 0.8}
        tips = corner.start + 0.18 * extent * corner.direction
        _closed(axes, tips, **line)
        axes.plot(*tips[:2].T, color=colour, linewidth=3)
        for start, tip in zip(corner.start, tips, strict=True):
            axes.plot(*np.stack([start, tip]).T, **line)
        _closed(axes, corner.start, **line)
        if camera.background is not None:
            _closed(axes, corner.end, **line, linestyle="--")
            axes.plot(*corner.end[:2].T, color=colour, linewidth=3)
        target = corner.end.mean(axis=0)
        axes.plot(*np.stack([centre, target]).T, color=colour, linewidth=0.4, alpha=0.6)
        outward = -corner.direction.mean(axis=0)  # the target may lie in the camera, if that is the world
        outward /= np.linalg.norm(outward)
        name_at = centre + (0.09, 0.2)[rank[i] % 2] * extent * outward  # so that names of neighbours do not overlap
        axes.text(*name_at, plain(camera.name), color=colour, fontsize=6.5, ha="center", va="center")
        points += [name_at[None], corner.start, corner.end]
    if box is not None:
        for ends in box_edges(box):
            axes.plot(*ends.T, color="black", linewidth=1)
    for axis, (name, colour) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        end = np.zeros(3)
        end[axis] = 0.3 * extent
        axes.plot(*np.stack([np.zeros(3), end]).T, color=colour, linewidth=1.5)
        axes.text(*(1.15 * end), name, color=colour, fontsize=9, fontweight="bold")
    every = np.concatenate([*points, np.zeros((1, 3))])
    middle, half = (every.max(axis=0) + every.min(axis=0)) / 2, np.maximum(np.ptp(every, axis=0) / 2, 0.25 * extent)
    for name, m, h in zip("xyz", middle, half, strict=True):
        axes.set(**{f"{name}lim": (m - h, m + h), f"{name}label": f"{name} [mm]"})
    axes.set_box_aspect(tuple(half))
    axes.zaxis.set_major_locator(MaxNLocator(3))
    axes.tick_params(labelsize=6)
    return axes


def draw_two_sides(figure: Figure, cameras: Sequence[Camera], box: Box | None = None) -> None:
    """Fill a figure with the rig in an oblique view and along z."""
    for i, (title, elevation, azimuth) in enumerate((("oblique view", 28, -60), ("from above (along -z)", 89.9, -90))):
        axes: Any = figure.add_axes((0.04 + 0.5 * i, 0.06, 0.4, 0.86), projection="3d")
        axes.patch.set_visible(False)  # it would cover the labels of its neighbour
        draw_rig(axes, cameras, box)
        axes.set_proj_type("ortho")
        axes.view_init(elevation, azimuth)
        axes.set_title(title)
        if i == 1:
            axes.set_zticks([])
            axes.set_zlabel("")
    figure.text(
        0.5, 0.02,
        "solid pyramids, or beams of telecentric lenses: cameras; dashed: their fields of view on the background; "
        "thick edges: top of the image; black: box",
        ha="center",
    )  # fmt: skip


def save_rig(path: Path, cameras: Sequence[Camera], box: Box | None = None) -> None:
    """Write an image of the rig from two sides."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"font.size": 8, "axes.titlesize": 9}):
        figure = Figure(figsize=(12, 6.2))
        draw_two_sides(figure, cameras, box)
        with atomic(path) as part:
            figure.savefig(part, dpi=130)


@dataclass(frozen=True)
class ImageCorners:
    """The lines of sight of the four corners of an image, the top edge first; mm."""

    start: Float[np.ndarray, "4 3"]
    """Where to begin drawing: the optical centre, or points of a telecentric beam before the target."""
    direction: Float[np.ndarray, "4 3"]  #: unit vectors, away from the camera
    end: Float[np.ndarray, "4 3"]  #: on the background or, without one, at the depth of the target


def image_corners(camera: Camera, target: Float[np.ndarray, 3]) -> ImageCorners:
    """Return the lines of sight of the image corners of a camera that looks at `target` (mm).

    Telecentric lines start at the camera's frame, but at most twice the diagonal of the image before the target.
    Distortion is ignored where it cannot be inverted at a corner.
    """
    height, width = camera.image_size
    last_row, last_column = height - 1, width - 1
    pixels = torch.tensor([[0, 0], [last_column, 0], [last_column, last_row], [0, last_row]], dtype=torch.float64)
    rays = camera.rays(pixels, sensitivity=False)
    if not bool((rays.origin + rays.direction).isfinite().all()):
        rays = replace(camera, distortion=torch.zeros_like(camera.distortion)).rays(pixels, sensitivity=False)
    origin, direction = rays.origin.numpy(), rays.direction.numpy()
    depth = ((target - origin) * direction).sum(axis=1, keepdims=True)
    before = np.minimum(0.0, depth - 2 * np.linalg.norm(origin[2] - origin[0]))
    first = np.maximum(before, rays.begin.numpy()[:, None])
    last = depth if rays.background is None else rays.background.distance.numpy()[:, None]
    start = origin + first * direction
    if camera.interfaces and camera.projection.shows_depth:  # not where the ray begins, on the last interface
        start = np.broadcast_to(camera.centre.double().numpy(), start.shape)
    return ImageCorners(start, direction, origin + last * direction)


def box_edges(box: Box) -> Float[np.ndarray, "edge end 3"]:
    """Return both ends of each edge of a box, mm."""
    corners = np.array(list(itertools.product(*zip(box.lower, box.upper, strict=True))))
    return np.array([(a, b) for a, b in itertools.combinations(corners, 2) if np.count_nonzero(a != b) == 1])


def _closed(axes: Axes3D, corners: np.ndarray, **style: object) -> None:
    axes.plot(*np.concatenate([corners, corners[:1]]).T, **style)
