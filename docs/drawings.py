"""The drawings of the pages on conventions, method, pixels, images and rigs as SVG: `python docs/drawings.py FOLDER`.

What they show is computed by nerif itself: camera axes, pixels and rays by `Camera`, voxel centres by `Grid`, the
displacement by warping dots as its definition says. A convention that changed would change the drawing.
"""
# ruff: noqa: RUF005 -- these are arrays, which are added and not joined

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import torch
from drawing_of_rig import observable
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from nerif.forward.images import References
from nerif.geometry import Box, Camera, Grid, Lens, Ring

__all__ = ["DRAWINGS", "draw_all"]

# Okabe & Ito, who can be told apart by everybody
BLUE, ORANGE, GREEN, RED, PURPLE, SKY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9"
INK, GREY, PALE = "#222222", "#7F7F7F", "#DDDDDD"
STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "mathtext.fontset": "dejavusans",
    "svg.hashsalt": "nerif",
    "svg.fonttype": "path",
}
Point = np.ndarray


class View:
    """Parallel projection of the world onto the paper, as seen along `towards`."""

    def __init__(self, towards: tuple[float, float, float]) -> None:
        forward = np.array(towards) / np.linalg.norm(towards)
        self.right = np.cross(forward, [0, 0, 1])
        self.right /= np.linalg.norm(self.right)
        self.up = np.cross(self.right, forward)

    def __call__(self, points: object) -> Point:
        """Map (..., 3) to (..., 2)."""
        p = np.asarray(points, dtype=float)
        return np.stack([p @ self.right, p @ self.up], axis=-1)


def label(axes: Axes, at: Point, text: str, offset: tuple[float, float] = (0, 0), **options: object) -> None:
    """Write beside a point; the offset is in typographic points."""
    settings = {"ha": "center", "va": "center", "color": INK, "zorder": 20, "annotation_clip": False} | options
    axes.annotate(text, at, xytext=offset, textcoords="offset points", **settings)  # type: ignore[arg-type]


