"""Figures of the study, each drawn into Axes; page_figures.py selects the data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from benchmarks.study.results import finite
from nerif.plotting.drawing import COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

LABELS = {
    "l2": "L2 error, paper's definition [%]",
    "l2_variation": "error of the variation of n [%]",
    "cc": "CC [1]",
    "ssim": "SSIM [1]",
    "seconds": "training time [s]",
    "epoch": "epochs (passes over all rays)",
}
PER_CENT = ("l2", "l2_variation")
MORE = {**COLOURS, "purple": "#AA5A8E", "amber": "#B87A00", "sky": "#2F8FC4"}  # Okabe & Ito, darkened for white
MARKS, DASHES = "osD^vPX", ("-", "--", ":")
METHODS = {
    "NeRIF": (COLOURS["blue"], "o"),
    "Tikhonov": (COLOURS["orange"], "s"),
    "Landweber": (COLOURS["green"], "^"),
    "TV": (COLOURS["grey"], "D"),
}

Line = dict[str, Any]
"""matplotlib's keywords for the line of one method and noise."""


def look(method: str, noise: float = 0.0) -> Line:
    """Return colour and mark of a method, and the dashes of a noise."""
    colour, mark = METHODS[method]
    dashes = {0.0: "-", 0.1: "--", 0.15: ":"}.get(noise, "-.")
    return {"color": colour, "marker": mark, "linestyle": dashes, "markersize": 4, "linewidth": 1.3}


def variety(i: int) -> Line:
    """Return colour, mark and dashes for the i-th of many lines: all the colours, then again with other dashes."""
    colours = list(MORE.values())
    turn, place = divmod(i, len(colours))
    mark = MARKS[(place + 3 * turn) % len(MARKS)]
    return look("NeRIF") | {"color": colours[place], "marker": mark, "linestyle": DASHES[turn % len(DASHES)]}


def draw_by_phantom(
    axes: Axes, here: Mapping[str, Sequence[float | None]], paper: Mapping[str, Sequence[float]], score: str
) -> None:
    """Draw a score over the phantoms, methods side by side; hollow marks are the paper's."""
    for i, name in enumerate(here):
        style = look(name) | {"linestyle": "none", "markersize": 6}
        x = [1 + place + 0.14 * (i - (len(here) - 1) / 2) for place in range(7)]
        _plot(axes, x, here[name], score, style | {"label": name})
        if name in paper:
            _plot(axes, x, paper[name], score, style | {"markerfacecolor": "none"})
    axes.plot([], [], color="0.4", marker="o", markerfacecolor="none", linestyle="none", label="hollow: the paper's")
    axes.set_xticks(range(1, 8))
    axes.set_xlabel("phantom")
    _finish(axes, score, log=score in PER_CENT)


def draw_slices(axes: Axes, series: Mapping[str, tuple[Line, Sequence[Mapping[str, Any]]]], score: str) -> None:
    """Draw a score ("cc" or "ssim") of slices over their z, a line for each name; 1 is perfect."""
    for name, (style, slices) in series.items():
        _plot(axes, [s["z_mm"] for s in slices], [s.get(score) for s in slices], score, style | {"label": name})
    axes.set_xlabel("z [mm]")
    _finish(axes, score, legend=False)


def draw_curves(
    axes: Axes, curves: Mapping[str, tuple[Line, Sequence[Mapping[str, Any]]]], across: str, score: str,
    points: Mapping[str, tuple[Line, float, float]] | None = None,
    levels: Mapping[str, tuple[Line, float]] | None = None,
) -> None:  # fmt: skip
    """Draw errors over time or epochs, both logarithmic.

    Parameters
    ----------
    curves : style and points of a run, by name
    across : "seconds" or "epoch"
    points : style, seconds and error of methods that have only one result, by name
    levels : style and error of horizontal lines, by name
    """
    for name, (style, curve) in curves.items():
        positive = [p for p in curve if (finite(p.get(across)) or 0) > 0]
        _plot(axes, [p[across] for p in positive], [p.get(score) for p in positive], score, style | {"label": name})
    for name, (style, seconds, error) in (points or {}).items():
        _plot(axes, [seconds], [error], score, style | {"linestyle": "none", "markersize": 7, "label": name})
    for name, (style, error) in (levels or {}).items():
        line = {"color": style["color"], "linestyle": style["linestyle"], "linewidth": 0.8}
        axes.axhline(_scale(score) * error, label=name, **line)
    axes.set_xscale("log")
    _plain_numbers(axes.xaxis, axes.get_xlim())
    axes.set_xlabel(LABELS[across])
    _finish(axes, score, log=True)


