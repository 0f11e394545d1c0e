"""Reprojection errors of a calibration, by image and over each camera's image."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nerif.common.files import atomic
from nerif.imaging.calibration.result import Calibration
from nerif.plotting.drawing import COLOURS, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_errors", "draw_residuals", "save_errors"]

FREE, ON_BACKGROUND, REJECTED = COLOURS["blue"], "#56B4E9", COLOURS["orange"]


def draw_errors(axes: Axes, calibration: Calibration) -> Axes:
    """Draw the rms reprojection error (px) of every image by camera; rejected images are hatched."""
    position, ticks = 0, []
    for k, name in enumerate(calibration.names):
        errors = [e for e in calibration.errors if e.camera == name]
        at = position + np.arange(len(errors))
        for x, e in zip(at, errors, strict=True):
            colour = REJECTED if not e.used else (ON_BACKGROUND if e.background else FREE)
            axes.bar(x, e.rms, color=colour, hatch="" if e.used else "//", width=0.9)
        axes.plot([at[0] - 0.5, at[-1] + 0.5], [calibration.rms(name)] * 2, color="black", linewidth=1)
        ticks.append((at.mean(), plain(name)))
        position = at[-1] + 3
        if k < len(calibration.names) - 1:
            axes.axvline(at[-1] + 1.5, color="0.85", linewidth=0.8)
    axes.set_xticks([t for t, _ in ticks], [n for _, n in ticks], rotation=30 if len(ticks) > 4 else 0, fontsize=8)
    axes.set_ylabel("rms reprojection error [px]")
    for label, colour in (("free in space", FREE), ("on the background", ON_BACKGROUND), ("rejected", REJECTED)):
        axes.bar(np.nan, np.nan, color=colour, label=label)
    axes.plot([], [], color="black", linewidth=1, label="all of a camera")
    axes.legend(fontsize=7, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    return axes


def draw_residuals(axes: Axes, residuals: np.ndarray, size: tuple[int, int], scale: float) -> Axes:
    """Draw residuals (n, 4: u, v, and detected minus projected, px) over an image, enlarged by `scale`."""
    u, v, du, dv = residuals.T
    axes.quiver(u, v, du * scale, dv * scale, angles="xy", scale_units="xy", scale=1, width=0.003, color=FREE)
    axes.set(xlim=(-0.5, size[1] - 0.5), ylim=(size[0] - 0.5, -0.5), aspect="equal")
    axes.tick_params(labelsize=6)
    return axes


def save_errors(path: Path, calibration: Calibration) -> None:
    """Write an image of the errors of every image, and of the residuals over each camera's image."""
    from matplotlib.figure import Figure

    columns = min(5, len(calibration.names))
    rows = -(-len(calibration.names) // columns)
    figure = Figure(figsize=(12, 3.2 + 2.4 * rows), layout="constrained")
    grid = figure.add_gridspec(rows + 1, columns, height_ratios=[1.2] + [1] * rows)
    draw_errors(figure.add_subplot(grid[0, :]), calibration)
    typical = np.median([np.linalg.norm(r[:, 2:], axis=1).mean() for r in calibration.residuals])
    length = 0.04 * max(max(s) for s in calibration.sizes)
    for i, name in enumerate(calibration.names):
        axes = figure.add_subplot(grid[1 + i // columns, i % columns])
        draw_residuals(axes, calibration.residuals[i], calibration.sizes[i], length / max(float(typical), 1e-9))
        axes.set_title(f"{plain(name)}: {calibration.rms(name):.3f} px rms", fontsize=8)
    figure.supxlabel(f"column and row [px]; an arrow of {length:.0f} px is a residual of {typical:.3f} px", fontsize=8)
    with atomic(path) as part:
        figure.savefig(part, dpi=130)
