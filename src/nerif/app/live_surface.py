"""Isosurface of the present field of a reconstruction in progress."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np
from nicegui import ui

from nerif.app.box_scene import BoxScene
from nerif.app.result_answers import live_address
from nerif.common.conventions import unit_shown
from nerif.data.volume import describe, name_of
from nerif.geometry import Box
from nerif.report.isosurface import default_level, surface_triangles
from nerif.results.live import Look

__all__ = ["LiveSurface", "caption_of"]

COLOUR = "#4aa3dd"
SIZE = (1080, 380)


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
        """Show the surface of a look.

        Parameters
        ----------
        name : result directory, relative to the project
        stamp : number that changes with each look
        box : mm
        caption : description of the surface
        """
        if self._scene is None or self._scene.box != box:
            self.clear()
            with self.place:
                self._scene = BoxScene(box, caption, SIZE)
                self._caption = ui.html("", sanitize=False)
        for surface in self._surfaces[:-1]:  # the previous one stays until the new one is loaded
            surface.delete()
        self._surfaces = [*self._surfaces[-1:], self._scene.add(live_address(name, stamp), COLOUR)]
        self._scene.name(f"{caption} Drag to turn, scroll to zoom.")
        self._caption.set_content(f"<figcaption>{escape(caption)}</figcaption>")


def caption_of(look: Look) -> str:
    """Return the level and extent of the isosurface of a look as text."""
    volume = look.volume
    level = default_level(volume)
    corners = surface_triangles(volume, level).reshape(-1, 3)
    unit = unit_shown(describe(look.quantity)[0])
    head = f"Isosurface of {name_of(look.quantity)} at {level:.2g} {unit}".rstrip()
    if not len(corners):
        return f"{head}: nowhere yet."
    ends = zip("xyz", np.min(corners, axis=0), np.max(corners, axis=0), strict=True)
    spans = ", ".join(f"{axis} from {low:.0f} to {high:.0f}" for axis, low, high in ends)
    return f"{head}, {spans} mm, after {look.seconds:.0f} s."
