"""Slices of volumes and maps of views, drawn into Axes of the caller: for print, pages and notebooks.

Sequential colour maps are perceptually uniform, diverging ones centred on 0; both suit colour-blind readers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from nerif.common.conventions import STATISTICS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from torch import Tensor

    from nerif.geometry import Grid

__all__ = [
    "COLOURS", "DIVERGING", "LABELS", "Drawable", "add_colour_bar", "colour_range", "colours_of", "draw_map",
    "draw_slice", "draw_slices", "label_of", "map_colours", "map_range", "plain", "plotted_quantities",
    "plotted_values", "style",
]  # fmt: skip


class Drawable(Protocol):
    """Values of a quantity at the voxel centres of a grid, such as a Volume."""

    @property
    def values(self) -> Tensor: ...
    @property
    def grid(self) -> Grid: ...
    @property
    def quantity(self) -> str: ...


PLANES = {"z": ("x", "y"), "y": ("x", "z"), "x": ("y", "z")}  #: normal of a slice, and its horizontal and vertical axis

SEQUENTIAL, DIVERGING = "viridis", "RdBu_r"

COLOUR_MAPS = {"temperature": "inferno", "emission": "magma"}  #: by quantity; SEQUENTIAL for the others

COLOURS = {"blue": "#0072B2", "orange": "#D55E00", "green": "#009E73", "grey": "#595959"}  # Okabe & Ito

LABELS = {
    "index_excess": ("n − n$_{ambient}$", "1"),
    "n": ("n − 1", "1"),
    "density": ("density", "kg m⁻³"),
    "temperature": ("temperature", "K"),
    "mole_fraction": ("mole fraction", "1"),
    "mass_fraction": ("mass fraction", "1"),
    "static_pressure": ("static pressure", "Pa"),
    "mach": ("Mach number", "1"),
    "pressure_coefficient": ("pressure coefficient", "1"),
    "salinity": ("salinity", "g kg⁻¹"),
    "electron_density": ("electron density", "m⁻³"),
    "extinction": ("extinction coefficient", "mm⁻¹"),
    "emission": ("radiance per length", "mm⁻¹"),
    "u": ("velocity along x", "m s⁻¹"),
    "v": ("velocity along y", "m s⁻¹"),
    "w": ("velocity along z", "m s⁻¹"),
    "speed": ("speed", "m s⁻¹"),
    "vorticity": ("vorticity", "s⁻¹"),
    "pressure": ("pressure", "Pa"),
    "transport_residual": ("residual of transport", "s⁻¹"),
    "momentum_residual": ("residual of momentum", "m s⁻²"),
}
"""Label of a colour bar, and unit."""


def plotted_quantities(quantities: Iterable[str]) -> tuple[str, ...]:
    """Return the quantities of a result to plot: without statistics, and without the index excess, which n shows."""
    return tuple(q for q in quantities if q != "index_excess" and q.rpartition("_")[2] not in STATISTICS)


@contextmanager
def style(size: float = 7.0) -> Iterator[None]:
    """Use text of `size` points, thin lines, and fonts that stay text in PDF and SVG."""
    import matplotlib as mpl

    lines, small = ("axes.linewidth", "xtick.major.width", "ytick.major.width", "hatch.linewidth"), size - 0.5
    settings: Any = {
        **dict.fromkeys(("font.size", "axes.titlesize", "axes.labelsize"), size),
        **dict.fromkeys(("legend.fontsize", "xtick.labelsize", "ytick.labelsize"), small),
        **dict.fromkeys(lines, 0.6),
        "pdf.fonttype": 42,
        "svg.fonttype": "none",
    }
    with mpl.rc_context(settings):
        yield


def plain(text: str) -> str:
    """Return a name from a file as Matplotlib shows it unchanged, also in legends: without mathematics."""
    return text.replace("$", r"\$")


def label_of(quantity: str) -> str:
    """Return the label of a colour bar with its unit, also for statistics such as density_std."""
    base, _, statistic = quantity.rpartition("_")
    if statistic in STATISTICS and base in LABELS:
        name, unit = LABELS[base]
        return f"{STATISTICS[statistic]} of {name} [{unit}]"
    name, unit = LABELS.get(quantity, (plain(quantity), "1"))
    return f"{name} [{unit}]"


def colours_of(quantity: str) -> str:
    """Return the colour map of a quantity, or of statistics of it."""
    return COLOUR_MAPS.get(quantity.partition("_")[0], SEQUENTIAL)


def plotted_values(volume: Drawable) -> np.ndarray:
    """Return the values to plot, (z, y, x): n - 1 for n."""
    values = volume.values.double().numpy()
    return values - 1 if volume.quantity == "n" else values


def draw_slice(
    axes: Axes, volume: Drawable, normal: str, limits: tuple[float, float] | None = None, colour_map: str | None = None
) -> Axes:
    """Draw the middle slice of a volume across the axis `normal`; lengths in mm, masked voxels grey."""
    values = plotted_values(volume)
    low, high = limits or colour_range(values)
    axis = "zyx".index(normal)
    plane = np.take(values, values.shape[axis] // 2, axis=axis)
    across, up = PLANES[normal]
    box = volume.grid.box
    i, j = "xyz".index(across), "xyz".index(up)
    axes.set_facecolor("0.8")
    axes.imshow(
        plane, origin="lower", extent=(box.lower[i], box.upper[i], box.lower[j], box.upper[j]), vmin=low, vmax=high,
        cmap=colour_map or colours_of(volume.quantity), interpolation="nearest",
    )  # fmt: skip
    axes.set(xlabel=f"{across} [mm]", ylabel=f"{up} [mm]")
    return axes


def draw_slices(
    line: Sequence[Axes], volume: Drawable, limits: tuple[float, float], colour_map: str | None = None, name: str = "",
    doubtful: np.ndarray | None = None,
) -> None:  # fmt: skip
    """Draw the middle slices across z, y and x, titled by name and position (mm), hatched in `doubtful` (z, y, x)."""
    for axes, normal in zip(line, "zyx", strict=True):
        draw_slice(axes, volume, normal, limits, colour_map)
        if doubtful is not None:
            _hatch(axes, doubtful, normal)
        along = volume.grid.axis(normal)
        axes.set_title(f"{name}{', ' if name else ''}{normal} = {float(along[len(along) // 2]):.1f} mm")


def _hatch(axes: Axes, doubtful: np.ndarray, normal: str) -> None:
    """Hatch the middle slice of a mask."""
    axis = "zyx".index(normal)
    plane = np.take(doubtful, doubtful.shape[axis] // 2, axis=axis)
    if plane.any() and min(plane.shape) > 1:
        left, right, bottom, top = axes.images[-1].get_extent()
        across = left + (np.arange(plane.shape[1]) + 0.5) * (right - left) / plane.shape[1]
        up = bottom + (np.arange(plane.shape[0]) + 0.5) * (top - bottom) / plane.shape[0]
        axes.contourf(across, up, plane.astype(float), levels=[0.5, 1.5], colors="none", hatches=["////"])


def colour_range(values: np.ndarray) -> tuple[float, float]:
    """Return the colour range: lowest and highest finite value (without any: 0 and 1), or 0.1 to 99.9 %.

    The latter if outliers would occupy a fifth of the range or more.
    """
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    inner = np.quantile(finite, [0.001, 0.999])
    if inner[1] > inner[0] and high - low > 1.25 * (inner[1] - inner[0]):
        return float(inner[0]), float(inner[1])
    return low, high


def map_range(values: np.ndarray, signed: bool, share: float = 1.0) -> tuple[float, float]:
    """Return the colour range of maps: from 0, or symmetric about it if `signed`, to the quantile `share` of |values|.

    NaN is ignored; the upper end without any value is 1.
    """
    sizes = np.abs(values[np.isfinite(values)])
    high = (float(np.quantile(sizes, share)) if sizes.size else 0.0) or 1.0
    return (-high if signed else 0.0), high


def map_colours(limits: tuple[float, float]) -> str:
    """Return the colour map of a range: a diverging one about 0, a sequential one from 0 up."""
    return DIVERGING if limits[0] < 0 else SEQUENTIAL


def draw_map(axes: Axes, image: np.ndarray, limits: tuple[float, float]) -> Axes:
    """Draw a map of one view in a colour range (map_range); rows downward, NaN grey."""
    axes.set_facecolor("0.8")
    axes.imshow(image, vmin=limits[0], vmax=limits[1], cmap=map_colours(limits), interpolation="nearest")
    axes.set(xlabel="column [px]", ylabel="row [px]")
    return axes


def add_colour_bar(axes: Sequence[Axes], label: str) -> Axes:
    """Put a colour bar beside axes that share the last one's scale, and return its axes."""
    from matplotlib.ticker import ScalarFormatter

    form = ScalarFormatter(useMathText=True)
    form.set_powerlimits((-3, 4))
    figure = axes[0].figure
    low, high = axes[-1].images[-1].get_clim()
    values = np.concatenate([np.ma.masked_invalid(np.ma.asarray(a.images[-1].get_array())).compressed() for a in axes])
    beyond = (bool((values < low).any()), bool((values > high).any()))
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get(beyond, "neither")
    bar = figure.colorbar(axes[-1].images[-1], ax=list(axes), format=form, shrink=0.9, pad=0.02, extend=extend)
    bar.set_label(label)
    return bar.ax
