"""Figures of each section, with the paper's values."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.runner import Figure
from benchmarks.study.paper import COLUMNS, CORRELATION, L2, MEMORY_GB, MINUTES
from benchmarks.study.plan import METHODS, NOISES, PHANTOMS, SECTIONS
from benchmarks.study.resolution import SAMPLES, SIZE, THRESHOLD
from benchmarks.study.results import Results, Row, scores
from nerif.plotting.drawing import COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LABELS = {
    "l2": "L2 error, paper's definition [%]",
    "l2_variation": "error of the variation of n [%]",
    "cc": "CC [1]",
    "ssim": "SSIM [1]",
    "seconds": "training time [s]",
    "epochs": "epochs (passes over all rays)",
}
SCALE = {"l2": 100, "l2_variation": 100}  # to per cent
MORE = [*COLOURS.values(), "#AA5A8E", "#B87A00", "#2F8FC4"]  # Okabe & Ito, darkened for white
LOOKS = dict(zip(METHODS, zip(("blue", "orange", "green", "grey"), "os^D", strict=True), strict=True))
DASHES = dict(zip(NOISES, ("-", "--", ":"), strict=True))
GREY: dict[str, Any] = {"color": COLOURS["grey"], "linewidth": 0.8}


def figures(results: Results, section: str) -> Iterator[Figure]:
    """Yield the figures of a section; none while it has no result."""
    rows = [row for row in results.by_key.values() if section in row["sections"].split()]
    caption = f"{SECTIONS[section]}: error of the variation of n."
    settings = [(section, caption, (7.5, 1.1 + 0.34 * len(results.section(section))), partial(_settings, name=section))]
    for name, caption, size, draw in FIGURES.get(section, settings) if scores(rows, "l2") else ():
        yield Figure(name, caption, size, partial(draw, results))


def look(method: str, noise: float = 0.0) -> Row:
    """Return colour and mark of a method, and the dashes of a noise."""
    colour, mark = LOOKS[method]
    return {"color": COLOURS[colour], "marker": mark, "linestyle": DASHES[noise], "markersize": 4, "linewidth": 1.3}


def _plot(axes: Axes, x: Sequence[float | None], y: Sequence[float | None], name: str, style: Row) -> None:
    axes.plot(np.array(x, float), np.array(y, float) * SCALE.get(name, 1), **style)


def _finish(axes: Axes, across: str, name: str, log: str = "") -> None:
    """Add labels and a grid, and plain numbers on the logarithmic axes ("x", "y")."""
    from matplotlib.ticker import LogLocator

    axes.set(xlabel=LABELS.get(across, across), ylabel=LABELS.get(name, name))
    for letter in log:
        axes.set(**{f"{letter}scale": "log"})
        axis = {"x": axes.xaxis, "y": axes.yaxis}[letter]
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    axes.grid(True, which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def _legend_below(figure: Any, columns: int) -> None:
    """Add one legend of all panels."""
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        handles |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns, frameon=False)


def _tables(results: Results, figure: Any) -> None:
    for axes, name, table in zip(figure.subplots(1, 2), ("l2", "cc"), (L2, CORRELATION), strict=True):
        for i, (method, column) in enumerate(zip(METHODS, ("NeRIF 0", "Tikhonov", "Landweber", ""), strict=True)):
            style = look(method) | {"linestyle": "none", "markersize": 6}
            x = [1 + place + 0.14 * (i - 1.5) for place in range(len(PHANTOMS))]
            here = [results.cell(p, 0.0, method).get(name) for p in PHANTOMS]
            _plot(axes, x, here, name, style | {"label": method})
            if column:
                paper = [table[p][COLUMNS.index(column)] for p in PHANTOMS]
                _plot(axes, x, paper, name, style | {"markerfacecolor": "none"})
        axes.plot([], [], "o", color="0.4", markerfacecolor="none", label="hollow: the paper's")
        axes.set_xticks(range(1, 8))
        _finish(axes, "phantom", name, "y" if name == "l2" else "")
    _legend_below(figure, 5)


def _slices(results: Results, figure: Any, name: str) -> None:
    *panels, last = figure.subplots(2, 4, sharex=True, sharey=True).flat
    for axes, phantom in zip(panels, PHANTOMS, strict=True):
        for method, noise in [("NeRIF", noise) for noise in NOISES] + [(method, 0.0) for method in METHODS[1:]]:
            slices = results.cell(phantom, noise, method).get("slices") or []
            style = look(method, noise) | {"markersize": 3, "label": f"{method}, noise {noise:g}"}
            _plot(axes, [s["z_mm"] for s in slices], [s[name] for s in slices], name, style)
        axes.set_title(f"Phantom {phantom}")
        _finish(axes, "z [mm]", name)
        axes.label_outer()
    panels[3].tick_params(labelbottom=True)
    panels[3].set_xlabel("z [mm]")
    last.axis("off")
    last.legend(*panels[0].get_legend_handles_labels(), frameon=False, loc="center")


def _draw_curve(axes: Axes, row: Row, across: str, name: str, style: Row) -> None:
    points = [point for point in row.get("curve") or [] if point[across]]
    _plot(axes, [point[across] for point in points], [point[name] for point in points], name, style)


def _draw_classical(axes: Axes, results: Results, name: str, **style: Any) -> None:
    """Mark time and error of the classical methods on Phantom 2 without noise."""
    for method in METHODS[1:]:
        row, mark = results.cell("2", 0.0, method), {"linestyle": "none", "label": f"{method}, noise 0"}
        _plot(axes, [row.get("time")], [row.get(name)], name, look(method) | mark | style)


def _curves(results: Results, figure: Any) -> None:
    left, right = figure.subplots(1, 2, sharey=True)
    for noise, mark, level in zip(NOISES, "ovX", L2["2"], strict=False):
        style = look("NeRIF", noise) | {"marker": mark, "label": f"NeRIF, noise {noise:g}"}
        for axes, across in ((left, "epochs"), (right, "seconds")):
            _draw_curve(axes, results.cell("2", noise, "NeRIF"), across, "l2", style)
        left.axhline(100 * level, label=f"the paper's, noise {noise:g}", linestyle=DASHES[noise], **GREY)
    _draw_classical(right, results, "l2")
    _finish(left, "epochs", "l2", "xy")
    _finish(right, "seconds", "", "xy")
    _legend_below(figure, 3)


def _bars(axes: Axes, label: str, here: dict[str, float | None], *paper: list[float | None], log: bool = False) -> None:
    """Draw a bar per name with its value, from top to bottom; hatched: the paper's."""
    hatched = {"color": "white", "edgecolor": "0.4", "hatch": "///", "label": "the paper's"}
    for i, values in enumerate(([*here.values()], *paper)):
        places = np.arange(len(values)) + 0.4 * (i - 0.5) * len(paper)
        bars = axes.barh(places, np.array(values, float), 0.38, log=log, **(hatched if i else {}))  # type: ignore[arg-type]
        axes.bar_label(bars, fmt="{:.3g}", padding=3, fontsize="small")
    axes.set_yticks(range(len(here)), list(here), parse_math=False)
    axes.set(xlabel=label, ylim=(len(here) - 0.5, -0.5))
    axes.margins(x=0.2)


