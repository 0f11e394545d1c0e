"""`nerif figures`: every figure of a result as vector PDF and PNG, at the column widths of journals."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from nerif.atomic import atomic
from nerif.drawing import (
    DIVERGING,
    add_colour_bar,
    colour_range,
    draw_displacement,
    draw_slices,
    label_of,
    shown,
    style,
)
from nerif.report.figures import draw_history, draw_residuals, draw_slice_scores, draw_view_scores
from nerif.report.isosurface import default_level, draw_isosurface
from nerif.report.view_images import lattice_step
from nerif.reprojection import Reprojection
from nerif.result import Result
from nerif.volume import Volume

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["JOURNALS", "error_of", "figures_of", "residuals_over_sigma", "save_figures"]

JOURNALS = {"elsevier": (90, 190), "aip": (85, 170), "aps": (86, 178), "nature": (89, 183), "springer": (84, 174)}
"""Widths of one and of two columns, mm, as the publishers' guides for authors give them."""

NOT_IN_FILES = r"[^\w.+-]"
TO_DRAW = ("n", "density", "temperature", "n_std", "density_std", "temperature_std")


def save_figures(result: Result, directory: Path, journal: str = "elsevier", dpi: int = 300) -> list[Path]:
    """Write NAME.pdf and NAME.png of every figure that the result has data for, and return the paths."""
    paths = []
    with style():
        for name, figure in figures_of(result, *JOURNALS[journal]):
            for ending in ("pdf", "png"):
                paths.append(directory / f"{name}.{ending}")
                with atomic(paths[-1]) as part:
                    figure.savefig(part, dpi=dpi, metadata={"Title": f"{name}, {result.directory.name}"})
    return paths


def figures_of(result: Result, single: float, double: float) -> Iterator[tuple[str, Figure]]:
    """Draw the figures one by one, with their names; `single` and `double` are column widths, mm."""
    for quantity in TO_DRAW:
        if quantity in result.volumes:
            yield f"slices_{quantity}", slices(result.volumes[quantity], double)
    error = error_of(result)
    if error is not None:
        yield "comparison", comparison(result.volumes["index_excess"], error, double)
    for quantity in ("n", "density", "temperature"):
        if quantity in result.volumes:
            yield f"isosurface_{quantity}", isosurface(result.volumes[quantity], single)
    if result.reprojection is not None:
        taken: set[str] = set()
        for i, name in enumerate(result.reprojection.measurement.names):
            plain = re.sub(NOT_IN_FILES, "_", name)
            plain = plain if plain not in taken else f"{plain}_{i}"
            taken.add(plain)
            yield f"view_{plain}", view(result.reprojection, i, double)
        if result.reprojection.measurement.sigma is not None:
            figure = _page(single, 0.7)
            draw_residuals(figure.subplots(), residuals_over_sigma(result.reprojection))
            yield "residuals", figure
        yield "rig", rig(result.reprojection, double)
    if result.metrics.get("views"):
        figure = _page(single, 0.8)
        draw_view_scores(figure.subplots(), result.metrics["views"])
        yield "views", figure
    if result.history:
        figure = _page(single, 0.7)
        draw_history(figure.subplots(), result.history, str(result.settings.get("method", "nerif")))
        yield "history", figure
    if result.metrics.get("slices"):
        figure = _page(single, 0.7)
        draw_slice_scores(figure.subplots(), result.metrics["slices"])
        yield "slice_scores", figure


def _page(width: float, height_over_width: float, layout: str = "constrained") -> Figure:
    """An empty figure of that width in mm."""
    from matplotlib.figure import Figure

    inches = width / 25.4
    return Figure(figsize=(inches, inches * height_over_width), layout=layout)  # type: ignore[arg-type]


def slices(volume: Volume, width: float) -> Figure:
    """The three middle slices of a volume, with one colour bar."""
    ex, ey, ez = volume.grid.box.edges
    ratios = [ex, ex, ey]
    tallest = max(ey, ez)
    figure = _page(width, max(0.2, 0.80 * tallest / sum(ratios)) + 0.06)
    line = figure.subplots(1, 3, gridspec_kw={"width_ratios": ratios})
    draw_slices(line, volume, colour_range(shown(volume)))
    add_colour_bar(line, label_of(volume.quantity))
    return figure


