"""nerif design: predicted performance of a rig."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from nerif.cli.arguments import check_output
from nerif.cli.output import say
from nerif.cli.settings import Settings, command
from nerif.common.settings import Flat
from nerif.geometry.rig import Ring
from nerif.simulation.rig_design import DesignSettings, Expectation, expect

__all__ = ["Design", "main", "run"]


@dataclass(frozen=True)
class Design(Settings):
    """Predict displacement, sensitivity, field of view, blur and spatial resolution of a rig."""

    out: Path | None = None
    """Drawing to write, .png or .pdf."""
    force: bool = False
    """Overwrite an existing drawing."""
    body: Path | None = None
    """Surface of a body in the flow (.stl, .obj, .ply), in the frame of the ring: counts the pixels that it hides."""
    unit: Literal["mm", "cm", "m", "in"] = "mm"
    """Unit of its lengths."""
    flow: Annotated[DesignSettings, Flat] = field(default_factory=DesignSettings)
    ring: Annotated[Ring, Flat] = field(default_factory=Ring)


def run(settings: Design) -> Expectation:
    """Print the prediction, and draw it."""
    from nerif.data.body_file import read_body
    from nerif.geometry.body import hidden_pixels

    if settings.out is not None:
        check_output(settings.out, settings.force, endings=(".png", ".pdf"))
    body = None if settings.body is None else read_body(settings.body, settings.unit, lambda line: say(f"note: {line}"))
    result = expect(settings.ring, settings.flow)
    _print(result, settings.flow)
    if body is not None:
        for camera in settings.ring.cameras(settings.flow.f_number):
            share = float(hidden_pixels(camera, [body]).double().mean())
            say(f"{f'hidden in view {camera.name}':<28}{f'{share:.1%}':>18}   by {body.name}")
    if settings.out is not None:
        from nerif.report.design_figure import save_design

        save_design(settings.out, settings.ring, settings.flow)
        say(f"{settings.out}: the rig, and the effect of background distance and f-number")
    return result


def _print(e: Expectation, flow: DesignSettings) -> None:
    rows = (
        ("index contrast", f"{flow.contrast:.3g}", ""),
        ("field of view at the flow", f"{e.field_of_view[0]:.1f} x {e.field_of_view[1]:.1f} mm", "width x height"),
        ("pixel at the flow", f"{e.pixel_at_flow:.3f} mm", ""),
        ("pixel on the background", f"{e.pixel_at_background:.3f} mm", ""),
        ("pattern to print", f"{e.background_size[0]:.0f} x {e.background_size[1]:.0f} mm", "with a margin of 10 %"),
        ("dot of 3 px", f"{e.dot:.2f} mm", ""),
        ("sensitivity", f"{e.sensitivity:.3f} px/mrad", ""),
        ("largest deflection", f"{e.deflection:.3f} mrad", "by a Gaussian structure"),
        ("its displacement", f"{e.displacement:.3f} px", f"noise {flow.displacement_noise:g} px"),
        ("of a layer edge-on", f"{e.displacement_of_sheet:.2f} px", "upper bound"),
        ("smallest index contrast", f"{e.smallest_contrast:.2g}", "displacement equal to the noise"),
        ("cone of rays at the flow", f"{e.cone:.2f} mm", f"f/{flow.f_number:g}, focused on the background"),
        ("window of the optical flow", f"{e.window:.2f} mm", f"{flow.window:g} px"),
        ("diffraction", f"{e.diffraction:.2f} mm", ""),
        ("spatial resolution", f"{e.resolution:.2f} mm", "cone, window and diffraction"),
    )
    for name, value, remark in rows:
        say(f"{name:<28}{value:>18}   {remark}".rstrip())
    for note in e.notes:
        say(f"note: {note}")


main = command("design", Design, run)
