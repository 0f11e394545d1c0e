"""What a symmetric flow looks like: its section beside and beyond the axis, profiles across it and along it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from nerif.data.meridian import Meridian
from nerif.plotting.drawing import COLOURS, add_colour_bar, colour_range, label_of, map_colours
from nerif.reconstruction.uncertainty.bootstrap import TAILS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_centre_line", "draw_profiles", "draw_section"]

HEIGHTS = (0.25, 0.5, 0.75)  # shares of the height of the box, of profiles


def _shown(meridian: Meridian, quantity: str) -> np.ndarray:
    """The values as they are shown: n as n - 1."""
    values = meridian.quantities[quantity]
    return values - 1 if quantity == "n" else values


def _banded(meridian: Meridian, quantity: str) -> Meridian:
    """The `line` of a quantity; `low` and `high`, which hold 90 %, where it has standard deviations."""
    known = meridian.quantities
    std = f"{quantity}_std"
    found = {"line": _shown(meridian, quantity)}
    if std in known:
        for name, (percentile, deviations) in zip(("low", "high"), TAILS.items(), strict=True):
            end = known.get(f"{quantity}_{percentile}")
            found[name] = found["line"] + deviations * known[std] if end is None else end
    return replace(meridian, quantities=found)


def draw_section(axes: Axes, meridian: Meridian, quantity: str) -> Axes:
    """Draw a quantity in a plane through the axis, mirrored at it; what is outside the box grey."""
    values, r, h = _shown(meridian, quantity), meridian.r, meridian.h
    if meridian.axial:
        values, r = np.concatenate([values[:, :0:-1], values], axis=1), np.concatenate([-r[:0:-1], r])
    limits = colour_range(values)
    axes.set_facecolor("0.8")
    axes.imshow(
        values, extent=(r[0], r[-1], h[0], h[-1]), origin="lower", vmin=limits[0], vmax=limits[1],
        cmap=map_colours(limits), aspect="equal", interpolation="nearest",
    )  # fmt: skip
    axes.set_xlabel("r [mm]")
    axes.set_ylabel("h [mm]")
    add_colour_bar([axes], label_of(quantity))
    return axes


def draw_profiles(axes: Axes, meridian: Meridian, quantity: str) -> Axes:
    """Draw a quantity over r at three heights, with bands that hold 90 % where there are standard deviations."""
    span, drawn = meridian.h[-1] - meridian.h[0], _banded(meridian, quantity)
    for share, colour in zip(HEIGHTS, (COLOURS["blue"], COLOURS["orange"], COLOURS["green"]), strict=True):
        height = meridian.h[0] + share * span
        lines = {name: drawn.profile(name, height) for name in drawn.quantities}
        axes.plot(meridian.r, lines["line"], color=colour, lw=1, label=f"h = {height:z.1f} mm")
        if "low" in lines:
            axes.fill_between(meridian.r, lines["low"], lines["high"], color=colour, alpha=0.25, lw=0)
    axes.set_xlabel("r [mm]")
    axes.set_ylabel(label_of(quantity))
    axes.legend(frameon=False)
    return axes


def draw_centre_line(axes: Axes, meridian: Meridian, quantity: str) -> Axes:
    """Draw a quantity over h at r = 0, with a band that holds 90 % where there are standard deviations."""
    middle = int(np.abs(meridian.r).argmin())
    lines = {name: values[:, middle] for name, values in _banded(meridian, quantity).quantities.items()}
    axes.plot(meridian.h, lines["line"], color=COLOURS["blue"], lw=1)
    if "low" in lines:
        axes.fill_between(meridian.h, lines["low"], lines["high"], color=COLOURS["blue"], alpha=0.25, lw=0)
    axes.set_xlabel("h [mm]")
    where = "on the axis" if meridian.axial else f"at r = {meridian.r[middle]:z.1f} mm"
    axes.set_ylabel(f"{label_of(quantity)} {where}")
    return axes
