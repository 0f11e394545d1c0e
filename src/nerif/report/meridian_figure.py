"""What a symmetric flow looks like: its section beside and beyond the axis, profiles across it and along it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nerif.drawing import COLOURS, add_colour_bar, colour_range, label_of, map_colours
from nerif.meridian import Meridian
from nerif.reconstruction.trials import TAILS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_centre_line", "draw_profiles", "draw_section"]

HEIGHTS = (0.25, 0.5, 0.75)  # shares of the height of the box, of profiles
WIDE = TAILS["p95"]  # standard deviations on either side of a band of 90 %


def _shown(meridian: Meridian, quantity: str) -> np.ndarray:
    """The values as they are shown: n as n - 1."""
    values = meridian.quantities[quantity]
    return values - 1 if quantity == "n" else values


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
    span = meridian.h[-1] - meridian.h[0]
    std = f"{quantity}_std"
    for share, colour in zip(HEIGHTS, (COLOURS["blue"], COLOURS["orange"], COLOURS["green"]), strict=True):
        height = meridian.h[0] + share * span
        line = meridian.profile(quantity, height) - (quantity == "n")
        axes.plot(meridian.r, line, color=colour, lw=1, label=f"h = {height:z.1f} mm")
        if std in meridian.quantities:
            beside = WIDE * meridian.profile(std, height)
            axes.fill_between(meridian.r, line - beside, line + beside, color=colour, alpha=0.25, lw=0)
    axes.set_xlabel("r [mm]")
    axes.set_ylabel(label_of(quantity))
    axes.legend(frameon=False)
    return axes


def draw_centre_line(axes: Axes, meridian: Meridian, quantity: str) -> Axes:
    """Draw a quantity on the axis, with a band that holds 90 % where there are standard deviations."""
    middle = int(np.abs(meridian.r).argmin())
    line = _shown(meridian, quantity)[:, middle]
    axes.plot(meridian.h, line, color=COLOURS["blue"], lw=1)
    if f"{quantity}_std" in meridian.quantities:
        beside = WIDE * meridian.quantities[f"{quantity}_std"][:, middle]
        axes.fill_between(meridian.h, line - beside, line + beside, color=COLOURS["blue"], alpha=0.25, lw=0)
    axes.set_xlabel("h [mm]")
    axes.set_ylabel(f"{label_of(quantity)} on the axis")
    return axes
