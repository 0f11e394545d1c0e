"""Drawings of a planned rig: plan view, sensitivity over the background distance, resolution over the f-number."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from nerif.common.files import atomic
from nerif.geometry import Ring
from nerif.plotting.drawing import COLOURS
from nerif.simulation.rig_design import DesignSettings, expect

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_displacement", "draw_plan", "draw_resolution", "save_design"]

F_NUMBERS = (2, 4, 8, 16, 32, 64)


def draw_plan(axes: Axes, ring: Ring, flow: DesignSettings) -> Axes:
    """Draw cameras, fields of view, backgrounds and flow from above; mm."""
    from matplotlib.patches import Circle

    for camera in ring.cameras():
        height, width = camera.image_size
        ends = torch.tensor([[0.0, (height - 1) / 2], [width - 1.0, (height - 1) / 2]], dtype=torch.float64)
        rays = camera.rays(ends)
        lens, edges = rays.origin[:, :2].numpy(), rays.end_points[:, :2].numpy()
        axes.fill(*np.concatenate([lens, edges[::-1]]).T, color=COLOURS["blue"], alpha=0.08, linewidth=0)
        axes.plot(*edges.T, color="black", linewidth=2)
        axes.plot(*lens.T, marker="o", color=COLOURS["blue"], markersize=5)
    axes.add_patch(Circle((0, 0), flow.flow_size / 2, color=COLOURS["orange"], alpha=0.7))
    axes.set(aspect="equal", xlabel="x [mm]", ylabel="y [mm]")
    axes.set_title("plan view: cameras, backgrounds, flow", fontsize=9)
    return axes


def draw_displacement(axes: Axes, ring: Ring, flow: DesignSettings) -> Axes:
    """Draw the expected displacement (px) and the resolution (mm) over the background distance."""
    distances = ring.background_distance * np.geomspace(0.2, 3, 60)
    expected = [expect(replace(ring, background_distance=float(d)), flow) for d in distances]
    displacements, resolutions = [e.displacement for e in expected], [e.resolution for e in expected]
    axes.plot(distances, displacements, color=COLOURS["blue"], label="displacement [px]")
    axes.plot(distances, resolutions, color=COLOURS["orange"], linestyle="--", label="resolution [mm]")
    axes.axhline(flow.displacement_noise, color="0.5", linewidth=0.8)
    axes.text(distances[-1], flow.displacement_noise, "noise [px]", fontsize=7, ha="right", va="bottom", color="0.4")
    axes.axvline(ring.background_distance, color="0.7", linewidth=0.8, linestyle=":")
    axes.set(yscale="log", xlabel="flow to background [mm]", ylabel="displacement [px], resolution [mm]")
    axes.legend(fontsize=7, loc="center right")
    axes.set_title("background distance (dotted: as planned)", fontsize=9)
    return axes


def draw_resolution(axes: Axes, ring: Ring, flow: DesignSettings) -> Axes:
    """Draw the contributions to the resolution (mm at the flow) over the f-number."""
    numbers = np.geomspace(1.4, 64, 60)
    expected = [expect(ring, replace(flow, f_number=float(n))) for n in numbers]
    for name, style in (("cone", "--"), ("window", ":"), ("diffraction", "-.")):
        axes.plot(numbers, [getattr(e, name) for e in expected], linestyle=style, label=name)
    axes.plot(numbers, [e.resolution for e in expected], color="black", label="together")
    axes.axvline(flow.f_number, color="0.7", linewidth=0.8, linestyle=":")
    axes.set(xscale="log", xlabel="f-number", ylabel="length at the flow [mm]")
    axes.set_xticks(F_NUMBERS, [f"{n}" for n in F_NUMBERS])
    axes.minorticks_off()
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=7)
    axes.set_title("resolution (dotted: as planned)", fontsize=9)
    return axes


def save_design(path: Path, ring: Ring, flow: DesignSettings) -> None:
    """Write the three drawings side by side, as PNG or PDF by the ending."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4.2), layout="constrained")
    for axes, draw in zip(figure.subplots(1, 3), (draw_plan, draw_displacement, draw_resolution), strict=True):
        draw(axes, ring, flow)
    with atomic(path) as part:
        figure.savefig(part, dpi=130)
