"""The rig in three dimensions: cameras, what they see, box and background planes. Mirrored axes show here first."""

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

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

__all__ = ["ImageCorners", "draw_rig", "draw_two_sides", "image_corners", "save_rig"]

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")  # Okabe & Ito


def draw_rig(axes: Axes3D, cameras: Sequence[Camera], box: Box | None = None) -> Axes3D:
    """Draw cameras as the pyramids or, telecentric, the beams they see along; backgrounds, box and world axes; mm.

    A thick edge marks the top of the image.
    """
    from matplotlib.ticker import MaxNLocator

    middle = np.zeros(3) if box is None else np.array(box.centre)
    seen = [image_corners(c, middle) for c in cameras]
    centres = np.stack([s.start.mean(axis=0) for s in seen])
    reach = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()) or float(np.linalg.norm(centres[0]))
    everything = [centres]
    around = np.argsort(np.argsort(np.arctan2(*(centres - centres.mean(axis=0)).T[1::-1])))
    for i, (camera, corners, centre) in enumerate(zip(cameras, seen, centres, strict=True)):
        colour = COLOURS[i % len(COLOURS)]
        tips = corners.start + 0.18 * reach * corners.direction
        _close(axes, tips, color=colour, linewidth=0.8)
        axes.plot(*tips[:2].T, color=colour, linewidth=3)
        for start, tip in zip(corners.start, tips, strict=True):
            axes.plot(*np.stack([start, tip]).T, color=colour, linewidth=0.8)
        _close(axes, corners.start, color=colour, linewidth=0.8)
        if camera.background is not None:
            _close(axes, corners.end, color=colour, linewidth=0.8, linestyle="--")
            axes.plot(*corners.end[:2].T, color=colour, linewidth=3)
        target = corners.end.mean(axis=0)
        axes.plot(*np.stack([centre, target]).T, color=colour, linewidth=0.4, alpha=0.6)
        outward = (centre - target) / np.linalg.norm(centre - target)
        away = (0.09, 0.2)[around[i] % 2] * reach  # names of neighbours are not in each other's way
        name_at = centre + away * outward
        axes.text(*name_at, camera.name, color=colour, fontsize=6.5, ha="center", va="center", parse_math=False)
        everything += [name_at[None], corners.start, corners.end]
    if box is not None:
        _draw_box(axes, box)
    for axis, (name, colour) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        end = np.zeros(3)
        end[axis] = 0.3 * reach
        axes.plot(*np.stack([np.zeros(3), end]).T, color=colour, linewidth=1.5)
        axes.text(*(1.15 * end), name, color=colour, fontsize=9, fontweight="bold")
    points = np.concatenate([*everything, np.zeros((1, 3))])
    middle, half = (points.max(axis=0) + points.min(axis=0)) / 2, np.maximum(np.ptp(points, axis=0) / 2, 0.25 * reach)
    for setter, m, h in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, half, strict=True):
        setter(m - h, m + h)
    axes.set_box_aspect(tuple(half))
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("y [mm]")
    axes.set_zlabel("z [mm]")
    axes.zaxis.set_major_locator(MaxNLocator(3))
    axes.tick_params(labelsize=6)
    return axes


def draw_two_sides(figure: Figure, cameras: Sequence[Camera], box: Box | None = None) -> None:
    """Fill a figure with the rig from two sides: obliquely from above, and along z."""
    for i, (title, elevation, azimuth) in enumerate((("oblique view", 28, -60), ("from above (along -z)", 89.9, -90))):
        axes: Any = figure.add_axes((0.04 + 0.5 * i, 0.06, 0.4, 0.86), projection="3d")
        axes.patch.set_visible(False)  # it would hide what its neighbour writes at the edge
        draw_rig(axes, cameras, box)
        axes.set_proj_type("ortho")
        axes.view_init(elevation, azimuth)
        axes.set_title(title)
        if i == 1:
            axes.set_zticks([])
            axes.set_zlabel("")
    figure.text(
        0.5, 0.02,
        "solid pyramids, or beams of telecentric lenses: cameras; dashed: what they see of their backgrounds; "
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
    """The lines along which a camera sees the four corners of its image, the top edge first; mm.

    Parameters
    ----------
    start : (4, 3) where to begin drawing them: the optical centre, or places before what is looked at
    direction : (4, 3) unit vectors, away from the camera
    end : (4, 3) on the background or, without one, abreast of what is looked at
    """

    start: Float[np.ndarray, "4 3"]
    direction: Float[np.ndarray, "4 3"]
    end: Float[np.ndarray, "4 3"]


def image_corners(camera: Camera, middle: Float[np.ndarray, 3]) -> ImageCorners:
    """Return the lines to the corners of the image of a camera that looks at `middle` (mm).

    Lines without a beginning are drawn from where the camera's frame is, or from twice the diagonal of the image
    before the middle if that is further off. Where the distortion of a corner cannot be inverted, it is left out.
    """
    height, width = camera.image_size
    pixels = torch.tensor(
        [[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=torch.float64
    )  # fmt: skip
    rays = camera.rays(pixels, sensitivity=False)
    if not bool((rays.origin + rays.direction).isfinite().all()):
        rays = replace(camera, distortion=torch.zeros_like(camera.distortion)).rays(pixels, sensitivity=False)
    origin, direction = rays.origin.numpy(), rays.direction.numpy()
    abreast = ((middle - origin) * direction).sum(axis=1, keepdims=True)
    before = np.minimum(0.0, abreast - 2 * np.linalg.norm(origin[2] - origin[0]))
    first = np.maximum(before, rays.begin.numpy()[:, None])
    last = abreast if rays.background is None else rays.background.distance.numpy()[:, None]
    return ImageCorners(origin + first * direction, direction, origin + last * direction)


def _close(axes: Axes3D, corners: np.ndarray, **style: object) -> None:
    axes.plot(*np.concatenate([corners, corners[:1]]).T, **style)


def _draw_box(axes: Axes3D, box: Box) -> None:
    corners = np.array(list(itertools.product(*zip(box.lower, box.upper, strict=True))))
    for a, b in itertools.combinations(corners, 2):
        if np.count_nonzero(a != b) == 1:
            axes.plot(*np.stack([a, b]).T, color="black", linewidth=1)
