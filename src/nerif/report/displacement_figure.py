"""The displacements, or what else was measured, and flow masks of a measurement, view by view."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nerif.common.files import atomic
from nerif.data.measurement import Measurement
from nerif.plotting.drawing import draw_map

__all__ = ["save_displacements", "save_masks"]

MOST = 512  # px along the longer edge of a view


def save_displacements(path: Path, measurement: Measurement) -> None:
    """Write an image with u and v (px) of every view on one scale; what is not valid is left grey."""
    from matplotlib.figure import Figure

    step = _step(measurement)
    usable, d = (x[:, ::step, ::step].numpy() for x in (measurement.usable, measurement.displacements))
    d = np.where(usable[..., None], d, np.nan)
    limit = float(np.nanpercentile(np.abs(d), 99.5)) or 1.0
    count = len(measurement.cameras)
    columns = min(count, 5)
    rows = -(-count // columns)
    figure = Figure(figsize=(2.6 * columns + 1, 4.6 * rows), layout="constrained")
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
            shown = draw_map(axes, d[i, : -(-height // step), : -(-width // step), k], (-limit, limit))
            shown.images[-1].set_extent((-0.5, width - 0.5, height - 0.5, -0.5))
            axes.set_title(f"{camera.name}: {component}", fontsize=8)
            axes.tick_params(labelsize=6)
            axes.set_xlabel("column [px]" if k else "", fontsize=7)
            axes.set_ylabel("row [px]" if i % columns == 0 else "", fontsize=7)
    assert shown is not None
    figure.colorbar(shown.images[-1], ax=grid.ravel().tolist(), label="displacement [px]", shrink=0.6, extend="both")
    with atomic(path) as part:
        figure.savefig(part, dpi=120)


def save_masks(path: Path, measurement: Measurement) -> None:
    """Write an image of how large the values of the first technique are in every view, and of its flow mask."""
    from matplotlib.figure import Figure

    assert measurement.flow_mask is not None
    step, seen = _step(measurement), measurement.observations[0]
    maps = measurement.usable_for(seen), seen.values, measurement.flow_mask
    usable, components, masks = (x[:, ::step, ::step].numpy() for x in maps)
    d = np.where(usable, np.linalg.norm(components, axis=-1), np.nan)
    limit = float(np.nanpercentile(d, 99.5)) or 1.0
    count = len(measurement.cameras)
    columns = min(count, 5)
    figure = Figure(figsize=(2.6 * columns + 1, 2.5 * -(-count // columns)), layout="constrained")
    grid = figure.subplots(-(-count // columns), columns, squeeze=False)
    for axes in grid.flat[count:]:
        axes.set_visible(False)
    for i, (axes, camera) in enumerate(zip(grid.flat, measurement.cameras, strict=False)):
        height, width = camera.image_size
        axes.set_facecolor("0.75")
        inside = (i, slice(0, -(-height // step)), slice(0, -(-width // step)))
        extent = (-0.5, width - 0.5, height - 0.5, -0.5)
        shown = axes.imshow(d[inside], vmin=0, vmax=limit, cmap="viridis", interpolation="nearest", extent=extent)
        if masks[inside].any() and not masks[inside].all():
            columns_px, rows_px = np.arange(0, width, step), np.arange(0, height, step)
            axes.contour(columns_px, rows_px, masks[inside].astype(float), [0.5], colors="white", linewidths=1)
        axes.set_title(camera.name, fontsize=8)
        axes.tick_params(labelsize=6)
        axes.set_xlabel("column [px]", fontsize=7)
        axes.set_ylabel("row [px]" if i % columns == 0 else "", fontsize=7)
    label = f"|{seen.technique.measured}| [{seen.technique.unit}]"
    figure.colorbar(shown, ax=grid.ravel().tolist(), label=label, shrink=0.6, extend="max")
    with atomic(path) as part:
        figure.savefig(part, dpi=120)


def _step(measurement: Measurement) -> int:
    """Distance of the pixels that are drawn: more than MOST along an edge would not show."""
    return max(1, -(-max(measurement.shape[1:]) // MOST))
