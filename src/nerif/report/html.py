"""`report.html`: one file that opens from disk or an e-mail, with everything it needs inside and no network."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerif import __version__
from nerif.analysis.evaluation import rms_text
from nerif.common.files import atomic
from nerif.data.meridian import Meridian
from nerif.data.volume import name_of
from nerif.forward.registry import technique_of
from nerif.plotting.drawing import drawn_of, map_colours
from nerif.plotting.notebook import image, number
from nerif.report.figures import draw_history, draw_residuals, draw_slice_scores
from nerif.report.meridian_figure import draw_centre_line, draw_profiles, draw_section
from nerif.report.moves_figure import draw_moved_rig, draw_moves
from nerif.report.pages import residuals_over_sigma
from nerif.report.scene import scene_of
from nerif.report.summary import came_out, headline, looked, measured, trust, trust_figures
from nerif.report.uncertainty_figure import banded, draw_bands, draw_reliability
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
    """Return the page of a result, whatever of it is there."""
    statements = trust(result)
    scene, arrays = scene_of(result)
    metrics = result.metrics.get("views")
    metrics = metrics if isinstance(metrics, list) else []
    views, scales = ([], []) if result.reprojection is None else view_images(result.reprojection, metrics)
    meridian = result.meridian
    first = next((v.name for v in views if v.withheld), views[0].name if views else "")
    return render_page(
        kind=_kind(result),
        title=result.directory.resolve().name,
        source=_source(result),
        finished=result.about.get("finished", ""),
        headline=headline(result),
        statements=statements,
        cards=(
            ("What was measured", measured(result)),
            ("What came out", came_out(result)),
            ("Can it be trusted", trust_figures(result)),
        ),
        scene=scene,
        arrays=arrays,
        views=views,
        first_view=first,
        scales=scales,
        scores=metrics,
        kept_out=looked(result),
        plane=_plane(meridian),
        plane_title="Around the axis" if meridian is None or meridian.axial else "In the plane of the flow",
        curves=_curves(result),
        assumptions=[
            (name_of(q).capitalize(), result.volumes[q].notes)
            for q in drawn_of(result.volumes)
            if "assumption" in result.volumes[q].notes
        ],
        trials=result.metrics.get("uncertainty"),
        coverage=result.metrics.get("coverage"),
        settings=flat(result.settings),
        about=flat(result.about),
    )


def render_page(scene: dict[str, Any] | None, **parts: Any) -> str:
    """Return the page of what report.html.j2 is given; parts that are left out are not shown."""
    return _template().render(
        version=__version__,
        scene=scene,
        scene_json=_json(scene),
        citation=CITATION,
        style=(ASSETS / "report.css").read_text(),
        three=(ASSETS / "three.min.js").read_text(),
        script="\n".join((ASSETS / name).read_text() for name in ("volume3d.js", "slices.js", "report.js")),
        **parts,
    )


@cache  # to parse it takes half a second
def _template() -> jinja2.Template:
    import jinja2

    loader = jinja2.FileSystemLoader(ASSETS)
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["number"] = number
    environment.filters["gradient"] = lambda limits: _gradient(map_colours(limits))
    environment.filters["ends"] = _ends
    environment.filters["rms"] = partial(rms_text, digits=3)
    return environment.get_template("report.html.j2")


def _plane(meridian: Meridian | None) -> list[tuple[str, str]]:
    """Titles and images of what a symmetric flow is over (r, h)."""
    if meridian is None:
        return []
    plane = "in a plane through the axis" if meridian.axial else "in the plane across"
    beside, along = ("across the axis", "on the axis") if meridian.axial else ("along r", "along h")
    ways = (plane, draw_section), (beside, draw_profiles), (along, draw_centre_line)
    return [
        (f"{name_of(quantity).capitalize()} {where}", svg(partial(draw, meridian=meridian, quantity=quantity)))
        for quantity, (where, draw) in itertools.product(drawn_of(meridian.quantities), ways)
    ]


def _curves(result: Result) -> list[tuple[str, str]]:
    """Titles and images (SVG as data addresses) of how the run went and of how it compares with the truth."""
    found = []
    if result.history:
        method = str(result.settings.get("method", "nerif"))
        found.append(("How the run went", svg(lambda axes: draw_history(axes, result.history, method))))
    if result.reprojection is not None:
        several = len(result.reprojection.measurement.observations) > 1
        for name, residuals in residuals_over_sigma(result.reprojection).items():
            of = f" of {name}" if several else ""
            found.append((f"Residuals{of} against the noise", svg(partial(draw_residuals, residuals=residuals))))
    rig = result.metrics.get("rig")
    if rig:
        found.append(("How far the cameras were moved", svg(partial(draw_moves, table=rig))))
        if result.reprojection is not None:
            cameras = result.reprojection.measurement.cameras
            found.append(("Where the cameras were moved to", svg(partial(draw_moved_rig, cameras=cameras, table=rig))))
    for quantity in banded(result.volumes):
        draw = partial(draw_bands, volumes=result.volumes, quantity=quantity)
        found.append((f"{name_of(quantity).capitalize()} with bands that hold 90 %", svg(draw)))
    if "reliability" in (result.metrics.get("coverage") or {}):
        draw = partial(draw_reliability, coverage=result.metrics["coverage"])
        found.append(("Are the bands right? Against the truth", svg(draw)))
    if result.metrics.get("slices"):
        slices = result.metrics["slices"]
        found.append(("Against the truth, slice by slice", svg(lambda axes: draw_slice_scores(axes, slices))))
    return found


def svg(draw: Callable[[Axes], object]) -> str:
    """Return a plot as SVG in a data address."""
    return image(lambda figure: draw(figure.subplots()), 5.6, 3.6, 10, "svg")


def _kind(result: Result) -> str:
    """What kind of tomography it is, by what was measured, or by what was reconstructed where that is not there."""
    if result.measurement is not None:
        kinds = result.measurement.techniques
    else:
        kinds = () if result.field is None else (technique_of(result.field.quantity),)
    return " and ".join(dict.fromkeys(kind.tomography for kind in kinds))


def _source(result: Result) -> str:
    """Name of the measurement whose views are shown."""
    path = result.metrics.get("measurement", result.settings.get("measurement"))
    return Path(str(path)).name if path else ""


def _gradient(name: str) -> str:
    table = [*colour_table(name)[::16], colour_table(name)[-1]]
    return "linear-gradient(to right, " + ", ".join(f"rgb({r} {g} {b})" for r, g, b in table) + ")"


def _ends(limits: tuple[float, float], unit: str) -> list[str]:
    """What stands below a bar of colours: its ends, and 0 between them."""
    low, high = limits
    below = [f"−{number(-low, 3)}"] if low < 0 else []
    return [*below, "0", f"{number(high, 3)} {unit}".rstrip()]


def _json(value: Any) -> str:
    """JSON that cannot end the script it stands in."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def flat(table: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Return nested settings as rows of name and value."""
    rows = []
    for key, value in table.items():
        if isinstance(value, dict):
            rows += flat(value, f"{prefix}{key}.")
        else:
            rows.append((f"{prefix}{key}", ", ".join(map(str, value)) if isinstance(value, list) else str(value)))
    return rows
