"""Design: what a rig will see, before it is built."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import torch
from nicegui import ui

from nerif.app.forms.elements import CommandLine, card, figures, html, items_html
from nerif.app.forms.form import Form
from nerif.app.forms.form_view import FormView
from nerif.app.pages.page import Hint, Page
from nerif.app.project.demo_project import RIG
from nerif.app.project.workspace import Workspace
from nerif.cli.commands.design import Design
from nerif.geometry import Camera
from nerif.simulation.rig_design import Expectation, expect

__all__ = ["PAGE"]

MAIN = (
    "focal_length", "f_number", "pixel_pitch", "distance", "background_distance", "index_contrast", "flow_size",
    "feature_size", "views", "image_size",
)  # fmt: skip
SLIDERS = {
    "focal_length": (8.0, 400.0),
    "f_number": (1.4, 64.0),
    "pixel_pitch": (0.001, 0.05),
    "distance": (100.0, 4000.0),
    "background_distance": (50.0, 4000.0),
    "index_contrast": (1e-6, 5e-4),
    "flow_size": (5.0, 500.0),
    "feature_size": (0.5, 50.0),
    "views": (1, 24),
}
EDGE = 0.06  # margin, relative to the drawing
SIZE = 1000.0  # longer side, units of the drawing


def build(work: Workspace) -> None:
    """Build the page."""
    form = Form(Design(), ("design",), without=("config", "out", "force"))
    with ui.element("div").classes("columns"):
        with card("Rig and flow"):
            left = ui.element("div").classes("form")
        with ui.element("div").classes("stack"):
            with card("What to expect"):
                notice = html().props('aria-live="polite"')
            with card("From above, to scale"):
                drawing = html().classes("drawing")
            with card("The same on the command line"):
                command = CommandLine()

    def show() -> None:
        work.keep(PAGE.name, form.changed(view.values))
        command.show(view.arguments)
        if not view.valid:
            return
        request = view.record()
        notice.set_content(_text(expect(request.ring, request.flow), request))
        drawing.set_content(_rig_drawing(request.ring.cameras(), request.flow.flow_size))

    def reset() -> None:
        for name in list(form.changed(view.values)):
            view.set(name, form.field(name).default)

    with left:
        view = FormView(form, show, work.draft(PAGE.name), MAIN, SLIDERS)
        ui.button("Back to the defaults", on_click=reset).props("flat")
    show()


def _text(e: Expectation, request: Design) -> str:
    """The figures as HTML: the three that decide, the others, and what looks wrong."""
    flow = request.flow
    first = (
        (f"{e.displacement:.3f} px", f"displacement; noise {flow.displacement_noise:g} px"),
        (f"{math.hypot(e.cone, e.diffraction):.2f} mm", "blur by aperture and diffraction, at the flow"),
        (f"{e.resolution:.2f} mm", f"resolution; structures of {flow.feature_size:g} mm"),
    )
    head = "".join(f"<div><b>{escape(a)}</b><span>{escape(b)}</span></div>" for a, b in first)
    rows = (
        ("Index contrast", f"{flow.contrast:.3g}", ""),
        ("Smallest index contrast", f"{e.smallest_contrast:.2g}", "its displacement is the noise"),
        ("Field of view at the flow", f"{e.field_of_view[0]:.1f} × {e.field_of_view[1]:.1f} mm", ""),
        ("Pixel at the flow", f"{e.pixel_at_flow:.3f} mm", ""),
        ("Pixel on the background", f"{e.pixel_at_background:.3f} mm", ""),
        ("Pattern to print", f"{e.background_size[0]:.0f} × {e.background_size[1]:.0f} mm", f"dots of {e.dot:.2f} mm"),
        ("Sensitivity", f"{e.sensitivity:.3f} px/mrad", ""),
        ("Largest deflection", f"{e.deflection:.3f} mrad", ""),
        ("Layer seen edge-on", f"{e.displacement_of_sheet:.2f} px", "upper bound"),
        ("Cone of rays at the flow", f"{e.cone:.2f} mm", f"f/{flow.f_number:g}"),
        ("Window of the optical flow", f"{e.window:.2f} mm", f"{flow.window:g} px"),
        ("Diffraction", f"{e.diffraction:.2f} mm", ""),
    )
    notes = items_html([f"{note[:1].upper()}{note[1:]}." for note in e.notes])
    return f"<div class=headline>{head}</div>{figures(rows)}{notes}"


def _rig_drawing(cameras: Sequence[Camera], flow_size: float) -> str:
    """Return an SVG of the rig from above, to scale: cameras, fields of view, backgrounds, flow, a scale bar.

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

    def circle(centre: torch.Tensor, radius: float, colour: str, title: str) -> str:
        x, y = at(centre).split(",")
        return f'<circle cx="{x}" cy="{y}" r="{radius:.1f}" fill="var(--{colour})"><title>{title}</title></circle>'

    views, things = [], []
    for camera, (lens, ends) in zip(cameras, rays, strict=True):
        name, (a, b) = escape(camera.name), map(at, ends)
        views.append(f'<polygon points="{at(lens[0])} {a} {b} {at(lens[1])}" fill="var(--plot)" opacity="0.07"/>')
        title = f"<title>background of {name}</title>"
        things.append(f'<polyline points="{a} {b}" stroke="currentColor" stroke-width="5">{title}</polyline>')
        things.append(circle(lens.mean(dim=0), 8, "plot", name))
    flow = circle(torch.zeros(2), max(flow_size / 2 * unit, 3), "flow", "flow")
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
    rays = camera.rays(torch.tensor([[u, (height - 1) / 2] for u in (0.0, width - 1.0)], dtype=torch.float64))
    return rays.origin[:, :2], rays.end_points[:, :2]


HINT = Hint(
    "Predicts what a rig measures before it is built: displacement, blur and resolution.",
    "Fill in the values of the rig of this demo. Then move a slider, such as the background distance.",
    "The displacement should be well above its noise, and the resolution finer than the structures of the flow. "
    "The drawing shows the rig from above, to scale.",
    values={"design": {name: list(v) if isinstance(v, tuple) else v for name, v in RIG.items()}},
)
ABOUT = "Displacement, blur and resolution of a rig before it is built."
PAGE = Page("design", "Design", ABOUT, build, HINT)
