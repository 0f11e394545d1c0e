"""Isosurfaces of one or two volumes in their box, to be turned with the mouse."""

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
COLOURS = (("#4aa3dd", 1.0), ("#e8853a", 0.55))  # and how opaque


@dataclass(frozen=True)
class Surface:
    """What an isosurface is of.

    Parameters
    ----------
    name : of the result or film, relative to the project
    frame : of a film
    stamp : that changes with its file
    """

    name: str
    frame: int
    stamp: int


class SurfaceView:
    """A scene with a slider for the level.

    Parameters
    ----------
    quantity : name of it
    unit : of the level
    limits : ends of the slider
    level : to begin with
    box : of the volume, mm
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
        self._named = ui.html("", sanitize=False)
        # named for those who do not see it: what it shows is in the slices too
        self.scene = BoxScene(box, "Isosurface; drag to turn, scroll to come nearer")

    @property
    def level(self) -> float:
        """The level, in the unit of the quantity."""
        low, high = self.limits
        return low + (high - low) * self._slider.value / STEPS

    def _text(self, step: int) -> str:
        low, high = self.limits
        return f"{low + (high - low) * step / STEPS:.4g}"

    def show(self, surfaces: Sequence[Surface]) -> None:
        """Show the surfaces of these from now on."""
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
        self._named.set_content(f"<ul class=legend>{names}</ul>")
