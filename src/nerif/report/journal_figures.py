"""`nerif figures`: every figure of a result as vector PDF and PNG, at the column widths of journals."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from nerif.common.arrays import filled
from nerif.common.conventions import with_unit
from nerif.common.files import atomic
from nerif.common.written_files import OwnFiles
from nerif.data.measurement_data import Observation
from nerif.data.quantity_names import INDEX
from nerif.data.reprojection import Reprojection
from nerif.data.volume import Volume
from nerif.plotting import drawing
from nerif.plotting.drawing import (
    add_colour_bar,
    colour_range,
    draw_map,
    label_of,
    map_range,
    plain,
    plotted_quantities,
    plotted_values,
)
from nerif.report.isosurface import default_level, draw_isosurface
from nerif.report.journals import JOURNALS
from nerif.report.meridian_figure import draw_centre_line, draw_profiles, draw_section
from nerif.report.result_plots import draw_line, plots_of
from nerif.report.surface_figure import draw_surface
from nerif.results.directory import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["error_of", "figures_of", "save_figures"]

NOT_IN_FILES = r"[^\w.+-]"
HATCHED_STD = 0.1  # standard deviation over the range of the colours, above which slices are hatched
MAX_LINES = 3  # rows or columns of images that are drawn as lines

Maps = tuple[Observation, np.ndarray, np.ndarray, np.ndarray | None]
"""An observation of a view: measured, NaN where invalid; predicted; sigma or None: (row, column, c)."""


def save_figures(result: Result, directory: Path, journal: str = "elsevier", dpi: int = 300) -> list[Path]:
    """Write NAME.pdf and NAME.png of every figure that the result has data for, and return the paths.

    Foreign or edited files of these names are renamed (OwnFiles).
    """
    paths, files = [], OwnFiles(directory)
    with drawing.style():
        for name, figure in figures_of(result, *JOURNALS[journal]):
            for ending in ("pdf", "png"):
                paths.append(directory / f"{name}.{ending}")
                with files.writing(paths[-1].name) as path, atomic(path) as part:
                    figure.savefig(part, dpi=dpi, metadata={"Title": f"{name}, {result.directory.name}"})
    return paths


def figures_of(result: Result, single: float, double: float) -> Iterator[tuple[str, Figure]]:
    """Draw the figures one by one, with their names; `single` and `double` are column widths, mm."""
    quantities = plotted_quantities(result.volumes)
    for quantity in (*quantities, *(f"{q}_std" for q in quantities)):
        if quantity in result.volumes:
            std = result.volumes.get(f"{quantity}_std")
            yield f"slices_{quantity}", slices(result.volumes[quantity], double, std)
    error = error_of(result)
    if error is not None and result.field is not None:
        yield "comparison", comparison(result.field, error, double)
    for quantity in quantities if result.field is None or min(result.field.grid.shape) > 1 else ():
        yield f"isosurface_{quantity}", isosurface(result.volumes[quantity], single)
    if result.surface is not None:
        for quantity in plotted_quantities(result.surface.quantities):
            figure = _page(double, 0.5)
            draw_surface(figure, result.surface, quantity)
            yield f"surface_{quantity}", figure
    if (meridian := result.meridian) is not None:
        plots = ("section", draw_section), ("profiles", draw_profiles), ("centre_line", draw_centre_line)
        for quantity, (name, draw) in itertools.product(plotted_quantities(meridian.quantities), plots):
            figure = _page(single, 0.9 if name == "section" else 0.7)
            draw(figure.subplots(), meridian, quantity)
            yield f"{name}_{quantity}", figure
    if result.reprojection is not None:
        used: set[str] = set()
        for i, name in enumerate(result.reprojection.measurement.names):
            plain = re.sub(NOT_IN_FILES, "_", name)
            plain = plain if plain not in used else f"{plain}_{i}"
            used.add(plain)
            yield f"view_{plain}", view(result.reprojection, i, double)
        yield "rig", rig(result.reprojection, double)
    for plot in plots_of(result):
        figure = _page(single, plot.height)
        plot.draw(figure.subplots())
        yield plot.name, figure


def _page(width: float, height_over_width: float, layout: str = "constrained") -> Figure:
    """An empty figure; width in mm."""
    from matplotlib.figure import Figure

    inches = width / 25.4
    return Figure(figsize=(inches, inches * height_over_width), layout=layout)  # type: ignore[arg-type]


def slices(volume: Volume, width: float, std: Volume | None = None) -> Figure:
    """Draw the three middle slices of a volume, hatched where the standard deviation is large."""
    ex, ey, ez = volume.grid.box.edges
    ratios = [ex, ex, ey]
    figure = _page(width, max(0.2, 0.80 * max(ey, ez) / sum(ratios)) + 0.06)
    row = figure.subplots(1, 3, gridspec_kw={"width_ratios": ratios})
    low, high = limits = colour_range(plotted_values(volume))
    doubtful = None if std is None else std.values.double().numpy() > HATCHED_STD * (high - low)
    drawing.draw_slices(row, volume, limits, doubtful=doubtful)
    add_colour_bar(row, label_of(volume.quantity))
    return figure


def isosurface(volume: Volume, width: float) -> Figure:
    """Draw the isosurface halfway between the ambient and the extreme."""
    figure = _page(width, 1.0, layout="none")
    axes: Any = figure.add_axes((0.02, 0.04, 0.90, 0.88), projection="3d")
    level = default_level(volume)
    draw_isosurface(axes, volume, level)
    name, unit = label_of(volume.quantity).removesuffix("]").split(" [")
    figure.suptitle(f"{name} = {with_unit(f'{level:.4g}', unit)}", y=0.97)
    return figure


def view(reprojection: Reprojection, i: int, width: float) -> Figure:
    """Draw measurement and prediction of view `i`: as maps or, if it has few rows or columns, as lines."""
    measurement = reprojection.measurement
    height_px, width_px = measurement.cameras[i].image_size
    inside = i, slice(0, height_px), slice(0, width_px)
    usable = [(o, measurement.usable_for(o)[inside][..., None].numpy()) for o in measurement.observations]
    maps: list[Maps] = []
    for o, mask in usable:
        if mask.any() or len(usable) == 1:
            sigma = None if o.sigma is None else np.where(mask, o.sigma[inside].numpy(), np.nan)
            predicted = reprojection.maps[o.technique.name][inside].numpy()
            maps.append((o, np.where(mask, o.values[inside].numpy(), np.nan), predicted, sigma))
    figure = (_lines if min(height_px, width_px) <= MAX_LINES else _maps)(maps, width)
    withheld = ", withheld" if measurement.names[i] in reprojection.withheld else ""
    figure.suptitle(f"view {plain(measurement.names[i])}{withheld}")
    return figure


def _maps(maps: list[Maps], width: float) -> Figure:
    """Measured, re-projected and residual of every component."""
    rows = sum(len(o.components) for o, *_ in maps)
    height_px, width_px, _ = maps[0][1].shape
    figure = _page(width, min(1.2, 0.31 * rows * height_px / width_px + 0.08))
    grid = iter(figure.subplots(rows, 3, sharex=True, sharey=True, squeeze=False))
    for o, measured, predicted, _ in maps:
        limits = map_range(measured, o.signed)
        difference_limits = limits if o.signed else map_range(predicted - measured, True)
        for c, (component, row) in enumerate(zip(o.components, grid, strict=False)):
            draw_map(row[0], measured[..., c], limits)
            draw_map(row[1], predicted[..., c], limits)
            draw_map(row[2], (predicted - measured)[..., c], difference_limits)
            for axes, title in zip(row, ("measured", "re-projected", "residual"), strict=True):
                axes.set_title(f"{title} {component}" if len(o.components) > 1 else title)
                axes.label_outer()
            label = f"{component} [{o.technique.unit}]"
            add_colour_bar(list(row if o.signed else row[:2]), label)
            if not o.signed:
                add_colour_bar([row[2]], f"residual [{o.technique.unit}]")
    return figure


def _lines(maps: list[Maps], width: float) -> Figure:
    """Every component along every row, or along every column if these are fewer: values and residual."""
    upright = maps[0][1].shape[0] > maps[0][1].shape[1]
    along, across = ("row", "column") if upright else ("column", "row")
    count = min(maps[0][1].shape[:2])
    panels = [(k, c, m) for m in maps for k, c in itertools.product(range(count), range(len(m[0].components)))]
    figure = _page(width, min(1.3, 0.34 * len(panels) + 0.06))
    grid = figure.subplots(2 * len(panels), 1, sharex=True, height_ratios=[3, 1.6] * len(panels))
    for (k, c, (o, measured, predicted, sigma)), above, below in zip(panels, grid[::2], grid[1::2], strict=True):
        line = (slice(None), k, c) if upright else (k, slice(None), c)
        deviation, label = None if sigma is None else sigma[line], f"{o.components[c]} [{o.technique.unit}]"
        draw_line((above, below), measured[line], predicted[line], deviation, label)
        above.set_title(f"{across} {k}" if count > 1 else "")
    grid[-1].set_xlabel(f"{along} [px]")
    figure.align_ylabels(grid)
    return figure


def rig(reprojection: Reprojection, width: float) -> Figure:
    """Draw cameras, box and backgrounds, obliquely and from above."""
    from nerif.report.rig_figure import draw_two_sides

    figure = _page(width, 0.48, layout="none")
    draw_two_sides(figure, reprojection.measurement.cameras, reprojection.measurement.box)
    return figure


def comparison(field: Volume, error: Volume, width: float) -> Figure:
    """Draw middle slices of reconstruction, truth and error."""
    truth = replace(field, values=field.values - error.values)
    limits = colour_range(plotted_values(truth))
    largest = float(error.values.nan_to_num(0.0).abs().max()) or 1.0
    ex, ey, ez = field.grid.box.edges
    figure = _page(width, max(0.3, 2.7 * max(ey, ez) / (2 * ex + ey)) + 0.08)
    grid = figure.subplots(3, 3, gridspec_kw={"width_ratios": [ex, ex, ey]})
    label = label_of(field.quantity)
    error_label = "error of n [1]" if field.quantity == INDEX else f"error of {label}"
    volumes = (("reconstruction", field, limits), ("truth", truth, limits), ("error", error, (-largest, largest)))
    for (name, volume, ends), row in zip(volumes, grid, strict=True):
        drawing.draw_slices(row, volume, ends, drawing.DIVERGING if name == "error" else None, name)
        add_colour_bar(list(row), error_label if name == "error" else label)
    return figure


def error_of(result: Result) -> Volume | None:
    """Reconstruction minus truth on the grid of the reconstruction; None without a truth that covers it."""
    from nerif.fields.voxel_field import VoxelField

    field, truth = result.field, result.truth
    if field is None or truth is None:
        return None
    if field.grid == truth.grid:
        return replace(field, values=field.values - truth.values, attributes={})
    if not truth.grid.box.holds(field.grid.box):
        return None
    spline = VoxelField.through(torch.from_numpy(filled(truth.values.numpy())), truth.grid)
    with torch.no_grad():
        return replace(field, values=field.values - spline.sample(field.grid), attributes={})