def isosurface(volume: Volume, width: float) -> Figure:
    """The surface halfway between the ambient and the extreme."""
    figure = _page(width, 1.0, layout="none")
    axes: Any = figure.add_axes((0.02, 0.04, 0.90, 0.88), projection="3d")
    level = default_level(volume)
    draw_isosurface(axes, volume, level)
    name, unit = label_of(volume.quantity).removesuffix("]").split(" [")
    figure.suptitle(f"{name} = {level:.4g} {'' if unit == '1' else unit}".rstrip(), y=0.97)
    return figure


def view(reprojection: Reprojection, i: int, width: float) -> Figure:
    """Measured, re-projected and difference of both components of view `i`."""
    measurement = reprojection.measurement
    height_px, width_px = measurement.cameras[i].image_size
    usable = measurement.usable[i, :height_px, :width_px, None].numpy()
    measured = np.where(usable, measurement.displacements[i, :height_px, :width_px].numpy(), np.nan)
    predicted = reprojection.predicted[i, :height_px, :width_px].numpy()
    limit = float(np.nanmax(np.abs(measured))) or 1.0
    figure = _page(width, min(1.2, 0.62 * height_px / width_px + 0.08))
    grid = figure.subplots(2, 3, sharex=True, sharey=True)
    for component, line in zip((0, 1), grid, strict=True):
        images = (measured[..., component], predicted[..., component], (predicted - measured)[..., component])
        for axes, title, image in zip(line, ("measured", "re-projected", "difference"), images, strict=True):
            draw_displacement(axes, image, limit)
            axes.set_title(f"{title} {'uv'[component]}")
            axes.label_outer()
        add_colour_bar(list(line), f"{'uv'[component]} [px]")
    held = ", held out" if measurement.names[i] in reprojection.held_out else ""
    figure.suptitle(f"view {measurement.names[i]}{held}", parse_math=False)
    return figure


def residuals_over_sigma(reprojection: Reprojection, most: int = 1 << 20) -> np.ndarray:
    """Return (predicted - measured) / sigma of every usable pixel whose ray crosses the box.

    Of more than `most` pixels, those of a regular lattice are taken.
    """
    m = reprojection.measurement
    assert m.sigma is not None
    step, usable, found = lattice_step(m, most), m.usable, []
    for i, camera in enumerate(m.cameras):
        rows, columns = (slice(0, n, step) for n in camera.image_size)
        pixels = camera.pixel_grid()[::step, ::step]
        crosses = camera.rays(pixels.reshape(-1, 2)).clip(m.box).crosses.reshape(pixels.shape[:2])
        seen = usable[i, rows, columns] & crosses
        residual = reprojection.predicted[i, rows, columns] - m.displacements[i, rows, columns]
        found.append((residual[seen] / m.sigma[i, rows, columns][seen]).flatten())
    return torch.cat(found).numpy()


def rig(reprojection: Reprojection, width: float) -> Figure:
    """Cameras, box and backgrounds, obliquely and from above."""
    from nerif.report.rig_figure import draw_two_sides

    figure = _page(width, 0.48, layout="none")
    draw_two_sides(figure, reprojection.measurement.cameras, reprojection.measurement.box)
    return figure


def comparison(excess: Volume, error: Volume, width: float) -> Figure:
    """Middle slices of reconstruction, truth and error."""
    from dataclasses import replace

    truth = replace(excess, values=excess.values - error.values)
    limits = colour_range(shown(truth))
    reach = float(error.values.abs().max()) or 1.0
    ex, ey, ez = excess.grid.box.edges
    figure = _page(width, max(0.3, 2.7 * max(ey, ez) / (2 * ex + ey)) + 0.08)
    grid = figure.subplots(3, 3, gridspec_kw={"width_ratios": [ex, ex, ey]})
    rows = (("reconstruction", excess, limits), ("truth", truth, limits), ("error", error, (-reach, reach)))
    for (name, volume, scale), line in zip(rows, grid, strict=True):
        draw_slices(line, volume, scale, DIVERGING if name == "error" else None, name)
        add_colour_bar(list(line), "error of n [1]" if name == "error" else label_of("index_excess"))
    return figure


def error_of(result: Result) -> Volume | None:
    """Reconstruction minus truth on the grid of the reconstruction; None without a truth that covers it."""
    from nerif.fields.grid import VoxelField

    excess, truth = result.volumes.get("index_excess"), result.truth
    if excess is None or truth is None:
        return None
    if excess.grid == truth.grid:
        return Volume(excess.values - truth.values, excess.grid)
    if not truth.grid.box.holds(excess.grid.box):
        return None
    field = VoxelField.through(truth.values, truth.grid)
    with torch.no_grad():
        return Volume(excess.values - field.sample(excess.grid), excess.grid)