def draw_dots(axes: Axes, values: Mapping[str, float | None], score: str = "l2_variation") -> None:
    """Draw one value per name, from top to bottom; the lowest in blue."""
    points = [(place, _scale(score) * v) for place, v in enumerate(values.values()) if v is not None]
    best = min((value for _, value in points), default=None)
    for place, value in points:
        colour = COLOURS["blue"] if value == best else COLOURS["grey"]
        axes.plot([0, value], [place, place], color=colour, linewidth=1.2, zorder=1)
        axes.plot(value, place, marker="o", color=colour, markersize=7)
        text = f"{value:.2f}" if value < 10 else f"{value:.1f}"
        axes.annotate(text, (value, place), (5, 0), textcoords="offset points", va="center", color=colour)
    axes.set_yticks(range(len(values)), list(values), parse_math=False)
    axes.set_ylim(len(values) - 0.5, -0.5)
    axes.set_xlim(0, 1.18 * max((value for _, value in points), default=1) or 1)
    axes.set_xlabel(LABELS[score])
    axes.grid(True, axis="x", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def draw_views(axes: Axes, errors: Mapping[int, float | None], score: str = "l2_variation") -> None:
    """Draw the error over the number of views, both logarithmic."""
    from matplotlib.ticker import NullFormatter

    views = sorted(errors)
    _plot(axes, views, [errors[n] for n in views], score, look("NeRIF") | {"markersize": 6})
    axes.set_xscale("log")
    axes.set_xticks(views, [str(n) for n in views])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.minorticks_off()
    axes.set_xlabel("views over 180°")
    _finish(axes, score, log=True, legend=False)


def draw_costs(
    axes: Axes, here: Mapping[str, float | None], paper: Mapping[str, float], label: str, form: Callable[[float], str]
) -> None:
    """Draw costs of methods here and in the paper as logarithmic bars, with values as text by `form`."""
    positive = [v for v in (*here.values(), *paper.values()) if v]
    low = min(positive, default=1) / 3
    for i, name in enumerate(here):
        for value, shift, hollow in ((here[name], -0.2, False), (paper.get(name), 0.2, True)):
            if value:
                colour = METHODS[name][0]
                face, hatch = ("white", "////") if hollow else (colour, "")
                axes.barh(i + shift, value - low, 0.36, left=low, color=face, edgecolor=colour, hatch=hatch)
                text, place = form(value), (value, i + shift)
                axes.annotate(text, place, (3, 0), textcoords="offset points", va="center", fontsize="small")
    axes.barh([0], [0], color="0.4", edgecolor="0.4", label="here")
    axes.barh([0], [0], color="white", edgecolor="0.4", hatch="////", label="paper")
    axes.set_xscale("log")
    axes.set_xlim(low, 8 * max(positive, default=1))
    axes.set_yticks(range(len(here)), list(here))
    axes.set_ylim(len(here) - 0.5, -0.5)
    axes.set_xlabel(label)
    axes.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)


def _scale(score: str) -> float:
    return 100 if score in PER_CENT else 1


def _plot(axes: Axes, x: Sequence[float], y: Sequence[float | None], score: str, style: Line) -> None:
    """Plot the finite points, errors in per cent."""
    points = [(a, _scale(score) * b) for a, b in zip(x, y, strict=True) if finite(b) is not None and b is not None]
    if points:
        axes.plot(*zip(*points, strict=True), **style)


def _finish(axes: Axes, score: str, log: bool = False, legend: bool = True) -> None:
    """Add label of the score, plain numbers on a logarithmic axis, grid and legend."""
    if log:
        axes.set_yscale("log")
        _plain_numbers(axes.yaxis, axes.get_ylim())
    axes.set_ylabel(LABELS[score])
    axes.grid(True, which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    if legend and axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False)


def _plain_numbers(axis: Axis, limits: tuple[float, float]) -> None:
    """Label a logarithmic axis with plain numbers, and with more than powers of ten where those are few."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ratio = limits[1] / limits[0]
    subs = (1, 1.5, 2, 3, 5, 7) if ratio < 12 else (1, 2, 5) if ratio < 300 else (1,)
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
