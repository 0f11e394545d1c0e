"""Plots of a symmetric flow: section through the axis, profiles across it, and the line along it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from nerif.data.meridian import Meridian
from nerif.plotting.drawing import COLOURS, add_colour_bar, colour_range, label_of, map_colours
from nerif.reconstruction.uncertainty.deviations import TAILS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_centre_line", "draw_profiles", "draw_section"]

PROFILE_HEIGHTS = (0.25, 0.5, 0.75)  # of the height of the box


def _shown(meridian: Meridian, quantity: str) -> np.ndarray:
    """The values as plotted: n as n - 1."""
    values = meridian.quantities[quantity]
    return values - 1 if quantity == "n" else values


def _banded(meridian: Meridian, quantity: str) -> Meridian:
    """The quantity as `line` and, where it has standard deviations, its band of 90 % as `low` and `high`."""
    std = meridian.quantities.get(f"{quantity}_std")
    curves = {"line": _shown(meridian, quantity)}
    if std is not None:
        for name, (percentile, deviations) in zip(("low", "high"), TAILS.items(), strict=True):
            end = meridian.quantities.get(f"{quantity}_{percentile}")
            curves[name] = curves["line"] + deviations * std if end is None else end
    return replace(meridian, quantities=curves)


def _draw(axes: Axes, at: np.ndarray, curves: dict[str, np.ndarray], colour: str, label: str = "") -> None:
    axes.plot(at, curves["line"], color=colour, lw=1, label=label)
    if "low" in curves:
        axes.fill_between(at, curves["low"], curves["high"], color=colour, alpha=0.25, lw=0)


def draw_section(axes: Axes, meridian: Meridian, quantity: str) -> Axes:
    """Draw a quantity in a plane through the axis, grey outside the box."""
    values, r, h = _shown(meridian, quantity), meridian.r, meridian.h
    if meridian.axial:
        values, r = np.concatenate([values[:, :0:-1], values], axis=1), np.concatenate([-r[:0:-1], r])
    limits = colour_range(values)
    axes.set_facecolor("0.8")
    axes.imshow(
        values, extent=(r[0], r[-1], h[0], h[-1]), origin="lower", vmin=limits[0], vmax=limits[1],
        cmap=map_colours(limits), aspect="equal", interpolation="nearest",
    )  # fmt: skip
    axes.set(xlabel="r [mm]", ylabel="h [mm]")
    add_colour_bar([axes], label_of(quantity))
    return axes


def draw_profiles(axes: Axes, meridian: Meridian, quantity: str) -> Axes:
    """Draw a quantity over r at three heights, with bands of 90 % where it has standard deviations."""
    span, curves = meridian.h[-1] - meridian.h[0], _banded(meridian, quantity)
    for share, colour in zip(PROFILE_HEIGHTS, (COLOURS["blue"], COLOURS["orange"], COLOURS["green"]), strict=True):
        height = meridian.h[0] + share * span
        profiles = {name: curves.profile(name, height) for name in curves.quantities}
        _draw(axes, meridian.r, profiles, colour, f"h = {height:z.1f} mm")
    axes.set(xlabel="r [mm]", ylabel=label_of(quantity))
    axes.legend(frameon=False)
    return axes


def draw_centre_line(axes: Axes, meridian: Meridian, quantity: str) -> Axes:
    """Draw a quantity over h at r = 0, with a band of 90 % where it has standard deviations."""
    centre = int(np.abs(meridian.r).argmin())
    curves = _banded(meridian, quantity).quantities
    _draw(axes, meridian.h, {name: values[:, centre] for name, values in curves.items()}, COLOURS["blue"])
    where = "on the axis" if meridian.axial else f"at r = {meridian.r[centre]:z.1f} mm"
    axes.set(xlabel="h [mm]", ylabel=f"{label_of(quantity)} {where}")
    return axes
