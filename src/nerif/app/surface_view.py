"""Isosurfaces of one or two volumes in their box, to be turned with the mouse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from nicegui import ui

from nerif.app.range_slider import RangeSlider
from nerif.app.result_answers import surface_address
from nerif.geometry import Box

__all__ = ["Surface", "SurfaceView"]

STEPS = 100  # of the slider
SIZE = 4.0  # of the longest edge of the box in the scene
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
        self.quantity, self.box, self.limits = quantity, box, limits
        self.surfaces: Sequence[Surface] = ()
        low, high = limits
        step = round((level - low) / ((high - low) or 1.0) * STEPS)

        async def move(_: int) -> None:
            self._draw()

        label = f"Level{f', {unit}' if unit else ''}"
        self._slider = RangeSlider(label, STEPS, min(max(step, 1), STEPS - 1), self._text, move, settled=True)
        self._named = ui.html("", sanitize=False)
        camera = ui.scene.perspective_camera(fov=38)
        # named for those who do not see it: what it shows is in the slices too
        self.scene = ui.scene(width=1080, height=480, grid=False, camera=camera, background_color="#eef1f4")
        self.scene.classes("surface").props('role=img aria-label="Isosurface; drag to turn, scroll to come nearer"')
        self.scene.move_camera(6.0, -6.9, 3.9, 0, 0, -0.3, duration=0)

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
        scale = SIZE / max(self.box.edges)
        self.scene.clear()
        with self.scene:
            lower, upper = self.box.lower, self.box.upper
            corners = [
                [(upper if i >> a & 1 else lower)[a] * scale - self.box.centre[a] * scale for a in range(3)]
                for i in range(8)
            ]
            for i in range(8):
                for a in range(3):
                    if not i >> a & 1:
                        self.scene.line(corners[i], corners[i | 1 << a]).material("#76838f")
            for surface, (colour, opacity) in zip(self.surfaces, COLOURS, strict=False):
                address = surface_address(surface.name, self.quantity, self.level, surface.frame, surface.stamp)
                x, y, z = (-c * scale for c in self.box.centre)
                self.scene.stl(address).material(colour, opacity, side="both").scale(scale).move(x, y, z)
        names = "".join(
            f"<li><i style='background:{colour};opacity:{opacity}'></i>{escape(surface.name)}</li>"
            for surface, (colour, opacity) in zip(self.surfaces, COLOURS, strict=False)
        )
        self._named.set_content(f"<ul class=legend>{names}</ul>")
