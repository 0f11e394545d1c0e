"""Plots of a result, drawn into Axes and returned: convergence, scores, residuals, uncertainty, refined rig."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from nerif.analysis.metrics import LEVELS
from nerif.data.reprojection import Reprojection
from nerif.data.volume import Volume, name_of
from nerif.geometry import Camera
from nerif.plotting.drawing import COLOURS, label_of, plain, plotted_quantities, plotted_values
from nerif.reconstruction.rig_parameters import RefinedView
from nerif.reconstruction.uncertainty.deviations import TAILS
from nerif.report.view_images import lattice_step
from nerif.results.directory import Result
from nerif.results.metrics_file import ViewScores

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "banded", "draw_bands", "draw_corrections", "draw_history", "draw_line", "draw_refined_rig", "draw_reliability",
    "draw_residuals", "draw_slice_scores", "draw_view_scores", "plots_of", "residuals_over_sigma",
]  # fmt: skip

TERMS = {
    "automatic": "views, exact gradient",
    "numerical": "views, central differences",
    "head": "views, gradient head",
    "consistency": "head against gradient",
    "gauge": "ambient (gauge)",
    "loss": "total loss",
}
"""Labels of the terms of the loss."""
NOT_DRAWN = {
    "step", "epoch", "seconds", "rays_per_second", "learning_rate", "samples", "weight", "voxels", "iteration",
    "rolled_back", "fit_step", "bin_edge", "withheld_residual",
}  # fmt: skip
LONGEST_SHIFT = 0.25  # as drawn, of the extent of the rig
BAND_SIGMAS = TAILS["p95"]  # on either side of a band of 90 %
MAX_RESIDUALS = 1 << 20
GRID: dict[str, Any] = {"visible": True, "which": "major", "color": "0.9", "linewidth": 0.6}


class Plot(NamedTuple):
    """A plot of a result."""

    name: str  #: of its file
    title: str  #: on a page; empty if it is not shown there
    height: float  #: over the width
    draw: Callable[[Axes], Axes]


def plots_of(result: Result) -> Iterator[Plot]:
    """Yield the plots for which a result has data."""
    metrics, views = result.metrics, result.reprojection
    if result.history:
        yield Plot("history", "Convergence", 0.7, partial(draw_history, history=result.history))
    for measured, residuals in ({} if views is None else residuals_over_sigma(views)).items():
        several = views is not None and len(views.measurement.observations) > 1
        name, of = (f"residuals_{measured}", f" of {measured}") if several else ("residuals", "")
        yield Plot(name, f"Residuals{of} over the noise", 0.7, partial(draw_residuals, residuals=residuals))
    if metrics.rig:
        yield Plot("corrections", "Corrections of the cameras", 0.8, partial(draw_corrections, table=metrics.rig))
    if metrics.rig and views is not None:
        draw = partial(draw_refined_rig, cameras=views.measurement.cameras, table=metrics.rig)
        yield Plot("refined_rig", "Refined camera positions", 0.8, draw)
    if metrics.views:
        yield Plot("views", "", 0.8, partial(draw_view_scores, views=metrics.views))
    for quantity in banded(result.volumes):
        title = f"{name_of(quantity).capitalize()} with bands of 90 %"
        yield Plot(f"bands_{quantity}", title, 0.7, partial(draw_bands, volumes=result.volumes, quantity=quantity))
    if metrics.coverage and "reliability" in metrics.coverage:
        draw = partial(draw_reliability, coverage=metrics.coverage)
        yield Plot("reliability", "Reliability of the bands, against the truth", 0.9, draw)
    if metrics.slices:
        draw = partial(draw_slice_scores, slices=metrics.slices)
        yield Plot("slice_scores", "Against the truth, slice by slice", 0.7, draw)


def residuals_over_sigma(reprojection: Reprojection, max_pixels: int = MAX_RESIDUALS) -> dict[str, np.ndarray]:
    """Return (predicted - measured) / sigma of every usable pixel whose ray crosses the box, by measured quantity.

    Of more than `max_pixels` pixels, a regular lattice; quantities without sigma are left out.
    """
    m = reprojection.measurement
    step, residuals = lattice_step(m, max_pixels), {}
    for o in m.observations:
        if o.sigma is None:
            continue
        usable, parts = m.usable_for(o), []
        for i, camera in enumerate(m.cameras):
            rows, columns = (slice(0, n, step) for n in camera.image_size)
            pixels = camera.pixel_grid()[::step, ::step]
            crosses = camera.rays(pixels.reshape(-1, 2), sensitivity=False).clip(m.box).crosses
            valid = usable[i, rows, columns] & crosses.reshape(pixels.shape[:2])
            residual = reprojection.maps[o.technique.name][i, rows, columns] - o.values[i, rows, columns]
            parts.append((residual[valid] / o.sigma[i, rows, columns][valid]).flatten())
        residuals[o.technique.measured] = torch.cat(parts).numpy()
    return residuals


def draw_history(axes: Axes, history: list[dict[str, float]]) -> Axes:
    """Draw the convergence: terms of the loss, or residual and penalty, over time; logarithmic."""
    names = dict.fromkeys(name for record in history for name in record)
    across = "seconds" if "seconds" in names else "step"
    colours, curves = [*COLOURS.values()], 0
    for name in (n for n in names if n not in NOT_DRAWN):
        points = [(r[across], r[name]) for r in history if r.get(name, 0) > 0 and np.isfinite(r.get(name, np.nan))]
        if len(points) < 2:
            continue
        x, y = np.array(points).T
        total = name == "loss"  # drawn below its terms, one of which may be nearly all of it
        axes.plot(
            x, y, label=TERMS.get(name, name.replace("_", " ")), linewidth=3 if total else 1, zorder=1 if total else 2,
            color="0.75" if total else colours[curves % len(colours)],
            linestyle=("-", "--", ":", "-.")[curves // len(colours) % 4],
        )  # fmt: skip
        curves += 1
    axes.set(yscale="log", xlabel="time [s]" if across == "seconds" else "step")
    axes.set_ylabel("loss [1]" if "loss" in names else "scaled residual, penalty [1]")
    axes.grid(**GRID)
    if curves:
        axes.legend(frameon=False)
    return axes


def draw_slice_scores(axes: Axes, slices: Sequence[Any]) -> Axes:
    """Draw SSIM and CC of slices across z against the truth."""
    z = [s["z_mm"] for s in slices]
    for name, marker, colour in (("cc", "o", COLOURS["blue"]), ("ssim", "s", COLOURS["orange"])):
        values = [s[name] for s in slices]
        axes.plot(z, values, marker=marker, markersize=3, linewidth=1, color=colour, label=name.upper())
    axes.set(xlabel="z [mm]", ylabel="CC, SSIM of a slice [1]")
    axes.grid(**GRID)
    axes.legend(frameon=False)
    return axes


def draw_view_scores(axes: Axes, views: list[ViewScores]) -> Axes:
    """Draw the rms residual of every view, over the noise if that is known for all; withheld views are hatched."""
    in_sigma = all(np.isfinite(v.get("rms_over_sigma", np.nan)) for v in views)
    several = len({v["measured"] for v in views}) > 1
    names = []
    for place, view in enumerate(views):
        value, withheld = view["rms_over_sigma"] if in_sigma else view["rms"], view["withheld"]
        name = f"{plain(view['name'])}{', ' + view['measured'] if several else ''}"
        names.append(f"{name}\nwithheld" if withheld else name)
        if np.isfinite(value):
            colour, hatch = (COLOURS["orange"], "///") if withheld else (COLOURS["blue"], None)
            axes.bar(place, value, width=0.7, color=colour, hatch=hatch, edgecolor="white", linewidth=0)
    if in_sigma:
        axes.axhline(1, color=COLOURS["grey"], linewidth=0.8, linestyle="--")
    axes.set_xticks(range(len(views)), names, rotation=90)
    axes.set_ylabel("rms residual / σ [1]" if in_sigma else f"rms residual [{plain(views[0]['unit'])}]")
    return axes


def draw_line(
    axes: tuple[Axes, Axes], measured: np.ndarray, predicted: np.ndarray, sigma: np.ndarray | None, label: str
) -> tuple[Axes, Axes]:
    """Draw measurement (NaN where invalid) and prediction along a line of pixels, and the residual below.

    Bars are one sigma; `label` ends with the unit in brackets.
    """
    above, below = axes
    at, blue, orange = np.arange(len(measured)), COLOURS["blue"], COLOURS["orange"]
    points: dict[str, Any] = {"fmt": ".", "color": blue, "markersize": 3.5, "elinewidth": 0.7}
    above.errorbar(at, measured, sigma, label="measured" if sigma is None else "measured ± σ", **points)
    above.plot(at, predicted, color=orange, linewidth=1, label="re-projected")
    below.axhline(0, color=COLOURS["grey"], linewidth=0.6)
    below.errorbar(at, predicted - measured, sigma, **points)
    above.set_ylabel(label)
    below.set_ylabel(f"residual [{label.rpartition('[')[2]}")
    above.legend(frameon=False)
    return axes


def draw_residuals(axes: Axes, residuals: np.ndarray) -> Axes:
    """Draw the distribution of residuals over the noise, and the unit Gaussian."""
    edges = np.linspace(-5, 5, 61)
    counts = np.histogram(residuals, bins=edges)[0] / (max(residuals.size, 1) * (edges[1] - edges[0]))
    beyond = float(np.mean(np.abs(residuals) > edges[-1])) if residuals.size else 0.0
    centres = (edges[1:] + edges[:-1]) / 2
    axes.stairs(counts, edges, color=COLOURS["blue"], fill=True, alpha=0.35)
    axes.stairs(counts, edges, color=COLOURS["blue"], label=f"residual\n({beyond:.1%} beyond ±5)")
    gauss = np.exp(-(centres**2) / 2) / np.sqrt(2 * np.pi)
    axes.plot(centres, gauss, color=COLOURS["orange"], linestyle="--", linewidth=1, label="noise alone")
    axes.set(xlabel="(predicted − measured) / σ [1]", ylabel="probability density [1]")
    axes.set_ylim(bottom=0, top=1.15 * float(max(counts.max(), gauss.max())))
    axes.legend(frameon=False, loc="upper left", handlelength=1.2)
    return axes


def banded(volumes: Mapping[str, Volume]) -> list[str]:
    """Return the quantities that have standard deviations."""
    return [quantity for quantity in plotted_quantities(volumes) if f"{quantity}_std" in volumes]


def draw_bands(axes: Axes, volumes: Mapping[str, Volume], quantity: str) -> Axes:
    """Draw a quantity along the three lines through the middle of the box, with bands of 90 %.

    Parameters
    ----------
    volumes : of a result, among them the quantity, its standard deviation and, if any, its percentiles
    quantity : one of `banded`
    """
    volume = volumes[quantity]
    values, std = plotted_values(volume), volumes[f"{quantity}_std"].values.double().numpy()
    ends = [volumes.get(f"{quantity}_{name}") for name in ("p05", "p95")]
    low, high = (
        values + sign * BAND_SIGMAS * std if end is None else end.values.double().numpy()
        for sign, end in zip((-1, 1), ends, strict=True)
    )
    centre = [n // 2 for n in values.shape]
    colours = (COLOURS["blue"], COLOURS["orange"], COLOURS["green"])
    for axis, name, colour in zip((2, 1, 0), "xyz", colours, strict=True):
        line = tuple(slice(None) if i == axis else n for i, n in enumerate(centre))
        at = volume.grid.box.lower[2 - axis] + (np.arange(values.shape[axis]) + 0.5) * volume.grid.spacing[2 - axis]
        axes.plot(at, values[line], color=colour, lw=1, label=f"along {name}")
        axes.fill_between(at, low[line], high[line], color=colour, alpha=0.25, lw=0)
    axes.set(xlabel="distance [mm]", ylabel=label_of(quantity))
    axes.legend(frameon=False)
    return axes


def draw_reliability(axes: Axes, coverage: Mapping[str, Any]) -> Axes:
    """Draw the coverage of the truth in the flow by intervals of several confidence levels."""
    axes.plot([0, 1], [0, 1], color="0.6", lw=0.8, ls="--", label="ideal")
    axes.plot(LEVELS, coverage["reliability"], "o-", ms=3, color=COLOURS["blue"], label="in the flow")
    axes.set(xlabel="confidence level [1]", ylabel="share of the truth in the interval [1]", xlim=(0, 1), ylim=(0, 1))
    axes.legend(frameon=False)
    return axes


def draw_corrections(axes: Axes, table: Sequence[RefinedView]) -> Axes:
    """Draw each pose correction of each view over its prior standard deviation; bars are the posterior ones."""
    names = list(table[0]["values"])
    for i, row in enumerate(table):
        prior = [row["prior_sigma"][name] for name in names]
        refined = [n for n, sigma in enumerate(prior) if sigma > 0]
        values = [row["values"][names[n]] / prior[n] for n in refined]
        posterior = [row.get("posterior_sigma", {}).get(names[n], 0.0) / prior[n] for n in refined]
        place = np.array(refined) + 0.7 * ((i + 0.5) / len(table) - 0.5)
        axes.errorbar(place, values, yerr=posterior, fmt="o", ms=3, lw=0.8, label=plain(row["name"]))
    for limit in (-3, 3):
        axes.axhline(limit, color="0.6", lw=0.8, ls="--")
    axes.axhline(0, color="0.6", lw=0.8)
    axes.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=7)
    axes.set_ylabel("correction [standard deviations]")
    axes.legend(fontsize=6, ncols=max(1, len(table) // 3))
    return axes


def draw_refined_rig(axes: Axes, cameras: Sequence[Camera], table: Sequence[RefinedView]) -> Axes:
    """Draw the rig from above: circles as calibrated, enlarged arrows to the refined positions.

    Parameters
    ----------
    cameras : refined
    table : of the refinement of these cameras
    """
    rows = {row["name"]: row["values"] for row in table}
    centres = np.stack([camera.centre.double().numpy() for camera in cameras])
    shifts, sights = np.zeros_like(centres), np.stack([camera.rotation[2].double().numpy() for camera in cameras])
    for i, camera in enumerate(cameras):
        shift = np.array([rows.get(camera.name, {}).get(f"shift_{axis}", 0.0) for axis in "xyz"])
        shifts[i] = camera.rotation.double().numpy().T @ shift
    extent = float(np.abs(centres - centres.mean(axis=0)).max()) or 1.0
    longest = float(np.linalg.norm(shifts, axis=1).max())
    scale = LONGEST_SHIFT * extent / longest if longest > 0 else 1.0
    before = centres - shifts
    for i, camera in enumerate(cameras):
        colour = f"C{i % 10}"
        axes.plot(*before[i, :2], "o", mfc="none", color=colour, ms=6)
        axes.plot(*np.stack([before[i], before[i] + 0.3 * extent * sights[i]])[:, :2].T, color=colour, lw=0.6)
        end = before[i] + scale * shifts[i]
        axes.annotate("", end[:2], before[i, :2], arrowprops={"arrowstyle": "->", "color": colour})
        axes.annotate(plain(camera.name), before[i, :2], xytext=(4, 4), textcoords="offset points", fontsize=6)
    axes.margins(0.2)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x [mm]", ylabel="y [mm]")
    axes.set_title(f"shifts enlarged {scale:.2g} times; longest {longest:.2g} mm", fontsize=8)
    return axes
