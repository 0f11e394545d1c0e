"""Which figures the page of a study has, and what is drawn in them; a figure without data is left out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from nerif.plotting.drawing import COLOURS
from study.cases import METHODS, NOISES, PHANTOMS, SECTIONS
from study.figures import (
    Line,
    draw_by_phantom,
    draw_costs,
    draw_curves,
    draw_dots,
    draw_slices,
    draw_views,
    look,
    variety,
)
from study.mtf import draw_mtf
from study.octahedron import from_plain
from study.octahedron_figures import draw_distribution, draw_edge_spread
from study.paper import COLUMNS, CORRELATION, L2, MEMORY_GB, MINUTES, paper_value
from study.results import Results, metric, typical
from study.words import duration, memory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["FigureSpec", "page_figures"]


@dataclass(frozen=True)
class FigureSpec:
    """A figure of the page.

    Parameters
    ----------
    name : of its file
    section : it belongs to
    caption : one sentence
    size : width and height, inches
    draw : draws it into an empty figure
    """

    name: str
    section: str
    caption: str
    size: tuple[float, float]
    draw: Callable[[Figure], None]


def page_figures(results: Results) -> list[FigureSpec]:
    """Return the figures that there are data for, in the order of the sections asked for."""
    return [spec for section in results.sections for spec in DRAWN[section](results, section)]


def _tables(results: Results, section: str) -> Iterator[FigureSpec]:
    def values(name: str) -> dict[str, list[float | None]]:
        rows = {m: [metric(results.cell(p, 0.0, m), name) for p in PHANTOMS] for m in METHODS}
        return {m: row for m, row in rows.items() if any(v is not None for v in row)}

    def draw(figure: Figure) -> None:
        for axes, name, table in zip(figure.subplots(1, 2), ("l2", "cc"), (L2, CORRELATION), strict=True):
            paper = {m: [table[p][COLUMNS.index(c)] for p in PHANTOMS] for m, c in zip(METHODS, PAPER, strict=False)}
            draw_by_phantom(axes, values(name), paper, name)
        _one_legend(figure, 5)

    if values("l2"):
        yield FigureSpec("tables", section, "L2 and CC without noise, here and in the paper.", (11, 4.4), draw)


PAPER = ("NeRIF 0", "Tikhonov", "Landweber")


def _slices(results: Results, section: str) -> Iterator[FigureSpec]:
    shown = [("NeRIF", noise) for noise in NOISES] + [(method, 0.0) for method in METHODS[1:]]

    def series(phantom: str) -> dict[str, tuple[Line, list[dict[str, float]]]]:
        found = {}
        for method, noise in shown:
            record = results.cell(phantom, noise, method)
            if record is not None and record["metrics"].get("slices"):
                name = f"{method}, noise {noise:g}"
                found[name] = (look(method, noise) | {"markersize": 3}, record["metrics"]["slices"])
        return found

    def draw(score: str) -> Callable[[Figure], None]:
        def into(figure: Figure) -> None:
            *panels, last = figure.subplots(2, 4, sharex=True, sharey=True).flat
            handles: dict[Any, Any] = {}
            for axes, phantom in zip(panels, PHANTOMS, strict=True):
                draw_slices(axes, series(phantom), score)
                handles |= {line.get_label(): line for line in axes.get_lines()}
                axes.set_title(f"Phantom {phantom}")
                axes.label_outer()
            panels[3].tick_params(labelbottom=True)
            panels[3].set_xlabel("z [mm]")
            last.axis("off")
            last.legend(handles.values(), handles.keys(), frameon=False, loc="center")

        return into

    if any(series(phantom) for phantom in PHANTOMS):
        for score, name in (("cc", "Correlation"), ("ssim", "Structural similarity")):
            caption = f"{name} of ten slices across z with the truth; 1 is perfect."
            yield FigureSpec(f"slices_{score}", section, caption, (11, 5.4), draw(score))


def _curves(results: Results, section: str) -> Iterator[FigureSpec]:
    curves: dict[str, tuple[Line, list[dict[str, float]]]] = {}
    levels: dict[str, tuple[Line, float]] = {}
    for noise, mark in zip(NOISES, "ovX", strict=True):
        record, level = results.cell("2", noise, "NeRIF"), paper_value(L2, "2", "NeRIF", noise)
        style = look("NeRIF", noise) | {"marker": mark}
        if record is not None and record.get("curve") and level is not None:
            curves[f"NeRIF, noise {noise:g}"] = (style, record["curve"])
            levels[f"the paper's, noise {noise:g}"] = (style | {"color": COLOURS["grey"]}, level)

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2, sharey=True)
        draw_curves(left, curves, "epoch", "l2", levels=levels)
        draw_curves(right, curves, "seconds", "l2", points=_points(results, "l2"))
        right.set_ylabel("")
        _one_legend(figure, 3)

    if curves:
        caption = "L2 error of Phantom 2 over epochs and over time; in grey the paper's final errors."
        yield FigureSpec("curves", section, caption, (11, 4.6), draw)


def _points(results: Results, score: str) -> dict[str, tuple[Line, float, float]]:
    """Seconds and error of the classical methods on Phantom 2 without noise."""
    found = {}
    for method in METHODS[1:]:
        record = results.cell("2", 0.0, method)
        error = metric(record, score)
        if record is not None and error is not None:
            found[f"{method}, noise 0"] = (look(method), record["seconds"], error)
    return found


def _cost(results: Results, section: str) -> Iterator[FigureSpec]:
    records = {m: [r for r in (results.cell(p, 0.0, m) for p in PHANTOMS) if r is not None] for m in METHODS}
    seconds = {m: typical(found, "seconds") for m, found in records.items()}
    sizes = {m: typical(found, "peak_memory_bytes") for m, found in records.items()}
    gigabytes = {m: size / 1e9 if size else None for m, size in sizes.items()}

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        draw_costs(
            left,
            seconds,
            {m: 60.0 * minutes for m, minutes in MINUTES.items()},
            "time of a reconstruction [s]",
            duration,
        )
        draw_costs(
            right,
            gigabytes,
            {m: float(size) for m, size in MEMORY_GB.items()},
            "peak memory [GB]",
            lambda v: memory(1e9 * v),
        )

    if any(seconds.values()):
        caption = "Time and peak memory of one reconstruction, medians over the phantoms without noise."
        yield FigureSpec("cost", section, caption, (11, 3.4), draw)


def _settings(results: Results, section: str) -> Iterator[FigureSpec]:
    values = {label: metric(record, "l2_variation") for label, _, record in results.rows(section)}

    def draw(figure: Figure) -> None:
        draw_dots(figure.subplots(), values)

    if any(value is not None for value in values.values()):
        caption = f"{SECTIONS[section]}: error of the variation of n; the lowest in blue."
        yield FigureSpec(section, section, caption, (7.5, 1.1 + 0.34 * len(values)), draw)


def _resolution(results: Results, section: str) -> Iterator[FigureSpec]:
    found = {
        label: from_plain(record["resolution"])
        for label, _, record in results.rows(section)
        if record is not None and record.get("resolution")
    }

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        for label, resolution in found.items():
            colour = look(label)["color"]
            draw_edge_spread(left, resolution, label, colour)
            draw_mtf(right, resolution.mtf_per_unit, label, colour, "unit")

    def distribution(figure: Figure) -> None:
        draw_distribution(figure.subplots(), found["NeRIF"])

    if found:
        caption = (
            "Edge spread function of the octahedron's faces, and modulation transfer function with the 10% cutoff."
        )
        yield FigureSpec("resolution", section, caption, (11, 4), draw)
    if "NeRIF" in found:
        caption = "Resolution of NeRIF over the octahedron's eight faces, laid side by side."
        yield FigureSpec("resolution_distribution", section, caption, (9, 4.6), distribution)


def _views(results: Results, section: str) -> Iterator[FigureSpec]:
    errors = {case.ring.views: metric(record, "l2_variation") for _, case, record in results.rows(section)}

    def draw(figure: Figure) -> None:
        draw_views(figure.subplots(), errors)

    if any(value is not None for value in errors.values()):
        yield FigureSpec("views", section, "Error over the number of views, Phantom 2 at noise 0.1.", (7.5, 4.2), draw)


def _speed(results: Results, section: str) -> Iterator[FigureSpec]:
    found = [(label, record["curve"]) for label, _, record in results.rows(section) if record and record.get("curve")]
    curves: Mapping[str, tuple[Line, list[dict[str, float]]]] = {
        label: (variety(i), curve) for i, (label, curve) in enumerate(found)
    }

    def draw(figure: Figure) -> None:
        points = {
            name: (style | {"color": "black", "markerfacecolor": "none", "markeredgewidth": 1.5}, seconds, error)
            for name, (style, seconds, error) in _points(results, "l2_variation").items()
        }
        axes = draw_curves(figure.subplots(), curves, "seconds", "l2_variation", points=points)
        axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))

    if curves:
        caption = "Error against seconds of NeRIF's variants and of the classical methods, Phantom 2 without noise."
        yield FigureSpec("speed", section, caption, (10, 5), draw)


def _one_legend(figure: Figure, columns: int) -> None:
    """Put one legend below all panels in the place of theirs."""
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        handles |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        legend = axes.get_legend()
        if legend is not None:
            legend.remove()
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns, frameon=False)


DRAWN: dict[str, Callable[[Results, str], Iterator[FigureSpec]]] = {
    **dict.fromkeys(SECTIONS, _settings),
    "tables": _tables,
    "slices": _slices,
    "curves": _curves,
    "cost": _cost,
    "resolution": _resolution,
    "views": _views,
    "speed": _speed,
}
