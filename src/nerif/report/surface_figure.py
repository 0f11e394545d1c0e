"""A quantity on the surface of bodies, from two sides."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nerif.data.surface import SurfaceMap
from nerif.plotting.drawing import colour_range, colours_of, label_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_surface"]

SIDES = (("from above, azimuth −60°", 22.0, -60.0), ("from below, azimuth 120°", -22.0, 120.0))
FLAT = 0.15  # of the longest edge, below which an axis has a single tick
UNKNOWN = "0.75"  # grey of triangles without a value


def draw_surface(figure: Figure, surface: SurfaceMap, quantity: str) -> None:
    """Fill a figure with a quantity on the surface, seen from two opposite sides; grey where it is unknown."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    corners = surface.vertices[surface.faces].numpy()
    values = surface.quantities[quantity][surface.faces].mean(dim=1).numpy()
    colour_map = colormaps[colours_of(quantity)].with_extremes(bad=UNKNOWN)
    scale = ScalarMappable(Normalize(*colour_range(values)), colour_map)
    colours = scale.to_rgba(np.ma.masked_invalid(values))
    lower, upper = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    every: Any = figure.subplots(1, 2, subplot_kw={"projection": "3d"})
    for axes, (title, elevation, azimuth) in zip(every, SIDES, strict=True):
        axes.add_collection3d(
            Poly3DCollection(corners, facecolors=colours, edgecolors=colours, linewidths=0.2, rasterized=True)
        )
        axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), zlim=(lower[2], upper[2]))
        axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
        axes.set_title(title, pad=18)
        axes.set_box_aspect(np.maximum(upper - lower, 1e-9), zoom=0.72)
        axes.set_proj_type("ortho")
        axes.view_init(elevation, azimuth)
        axes.tick_params(labelsize=6)
        for axis, low, high in zip((axes.xaxis, axes.yaxis, axes.zaxis), lower, upper, strict=True):
            if high - low > FLAT * float((upper - lower).max()):
                axis.set_major_locator(MaxNLocator(4))
            else:
                axis.set_ticks([float(f"{(low + high) / 2:.3g}")])
    figure.colorbar(scale, ax=list(every), label=label_of(quantity), shrink=0.7, pad=0.08)
