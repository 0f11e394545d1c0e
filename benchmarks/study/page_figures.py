"""Figures of the page and their data; a figure without data is left out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from benchmarks.study import figures as draw
from benchmarks.study.figures import Line, look, variety
from benchmarks.study.mtf import draw_mtf
from benchmarks.study.octahedron_figures import draw_distribution, draw_edge_spread
from benchmarks.study.paper import COLUMNS, CORRELATION, L2, MEMORY_GB, MINUTES, paper_value
from benchmarks.study.plan import METHODS, NOISES, PHANTOMS, SECTIONS
from benchmarks.study.resolution import from_plain
from benchmarks.study.results import Results, metric, typical
from benchmarks.study.words import duration, memory
from nerif.plotting.drawing import COLOURS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class FigureSpec:
    """A figure of the page.

    Parameters
    ----------
    name : of its file
    size : width and height, inches
    draw : draws it into an empty figure
    """

    name: str
    section: str
    caption: str
    size: tuple[float, float]
    draw: Callable[[Figure], None]


def page_figures(results: Results) -> list[FigureSpec]:
    """Return the figures with data, in the order of the sections."""
    return [spec for section in results.sections for spec in FIGURES[section](results, section)]


def _tables(results: Results, section: str) -> Iterator[FigureSpec]:
    def values(name: str) -> dict[str, list[float | None]]:
        rows = {m: [metric(results.cell(p, 0.0, m), name) for p in PHANTOMS] for m in METHODS}
        return {m: row for m, row in rows.items() if any(v is not None for v in row)}

    def panels(figure: Figure) -> None:
        for axes, name, table in zip(figure.subplots(1, 2), ("l2", "cc"), (L2, CORRELATION), strict=True):
            columns = zip(METHODS, ("NeRIF 0", "Tikhonov", "Landweber"), strict=False)
            paper = {m: [table[p][COLUMNS.index(c)] for p in PHANTOMS] for m, c in columns}
            draw.draw_by_phantom(axes, values(name), paper, name)
        _one_legend(figure, 5)

    if values("l2"):
        yield FigureSpec("tables", section, "L2 and CC without noise, here and in the paper.", (11, 4.4), panels)


def _slices(results: Results, section: str) -> Iterator[FigureSpec]:
    columns = [("NeRIF", noise) for noise in NOISES] + [(method, 0.0) for method in METHODS[1:]]

    def series(phantom: str) -> dict[str, tuple[Line, list[dict[str, float]]]]:
        records = {(method, noise): results.cell(phantom, noise, method) for method, noise in columns}
        return {
            f"{method}, noise {noise:g}": (look(method, noise) | {"markersize": 3}, record["metrics"]["slices"])
            for (method, noise), record in records.items()
            if record is not None and record["metrics"].get("slices")
        }

    def panels_of(score: str) -> Callable[[Figure], None]:
        def panels(figure: Figure) -> None:
            *axes_of_phantoms, last = figure.subplots(2, 4, sharex=True, sharey=True).flat
            handles: dict[Any, Any] = {}
            for axes, phantom in zip(axes_of_phantoms, PHANTOMS, strict=True):
                draw.draw_slices(axes, series(phantom), score)
                handles |= {line.get_label(): line for line in axes.get_lines()}
                axes.set_title(f"Phantom {phantom}")
                axes.label_outer()
            axes_of_phantoms[3].tick_params(labelbottom=True)
            axes_of_phantoms[3].set_xlabel("z [mm]")
            last.axis("off")
            last.legend(handles.values(), handles.keys(), frameon=False, loc="center")

        return panels

    if any(series(phantom) for phantom in PHANTOMS):
        for score, name in (("cc", "Correlation"), ("ssim", "Structural similarity")):
            caption = f"{name} of ten slices across z with the truth; 1 is perfect."
            yield FigureSpec(f"slices_{score}", section, caption, (11, 5.4), panels_of(score))


def _curves(results: Results, section: str) -> Iterator[FigureSpec]:
    curves: dict[str, tuple[Line, list[dict[str, float]]]] = {}
    levels: dict[str, tuple[Line, float]] = {}
    for noise, mark in zip(NOISES, "ovX", strict=True):
        record, level = results.cell("2", noise, "NeRIF"), paper_value(L2, "2", "NeRIF", noise)
        style = look("NeRIF", noise) | {"marker": mark}
        if record is not None and record.get("curve") and level is not None:
            curves[f"NeRIF, noise {noise:g}"] = (style, record["curve"])
            levels[f"the paper's, noise {noise:g}"] = (style | {"color": COLOURS["grey"]}, level)

    def panels(figure: Figure) -> None:
        left, right = figure.subplots(1, 2, sharey=True)
        draw.draw_curves(left, curves, "epoch", "l2", levels=levels)
        draw.draw_curves(right, curves, "seconds", "l2", points=_points(results, "l2"))
        right.set_ylabel("")
        _one_legend(figure, 3)

    if curves:
        caption = "L2 error of Phantom 2 over epochs and over time; in grey the paper's final errors."
        yield FigureSpec("curves", section, caption, (11, 4.6), panels)


def _points(results: Results, score: str) -> dict[str, tuple[Line, float, float]]:
    """Return style, seconds and error of the classical methods on Phantom 2 without noise."""
    records = {method: results.cell("2", 0.0, method) for method in METHODS[1:]}
    return {
        f"{method}, noise 0": (look(method), record["seconds"], error)
        for method, record in records.items()
        if record is not None and (error := metric(record, score)) is not None
    }


def _cost(results: Results, section: str) -> Iterator[FigureSpec]:
    records = {m: [r for r in (results.cell(p, 0.0, m) for p in PHANTOMS) if r is not None] for m in METHODS}
    seconds = {m: typical(of_method, "seconds") for m, of_method in records.items()}
    sizes = {m: typical(of_method, "peak_memory_bytes") for m, of_method in records.items()}

    def panels(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        paper = {m: 60.0 * minutes for m, minutes in MINUTES.items()}
        draw.draw_costs(left, seconds, paper, "time of a reconstruction [s]", duration)
        gigabytes, paper = (
            {m: v / 1e9 if v else None for m, v in sizes.items()},
            {m: float(v) for m, v in MEMORY_GB.items()},
        )
        draw.draw_costs(right, gigabytes, paper, "peak memory [GB]", lambda v: memory(1e9 * v))

    if any(seconds.values()):
        caption = "Time and peak memory of one reconstruction, medians over the phantoms without noise."
        yield FigureSpec("cost", section, caption, (11, 3.4), panels)


def _settings(results: Results, section: str) -> Iterator[FigureSpec]:
    values = {label: metric(record, "l2_variation") for label, _, record in results.rows(section)}
    if any(value is not None for value in values.values()):
        caption = f"{SECTIONS[section]}: error of the variation of n; the lowest in blue."
        size = (7.5, 1.1 + 0.34 * len(values))
        yield FigureSpec(section, section, caption, size, lambda figure: draw.draw_dots(figure.subplots(), values))


def _resolution(results: Results, section: str) -> Iterator[FigureSpec]:
    resolutions = {
        label: from_plain(record["resolution"])
        for label, _, record in results.rows(section)
        if record is not None and record.get("resolution")
    }

    def panels(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        for label, resolution in resolutions.items():
            colour = look(label)["color"]
            draw_edge_spread(left, resolution, label, colour)
            draw_mtf(right, resolution.mtf_per_unit, label, colour, "unit")

    def distribution(figure: Figure) -> None:
        draw_distribution(figure.subplots(), resolutions["NeRIF"])

    if resolutions:
        caption = (
            "Edge spread function of the octahedron's faces, and modulation transfer function with the 10% cutoff."
        )
        yield FigureSpec("resolution", section, caption, (11, 4), panels)
    if "NeRIF" in resolutions:
        caption = "Resolution of NeRIF over the octahedron's eight faces, laid side by side."
        yield FigureSpec("resolution_distribution", section, caption, (9, 4.6), distribution)


def _views(results: Results, section: str) -> Iterator[FigureSpec]:
    errors = {case.ring.views: metric(record, "l2_variation") for _, case, record in results.rows(section)}
    if any(value is not None for value in errors.values()):
        caption = "Error over the number of views, Phantom 2 at noise 0.1."
        yield FigureSpec(
            "views", section, caption, (7.5, 4.2), lambda figure: draw.draw_views(figure.subplots(), errors)
        )


def _speed(results: Results, section: str) -> Iterator[FigureSpec]:
    records = [(label, record) for label, _, record in results.rows(section) if record and record.get("curve")]
    curves = {label: (variety(i), record["curve"]) for i, (label, record) in enumerate(records)}

    def panels(figure: Figure) -> None:
        hollow = {"color": "black", "markerfacecolor": "none", "markeredgewidth": 1.5}
        classical = _points(results, "l2_variation").items()
        points = {name: (style | hollow, seconds, error) for name, (style, seconds, error) in classical}
        axes = figure.subplots()
        draw.draw_curves(axes, curves, "seconds", "l2_variation", points=points)
        axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))

    if curves:
        caption = "Error against seconds of NeRIF's variants and of the classical methods, Phantom 2 without noise."
        yield FigureSpec("speed", section, caption, (10, 5), panels)


def _one_legend(figure: Figure, columns: int) -> None:
    """Replace the legends of all panels by one below them."""
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        handles |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        legend = axes.get_legend()
        if legend is not None:
            legend.remove()
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns, frameon=False)


FIGURES: dict[str, Callable[[Results, str], Iterator[FigureSpec]]] = {
    **dict.fromkeys(SECTIONS, _settings),
    "tables": _tables,
    "slices": _slices,
    "curves": _curves,
    "cost": _cost,
    "resolution": _resolution,
    "views": _views,
    "speed": _speed,
}