def _cost(results: Results, figure: Any) -> None:
    columns = (("time", "minutes", MINUTES, 60), ("memory", "peak memory [GB]", MEMORY_GB, 1))
    for axes, (name, label, paper, unit) in zip(figure.subplots(1, 2), columns, strict=True):
        rows = {m: scores(results.cells([m], [0.0]).values(), name) for m in METHODS}
        medians = {m: median(values) / unit if values else None for m, values in rows.items()}
        _bars(axes, label, medians, [paper.get(m) for m in METHODS], log=True)
    _legend_below(figure, 1)


def _settings(results: Results, figure: Any, name: str) -> None:
    errors = {label: row.get("l2_variation") for label, row in results.section(name).items()}
    _bars(figure.subplots(), LABELS["l2_variation"], {label: e and 100 * e for label, e in errors.items()})


def _resolution(results: Results, figure: Any) -> None:
    left, right = figure.subplots(1, 2)
    furthest = 0.0
    for label, row in results.section("resolution").items():
        if plain := row.get("resolution"):
            colour, value = look(label)["color"], plain["lp_per_unit"]
            left.plot(plain["distance_mm"], plain["edge_spread"], color=colour, label=label)
            text = f"> {SAMPLES / 2:g} lp/unit" if value is None else f"{value:.2f} lp/unit" if value else "no edge"
            frequency = np.array(plain["frequency_lp_per_unit"])
            right.plot(frequency, np.array(plain["mtf"], float), color=colour, label=f"{label}: {text}")
            furthest = max(furthest, 2 * value if value else frequency[-1])
    left.step(left.get_xlim(), [-1, 0], where="mid", linestyle="--", **GREY)
    right.axhline(THRESHOLD, label=f"{THRESHOLD:.0%}", linestyle="--", **GREY)
    right.set(xlim=(0, furthest), ylim=(0, 1.1))
    _finish(left, "distance from the face [mm]", "gradient / true step [1]")
    _finish(right, "spatial frequency [lp/unit]", "MTF [1]")
    left.legend(frameon=False)
    right.legend(frameon=False)


