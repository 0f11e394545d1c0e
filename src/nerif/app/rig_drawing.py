"""The rig from above as SVG, to scale: cameras, fields of view, backgrounds, flow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import torch

from nerif.geometry import Camera

__all__ = ["rig_drawing"]

EDGE = 0.06  # margin, relative to the drawing
SIZE = 1000.0  # longer side, units of the drawing


def rig_drawing(cameras: Sequence[Camera], flow_size: float) -> str:
    """Return an SVG of cameras and backgrounds with a scale bar.

    Parameters
    ----------
    cameras : cameras with backgrounds
    flow_size : diameter of the flow, mm
    """
    rays = [_outline(camera) for camera in cameras]
    points = torch.cat([torch.cat(pair) for pair in rays])
    low, high = points.min(dim=0).values, points.max(dim=0).values
    reach = float((high - low).max()) or 1.0
    unit = SIZE / (reach * (1 + 2 * EDGE))  # of the drawing per mm
    width, height = (float(side) * unit + 2 * EDGE * reach * unit for side in high - low)

    def at(point: torch.Tensor) -> str:
        x = (float(point[0] - low[0]) + EDGE * reach) * unit
        y = height - (float(point[1] - low[1]) + EDGE * reach) * unit
        return f"{x:.1f},{y:.1f}"

    views, things = [], []
    for camera, (lens, ends) in zip(cameras, rays, strict=True):
        corners = " ".join(map(at, (lens[0], ends[0], ends[1], lens[1])))
        views.append(f'<polygon points="{corners}" fill="var(--plot)" opacity="0.07"/>')
        a, b = (at(end).split(",") for end in ends)
        things.append(
            f'<line x1="{a[0]}" y1="{a[1]}" x2="{b[0]}" y2="{b[1]}" stroke="currentColor" stroke-width="5">'
            f"<title>background of {escape(camera.name)}</title></line>"
        )
        x, y = at(lens.mean(dim=0)).split(",")
        name = f"<title>{escape(camera.name)}</title>"
        things.append(f'<circle cx="{x}" cy="{y}" r="8" fill="var(--plot)">{name}</circle>')
    x, y = at(torch.zeros(2)).split(",")
    radius = max(flow_size / 2 * unit, 3)
    flow = f'<circle cx="{x}" cy="{y}" r="{radius:.1f}" fill="var(--flow)"><title>flow</title></circle>'
    bar = 10 ** math.floor(math.log10(reach / 3))
    bar *= max(k for k in (1, 2, 5) if k * bar <= reach / 3)
    scale = (
        f'<path d="M20 {height - 20:.1f}h{bar * unit:.1f}m0 -6v12m{-bar * unit:.1f} 0v-12" fill="none" '
        f'stroke="currentColor" stroke-width="2.5"/><text x="20" y="{height - 34:.1f}" font-size="22" '
        f'fill="currentColor">{bar:g} mm</text>'
    )
    label = f"The rig from above, to scale: {len(cameras)} cameras, their backgrounds, and the flow between them"
    inside = "".join((*views, flow, *things, scale))
    return f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{label}">{inside}</svg>'


def _outline(camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Start and end of the two outermost rays of the middle row in x and y, (2, 2) in mm."""
    height, width = camera.image_size
    ends = torch.tensor([[0.0, (height - 1) / 2], [width - 1.0, (height - 1) / 2]], dtype=torch.float64)
    rays = camera.rays(ends)
    return rays.origin[:, :2], rays.end_points[:, :2]
