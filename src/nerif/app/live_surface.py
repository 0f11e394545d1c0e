"""The isosurface of a field that is being found, which sharpens from look to look."""

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

__all__ = ["LiveSurface", "said_of"]

COLOUR = "#4aa3dd"
SIZE = (1080, 380)


class LiveSurface:
    """A scene with the surface of the last look, where the page is being built; empty before the first one."""

    def __init__(self) -> None:
        self.place = ui.element("figure").classes("live-surface")
        self._scene: BoxScene | None = None
        self._shown: list[Any] = []

    def forget(self) -> None:
        """Show nothing: another run is followed."""
        self.place.clear()
        self._scene, self._shown = None, []

    def show(self, name: str, stamp: int, box: Box, lines: str) -> None:
        """Show the surface of a look.

        Parameters
        ----------
        name : of the result directory, relative to the project
        stamp : that changes with each look
        box : mm
        lines : description of the view
        """
        if self._scene is None or self._scene.box != box:
            self.forget()
            with self.place:
                self._scene = BoxScene(box, lines, SIZE)
                self._caption = ui.html("", sanitize=False)
        for surface in self._shown[:-1]:  # the last one stays until this one is there
            surface.delete()
        self._shown = [*self._shown[-1:], self._scene.add(live_address(name, stamp), COLOUR)]
        self._scene.name(f"{lines} Drag to turn, scroll to come nearer.")
        self._caption.set_content(f"<figcaption>{escape(lines)}</figcaption>")


def said_of(look: Look) -> str:
    """Return in words where the isosurface of a look is."""
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
