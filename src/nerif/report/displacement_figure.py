"""The displacements and flow masks of a measurement, view by view."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nerif.atomic import atomic
from nerif.drawing import draw_displacement
from nerif.measurement import Measurement

__all__ = ["save_displacements", "save_masks"]


def save_displacements(path: Path, measurement: Measurement) -> None:
    """Write a picture with u and v (px) of every view on one scale; what is not valid is left grey."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    d = np.where(measurement.usable.numpy()[..., None], measurement.displacement.numpy(), np.nan)
    limit = float(np.nanpercentile(np.abs(d), 99.5)) or 1.0
    count = len(measurement.cameras)
    columns = min(count, 5)
    rows = -(-count // columns)
    figure = Figure(figsize=(2.6 * columns + 1, 4.6 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(2 * rows, columns, squeeze=False)
    for axes in grid.flat:
        axes.set_visible(False)
    shown = None
    for i, camera in enumerate(measurement.cameras):
        height, width = camera.image_size
        for k, component in enumerate("uv"):
            axes = grid[2 * (i // columns) + k, i % columns]
            axes.set_visible(True)
            axes.set_facecolor("0.75")
            shown = draw_displacement(axes, d[i, :height, :width, k], limit)
            axes.set_title(f"{camera.name}: {component}", fontsize=8)
            axes.tick_params(labelsize=6)
            axes.set_xlabel("column [px]" if k else "", fontsize=7)
            axes.set_ylabel("row [px]" if i % columns == 0 else "", fontsize=7)
    assert shown is not None
    figure.colorbar(shown.images[-1], ax=grid.ravel().tolist(), label="displacement [px]", shrink=0.6, extend="both")
    with atomic(path) as part:
        figure.savefig(part, dpi=120)


def save_masks(path: Path, measurement: Measurement) -> None:
    """Write a picture with |d| (px) of every view and the outline of its flow mask."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    assert measurement.flow_mask is not None
    d = np.where(measurement.usable.numpy(), measurement.displacement.norm(dim=-1).numpy(), np.nan)
    limit = float(np.nanpercentile(d, 99.5)) or 1.0
    count = len(measurement.cameras)
    columns = min(count, 5)
    figure = Figure(figsize=(2.6 * columns + 1, 2.5 * -(-count // columns)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(-(-count // columns), columns, squeeze=False)
    for axes in grid.flat[count:]:
        axes.set_visible(False)
    for i, (axes, camera) in enumerate(zip(grid.flat, measurement.cameras, strict=False)):
        height, width = camera.image_size
        axes.set_facecolor("0.75")
        shown = axes.imshow(d[i, :height, :width], vmin=0, vmax=limit, cmap="viridis", interpolation="nearest")
        mask = measurement.flow_mask[i, :height, :width].numpy()
        if mask.any() and not mask.all():
            axes.contour(mask.astype(float), [0.5], colors="white", linewidths=1)
        axes.set_title(camera.name, fontsize=8)
        axes.tick_params(labelsize=6)
        axes.set_xlabel("column [px]", fontsize=7)
        axes.set_ylabel("row [px]" if i % columns == 0 else "", fontsize=7)
    figure.colorbar(shown, ax=grid.ravel().tolist(), label="|d| [px]", shrink=0.6, extend="max")
    with atomic(path) as part:
        figure.savefig(part, dpi=120)
