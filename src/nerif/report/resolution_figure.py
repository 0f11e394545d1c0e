"""Modulation transfer function of a reconstructed edge (nerif/resolution.py)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nerif.analysis.resolution import MTF, THRESHOLD
from nerif.plotting.drawing import COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_mtf"]


def draw_mtf(axes: Axes, mtf: MTF, label: str = "", colour: str = COLOURS["blue"], unit: str = "mm") -> Axes:
    """Draw the MTF over line pairs per unit of length, and where it falls below 10 %; again for another one."""
    first = not axes.has_data()
    frequency, found = mtf.frequency.numpy(), float(mtf.resolution)
    right = 2 * found if found > 0 else frequency[-1]  # NaN and 0 have no place on the axis
    if not first:
        right = max(right, axes.get_xlim()[1])
    told = f"{found:.2f} lp/{unit}" if found > 0 else "no edge" if found == 0 else f"> {frequency[-1]:.4g} lp/{unit}"
    axes.plot(frequency, mtf.transfer.numpy(), color=colour, label=f"{label}: {told}" if label else told)
    if first:
        axes.axhline(THRESHOLD, color=COLOURS["grey"], linewidth=0.8, linestyle="--", label=f"{THRESHOLD:.0%}")
    if found > 0:
        axes.plot(found, THRESHOLD, marker="o", markersize=4, color=colour)
    axes.set_xlim(0, right)
    axes.set_ylim(0, 1.1)
    axes.set_xlabel(f"spatial frequency [lp/{unit}]")
    axes.set_ylabel("MTF [1]")
    axes.legend(frameon=False)
    return axes
