"""nerif design: what a rig will see, before it is built."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from nerif.commands.output import check_file, say
from nerif.commands.settings import Settings, read_settings
from nerif.conventions import InputError
from nerif.geometry import Ring
from nerif.physics.design import Expectation, Plan, expect
from nerif.physics.gas_optics import ambient_index

__all__ = ["Design", "main", "run"]


@dataclass(frozen=True)
class Design(Settings):
    """Expected displacement, sensitivity, field of view, blur and resolution of a rig, before anyone drills a hole."""

    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Drawing to write, .png or .pdf."""
    index_contrast: float = 2.0e-4
    """Largest difference of the index to the ambient."""
    temperature: float | None = None
    """Hottest (or coldest) temperature of air, K; takes the place of index_contrast."""
    ambient_temperature: float = 293.15
    """Temperature of the air around, K."""
    pressure_pa: float = 101325.0
    """Pressure, Pa."""
    f_number: float = 16.0
    """Focal length over aperture."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm."""
    flow_size: float = 50.0
    """Width of the flow, mm."""
    feature_size: float = 5.0
    """Smallest structure of interest, mm."""
    displacement_noise: float = 0.03
    """Noise of the optical flow, px."""
    window: float = 8.0
    """What the optical flow averages over, px."""
    force: bool = False
    """Overwrite an existing drawing."""
    ring: Annotated[Ring, tyro.conf.arg(name="")] = field(default_factory=Ring)


def run(settings: Design) -> Expectation:
    """Print what to expect, and draw it."""
    if settings.out is not None:
        if settings.out.suffix not in (".png", ".pdf"):
            raise InputError(f"out: expected a name ending in .png or .pdf, got '{settings.out.name}'")
        check_file(settings.out, settings.force)
    if settings.temperature is not None:
        settings = replace(settings, index_contrast=_contrast(settings, settings.temperature))
    names = ("index_contrast", "f_number", "wavelength_nm", "flow_size", "feature_size", "displacement_noise", "window")
    plan = Plan(**{name: getattr(settings, name) for name in names})
    result = expect(settings.ring, plan)
    _tell(result, plan)
    if settings.out is not None:
        from nerif.report.design_figure import save_design

        save_design(settings.out, settings.ring, plan)
        say(f"{settings.out}: the rig, and what moving the background or stopping down would do")
    return result


def _contrast(settings: Design, temperature: float) -> float:
    """Difference of the index of air between two temperatures."""
    for name in ("temperature", "ambient_temperature", "pressure_pa"):
        if not getattr(settings, name) > 0:
            raise InputError(f"{name}: expected a positive number, got {getattr(settings, name)}")
    hot, ambient = (
        ambient_index("air", t, settings.pressure_pa, settings.wavelength_nm)
        for t in (temperature, settings.ambient_temperature)
    )
    if hot == ambient:
        raise InputError(f"temperature: expected another one than ambient_temperature, {temperature:g} K")
    return abs(hot - ambient)


def _tell(e: Expectation, plan: Plan) -> None:
    rows = (
        ("index contrast", f"{plan.index_contrast:.3g}", ""),
        ("field of view at the flow", f"{e.field_of_view[0]:.1f} x {e.field_of_view[1]:.1f} mm", "width x height"),
        ("pixel at the flow", f"{e.pixel_at_flow:.3f} mm", ""),
        ("pixel on the background", f"{e.pixel_at_background:.3f} mm", ""),
        (
            "pattern to print",
            f"{e.background_size[0]:.0f} x {e.background_size[1]:.0f} mm",
            "a tenth to spare",
        ),
        ("dot of 3 px", f"{e.dot:.2f} mm", ""),
        ("sensitivity", f"{e.sensitivity:.3f} px/mrad", ""),
        ("largest deflection", f"{e.deflection:.3f} mrad", "by a Gaussian structure"),
        ("its displacement", f"{e.displacement:.3f} px", f"noise {plan.displacement_noise:g} px"),
        ("of a layer edge-on", f"{e.displacement_of_sheet:.2f} px", "upper bound"),
        ("smallest index contrast", f"{e.smallest_contrast:.2g}", "whose displacement is the noise"),
        ("cone of rays at the flow", f"{e.cone:.2f} mm", f"f/{plan.f_number:g}, focused on the background"),
        ("window of the optical flow", f"{e.window:.2f} mm", f"{plan.window:g} px"),
        ("diffraction", f"{e.diffraction:.2f} mm", ""),
        ("spatial resolution", f"{e.resolution:.2f} mm", "the three together"),
    )
    for name, value, remark in rows:
        say(f"{name:<28}{value:>18}   {remark}".rstrip())
    for note in e.notes:
        say(f"note: {note}")


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(Design(), arguments, "design"))
