"""The rig in three dimensions: cameras, what they see, box and background planes. Mirrored axes show here first."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from nerif.atomic import atomic
from nerif.geometry import Box, Camera

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

__all__ = ["draw_rig", "draw_two_sides", "picture_corners", "save_rig"]

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")  # Okabe & Ito


def draw_rig(axes: Axes3D, cameras: Sequence[Camera], box: Box | None = None) -> Axes3D:
    """Draw cameras as pyramids (a thick edge marks the top of the picture), backgrounds, box and world axes; mm."""
    from matplotlib.ticker import MaxNLocator

    centres = np.stack([c.centre.numpy() for c in cameras])
    reach = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()) or float(np.linalg.norm(centres[0]))
    everything = [centres]
    around = np.argsort(np.argsort(np.arctan2(*(centres - centres.mean(axis=0)).T[1::-1])))
    for i, camera in enumerate(cameras):
        colour = COLOURS[i % len(COLOURS)]
        directions, hits = picture_corners(camera)
        pyramid = camera.centre.numpy() + 0.18 * reach * directions
        _close(axes, pyramid, color=colour, linewidth=0.8)
        axes.plot(*pyramid[:2].T, color=colour, linewidth=3)
        _close(axes, hits, color=colour, linewidth=0.8, linestyle="--")
        axes.plot(*hits[:2].T, color=colour, linewidth=3)
        for corner in pyramid:
            axes.plot(*np.stack([camera.centre.numpy(), corner]).T, color=colour, linewidth=0.8)
        axes.plot(*np.stack([camera.centre.numpy(), hits.mean(axis=0)]).T, color=colour, linewidth=0.4, alpha=0.6)
        outward = camera.centre.numpy() - hits.mean(axis=0)
        outward /= np.linalg.norm(outward)
        away = (0.09, 0.2)[around[i] % 2] * reach  # names of neighbours are not in each other's way
        name_at = camera.centre.numpy() + away * outward
        axes.text(*name_at, camera.name, color=colour, fontsize=6.5, ha="center", va="center", parse_math=False)
        everything += [name_at[None], hits]
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
        "solid pyramids: cameras; dashed: what they see of their backgrounds; thick edges: top of the picture; "
        "black: box",
        ha="center",
    )  # fmt: skip


def save_rig(path: Path, cameras: Sequence[Camera], box: Box | None = None) -> None:
    """Write a picture of the rig from two sides."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"font.size": 8, "axes.titlesize": 9}):
        figure = Figure(figsize=(12, 6.2))
        draw_two_sides(figure, cameras, box)
        with atomic(path) as part:
            figure.savefig(part, dpi=130)


def picture_corners(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Directions of the four corners of the picture, the top edge first, and where they meet the background (mm)."""
    height, width = camera.image_size
    pixels = torch.tensor(
        [[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=torch.float64
    )  # fmt: skip
    rays = camera.rays(pixels)
    return rays.direction.numpy(), rays.end_points.numpy()


def _close(axes: Axes3D, corners: np.ndarray, **style: object) -> None:
    axes.plot(*np.concatenate([corners, corners[:1]]).T, **style)


def _draw_box(axes: Axes3D, box: Box) -> None:
    corners = np.array(list(itertools.product(*zip(box.lower, box.upper, strict=True))))
    for a, b in itertools.combinations(corners, 2):
        if np.count_nonzero(a != b) == 1:
            axes.plot(*np.stack([a, b]).T, color="black", linewidth=1)