def arrow(axes: Axes, start: Point, end: Point, colour: str, width: float = 1.8, zorder: float = 10) -> None:
    """Draw an arrow from start to end."""
    style = {"arrowstyle": "-|>,head_width=0.22,head_length=0.5", "color": colour, "lw": width}
    style |= {"shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, xytext=start, arrowprops=style, annotation_clip=False, zorder=zorder)


def edges(axes: Axes, view: View, corners: Callable[[int, int, int], Point], hidden: tuple[int, int, int]) -> None:
    """Draw the edges of a box; those that meet in the corner `hidden` are behind it."""
    for axis in range(3):
        for a in (0, 1):
            for b in (0, 1):
                ends = [[a, b], [a, b]]
                for k, end in enumerate(ends):
                    end.insert(axis, k)
                behind = any(tuple(end) == hidden for end in ends)
                line = view([corners(*ends[0]), corners(*ends[1])])
                dash = (0, (4, 3)) if behind else "-"
                axes.plot(*line.T, color=GREY, lw=1.0 if behind else 1.3, ls=dash, zorder=1 if behind else 6)


def panel() -> tuple[Figure, Axes]:
    """An empty drawing; see fit."""
    figure = Figure(figsize=(9.2, 4.5), facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_aspect("equal", adjustable="datalim")
    axes.axis("off")
    return figure, axes


def fit(axes: Axes, margin: float) -> None:
    """Set limits and height so that all that is drawn is inside, `margin` points to spare; the width stays."""
    figure = axes.figure
    assert isinstance(figure, Figure)
    canvas = FigureCanvasAgg(figure)
    sign = -1 if axes.yaxis_inverted() else 1
    axes.set_aspect("auto")
    scale = 0.0
    for _ in range(12):  # texts keep their size while the rest shrinks, so go on until it settles
        width, height = figure.get_size_inches()
        if scale:
            axes.set_xlim(cu - scale * width / 2, cu + scale * width / 2)
            axes.set_ylim(cv - sign * scale * height / 2, cv + sign * scale * height / 2)
        canvas.draw()
        boxes = [a.get_tightbbox(canvas.get_renderer()) for a in (*axes.patches, *axes.lines, *axes.texts)]
        boxes = [b for b in boxes if b is not None and b.width + b.height > 0]
        pixel = margin * figure.dpi / 72
        x0, y0 = min(b.x0 for b in boxes) - pixel, min(b.y0 for b in boxes) - pixel
        x1, y1 = max(b.x1 for b in boxes) + pixel, max(b.y1 for b in boxes) + pixel
        (u0, v0), (u1, v1) = axes.transData.inverted().transform([(x0, y0), (x1, y1)])
        cu, cv = (u0 + u1) / 2, (v0 + v1) / 2
        scale = (u1 - u0) / width
        figure.set_size_inches(width, abs(v1 - v0) / scale)
    width, height = figure.get_size_inches()
    axes.set_xlim(cu - scale * width / 2, cu + scale * width / 2)
    axes.set_ylim(cv - sign * scale * height / 2, cv + sign * scale * height / 2)


# -- world, camera, pixels, background ---------------------------------------------------------------------------------


def pixel_points(camera: Camera, uv: object, depth: float) -> Point:
    """Points of the world at `depth` mm in front of a camera that project to pixels."""
    rays = camera.rays(torch.tensor(uv, dtype=torch.float64).reshape(-1, 2))
    cosine = rays.direction @ camera.rotation[2]
    return (rays.origin + (depth / cosine)[:, None] * rays.direction).numpy()


def axes_and_pixels() -> Figure:
    """World, camera, image and background of one view."""
    rows, columns = 6, 8
    ring = Ring(
        views=1, arc=(-90, -90), elevation=0, focal_length=50, pixel_pitch=4.4, image_size=(rows, columns),
        distance=130, background_distance=80,
    )  # fmt: skip
    camera = ring.cameras()[0]
    box = Box.cube(50)
    view = View((-0.62, 0.62, -0.36))
    figure, axes = panel()

    # the background, with dots
    normal, offset = camera.background.normal.numpy(), camera.background.offset
    depth = float(offset / (normal @ camera.rotation[2].numpy())) - float(camera.centre @ camera.rotation[2])
    low, high_u, high_v = -0.5, columns - 0.5, rows - 0.5
    outline = [[low, low], [high_u, low], [high_u, high_v], [low, high_v]]
    axes.add_patch(Polygon(view(pixel_points(camera, outline, depth)), fc="#F6F6F6", ec=GREY, lw=1.2, zorder=0))
    spread = np.random.default_rng(3).uniform((low + 0.2, low + 0.2), (high_u - 0.2, high_v - 0.2), (150, 2))
    dots = view(pixel_points(camera, spread, depth))
    axes.plot(*dots.T, "o", ms=2.0, color="#9A9A9A", mew=0, zorder=0.5)

    # the box and the world
    lower, upper = np.array(box.lower), np.array(box.upper)
    # seen from +x, -y, above: the corner behind is that of small x, large y, small z
    edges(axes, view, lambda *c: np.where(c, upper, lower), hidden=(0, 1, 0))
    for name, direction, colour, shift in (
        ("x", (1, 0, 0), RED, (9, -5)), ("y", (0, 1, 0), GREEN, (9, 2)), ("z", (0, 0, 1), BLUE, (0, 9)),
    ):  # fmt: skip
        start, end = view([[0, 0, 0], np.array(direction) * 20])
        arrow(axes, start, end, colour)
        label(axes, end, f"${name}$", shift, color=colour, fontsize=12)
    label(axes, view([0, 0, 0]), "world", (-20, -3), fontsize=9)
    label(axes, view([-25, -25, 25]), "box", (8, 20), color=GREY)

    # the image, in front of the camera
    plane = 78.0
    axes.add_patch(
        Polygon(view(pixel_points(camera, outline, plane)), fc="white", ec=INK, lw=1.2, alpha=0.85, zorder=7)
    )
    for i in range(1, columns):
        axes.plot(
            *view(pixel_points(camera, [[i - 0.5, low], [i - 0.5, high_v]], plane)).T, color=PALE, lw=0.8, zorder=7.1
        )
    for i in range(1, rows):
        axes.plot(
            *view(pixel_points(camera, [[low, i - 0.5], [high_u, i - 0.5]], plane)).T, color=PALE, lw=0.8, zorder=7.1
        )
    first = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]
    axes.add_patch(Polygon(view(pixel_points(camera, first, plane)), fc=ORANGE, ec=ORANGE, zorder=7.2))
    corner = view(pixel_points(camera, [[0, 0]], plane))[0]
    label(axes, corner, "pixel (0, 0)", (-20, 44), color="#A06C00")
    axes.annotate("", corner, xytext=(-18, 37), textcoords="offset points", annotation_clip=False,
                  arrowprops={"arrowstyle": "-", "color": ORANGE, "lw": 1.0, "shrinkB": 3}, zorder=19)  # fmt: skip
    start, end = view(pixel_points(camera, [[0.8, low - 0.9], [3.6, low - 0.9]], plane))
    arrow(axes, start, end, INK, 1.2)
    label(axes, end, "$u$, columns", (36, 2))
    start, end = view(pixel_points(camera, [[low - 0.9, 1.2], [low - 0.9, 4.2]], plane))
    arrow(axes, start, end, INK, 1.2)
    label(axes, end, "$v$, rows", (-12, -9))

    # the camera
    centre = camera.centre.numpy()
    rotation = camera.rotation.numpy()
    size = np.array([13.0, 10.0, 22.0])
    body = lambda *c: centre + ((np.array(c) - [0.5, 0.5, 1.0]) * size) @ rotation  # noqa: E731
    faces = [[(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)], [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)],
             [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]]  # fmt: skip
    for face, shade in zip(faces, ("#C9C9C9", "#A9A9A9", "#B8B8B8"), strict=True):
        axes.add_patch(Polygon(view([body(*c) for c in face]), fc=shade, ec=INK, lw=0.8, zorder=4))
    for name, direction, colour, shift in zip(
        ("x right", "y down", "z forward"), rotation, (RED, GREEN, BLUE), ((26, -6), (0, -9), (-22, 12)), strict=True
    ):
        start, end = view([centre, centre + direction * 26])
        arrow(axes, start, end, colour)
        label(axes, end, f"${name[0]}$ {name[2:]}", shift, color=colour)
    label(axes, view(body(0, 0.5, 0)), "camera", (-28, 14))

    # a pixel and its ray
    pixel = [[5.0, 2.0]]
    through = pixel_points(camera, pixel, plane)[0]
    rays = camera.rays(torch.tensor(pixel, dtype=torch.float64)).clip(box)
    end = rays.end_points.numpy()[0]
    enter, leave = rays.at(torch.stack([rays.near, rays.far], dim=-1)).numpy()[0]
    around = [[4.5, 1.5], [5.5, 1.5], [5.5, 2.5], [4.5, 2.5]]
    axes.add_patch(Polygon(view(pixel_points(camera, around, plane)), fc=PURPLE, ec=PURPLE, alpha=0.75, zorder=7.2))
    for a, b, dash in ((centre, enter, "-"), (enter, leave, (0, (2, 1.5))), (leave, end, "-")):
        axes.plot(*view([a, b]).T, color=PURPLE, lw=1.5, ls=dash, zorder=8)
    for point, text, shift in ((enter, "near", (4, -10)), (leave, "far", (17, -7))):
        axes.plot(*view(point), "o", ms=4, color=PURPLE, zorder=9)
        label(axes, view(point), text, shift, color=PURPLE, fontsize=9)
    axes.plot(*view(end), "o", ms=6, color=PURPLE, zorder=9)
    label(axes, view(end), "$X_0$", (11, 5), color=PURPLE, fontsize=12)
    label(axes, view(through), "$p$", (2, -18), color=PURPLE, fontsize=12)
    lowest = pixel_points(camera, [[columns / 2 - 0.5, high_v]], depth)[0]
    label(axes, view(lowest), "background plane\nnormal · $x$ = offset", (-4, -30), color=GREY)
    fit(axes, 14)
    return figure