def _faces(results: Results, figure: Any) -> None:
    """Draw the resolution on the eight faces, unfolded side by side: x+ y+ first, those of z+ above.

    A patch finer than the samples resolve is grey. The outlines are the whole faces.
    """
    from matplotlib import colormaps
    from matplotlib.collections import PolyCollection

    plain, axes = results.section("resolution")["NeRIF"]["resolution"], figure.subplots()
    edge = SIZE * plain["unit_mm"]
    signs = np.array(list(product((1, -1), repeat=3)))
    patches = np.array(plain["patches_mm"])
    patches = patches - patches.mean(axis=(0, 1))
    outlines = _unfold(signs[:, None] * np.eye(3) * edge, edge)
    axes.add_collection(PolyCollection(list(outlines), facecolors="none", edgecolors=COLOURS["grey"], linewidths=0.8))
    values = np.ma.masked_invalid(np.array(plain["local_lp_per_unit"], float))
    collection = PolyCollection(list(_unfold(patches, edge)), array=values, edgecolors="face")
    collection.set_cmap(colormaps["viridis"].with_extremes(bad="0.7"))
    axes.add_collection(collection)
    for face, sign in zip(outlines, signs, strict=True):
        name = " ".join(f"{axis}{'+' if s > 0 else '-'}" for axis, s in zip("xyz", sign, strict=True))
        axes.text(face[:, 0].mean(), 1.03 * face[2, 1], name, ha="center", va="bottom" if face[2, 1] > 0 else "top")
    axes.set(aspect="equal", xlabel="around the z axis [mm]", ylabel="up the faces [mm]")
    axes.margins(0.03, 0.16)
    figure.colorbar(collection, ax=axes, shrink=0.9, pad=0.02, label="resolution, MTF at 10 % [lp/unit]")


def _unfold(triangles: np.ndarray, edge: float) -> np.ndarray:
    """Lay triangles (k, 3 corners, 3) on the faces, from the centre, side by side into a plane (k, 3, 2); mm.

    The corner of the z axis is the tip of a face; those of the x and y axes lie on the line of the others' bases.
    """
    signs = np.sign(triangles.mean(axis=1))
    x, y, z = np.moveaxis(np.abs(triangles) / edge, -1, 0)
    quadrant = ((signs[:, 1] < 0) * 2 + (signs[:, 0] * signs[:, 1] < 0))[:, None]
    across = quadrant + np.where(quadrant % 2 == 0, y, x) + z / 2
    return math.sqrt(2) * edge * np.stack([across, signs[:, None, 2] * z * (math.sqrt(3) / 2)], axis=-1)


def _views(results: Results, figure: Any) -> None:
    axes, rows = figure.subplots(), results.section("views")
    views = [int(label) for label in rows]
    _plot(axes, views, [row.get("l2_variation") for row in rows.values()], "l2_variation", look("NeRIF"))
    _finish(axes, "views over 180°", "l2_variation", "xy")
    axes.set_xticks(views, list(rows))


def _speed(results: Results, figure: Any) -> None:
    axes = figure.subplots()
    for i, (label, row) in enumerate(results.section("speed").items()):  # all the colours, then again with other dashes
        turn, place = divmod(i, len(MORE))
        style = {"color": MORE[place], "marker": "osD^vPX"[(place + 3 * turn) % 7], "linestyle": "-:"[turn % 2]}
        _draw_curve(axes, row, "seconds", "l2_variation", look("NeRIF") | style | {"label": label})
    _draw_classical(axes, results, "l2_variation", color="black", markerfacecolor="none", markeredgewidth=1.5)
    _finish(axes, "seconds", "l2_variation", "xy")
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))


_TEN = "of ten slices across z with the truth; 1 is perfect."
FIGURES: dict[str, list[tuple[str, str, tuple[float, float], Callable[..., None]]]] = {
    "tables": [("tables", "L2 and CC without noise, here and in the paper.", (11, 4.4), _tables)],
    "slices": [
        ("slices_cc", f"Correlation {_TEN}", (13, 6), partial(_slices, name="cc")),
        ("slices_ssim", f"Structural similarity {_TEN}", (13, 6), partial(_slices, name="ssim")),
    ],
    "curves": [("curves", "L2 of Phantom 2 over epochs and time; grey: the paper's final errors.", (11, 4.6), _curves)],
    "cost": [("cost", "Time and peak memory, medians over the phantoms without noise.", (11, 3.4), _cost)],
    "resolution": [
        ("resolution", "Edge spread function and MTF of the octahedron's faces.", (11, 4), _resolution),
        ("resolution_distribution", "Resolution of NeRIF over the octahedron's faces, unfolded.", (9, 4.6), _faces),
    ],
    "views": [("views", "Error over the number of views, Phantom 2 at noise 0.1.", (7.5, 4.2), _views)],
    "speed": [("speed", "Error of NeRIF's variants and the classical methods, Phantom 2, no noise.", (10, 5), _speed)],
}
"""Name, caption, size and function; the other sections have the errors of their settings."""
