"""Design: what a rig will see, before it is built."""

from __future__ import annotations

import math
from html import escape

from nicegui import ui

from nerif.app.elements import CommandLine, card, figures, items_html
from nerif.app.form_view import FormView
from nerif.app.forms import Form
from nerif.app.pages.page import Page
from nerif.app.rig_drawing import rig_drawing
from nerif.app.workspace import Workspace
from nerif.cli.commands.design import Design
from nerif.simulation.design import Expectation, expect

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


def build(work: Workspace) -> None:
    """Build the page."""
    form = Form(Design(), ("design",), without=("config", "out", "force"))
    with ui.element("div").classes("columns"):
        with card("Rig and flow"), ui.element("div").classes("form") as left:
            pass
        with ui.element("div").classes("stack"):
            with card("What to expect"):
                notice = ui.html("", sanitize=False).props('aria-live="polite"')
            with card("From above, to scale"):
                drawing = ui.html("", sanitize=False).classes("drawing")
            with card("The same on the command line"):
                command = CommandLine()

    def show() -> None:
        work.keep(PAGE.name, form.changed(view.values))
        command.show(view.arguments)
        if not view.valid:
            return
        request = view.record()
        notice.set_content(_text(expect(request.ring, request.flow), request))
        drawing.set_content(rig_drawing(request.ring.cameras(), request.flow.flow_size))

    with left:
        view = FormView(form, show, work.draft(PAGE.name), MAIN, SLIDERS)
        ui.button("Back to the defaults", on_click=lambda: _reset(form, view)).props("flat no-caps")
    show()


def _reset(form: Form[Design], view: FormView[Design]) -> None:
    for name in list(form.changed(view.values)):
        view.set(name, form.field(name).default)


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


PAGE = Page("design", "Design", "/design", "What a rig will see, before anyone drills a hole.", build)