# -- the sign of the displacement --------------------------------------------------------------------------------------


def displacement_at(p: Point) -> Point:
    """A smooth displacement, px, on the grid of the flow image."""
    x, y = (p[..., 0] - 5.5) / 3.6, (p[..., 1] - 4.0) / 3.0
    bump = np.exp(-(x**2 + y**2))
    return np.stack([1.9 * bump * (0.6 + 0.5 * x), 1.3 * bump * (0.75 - 0.3 * y)], axis=-1)


def seen_at(p0: Point) -> Point:
    """Where in the flow image the dots of the reference are seen: p = p0 + d(p)."""
    p = p0.copy()
    for _ in range(200):
        p = p0 + displacement_at(p)
    return p


def displacement_sign() -> Figure:
    """Reference and flow image, and d between them."""
    figure, axes = panel()
    axes.invert_yaxis()
    width, height, gap = 11, 8, 3.6
    rng = np.random.default_rng(11)
    column, row = np.meshgrid(np.arange(0.4, width - 1, 1.3), np.arange(0.4, height - 1, 1.25))
    reference = np.stack([column, row], axis=-1).reshape(-1, 2) + rng.uniform(-0.28, 0.28, (column.size, 2))
    flow = seen_at(reference)
    assert np.allclose(flow - displacement_at(flow), reference)
    chosen = int(np.argmin(((reference - [4.1, 2.7]) ** 2).sum(-1)))
    p0, p = reference[chosen], flow[chosen]
    shift = np.array([width + gap, 0.0])
    for corner, title in ((np.zeros(2), "reference: without flow"), (shift, "flow image")):
        axes.add_patch(Rectangle(corner - 0.5, width, height, fc="white", ec=INK, lw=1.2))
        axes.add_patch(Rectangle(corner - 0.5, 1, 1, fc=ORANGE, ec="none", alpha=0.55))
        label(axes, corner + [width / 2 - 0.5, height - 0.5], title, (0, -13), fontsize=10.5)
        arrow(axes, corner + [-0.5, -1.1], corner + [2.5, -1.1], INK, 1.2)
        label(axes, corner + [2.5, -1.1], "$u$, columns", (36, 0))
        arrow(axes, corner + [-1.1, -0.5], corner + [-1.1, 2.5], INK, 1.2)
        label(axes, corner + [-1.1, 2.5], "$v$, rows", (-8, -9))
    label(axes, np.array([0.0, 0.0]), "(0, 0)", (0, 0), fontsize=7.5, color="#7A5200")
    label(axes, shift, "(0, 0)", (0, 0), fontsize=7.5, color="#7A5200")
    # the dots next to the arrow make room for what is written there
    others = np.minimum(*(np.linalg.norm(reference - q, axis=-1) for q in (p0, p0 + [1.2, 0.5]))) > 1.25
    others &= (reference > 0.6).any(-1)
    axes.plot(*reference[others].T, "o", ms=5, color="#555555", mew=0)
    axes.plot(*(reference + shift)[others].T, "o", ms=5, mfc="none", mec="#BBBBBB", mew=0.9)
    inside = (flow < [width - 0.7, height - 0.7]).all(-1)
    axes.plot(*(flow + shift)[others & inside].T, "o", ms=5, color="#555555", mew=0)
    axes.plot(*p0, "o", ms=8, color=BLUE, mew=0)
    label(axes, p0, "$p_0$", (-11, 7), color=BLUE, fontsize=12)
    axes.plot(*(p0 + shift), "o", ms=8, mfc="none", mec=BLUE, mew=1.5)
    label(axes, p0 + shift, "$p_0$", (-11, 7), color=BLUE, fontsize=12)
    axes.plot(*(p + shift), "o", ms=8, color=RED, mew=0)
    label(axes, p + shift, "$p$", (10, -7), color=RED, fontsize=12)
    arrow(axes, p0 + shift, p + shift, RED, 2.2)
    knee = np.array([p[0], p0[1]]) + shift
    axes.plot(*np.array([p0 + shift, knee]).T, color=RED, lw=1.0, ls=(0, (3, 2)))
    axes.plot(*np.array([knee, p + shift]).T, color=RED, lw=1.0, ls=(0, (3, 2)))
    label(axes, (p0 + shift + knee) / 2, "$u>0$", (0, 8), color=RED, fontsize=9)
    label(axes, (knee + p + shift) / 2, "$v>0$", (17, 0), color=RED, fontsize=9)
    below = np.array([width + gap / 2 - 0.5, height - 0.5])
    label(axes, below, "$d(p) = p - p_0(p)$", (-130, -44), color=RED, fontsize=12)
    label(axes, below, "flow($p$) = reference($p - d(p)$)", (110, -44), fontsize=11)
    label(axes, below, "the optical flow from the flow image to the reference is $-d$", (0, -66), color=GREY)
    fit(axes, 10)
    return figure


