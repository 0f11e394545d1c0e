"""`report.html`: a single file that contains everything it needs and loads nothing from the network."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerif import __version__
from nerif.analysis.evaluation import rms_with_unit
from nerif.common.files import atomic
from nerif.data.meridian import Meridian
from nerif.data.quantity_names import name_of
from nerif.forward.registry import technique_of
from nerif.plotting.drawing import map_colours, plotted_quantities
from nerif.plotting.notebook import image, number
from nerif.report import summary
from nerif.report.meridian_figure import draw_centre_line, draw_profiles, draw_section
from nerif.report.result_plots import plots_of
from nerif.report.scene import scene_of
from nerif.report.surface_figure import draw_surface
from nerif.report.view_images import colour_table, view_images
from nerif.results.directory import Result

if TYPE_CHECKING:
    import jinja2
    from matplotlib.axes import Axes

__all__ = ["flat", "render", "render_page", "svg", "write"]

ASSETS = Path(__file__).parent / "assets"
CITATION = (
    "Y. He, Y. Zheng, S. Xu, C. Liu, D. Peng, Y. Liu, W. Cai, Neural refractive index field: Unlocking the Potential "
    "of Background-oriented Schlieren Tomography in Volumetric Flow Visualization, arXiv:2409.14722 (2024)."
)


def write(page: str, path: Path) -> None:
    """Write a page, atomically."""
    with atomic(path) as part:
        part.write_text(page, encoding="utf-8")


def render(result: Result) -> str:
    """Return the page of a result, complete or not."""
    scene, arrays = scene_of(result)
    scores = result.metrics.views
    views, scales = ([], []) if result.reprojection is None else view_images(result.reprojection, scores)
    meridian = result.meridian
    measurement = result.metrics.measurement or result.settings.get("measurement")
    return render_page(
        kind=_kind(result),
        title=result.directory.resolve().name,
        source=Path(str(measurement)).name if measurement else "",
        finished=result.about.get("finished", ""),
        headline=summary.headline(result),
        statements=summary.statements(result),
        cards=(
            ("Measurement", summary.measurement_rows(result)),
            ("Reconstruction", summary.field_rows(result)),
            ("Accuracy", summary.accuracy_rows(result)),
        ),
        scene=scene,
        arrays=arrays,
        views=views,
        first_view=next((v.name for v in views if v.withheld), views[0].name if views else ""),
        scales=scales,
        scores=scores,
        first_run=summary.cross_validated(result),
        plane=_plane(meridian),
        plane_title="Around the axis" if meridian is None or meridian.axial else "In the plane of the flow",
        surface=_surface(result),
        curves=[(plot.title, svg(plot.draw)) for plot in plots_of(result) if plot.title],
        assumptions=[
            (name_of(q).capitalize(), result.volumes[q].notes)
            for q in plotted_quantities(result.volumes)
            if "assumption" in result.volumes[q].notes
        ],
        trials=result.metrics.uncertainty,
        coverage=result.metrics.coverage,
        settings=flat(result.settings),
        about=flat(result.about),
    )


def render_page(scene: dict[str, Any] | None, **parts: Any) -> str:
    """Return the page of report.html.j2 with these variables; missing parts are not shown."""
    return _template().render(
        version=__version__,
        scene=scene,
        scene_json=json.dumps(scene, separators=(",", ":")).replace("<", "\\u003c"),  # "</script>" would end it
        citation=CITATION,
        style=_assets("report.css"),
        three=_assets("three.min.js"),
        script=_assets("volume3d.js", "slices.js", "report.js"),
        **parts,
    )


def _assets(*names: str) -> str:
    return "\n".join((ASSETS / name).read_text(encoding="utf-8") for name in names)


@cache  # parsing takes half a second
def _template() -> jinja2.Template:
    import jinja2

    loader = jinja2.FileSystemLoader(ASSETS)
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["number"] = number
    environment.filters["gradient"] = lambda limits: _gradient(map_colours(limits))
    environment.filters["ends"] = _ends
    environment.filters["rms"] = partial(rms_with_unit, digits=3)
    return environment.get_template("report.html.j2")


def _plane(meridian: Meridian | None) -> list[tuple[str, str]]:
    """Titles and images of a symmetric flow over (r, h)."""
    if meridian is None:
        return []
    plane = "in a plane through the axis" if meridian.axial else "in the plane across"
    across, along = ("across the axis", "on the axis") if meridian.axial else ("along r", "along h")
    plots = (plane, draw_section), (across, draw_profiles), (along, draw_centre_line)
    return [
        (f"{name_of(quantity).capitalize()} {where}", svg(partial(draw, meridian=meridian, quantity=quantity)))
        for quantity, (where, draw) in itertools.product(plotted_quantities(meridian.quantities), plots)
    ]


def _surface(result: Result) -> tuple[str, str] | None:
    """Title and image of the first quantity on the surface of bodies, of an index the density; None without any."""
    if result.surface is None:
        return None
    quantity = next(iter(result.surface.quantities))
    title = f"{name_of(quantity).capitalize()} on the surface of the bodies"
    return title, image(partial(draw_surface, surface=result.surface, quantity=quantity), 9, 4.2, 10)


def svg(draw: Callable[[Axes], object]) -> str:
    """Return a plot as SVG in a data address."""
    return image(lambda figure: draw(figure.subplots()), 5.6, 3.6, 10, "svg")


def _kind(result: Result) -> str:
    """The kind of tomography, of the measurement or else of the field."""
    if result.measurement is not None:
        kinds = result.measurement.techniques
    else:
        kinds = () if result.field is None else (technique_of(result.field.quantity),)
    return " and ".join(dict.fromkeys(kind.tomography for kind in kinds))


def _gradient(name: str) -> str:
    table = [*colour_table(name)[::16], colour_table(name)[-1]]
    return "linear-gradient(to right, " + ", ".join(f"rgb({r} {g} {b})" for r, g, b in table) + ")"


def _ends(limits: tuple[float, float], unit: str) -> list[str]:
    """Labels below a colour bar: its ends, and 0 between them."""
    low, high = limits
    below = [f"−{number(-low, 3)}"] if low < 0 else []
    return [*below, "0", f"{number(high, 3)} {unit}".rstrip()]


def flat(table: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Return nested settings as rows of name and value."""
    rows = []
    for key, value in table.items():
        if isinstance(value, dict):
            rows += flat(value, f"{prefix}{key}.")
        else:
            rows.append((f"{prefix}{key}", ", ".join(map(str, value)) if isinstance(value, list) else str(value)))
    return rows
