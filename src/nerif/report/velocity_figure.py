"""Velocities in the middle slices of a volume: arrows over the speed, streamlines over the vorticity."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from nerif.data.velocity_sequence import VelocitySequence
from nerif.plotting.drawing import PLANES, add_colour_bar, colour_range, draw_slice, label_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_arrows", "draw_streamlines"]

ARROWS = 24  # along the longer edge
PLANES_SHOWN = "yx"  # normals of the slices


def draw_arrows(figure: Figure, store: VelocitySequence, index: int) -> None:
    """Draw the speed of one frame with arrows of the velocity in the plane."""
    _draw(figure, store, index, "speed", _arrows)


def draw_streamlines(figure: Figure, store: VelocitySequence, index: int) -> None:
    """Draw the vorticity of one frame with lines along the velocity in the plane."""
    _draw(figure, store, index, "vorticity", _streamlines)


def _draw(figure: Figure, store: VelocitySequence, index: int, quantity: str, add: Callable[..., None]) -> None:
    volume, vectors = store.volume(index, quantity), store.vectors(index).numpy()
    limits = (0.0, colour_range(volume.values.numpy())[1])
    line = figure.subplots(1, len(PLANES_SHOWN))
    for axes, normal in zip(line, PLANES_SHOWN, strict=True):
        draw_slice(axes, volume, normal, limits)
        axis, (across, up) = "zyx".index(normal), PLANES[normal]
        plane = np.take(vectors, vectors.shape[1 + axis] // 2, axis=1 + axis)
        x, y = (store.grid.axis(a).numpy() for a in (across, up))
        add(axes, x, y, plane["xyz".index(across)], plane["xyz".index(up)])
        along = store.grid.axis(normal)
        axes.set_title(f"{normal} = {float(along[len(along) // 2]):.1f} mm")
    add_colour_bar(line, label_of(quantity))


def _arrows(axes: Axes, x: np.ndarray, y: np.ndarray, u: np.ndarray, v: np.ndarray) -> None:
    step = max(1, round(max(len(x), len(y)) / ARROWS))
    i, j = slice(step // 2, None, step), slice(step // 2, None, step)
    longest = np.nanmax(np.hypot(u, v), initial=0.0) or 1.0
    scale = longest / (1.6 * step * abs(float(x[1] - x[0])))
    axes.quiver(x[j], y[i], u[i, j], v[i, j], color="white", angles="xy", scale_units="xy", scale=scale, width=0.004)


def _streamlines(axes: Axes, x: np.ndarray, y: np.ndarray, u: np.ndarray, v: np.ndarray) -> None:
    if np.isfinite(u + v).any():
        masked = np.ma.masked_invalid(u), np.ma.masked_invalid(v)
        axes.streamplot(x, y, *masked, color="white", density=1.2, linewidth=0.6, arrowsize=0.6)
        axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