# -- volumes -----------------------------------------------------------------------------------------------------------


def volume_index() -> Figure:
    """The order of voxels."""
    figure, axes = panel()
    grid = Grid(Box((0, 0, 0), (5, 4, 3)), (3, 4, 5))
    view = View((-0.42, 0.8, -0.42))
    centres = grid.points(torch.float64).numpy()  # [z, y, x]
    upper = np.array(grid.box.upper)

    def cube(index: tuple[int, int, int], colour: str) -> None:
        middle, half = centres[index], np.array(grid.spacing) / 2
        corner = lambda *c: middle + (2 * np.array(c) - 1) * half  # noqa: E731
        # the faces towards the eye: upper x, lower y, upper z
        for face in ([(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)], [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)],
                     [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]):  # fmt: skip
            axes.add_patch(
                Polygon(view([corner(*c) for c in face]), fc=colour, ec="white", lw=0.8, alpha=0.9, zorder=4)
            )

    nz, ny, nx = grid.shape
    for face in ([[0, 0, 0], [5, 0, 0], [5, 0, 3], [0, 0, 3]], [[5, 0, 0], [5, 4, 0], [5, 4, 3], [5, 0, 3]],
                 [[0, 0, 3], [5, 0, 3], [5, 4, 3], [0, 4, 3]]):  # fmt: skip
        axes.add_patch(Polygon(view(face), fc="#F4F8FB", ec="none", zorder=0))
    for i in range(nx + 1):
        axes.plot(*view([[i, 0, 0], [i, 0, nz], [i, ny, nz]]).T, color="#BFCBD3", lw=0.9, zorder=2)
    for i in range(ny + 1):
        axes.plot(*view([[nx, i, 0], [nx, i, nz], [0, i, nz]]).T, color="#BFCBD3", lw=0.9, zorder=2)
    for i in range(nz + 1):
        axes.plot(*view([[0, 0, i], [nx, 0, i], [nx, ny, i]]).T, color="#BFCBD3", lw=0.9, zorder=2)
    edges(axes, view, lambda *c: np.array(c) * upper, hidden=(0, 1, 0))
    shown = (
        ((0, 0, 0), "values[0, 0, 0]\nthe first in memory", (-120, 0), ORANGE, "#A06C00"),
        ((0, 0, 1), "values[0, 0, 1]\nthe next: x fastest", (0, -72), SKY, BLUE),
        ((2, 0, 0), "values[2, 0, 0]", (-110, 0), BLUE, BLUE),
        ((2, 3, 0), "values[2, 3, 0]", (-120, 10), GREEN, GREEN),
        ((2, 3, 4), "values[2, 3, 4]\nthe last", (96, 16), PURPLE, "#A3517C"),
    )
    for index, text, shift, colour, ink in shown:
        cube(index, colour)
        line = {"arrowstyle": "-", "color": ink, "lw": 1.0, "shrinkA": 2, "shrinkB": 0}
        middle = view(centres[index])
        axes.annotate(text, middle, xytext=shift, textcoords="offset points", ha="center", va="center", color=ink,
                      arrowprops=line, annotation_clip=False, zorder=20)  # fmt: skip
        axes.plot(*middle, "o", ms=3, color=ink, zorder=21)
    start = np.array([-3.0, 0.0, -2.0])
    for name, direction, colour, shift in (
        ("x", (1, 0, 0), RED, (10, -3)), ("y", (0, 1, 0), GREEN, (8, 5)), ("z", (0, 0, 1), BLUE, (0, 9)),
    ):  # fmt: skip
        base = view(start)
        end = view(start + np.array(direction) * 1.3)
        arrow(axes, base, end, colour)
        label(axes, end, f"${name}$", shift, color=colour, fontsize=12)
    at = view([nx, 0, 0])
    label(axes, at, "values at voxel centres:\n$x_i = x_{lower} + (i + \\frac{1}{2})\\,h_x$", (150, 24), fontsize=10.5)
    label(axes, at, "shape (nz, ny, nx) = (3, 4, 5)", (150, -14), fontsize=10.5)
    fit(axes, 10)
    return figure


