"""What standard deviations look like: bands about lines through the field, and how often a truth lies within them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from nerif.analysis.metrics import LEVELS
from nerif.data.volume import Volume
from nerif.plotting.drawing import COLOURS, drawn_of, label_of, shown
from nerif.reconstruction.uncertainty.bootstrap import TAILS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["banded", "draw_bands", "draw_reliability"]

WIDE = TAILS["p95"]  # standard deviations on either side of a band of 90 %


def banded(volumes: Mapping[str, Volume]) -> list[str]:
    """Return the quantities that are drawn with a band: those that have standard deviations."""
    return [quantity for quantity in drawn_of(volumes) if f"{quantity}_std" in volumes]


def draw_bands(axes: Axes, volumes: Mapping[str, Volume], quantity: str) -> Axes:
    """Draw a quantity along the lines through the middle of the box, with bands that hold 90 %.

    Parameters
    ----------
    volumes : of a result, the quantity and its standard deviation among them, and its percentiles if it has some
    quantity : one of `banded`
    """
    volume = volumes[quantity]
    values, std = shown(volume), volumes[f"{quantity}_std"].values.double().numpy()
    ends = [volumes.get(f"{quantity}_{name}") for name in ("p05", "p95")]
    low, high = (
        values + sign * WIDE * std if end is None else end.values.double().numpy()
        for sign, end in zip((-1, 1), ends, strict=True)
    )
    middle = [n // 2 for n in values.shape]
    colours = (COLOURS["blue"], COLOURS["orange"], COLOURS["green"])
    for axis, name, colour in zip((2, 1, 0), "xyz", colours, strict=True):
        line = tuple(slice(None) if i == axis else n for i, n in enumerate(middle))
        at = volume.grid.box.lower[2 - axis] + (np.arange(values.shape[axis]) + 0.5) * volume.grid.spacing[2 - axis]
        axes.plot(at, values[line], color=colour, lw=1, label=f"along {name}")
        axes.fill_between(at, low[line], high[line], color=colour, alpha=0.25, lw=0)
    axes.set_xlabel("distance [mm]")
    axes.set_ylabel(label_of(quantity))
    axes.legend(frameon=False)
    return axes


def draw_reliability(axes: Axes, coverage: Mapping[str, Any]) -> Axes:
    """Draw how often the truth lies within bands of several widths in the flow, against how often it should."""
    axes.plot([0, 1], [0, 1], color="0.6", lw=0.8, ls="--", label="as stated")
    axes.plot(LEVELS, coverage["reliability"], "o-", ms=3, color=COLOURS["blue"], label="found, in the flow")
    axes.set_xlabel("share that a band should hold [1]")
    axes.set_ylabel("share of the truth in it [1]")
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
    axes.legend(frameon=False)
    return axes
