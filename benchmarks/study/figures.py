"""Figures of a study, each drawn into Axes that the caller gives and gets back; from what: page_figures.py."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from nerif.plotting.drawing import COLOURS
from study.results import finite

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

__all__ = [
    "LABELS",
    "draw_by_phantom",
    "draw_costs",
    "draw_curves",
    "draw_dots",
    "draw_slices",
    "draw_views",
    "look",
    "variety",
]

LABELS = {
    "l2": "L2 error, paper's definition [%]",
    "l2_variation": "error of the variation of n [%]",
    "cc": "CC [1]",
    "ssim": "SSIM [1]",
    "seconds": "training time [s]",
    "epoch": "epochs (passes over all rays)",
}
"""What stands at an axis, with the unit."""

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
"""What the lines and points of one method and noise look like, as matplotlib's keywords."""


def look(method: str, noise: float = 0.0) -> Line:
    """Return colour and mark of a method, and the dashes of a noise."""
    colour, mark = METHODS[method]
    dashes = {0.0: "-", 0.1: "--", 0.15: ":"}.get(noise, "-.")
    return {"color": colour, "marker": mark, "linestyle": dashes, "markersize": 4, "linewidth": 1.3}


def draw_by_phantom(
    axes: Axes, here: Mapping[str, Sequence[float | None]], paper: Mapping[str, Sequence[float]], score: str
) -> Axes:
    """Draw a score over the phantoms, methods side by side; hollow marks are the paper's.

    Parameters
    ----------
    here, paper : a value for each phantom, by method (one of those `look` knows)
    score : one of LABELS
    """
    names = list(here)
    for i, name in enumerate(names):
        style = look(name) | {"linestyle": "none", "markersize": 6}
        at = [1 + place + 0.14 * (i - (len(names) - 1) / 2) for place in range(7)]
        _plot(axes, at, here[name], score, style | {"label": name})
        if name in paper:
            _plot(axes, at, paper[name], score, style | {"markerfacecolor": "none"})
    axes.plot([], [], color="0.4", marker="o", markerfacecolor="none", linestyle="none", label="hollow: the paper's")
    axes.set_xticks(range(1, 8))
    axes.set_xlabel("phantom")
    return _finish(axes, score, log=score in PER_CENT)


def draw_slices(axes: Axes, series: Mapping[str, tuple[Line, Sequence[Mapping[str, Any]]]], score: str) -> Axes:
    """Draw a score ("cc" or "ssim") of slices over their z, a line for each name; 1 is perfect."""
    for name, (style, slices) in series.items():
        _plot(axes, [s["z_mm"] for s in slices], [s.get(score) for s in slices], score, style | {"label": name})
    axes.set_xlabel("z [mm]")
    return _finish(axes, score, legend=False)


def draw_curves(
    axes: Axes,
    curves: Mapping[str, tuple[Line, Sequence[Mapping[str, Any]]]],
    across: str,
    score: str,
    points: Mapping[str, tuple[Line, float, float]] | None = None,
    levels: Mapping[str, tuple[Line, float]] | None = None,
) -> Axes:
    """Draw errors over time or epochs, both logarithmic.

    Parameters
    ----------
    curves : style and points of a run, by name
    across : "seconds" or "epoch"
    score : one of LABELS
    points : style, seconds and error of methods that have but one result, by name
    levels : style and error of what is to be reached, by name; drawn as horizontal lines
    """
    for name, (style, curve) in curves.items():
        known = [p for p in curve if (finite(p.get(across)) or 0) > 0]
        _plot(axes, [p[across] for p in known], [p.get(score) for p in known], score, style | {"label": name})
    for name, (style, seconds, error) in (points or {}).items():
        _plot(axes, [seconds], [error], score, style | {"linestyle": "none", "markersize": 7, "label": name})
    for name, (style, error) in (levels or {}).items():
        scale = 100 if score in PER_CENT else 1
        axes.axhline(scale * error, label=name, color=style["color"], linestyle=style["linestyle"], linewidth=0.8)
    axes.set_xscale("log")
    _plain_numbers(axes.xaxis, axes.get_xlim())
    axes.set_xlabel(LABELS[across])
    return _finish(axes, score, log=True)