# -- the forward model -------------------------------------------------------------------------------------------------


def lever_arm() -> Figure:
    """How refraction at one place moves the background point."""
    figure, axes = panel()
    s_b, near, far, s, bend = 100.0, 42.0, 66.0, 55.0, 0.28
    axes.add_patch(Rectangle((near, -12), far - near, 24, fc="#EEF5FA", ec=GREY, lw=1.2))
    label(axes, np.array([(near + far) / 2, 12]), "box, $n$ varies", (0, 10), color=GREY)
    axes.add_patch(Circle((s, 0), 5.5, fc=ORANGE, ec="none", alpha=0.35))
    label(axes, np.array([s, 0]), r"$\nabla n$", (-13, 19), color="#A06C00", fontsize=12)
    arrow(axes, np.array([s, 0]), np.array([s, 7.5]), "#A06C00", 1.6)
    axes.plot([s_b, s_b], [-12, 19], color=INK, lw=2.0)
    label(axes, np.array([s_b, 19]), "background", (0, 9))
    axes.plot([0, s_b], [0, 0], color=PURPLE, lw=1.4, ls=(0, (4, 3)))
    moved = bend * (s_b - s)
    axes.plot([0, s, s_b], [0, 0, moved], color=PURPLE, lw=1.8)
    axes.add_patch(Polygon([(-5, -3), (-5, 3), (0, 1.2), (0, -1.2)], fc="#B8B8B8", ec=INK, lw=0.8))
    label(axes, np.array([-2.5, -3]), "camera", (0, -10))
    label(axes, np.array([18, 0]), "pixel $p$, back-traced", (0, 9), color=PURPLE)
    axes.plot(s_b, 0, "o", ms=6, color=PURPLE)
    axes.plot(s_b, moved, "o", ms=6, color=RED)
    label(axes, np.array([s_b, 0]), "$X_0$: seen without flow", (78, 0), color=PURPLE)
    label(axes, np.array([s_b, moved]), "seen with flow", (52, 4), color=RED)
    arrow(axes, np.array([s_b + 2.2, 0.8]), np.array([s_b + 2.2, moved - 0.6]), RED, 1.6)
    label(
        axes, np.array([s_b + 2.2, moved / 2]), r"$(s_b - s)\,\frac{\nabla n}{n}\,ds$", (46, 0), color=RED, fontsize=11
    )
    for at, text in ((0, "0"), (near, "near"), (s, "$s$"), (far, "far"), (s_b, "$s_b$")):
        axes.plot([at, at], [-15.6, -14.4], color=INK, lw=1.0)
        label(axes, np.array([at, -15.6]), text, (0, -8), fontsize=9)
    arrow(axes, np.array([0, -15]), np.array([s_b + 8, -15]), INK, 1.0)
    label(axes, np.array([s_b + 8, -15]), "path length", (34, 0), fontsize=9)
    both = {"arrowstyle": "<|-|>", "color": GREY, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (s, -9), xytext=(s_b, -9), arrowprops=both, annotation_clip=False)
    label(axes, np.array([(far + s_b) / 2, -9]), "lever arm $s_b - s$", (0, 8), color=GREY)
    fit(axes, 10)
    return figure


