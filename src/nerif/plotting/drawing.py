"""Volumes and maps of views, drawn into Axes that the caller gives and gets back: for print, pages and notebooks.

Sequential colour maps are perceptually uniform, diverging ones centred on 0; the colour-blind can read both.
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
    "COLOURS",
    "COLOUR_MAPS",
    "DIVERGING",
    "LABELS",
    "SEQUENTIAL",
    "Drawable",
    "add_colour_bar",
    "colour_range",
    "draw_map",
    "draw_slice",
    "draw_slices",
    "drawn_of",
    "label_of",
    "map_colours",
    "map_range",
    "shown",
    "style",
]


class Drawable(Protocol):
    """What can be drawn in slices: values at the voxel centres of a grid, and which quantity they are. A Volume is."""

    @property
    def values(self) -> Tensor: ...
    @property
    def grid(self) -> Grid: ...
    @property
    def quantity(self) -> str: ...


PLANES = {"z": ("x", "y"), "y": ("x", "z"), "x": ("y", "z")}
"""Normal of a slice: the axes it is drawn over."""

SEQUENTIAL, DIVERGING = "viridis", "RdBu_r"

COLOUR_MAPS = {"temperature": "inferno", "emission": "magma"}
"""By quantity; the others are drawn in SEQUENTIAL."""

COLOURS = {"blue": "#0072B2", "orange": "#D55E00", "green": "#009E73", "grey": "#595959"}  # Okabe & Ito

LABELS = {
    "index_excess": ("n − n$_{ambient}$", "1"),
    "n": ("n − 1", "1"),
    "density": ("density", "kg m⁻³"),
    "temperature": ("temperature", "K"),
    "extinction": ("extinction coefficient", "mm⁻¹"),
    "emission": ("radiance per length", "mm⁻¹"),
}
"""What stands at a colour bar, and the unit."""


def drawn_of(quantities: Iterable[str]) -> tuple[str, ...]:
    """Return which of the quantities of a result are drawn: of an index n, which stands for the excess too."""
    return tuple(q for q in quantities if q != "index_excess" and q.rpartition("_")[2] not in STATISTICS)


@contextmanager
def style(size: float = 7.0) -> Iterator[None]:
    """Text of `size` points, thin lines, fonts that stay text in PDF and SVG."""
    import matplotlib as mpl

    settings: Any = {
        "font.size": size,
        "axes.titlesize": size,
        "axes.labelsize": size,
        "legend.fontsize": size - 0.5,
        "xtick.labelsize": size - 0.5,
        "ytick.labelsize": size - 0.5,
        "axes.linewidth": 0.6,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "pdf.fonttype": 42,
        "svg.fonttype": "none",
        "hatch.linewidth": 0.6,
    }
    with mpl.rc_context(settings):
        yield


def label_of(quantity: str) -> str:
    """Return the label of a colour bar, with its unit: of density, density_std and so on."""
    base, _, statistic = quantity.rpartition("_")
    if statistic in STATISTICS and base in LABELS:
        name, unit = LABELS[base]
        return f"{STATISTICS[statistic]} of {name} [{unit}]"
    name, unit = LABELS.get(quantity, (quantity, "1"))
    return f"{name} [{unit}]"


def shown(volume: Drawable) -> np.ndarray:
    """Return the values as they are shown, (z, y, x): n as n - 1, the others as they are."""
    values = volume.values.double().numpy()
    return values - 1 if volume.quantity == "n" else values


def draw_slice(
    axes: Axes, volume: Drawable, normal: str, limits: tuple[float, float] | None = None, colour_map: str | None = None
) -> Axes:
    """Draw the middle slice of a volume across the axis `normal`; lengths in mm, masked voxels grey."""
    values = shown(volume)
    low, high = limits or colour_range(values)
    axis = "zyx".index(normal)
    plane = np.take(values, values.shape[axis] // 2, axis=axis)
    across, up = PLANES[normal]
    box = volume.grid.box
    i, j = "xyz".index(across), "xyz".index(up)
    axes.set_facecolor("0.8")
    axes.imshow(
        plane,
        origin="lower",
        extent=(box.lower[i], box.upper[i], box.lower[j], box.upper[j]),
        vmin=low,
        vmax=high,
        cmap=colour_map or COLOUR_MAPS.get(volume.quantity.partition("_")[0], SEQUENTIAL),
        interpolation="nearest",
    )
    axes.set_xlabel(f"{across} [mm]")
    axes.set_ylabel(f"{up} [mm]")
    return axes


def draw_slices(
    line: Sequence[Axes], volume: Drawable, limits: tuple[float, float], colour_map: str | None = None, name: str = "",
    doubtful: np.ndarray | None = None,
) -> None:  # fmt: skip
    """Draw the middle slices across z, y and x side by side, each under where it lies (mm) and a name, if given.

    Where `doubtful` (z, y, x) is true, they are hatched.
    """
    for axes, normal in zip(line, "zyx", strict=True):
        draw_slice(axes, volume, normal, limits, colour_map)
        if doubtful is not None:
            _hatch(axes, doubtful, normal)
        along = volume.grid.axis(normal)
        axes.set_title(f"{name}{', ' if name else ''}{normal} = {float(along[len(along) // 2]):.1f} mm")


def _hatch(axes: Axes, doubtful: np.ndarray, normal: str) -> None:
    """Hatch where the middle slice of a mask is true."""
    axis = "zyx".index(normal)
    plane = np.take(doubtful, doubtful.shape[axis] // 2, axis=axis)
    if plane.any() and min(plane.shape) > 1:
        left, right, bottom, top = axes.images[-1].get_extent()
        across = left + (np.arange(plane.shape[1]) + 0.5) * (right - left) / plane.shape[1]
        up = bottom + (np.arange(plane.shape[0]) + 0.5) * (top - bottom) / plane.shape[0]
        axes.contourf(across, up, plane.astype(float), levels=[0.5, 1.5], colors="none", hatches=["////"])


def colour_range(values: np.ndarray) -> tuple[float, float]:
    """Return the ends of the colours: lowest and highest value, or where a thousandth of the voxels is left beyond.

    The latter where a few outliers would take a fifth of the colours and more. NaN is left out; 0 and 1 for nothing.
    """
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 1.0
    low, high = float(known.min()), float(known.max())
    inner = np.quantile(known, [0.001, 0.999])
    if inner[1] > inner[0] and high - low > 1.25 * (inner[1] - inner[0]):
        return float(inner[0]), float(inner[1])
    return low, high


def map_range(values: np.ndarray, signed: bool, share: float = 1.0) -> tuple[float, float]:
    """Return the ends of the colours of maps: 0 and the largest value, or where a share of the pixels lies below.

    Of what may be negative (`signed`) they are as far below 0 as above. NaN is left out; 1 for nothing.
    """
    sizes = np.abs(values[np.isfinite(values)])
    high = (float(np.quantile(sizes, share)) if sizes.size else 0.0) or 1.0
    return (-high if signed else 0.0), high


def map_colours(limits: tuple[float, float]) -> str:
    """Return the colour map between such ends: a diverging one about 0, a sequential one from 0 up."""
    return DIVERGING if limits[0] < 0 else SEQUENTIAL


def draw_map(axes: Axes, image: np.ndarray, limits: tuple[float, float]) -> Axes:
    """Draw what pixels measured between such ends (see map_range); rows downward, unmeasured pixels grey."""
    axes.set_facecolor("0.8")
    axes.imshow(image, vmin=limits[0], vmax=limits[1], cmap=map_colours(limits), interpolation="nearest")
    axes.set_xlabel("column [px]")
    axes.set_ylabel("row [px]")
    return axes


def add_colour_bar(axes: Sequence[Axes], label: str) -> Axes:
    """Put a colour bar beside axes that share the last one's scale, and return its axes."""
    from matplotlib.ticker import ScalarFormatter

    form = ScalarFormatter(useMathText=True)
    form.set_powerlimits((-3, 4))
    figure = axes[0].figure
    low, high = axes[-1].images[-1].get_clim()
    drawn = np.concatenate([np.ma.masked_invalid(np.ma.asarray(a.images[-1].get_array())).compressed() for a in axes])
    beyond = (bool((drawn < low).any()), bool((drawn > high).any()))
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get(beyond, "neither")
    bar = figure.colorbar(axes[-1].images[-1], ax=list(axes), format=form, shrink=0.9, pad=0.02, extend=extend)
    bar.set_label(label)
    return bar.ax
