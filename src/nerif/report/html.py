"""`report.html`: one file that opens from disk or an e-mail, with everything it needs inside and no network."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from nerif import __version__
from nerif.atomic import atomic
from nerif.drawing import COLOUR_MAPS, DIVERGING, style
from nerif.notebook import number
from nerif.report import packing
from nerif.report.figures import draw_history, draw_residuals, draw_slice_scores
from nerif.report.isosurface import default_level
from nerif.report.pages import error_of, residuals_over_sigma
from nerif.report.rig_figure import picture_corners
from nerif.report.summary import came_out, headline, measured, trust, trust_figures
from nerif.report.view_images import colour_table, view_images
from nerif.result import Result
from nerif.volume import Volume

if TYPE_CHECKING:
    import jinja2
    from matplotlib.axes import Axes

__all__ = ["flat", "render", "render_page", "svg", "write"]

ASSETS = Path(__file__).parent / "assets"
QUANTITIES = {
    "n": ("Refractive index", "n − 1", ""),
    "density": ("Density", "density", "kg m⁻³"),
    "temperature": ("Temperature", "temperature", "K"),
}
"""Button, label of the colour bar, and unit."""

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
    scene, arrays = _scene(result)
    metrics = result.metrics.get("views")
    metrics = metrics if isinstance(metrics, list) else []
    views, limit, apart = ([], 0.0, 0.0) if result.reprojection is None else view_images(result.reprojection, metrics)
    first = next((v.name for v in views if v.held_out), views[0].name if views else "")
    return render_page(
        title=result.directory.resolve().name,
        source=_source(result),
        finished=result.about.get("finished", ""),
        headline=headline(statements),
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
        limit=limit,
        apart=apart,
        scores=metrics,
        left_out=(result.metrics.get("ensemble") or {}).get("left_out") or [],
        curves=_curves(result),
        assumptions=[
            (QUANTITIES[q][0], result.volumes[q].notes)
            for q in ("density", "temperature")
            if q in result.volumes and "assumption" in result.volumes[q].notes
        ],
        ensemble=result.metrics.get("ensemble"),
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
        diverging=_gradient(DIVERGING),
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
    return environment.get_template("report.html.j2")


def _scene(result: Result) -> tuple[dict[str, Any] | None, dict[str, str]]:
    """What the page's own pictures are drawn from: grid, quantities, cameras; and the packed arrays by name."""
    excess = result.volumes.get("index_excess")
    if excess is None or "n_ambient" not in excess.attributes:
        return None, {}
    small = packing.coarsen(excess)
    sources: dict[str, Volume] = {"value": small}
    error = error_of(result)
    if error is not None:
        sources["error"] = packing.coarsen(error)
    for statistic in ("mean", "std"):
        if f"index_excess_{statistic}" in result.volumes:
            sources[statistic] = packing.coarsen(result.volumes[f"index_excess_{statistic}"])
        for quantity in ("density", "temperature"):
            volume = result.volumes.get(f"{quantity}_{statistic}")
            if volume is not None and _own(quantity, volume):
                sources[volume.quantity] = packing.coarsen(volume)
    packed = {
        name: packing.pack(volume.values.double().numpy(), packing.FINE if name == "value" else packing.COARSE)
        for name, volume in sources.items()
    }
    quantities: dict[str, dict[str, Any]] = {}
    for name, (button, label, unit) in QUANTITIES.items():
        if name not in result.volumes:
            continue
        quantities[name] = {
            "button": button,
            "label": label,
            "unit": unit,
            "relation": packing.as_plain(packing.relation(name, result.volumes[name].attributes)),
            "colours": COLOUR_MAPS.get(name, "viridis"),
            "level": default_level(result.volumes[name]),
        }
    if not quantities:
        return None, {}
    maps = {q["colours"] for q in quantities.values()} | {DIVERGING, "cividis"}
    scene = {
        "shape": small.grid.shape,
        "full_shape": excess.grid.shape,
        "lower": excess.grid.box.lower,
        "upper": excess.grid.box.upper,
        "arrays": {name: {"low": p["low"], "step": p["step"]} for name, p in packed.items()},
        "quantities": quantities,
        "variants": _variants(sources),
        "diverging": DIVERGING,
        "tables": {name: [c for rgb in colour_table(name) for c in rgb] for name in sorted(maps)},
        "cameras": _cameras(result),
    }
    return scene, {name: p["text"] for name, p in packed.items()}


def _own(quantity: str, volume: Volume) -> bool:
    """Whether a statistic has to be packed for itself: it is no linear function of the excess, or masked somewhere."""
    return quantity == "temperature" or not bool(torch.isfinite(volume.values).all())


def _variants(sources: dict[str, Volume]) -> dict[str, str]:
    """What can be switched to, and its button."""
    found = {"value": "Reconstruction"}
    if "mean" in sources:
        found |= {"mean": "Ensemble mean", "std": "Standard deviation"}
    if "error" in sources:
        found |= {"truth": "Truth", "error": "Error"}
    return found


def _cameras(result: Result) -> list[dict[str, Any]]:
    """Centre, directions of the picture's corners and where they meet the background, of every camera; mm."""
    if result.measurement is None:
        return []
    held_out = () if result.reprojection is None else result.reprojection.held_out
    found = []
    for camera in result.measurement.cameras:
        directions, hits = picture_corners(camera)
        found.append(
            {
                "name": camera.name,
                "held_out": camera.name in held_out,
                "centre": camera.centre.tolist(),
                "directions": np.round(directions, 6).tolist(),
                "background": np.round(hits, 3).tolist(),
            }
        )
    return found


def _curves(result: Result) -> list[tuple[str, str]]:
    """Titles and pictures (SVG as data addresses) of how the run went and of how it compares with the truth."""
    found = []
    if result.history:
        method = str(result.settings.get("method", "nerif"))
        found.append(("How the run went", svg(lambda axes: draw_history(axes, result.history, method))))
    if result.reprojection is not None and result.reprojection.measurement.sigma is not None:
        residuals = residuals_over_sigma(result.reprojection)
        found.append(("Residuals against the noise", svg(lambda axes: draw_residuals(axes, residuals))))
    if result.metrics.get("slices"):
        slices = result.metrics["slices"]
        found.append(("Against the truth, slice by slice", svg(lambda axes: draw_slice_scores(axes, slices))))
    return found


def svg(draw: Callable[[Axes], object]) -> str:
    """Return a plot as SVG in a data address."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with style(size=10):
        figure = Figure(figsize=(5.6, 3.6), layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure.subplots())
        text = io.BytesIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return "data:image/svg+xml;base64," + base64.b64encode(text.getvalue()).decode()


def _source(result: Result) -> str:
    """Name of the measurement whose views are shown."""
    path = result.metrics.get("measurement", result.settings.get("measurement"))
    return Path(str(path)).name if path else ""


def _gradient(name: str) -> str:
    table = [*colour_table(name)[::16], colour_table(name)[-1]]
    return "linear-gradient(to right, " + ", ".join(f"rgb({r} {g} {b})" for r, g, b in table) + ")"


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