def cone() -> Figure:
    """What a pixel sees through the whole of its lens, by the rays of a camera with one."""
    figure, axes = panel()
    ring = Ring(views=1, arc=(180, 180), distance=55, background_distance=45, focal_length=50, image_size=(1, 1))
    camera = replace(ring.cameras()[0], lens=Lens(22.0))
    rays = camera.rays(torch.zeros(1, 2, dtype=torch.float64)).clip(Box.cube(24))
    shares = torch.linspace(-1, 1, 7, dtype=torch.float64)
    turn = rays.lens.points(torch.tensor([[[1.0, 0.0], [0.0, 1.0]]], dtype=torch.float64))[0, :, 2].abs().argmax()
    disc = torch.zeros(1, 7, 2, dtype=torch.float64)
    disc[0, :, turn] = shares  # along z, the height of the paper
    through = rays.through(disc)
    start, end = (x.numpy()[:, [0, 2]] for x in (through.origin, through.end_points))
    enter, leave = (
        (through.origin + s[:, None] * through.direction).numpy()[:, [0, 2]] for s in (through.near, through.far)
    )
    axes.add_patch(Rectangle((-12, -12), 24, 24, fc="#EEF5FA", ec=GREY, lw=1.2))
    label(axes, np.array([0, 12]), "box", (0, 9), color=GREY)
    for a, b in zip(start, end, strict=True):
        axes.plot(*np.stack([a, b]).T, color=PURPLE, lw=0.9, alpha=0.6)
    axes.plot(*np.stack([start[3], end[3]]).T, color=PURPLE, lw=1.6, ls=(0, (4, 3)))
    for points in (enter, leave):
        axes.plot(*points[[0, -1]].T, color=ORANGE, lw=2.2, zorder=9)
    label(axes, np.array([enter[0, 0], np.abs(enter[:, 1]).max()]), "as wide as it blurs", (48, 9), color="#A06C00")
    axes.plot([45, 45], [-13, 13], color=INK, lw=2.0)
    label(axes, np.array([45, 13]), "background, in focus", (0, 9))
    axes.plot(*end[3], "o", ms=6, color=RED, zorder=12)
    label(axes, end[3], "$X_f = X_0$", (32, 0), color=RED)
    axes.plot(start[[0, -1], 0], start[[0, -1], 1], color=INK, lw=3.5, solid_capstyle="round")
    label(axes, np.array([-55, -11]), "lens, diameter $D$", (0, -12))
    fit(axes, 10)
    return figure


