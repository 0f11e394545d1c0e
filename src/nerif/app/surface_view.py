"""Isosurfaces of one or two volumes in a 3-D scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from nicegui import ui

from nerif.app.box_scene import BoxScene
from nerif.app.range_slider import RangeSlider
from nerif.app.result_answers import surface_address
from nerif.geometry import Box

__all__ = ["Surface", "SurfaceView"]

STEPS = 100  # of the slider
COLOURS = (("#4aa3dd", 1.0), ("#e8853a", 0.55))  # and opacity


@dataclass(frozen=True)
class Surface:
    """Source of an isosurface.

    Parameters
    ----------
    name : result or film, relative to the project
    frame : frame of a film
    stamp : value that changes with the file
    """

    name: str
    frame: int
    stamp: int


class SurfaceView:
    """A scene with a slider for the level.

    Parameters
    ----------
    quantity : name of the quantity
    unit : unit of the level
    limits : ends of the slider
    level : initial level
    box : box of the volume, mm
    """

    def __init__(self, quantity: str, unit: str, limits: tuple[float, float], level: float, box: Box) -> None:
        self.quantity, self.limits = quantity, limits
        self.surfaces: Sequence[Surface] = ()
        low, high = limits
        step = round((level - low) / ((high - low) or 1.0) * STEPS)

        async def move(_: int) -> None:
            self._draw()

        label = f"Level{f', {unit}' if unit else ''}"
        self._slider = RangeSlider(label, STEPS, min(max(step, 1), STEPS - 1), self._text, move, on_release=True)
        self._legend = ui.html("", sanitize=False)
        self.scene = BoxScene(box, "Isosurface; drag to turn, scroll to zoom")

    @property
    def level(self) -> float:
        """The current level, in the unit of the quantity."""
        low, high = self.limits
        return low + (high - low) * self._slider.value / STEPS

    def _text(self, step: int) -> str:
        low, high = self.limits
        return f"{low + (high - low) * step / STEPS:.4g}"

    def show(self, surfaces: Sequence[Surface]) -> None:
        """Replace the surfaces."""
        self.surfaces = surfaces
        self._draw()

    def _draw(self) -> None:
        self.scene.clear()
        for surface, (colour, opacity) in zip(self.surfaces, COLOURS, strict=False):
            address = surface_address(surface.name, self.quantity, self.level, surface.frame, surface.stamp)
            self.scene.add(address, colour, opacity)
        names = "".join(
            f"<li><i style='background:{colour};opacity:{opacity}'></i>{escape(surface.name)}</li>"
            for surface, (colour, opacity) in zip(self.surfaces, COLOURS, strict=False)
        )
        self._legend.set_content(f"<ul class=legend>{names}</ul>")
