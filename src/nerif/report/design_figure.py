"""What a planned rig will see, drawn: sensitivity and resolution over where the background stands and the aperture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from nerif.common.files import atomic
from nerif.geometry import Ring
from nerif.simulation.design import DesignSettings, expect

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_displacement", "draw_plan", "draw_resolution", "save_design"]


def draw_plan(axes: Axes, ring: Ring, flow: DesignSettings) -> Axes:
    """Draw the rig from above: cameras, what they see, backgrounds and the flow; mm."""
    from matplotlib.patches import Circle

    for camera in ring.cameras():
        height, width = camera.image_size
        ends = torch.tensor([[0.0, (height - 1) / 2], [width - 1.0, (height - 1) / 2]], dtype=torch.float64)
        rays = camera.rays(ends)
        lens, edges = rays.origin[:, :2].numpy(), rays.end_points[:, :2].numpy()
        axes.fill(*np.concatenate([lens, edges[::-1]]).T, color="#0072B2", alpha=0.08, linewidth=0)
        axes.plot(*edges.T, color="black", linewidth=2)
        axes.plot(*lens.T, marker="o", color="#0072B2", markersize=5)
    axes.add_patch(Circle((0, 0), flow.flow_size / 2, color="#D55E00", alpha=0.7))
    axes.set_aspect("equal")
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("y [mm]")
    axes.set_title("from above: cameras, backgrounds, flow", fontsize=9)
    return axes


def draw_displacement(axes: Axes, ring: Ring, flow: DesignSettings) -> Axes:
    """Draw the expected displacement (px) and the resolution (mm) over the distance of the background."""
    distances = ring.background_distance * np.geomspace(0.2, 3, 60)
    results = [expect(replace(ring, background_distance=float(d)), flow) for d in distances]
    axes.plot(distances, [r.displacement for r in results], color="#0072B2", label="displacement [px]")
    axes.plot(distances, [r.resolution for r in results], color="#D55E00", linestyle="--", label="resolution [mm]")
    axes.axhline(flow.displacement_noise, color="0.5", linewidth=0.8)
    axes.text(distances[-1], flow.displacement_noise, "noise [px]", fontsize=7, ha="right", va="bottom", color="0.4")
    axes.axvline(ring.background_distance, color="0.7", linewidth=0.8, linestyle=":")
    axes.set_yscale("log")
    axes.set_xlabel("flow to background [mm]")
    axes.set_ylabel("displacement [px], resolution [mm]")
    axes.legend(fontsize=7, loc="center right")
    axes.set_title("where the background stands (dotted: as planned)", fontsize=9)
    return axes


def draw_resolution(axes: Axes, ring: Ring, flow: DesignSettings) -> Axes:
    """Draw the parts of the resolution (mm at the flow) over the f-number."""
    numbers = np.geomspace(1.4, 64, 60)
    results = [expect(ring, replace(flow, f_number=float(n))) for n in numbers]
    for name, style in (("cone", "--"), ("window", ":"), ("diffraction", "-.")):
        axes.plot(numbers, [getattr(r, name) for r in results], linestyle=style, label=name)
    axes.plot(numbers, [r.resolution for r in results], color="black", label="together")
    axes.axvline(flow.f_number, color="0.7", linewidth=0.8, linestyle=":")
    axes.set_xscale("log")
    axes.set_xticks([2, 4, 8, 16, 32, 64], [f"{n}" for n in (2, 4, 8, 16, 32, 64)])
    axes.minorticks_off()
    axes.set_xlabel("f-number")
    axes.set_ylabel("length at the flow [mm]")
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=7)
    axes.set_title("what blurs (dotted: as planned)", fontsize=9)
    return axes


def save_design(path: Path, ring: Ring, flow: DesignSettings) -> None:
    """Write the three drawings side by side, as PNG or PDF by the ending."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4.2), layout="constrained")
    first, second, third = figure.subplots(1, 3)
    draw_plan(first, ring, flow)
    draw_displacement(second, ring, flow)
    draw_resolution(third, ring, flow)
    with atomic(path) as part:
        figure.savefig(part, dpi=130)