def images() -> Figure:
    """A pattern without and with flow, and what is left of the difference once the reference is moved."""
    size, draw = 72, np.random.default_rng(4)
    row, column = np.mgrid[:size, :size].astype(float)
    dots = draw.uniform(-4, size + 4, (520, 2))

    def light(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        squares = (u[..., None] - dots[:, 0]) ** 2 + (v[..., None] - dots[:, 1]) ** 2
        return np.clip(1 - np.exp(-squares / (2 * 1.1**2)).sum(axis=-1), 0.05, 1)

    lump = np.exp(-((column - 36) ** 2 + (row - 36) ** 2) / (2 * 14**2))
    d = 1.1 * np.stack([(column - 36) / 14 * lump, (row - 36) / 14 * lump], axis=-1)
    reference = light(column, row) + 0.02 * draw.standard_normal(row.shape)
    flow = light(column - d[..., 0], row - d[..., 1]) + 0.02 * draw.standard_normal(row.shape)
    references = References(torch.tensor(reference)[None].float(), [(size, size)])
    pixel = torch.tensor(np.stack([column, row], axis=-1)).reshape(-1, 2).float()
    view = torch.zeros(len(pixel), dtype=torch.int16)
    moved = references.flow_at(view, pixel, torch.tensor(d).reshape(-1, 2).float()).reshape(size, size).numpy()
    figure = Figure(figsize=(9.2, 2.6))
    FigureCanvasAgg(figure)
    shown = (("$R$", reference), ("$I$", flow), ("$R - I$", reference - flow), ("$R(p - d) - I$", moved - flow))
    for i, (name, image) in enumerate(shown):
        axes = figure.add_axes((0.005 + 0.25 * i, 0.01, 0.24, 0.85))
        limits = {"cmap": "gray", "vmin": 0, "vmax": 1.1} if i < 2 else {"cmap": "RdBu_r", "vmin": -0.6, "vmax": 0.6}
        axes.imshow(image, interpolation="nearest", **limits)
        axes.set_title(name, fontsize=11, color=INK, pad=4)
        axes.set_axis_off()
    return figure


DRAWINGS: dict[str, Callable[[], Figure]] = {
    "axes": axes_and_pixels,
    "displacement": displacement_sign,
    "volume": volume_index,
    "lever_arm": lever_arm,
    "cone": cone,
    "images": images,
    "observable": observable,
}


def draw_all(folder: Path, ending: str = "svg") -> None:
    """Write every drawing into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(STYLE):
        for name, make in DRAWINGS.items():
            temporary = folder / f".{name}.{os.getpid()}.{ending}"
            make().savefig(temporary, dpi=130, metadata={"Date": None} if ending == "svg" else None)
            temporary.replace(folder / f"{name}.{ending}")


if __name__ == "__main__":
    draw_all(Path(sys.argv[1]), *sys.argv[2:])
