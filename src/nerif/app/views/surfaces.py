"""Isosurfaces in a 3-D scene: of one or two volumes, and of the present field of a reconstruction in progress."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from nicegui import ui

from nerif.app.forms.elements import html
from nerif.app.forms.sliders import RangeSlider
from nerif.app.views.routes import bodies_address, live_address, surface_address
from nerif.common.conventions import unit_shown
from nerif.data.quantity_names import describe, name_of
from nerif.geometry import Box
from nerif.report.isosurface import default_level, surface_triangles
from nerif.report.rig_figure import box_edges
from nerif.results.live import LiveSnapshot

__all__ = ["LiveSurface", "Surface", "SurfaceView", "caption_of", "scene_of"]

SIZE = 4.0  # longest edge of the box, in scene units
LIVE_SIZE = (1080, 380)
GROUND = "#eef1f4"
EDGE = "#76838f"
BODY = "#8b949e"
STEPS = 100  # of the slider
COLOURS = (("#4aa3dd", 1.0), ("#e8853a", 0.55))  # and opacity


def scene_of(label: str, width: int, height: int) -> ui.scene:
    """Build an empty scene.

    Parameters
    ----------
    label : description for screen readers
    width, height : px
    """
    camera = ui.scene.perspective_camera(fov=38)
    scene = ui.scene(width=width, height=height, grid=False, camera=camera, background_color=GROUND)
    scene.classes("surface").props("role=img").props["aria-label"] = label
    return scene


class BoxScene:
    """A box with surfaces in it, turned with the mouse; added to the page under construction.

    Parameters
    ----------
    box : mm
    label : description for screen readers
    size : width and height, px
    """

    def __init__(self, box: Box, label: str, size: tuple[int, int] = (1080, 480)) -> None:
        self.box, self._scale = box, SIZE / max(box.edges)
        self.scene = scene_of(label, *size)
        self.scene.move_camera(6.0, -6.9, 3.9, 0, 0, -0.3, duration=0)
        self._edges()

    def clear(self) -> None:
        """Remove all surfaces; the box stays."""
        self.scene.clear()
        self._edges()

    def add(self, address: str, colour: str, opacity: float = 1.0) -> Any:
        """Add a surface, an STL file in mm, and return it; its `delete` removes it."""
        with self.scene:
            surface = self.scene.stl(address).material(colour, opacity, side="both").scale(self._scale)
            return surface.move(*(-c * self._scale for c in self.box.centre))

    def _edges(self) -> None:
        ends = (box_edges(self.box) - self.box.centre) * self._scale
        with self.scene:
            for a, b in ends.tolist():
                self.scene.line(a, b).material(EDGE)


@dataclass(frozen=True)
class Surface:
    """Source of an isosurface."""

    name: str  #: result or film, relative to the project
    title: str  #: its name for display
    frame: int  #: frame of a film
    stamp: int  #: value that changes with the file
    bodies: bool = False  #: whether there are bodies in its flow


class SurfaceView:
    """Surfaces in a scene with a slider for their level.

    Parameters
    ----------
    surfaces : sources of one or two surfaces
    quantity : name of the quantity
    unit : unit of the level
    limits : ends of the slider
    level : initial level
    box : box of the volume, mm
    """

    def __init__(
        self, surfaces: Sequence[Surface], quantity: str, unit: str, limits: tuple[float, float], level: float, box: Box
    ) -> None:
        self.surfaces, self.quantity, self.limits = surfaces, quantity, limits
        low, high = limits
        step = round((level - low) / ((high - low) or 1.0) * STEPS)

        async def move(_: int) -> None:
            self._draw()

        self._slider = RangeSlider(
            f"Level{f', {unit}' if unit else ''}", STEPS, min(max(step, 1), STEPS - 1),
            lambda step: f"{self._level(step):.4g}", move, on_release=True,
        )  # fmt: skip
        self._legend = html()
        self.scene = BoxScene(box, "Isosurface; drag to turn, scroll to zoom")
        self._draw()

    def _level(self, step: int) -> float:
        """The level of a step of the slider, in the unit of the quantity."""
        low, high = self.limits
        return low + (high - low) * step / STEPS

    def _draw(self) -> None:
        self.scene.clear()
        names, level = "", self._level(self._slider.value)
        for surface, (colour, opacity) in zip(self.surfaces, COLOURS, strict=False):
            address = surface_address(surface.name, self.quantity, level, surface.frame, surface.stamp)
            self.scene.add(address, colour, opacity)
            style = f"background:{colour};opacity:{opacity}"
            names += f"<li><i style='{style}'></i>{escape(surface.title)}</li>"
        if self.surfaces and self.surfaces[0].bodies:
            self.scene.add(bodies_address(self.surfaces[0].name, self.surfaces[0].stamp), BODY)
        self._legend.set_content(f"<ul class=legend>{names}</ul>")


class LiveSurface:
    """A scene with the latest isosurface, added to the page under construction; empty before the first one."""

    def __init__(self) -> None:
        self.place = ui.element("figure").classes("live-surface")
        self._scene: BoxScene | None = None
        self._surfaces: list[Any] = []

    def clear(self) -> None:
        """Remove the scene."""
        self.place.clear()
        self._scene, self._surfaces = None, []

    def show(self, name: str, stamp: int, box: Box, caption: str) -> None:
        """Show the surface of a snapshot.

        Parameters
        ----------
        name : result directory, relative to the project
        stamp : number that changes with each snapshot
        box : mm
        caption : description of the surface
        """
        if self._scene is None or self._scene.box != box:
            self.clear()
            with self.place:
                self._scene = BoxScene(box, caption, LIVE_SIZE)
                self._caption = html()
        for surface in self._surfaces[:-1]:  # the previous one stays until the new one is loaded
            surface.delete()
        self._surfaces = [*self._surfaces[-1:], self._scene.add(live_address(name, stamp), COLOURS[0][0])]
        self._scene.scene.props["aria-label"] = f"{caption} Drag to turn, scroll to zoom."
        self._caption.set_content(f"<figcaption>{escape(caption)}</figcaption>")


def caption_of(snapshot: LiveSnapshot) -> str:
    """Return the level and extent of the isosurface of a snapshot as text."""
    volume = snapshot.volume
    level = default_level(volume)
    corners = surface_triangles(volume, level).reshape(-1, 3)
    unit = unit_shown(describe(snapshot.quantity)[0])
    head = f"Isosurface of {name_of(snapshot.quantity)} at {level:.2g} {unit}".rstrip()
    if not len(corners):
        return f"{head}: nowhere yet."
    ends = zip("xyz", np.min(corners, axis=0), np.max(corners, axis=0), strict=True)
    spans = ", ".join(f"{axis} from {low:.0f} to {high:.0f}" for axis, low, high in ends)
    return f"{head}, {spans} mm, after {snapshot.seconds:.0f} s."