def draw_dots(axes: Axes, values: Mapping[str, float | None], score: str = "l2_variation") -> Axes:
    """Draw one value a name, the names down the side and the first on top."""
    names = list(values)
    scale = 100 if score in PER_CENT else 1
    known = [(place, value) for place, value in enumerate(values.values()) if value is not None]
    best = min((value for _, value in known), default=None)
    for place, value in known:
        colour = COLOURS["blue"] if value == best else COLOURS["grey"]
        axes.plot([0, scale * value], [place, place], color=colour, linewidth=1.2, zorder=1)
        axes.plot(scale * value, place, marker="o", color=colour, markersize=7)
        text = f"{scale * value:.2f}" if scale * value < 10 else f"{scale * value:.1f}"
        axes.annotate(text, (scale * value, place), (5, 0), textcoords="offset points", va="center", color=colour)
    axes.set_yticks(range(len(names)), names, parse_math=False)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlim(0, 1.18 * scale * max((value for _, value in known), default=1) or 1)
    axes.set_xlabel(LABELS[score])
    axes.grid(True, axis="x", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    return axes


def draw_views(axes: Axes, errors: Mapping[int, float | None], score: str = "l2_variation") -> Axes:
    """Draw the error over the number of views, both logarithmic."""
    from matplotlib.ticker import NullFormatter

    views = sorted(errors)
    _plot(axes, views, [errors[n] for n in views], score, look("NeRIF") | {"markersize": 6})
    axes.set_xscale("log")
    axes.set_xticks(views, [str(n) for n in views])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.minorticks_off()
    axes.set_xlabel("views over 180°")
    return _finish(axes, score, log=True, legend=False)


def draw_costs(
    axes: Axes, here: Mapping[str, float | None], paper: Mapping[str, float], label: str, form: Callable[[float], str]
) -> Axes:
    """Draw what methods cost, here and in the paper, as logarithmic bars; `form` words the value of a bar."""
    names = list(here)
    known = [v for v in (*here.values(), *paper.values()) if v]
    low = min(known, default=1) / 3
    for i, name in enumerate(names):
        for value, shift, hollow in ((here[name], -0.2, False), (paper.get(name), 0.2, True)):
            if not value:
                continue
            colour = METHODS[name][0]
            face = "white" if hollow else colour
            axes.barh(i + shift, value - low, 0.36, left=low, color=face, edgecolor=colour, hatch="////" * hollow)
            where = (value, i + shift)
            axes.annotate(form(value), where, (3, 0), textcoords="offset points", va="center", fontsize="small")
    axes.barh([0], [0], color="0.4", edgecolor="0.4", label="here")
    axes.barh([0], [0], color="white", edgecolor="0.4", hatch="////", label="paper")
    axes.set_xscale("log")
    axes.set_xlim(low, 8 * max(known, default=1))
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlabel(label)
    axes.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    return axes


def _plot(axes: Axes, x: Sequence[float], y: Sequence[float | None], score: str, style: Line) -> None:
    """Plot the points that are there, errors in per cent."""
    scale = 100 if score in PER_CENT else 1
    known = [(a, scale * b) for a, b in zip(x, y, strict=True) if finite(b) is not None and b is not None]
    if known:
        axes.plot(*zip(*known, strict=True), **style)


def _finish(axes: Axes, score: str, log: bool = False, legend: bool = True) -> Axes:
    """Label of the score, plain numbers on a logarithmic axis, grid and legend."""
    if log:
        axes.set_yscale("log")
        _plain_numbers(axes.yaxis, axes.get_ylim())
    axes.set_ylabel(LABELS[score])
    axes.grid(True, which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    if legend and axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False)
    return axes


def variety(i: int) -> Line:
    """Return colour, mark and dashes for the i-th of many lines: all the colours, then again with other dashes."""
    colours = list(MORE.values())
    turn, place = divmod(i, len(colours))
    mark = MARKS[(place + 3 * turn) % len(MARKS)]
    return look("NeRIF") | {"color": colours[place], "marker": mark, "linestyle": DASHES[turn % len(DASHES)]}


def _plain_numbers(axis: Axis, limits: tuple[float, float]) -> None:
    """Label a logarithmic axis with plain numbers, and with more than powers of ten where those are few."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ratio = limits[1] / limits[0]
    subs = (1, 1.5, 2, 3, 5, 7) if ratio < 12 else (1, 2, 5) if ratio < 300 else (1,)
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
