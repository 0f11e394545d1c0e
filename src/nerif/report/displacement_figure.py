"""Displacements, or other measured values, and flow masks of a measurement, view by view."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool
from torch import Tensor

from nerif.common.files import atomic
from nerif.data.measurement import Measurement
from nerif.geometry import Camera
from nerif.plotting.drawing import draw_map, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["save_displacements", "save_masks"]

MAX_PIXELS = 512  # along the longer edge of a view
COLUMNS = 5  # of views


def _grid(views: int, rows_per_view: int, height: float) -> tuple[Figure, Any]:
    """A figure with axes for the maps of each view; unused axes are hidden."""
    from matplotlib.figure import Figure

    columns, rows = min(views, COLUMNS), -(-views // COLUMNS)
    figure = Figure(figsize=(2.6 * columns + 1, height * rows), layout="constrained")
    grid = figure.subplots(rows_per_view * rows, columns, squeeze=False)
    for i in range(views, rows * columns):
        for k in range(rows_per_view):
            grid[rows_per_view * (i // columns) + k, i % columns].set_visible(False)
    return figure, grid


def _label(axes: Axes, title: str, row: bool, column: bool) -> None:
    axes.set_facecolor("0.75")
    axes.set_title(plain(title), fontsize=8)
    axes.tick_params(labelsize=6)
    axes.set_xlabel("column [px]" if column else "", fontsize=7)
    axes.set_ylabel("row [px]" if row else "", fontsize=7)


def _save(figure: Figure, path: Path, image: Any, grid: Any, label: str, extend: str) -> None:
    figure.colorbar(image, ax=grid.ravel().tolist(), label=label, shrink=0.6, extend=extend)
    with atomic(path) as part:
        figure.savefig(part, dpi=120)


def save_displacements(path: Path, measurement: Measurement) -> None:
    """Write an image with u and v (px) of every view on one scale; invalid pixels are grey."""
    step = _step(measurement)
    usable, d = (x[:, ::step, ::step].numpy() for x in (measurement.usable, measurement.displacements))
    d = np.where(usable[..., None], d, np.nan)
    limit = float(np.nanpercentile(np.abs(d), 99.5)) or 1.0
    figure, grid = _grid(len(measurement.cameras), 2, 4.6)
    for i, camera in enumerate(measurement.cameras):
        inside, extent = _inside(camera, step)
        for k, component in enumerate("uv"):
            axes = grid[2 * (i // COLUMNS) + k, i % COLUMNS]
            draw_map(axes, d[i][inside][..., k], (-limit, limit))
            axes.images[-1].set_extent(extent)
            _label(axes, f"{camera.name}: {component}", i % COLUMNS == 0, k == 1)
    _save(figure, path, axes.images[-1], grid, "displacement [px]", "both")


def save_masks(path: Path, measurement: Measurement, masks_of_views: Bool[Tensor, "view row column"]) -> None:
    """Write an image with the magnitude of the first technique in every view, and the outlines of masks."""
    step, observation = _step(measurement), measurement.observations[0]
    maps = measurement.usable_for(observation), observation.values, masks_of_views
    usable, components, masks = (x[:, ::step, ::step].numpy() for x in maps)
    d = np.where(usable, np.linalg.norm(components, axis=-1), np.nan)
    limit = float(np.nanpercentile(d, 99.5)) or 1.0
    figure, grid = _grid(len(measurement.cameras), 1, 2.5)
    for i, camera in enumerate(measurement.cameras):
        axes, (inside, extent) = grid[i // COLUMNS, i % COLUMNS], _inside(camera, step)
        mask = masks[i][inside]
        axes.imshow(d[i][inside], vmin=0, vmax=limit, cmap="viridis", interpolation="nearest", extent=extent)
        if mask.any() and not mask.all():
            rows, columns = (np.arange(0, n, step) for n in camera.image_size)
            axes.contour(columns, rows, mask.astype(float), [0.5], colors="white", linewidths=1)
        _label(axes, camera.name, i % COLUMNS == 0, True)
    label = f"|{observation.technique.measured}| [{observation.technique.unit}]"
    _save(figure, path, axes.images[-1], grid, label, "max")


def _step(measurement: Measurement) -> int:
    """Distance of the pixels that are drawn."""
    return max(1, -(-max(measurement.shape[1:]) // MAX_PIXELS))


def _inside(camera: Camera, step: int) -> tuple[tuple[slice, slice], tuple[float, float, float, float]]:
    """The part of a map that the image of a camera takes, and the extent of the image, px."""
    height, width = camera.image_size
    return (slice(0, -(-height // step)), slice(0, -(-width // step))), (-0.5, width - 0.5, height - 0.5, -0.5)
