"""How a run went and how good it is, each drawn into Axes that the caller gives and gets back.

`pages.py` makes pages of these and of the slices and maps of `nerif/drawing.py`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nerif.plotting.drawing import COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_history", "draw_line", "draw_residuals", "draw_slice_scores", "draw_view_scores"]

TERMS = {
    "automatic": "views, exact gradient",
    "numerical": "views, central differences",
    "head": "views, gradient head",
    "consistency": "head against gradient",
    "gauge": "ambient (gauge)",
    "loss": "whole loss",
}
"""Names of the terms of the loss in words."""


def draw_history(axes: Axes, history: list[dict[str, float]], method: str) -> Axes:
    """Draw how a run went: the terms of the loss over seconds, or the residual over iterations; logarithmic."""
    neural = method == "nerif"
    known = {name for record in history for name in record}
    across = "seconds" if "seconds" in known else "step"
    aside = {"step", "epoch", "seconds", "rays_per_second", "learning_rate", "samples", "weight", "voxels", "iteration"}
    aside |= {"taken_back", "fit_step", "bin_edge", "withheld_residual"}
    names = [n for n in dict.fromkeys(n for record in history for n in record) if n not in aside]
    colours = [*COLOURS.values()]
    drawn = 0
    for name in names:
        points = [(r[across], r[name]) for r in history if r.get(name, 0) > 0 and np.isfinite(r.get(name, np.nan))]
        if len(points) < 2:
            continue
        x, y = np.array(points).T
        whole = name == "loss"  # drawn below its terms, of which one is often all of it
        axes.plot(
            x, y, label=TERMS.get(name, name.replace("_", " ")), linewidth=3 if whole else 1, zorder=1 if whole else 2,
            color="0.75" if whole else colours[drawn % len(colours)],
            linestyle=("-", "--", ":", "-.")[drawn // len(colours) % 4],
        )  # fmt: skip
        drawn += 1
    axes.set_yscale("log")
    axes.set_xlabel("time [s]" if across == "seconds" else "step")
    axes.set_ylabel("loss [1]" if neural else "scaled residual, penalty [1]")
    axes.grid(True, which="major", color="0.9", linewidth=0.6)
    if drawn:
        axes.legend(frameon=False)
    return axes


def draw_slice_scores(axes: Axes, slices: list[dict[str, Any]]) -> Axes:
    """Draw SSIM and CC of slices across z against the truth; 1 is perfect."""
    z = [s["z_mm"] for s in slices]
    for name, mark, colour in (("cc", "o", COLOURS["blue"]), ("ssim", "s", COLOURS["orange"])):
        values = [np.nan if s.get(name) is None else s[name] for s in slices]
        axes.plot(z, values, marker=mark, markersize=3, linewidth=1, color=colour, label=name.upper())
    axes.set_xlabel("z [mm]")
    axes.set_ylabel("CC, SSIM of a slice [1]")
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.legend(frameon=False)
    return axes


def draw_view_scores(axes: Axes, views: list[dict[str, Any]]) -> Axes:
    """Draw the rms error of every view, in units of its noise where known, else as measured; held-out views marked."""
    in_sigma = all(v.get("rms_over_sigma") is not None for v in views)
    several = len({v["measured"] for v in views}) > 1
    key = "rms_over_sigma" if in_sigma else "rms"
    places = range(len(views))
    for place, view in zip(places, views, strict=True):
        value = view.get(key)
        if value is None:
            continue
        held = view["withheld"]
        colour = COLOURS["orange"] if held else COLOURS["blue"]
        axes.bar(place, value, width=0.7, color=colour, hatch="///" if held else None, edgecolor="white", linewidth=0)
    if in_sigma:
        axes.axhline(1, color=COLOURS["grey"], linewidth=0.8, linestyle="--")
    names = [f"{v['name']}{', ' + v['measured'] if several else ''}" for v in views]
    names = [f"{name}\nheld out" if v["withheld"] else name for name, v in zip(names, views, strict=True)]
    axes.set_xticks(list(places), names, rotation=90, parse_math=False)
    axes.set_ylabel("rms error / noise [1]" if in_sigma else f"rms error [{views[0]['unit']}]")
    return axes


def draw_line(
    axes: tuple[Axes, Axes], measured: np.ndarray, predicted: np.ndarray, sigma: np.ndarray | None, label: str
) -> tuple[Axes, Axes]:
    """Draw what pixels along a line measured, with its standard deviation, and what is predicted; below, how far apart.

    Pixels that measured nothing (NaN) are left out; the label stands at the first axes, with its unit in brackets.
    """
    above, below = axes
    at, blue, orange = np.arange(len(measured)), COLOURS["blue"], COLOURS["orange"]
    points: dict[str, Any] = {"fmt": ".", "color": blue, "markersize": 3.5, "elinewidth": 0.7}
    above.errorbar(at, measured, sigma, label="measured" if sigma is None else "measured ± σ", **points)
    above.plot(at, predicted, color=orange, linewidth=1, label="re-projected")
    below.axhline(0, color=COLOURS["grey"], linewidth=0.6)
    below.errorbar(at, predicted - measured, sigma, **points)
    above.set_ylabel(label)
    below.set_ylabel(f"difference [{label.rpartition('[')[2]}")
    above.legend(frameon=False)
    return axes


def draw_residuals(axes: Axes, residuals: np.ndarray) -> Axes:
    """Draw the distribution of residuals in units of the noise beside the unit Gaussian that pure noise would give."""
    edges = np.linspace(-5, 5, 61)
    counts = np.histogram(residuals, bins=edges)[0] / (max(residuals.size, 1) * (edges[1] - edges[0]))
    beyond = float(np.mean(np.abs(residuals) > edges[-1])) if residuals.size else 0.0
    middle = (edges[1:] + edges[:-1]) / 2
    axes.stairs(counts, edges, color=COLOURS["blue"], fill=True, alpha=0.35)
    axes.stairs(counts, edges, color=COLOURS["blue"], label=f"residual\n({beyond:.1%} beyond ±5)")
    gauss = np.exp(-(middle**2) / 2) / np.sqrt(2 * np.pi)
    axes.plot(middle, gauss, color=COLOURS["orange"], linestyle="--", linewidth=1, label="noise alone")
    axes.set_xlabel("(predicted − measured) / σ [1]")
    axes.set_ylabel("probability density [1]")
    axes.set_ylim(bottom=0, top=1.15 * float(max(counts.max(), gauss.max())))
    axes.legend(frameon=False, loc="upper left", handlelength=1.2)
    return axes
