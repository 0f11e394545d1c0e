"""Figures, drawn into Axes that the caller gives, and the two that go with every demo as PNG."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nerif.volume import Volume

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

__all__ = ["draw_displacement", "draw_slice", "save_slices", "save_view"]

PLANES = {"z": ("x", "y"), "y": ("x", "z"), "x": ("y", "z")}
"""Normal of a slice: the axes it is drawn over."""


def draw_slice(axes: Axes, volume: Volume, normal: str, limits: tuple[float, float]) -> AxesImage:
    """Draw the middle slice of a volume across the axis `normal`; lengths in mm."""
    values = volume.values.numpy()
    axis = "zyx".index(normal)
    plane = np.take(values, values.shape[axis] // 2, axis=axis)
    across, up = PLANES[normal]
    box = volume.grid.box
    i, j = "xyz".index(across), "xyz".index(up)
    image = axes.imshow(
        plane,
        origin="lower",
        extent=(box.lower[i], box.upper[i], box.lower[j], box.upper[j]),
        vmin=limits[0],
        vmax=limits[1],
        cmap="viridis",
        interpolation="nearest",
    )
    axes.set_xlabel(f"{across} [mm]")
    axes.set_ylabel(f"{up} [mm]")
    return image


def draw_displacement(axes: Axes, image: np.ndarray, limit: float) -> AxesImage:
    """Draw one displacement component (px) on a diverging scale centred on 0; rows downward."""
    drawn = axes.imshow(image, vmin=-limit, vmax=limit, cmap="RdBu_r", interpolation="nearest")
    axes.set_xlabel("column [px]")
    axes.set_ylabel("row [px]")
    return drawn


def save_slices(path: Path, reconstruction: Volume, truth: Volume | None = None) -> None:
    """Write a PNG of the three middle slices; with a truth, truth and difference below."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    values = reconstruction.values if truth is None else truth.values
    limits = float(values.min()), float(values.max())
    rows: list[tuple[str, Volume, tuple[float, float]]] = [("reconstruction", reconstruction, limits)]
    if truth is not None:
        error = Volume(reconstruction.values - truth.values, truth.grid)
        reach = float(error.values.abs().max())
        rows += [("truth", truth, limits), ("difference", error, (-reach, reach))]
    figure = Figure(figsize=(11, 3.6 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(rows), 3, squeeze=False)
    for (name, volume, scale), line in zip(rows, grid, strict=True):
        for axes, normal in zip(line, "zyx", strict=True):
            drawn = draw_slice(axes, volume, normal, scale)
            if name == "difference":
                drawn.set_cmap("RdBu_r")
            n = volume.grid.shape["zyx".index(normal)]
            height = float(volume.grid.axis(normal)[n // 2])
            axes.set_title(f"{name}, {normal} = {height:.2f} mm", fontsize=10)
        figure.colorbar(drawn, ax=list(line), label="n − n$_{ambient}$ [1]", format="%.1e")
    figure.savefig(path, dpi=130)


def save_view(path: Path, name: str, measured: np.ndarray, predicted: np.ndarray, valid: np.ndarray) -> None:
    """Write a PNG of measured, predicted and difference of both components of a view, px."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6.6), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(2, 3)
    masked = np.where(valid[..., None], measured, np.nan)
    limit = float(np.nanmax(np.abs(masked)))
    for component, line in zip((0, 1), grid, strict=True):
        images = (masked[..., component], predicted[..., component], (masked - predicted)[..., component])
        for axes, title, image in zip(line, ("measured", "predicted", "difference"), images, strict=True):
            drawn = draw_displacement(axes, image, limit)
            axes.set_title(f"{'uv'[component]} {title}, view {name}", fontsize=10)
        figure.colorbar(drawn, ax=list(line), label=f"displacement {'uv'[component]} [px]")
    figure.savefig(path, dpi=130)
