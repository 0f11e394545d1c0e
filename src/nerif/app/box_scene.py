"""A box with surfaces in it, in 3D, turned with the mouse."""

from __future__ import annotations

from typing import Any

from nicegui import ui

from nerif.geometry import Box

__all__ = ["BoxScene"]

SIZE = 4.0  # longest edge of the box, in scene units
GROUND = "#eef1f4"
EDGE = "#76838f"


class BoxScene:
    """A 3D scene, added to the page under construction.

    Parameters
    ----------
    box : mm
    label : description for screen readers
    size : width and height, px
    """

    def __init__(self, box: Box, label: str, size: tuple[int, int] = (1080, 480)) -> None:
        self.box, self._scale = box, SIZE / max(box.edges)
        camera = ui.scene.perspective_camera(fov=38)
        self.scene = ui.scene(width=size[0], height=size[1], grid=False, camera=camera, background_color=GROUND)
        self.scene.classes("surface").props("role=img")
        self.name(label)
        self.scene.move_camera(6.0, -6.9, 3.9, 0, 0, -0.3, duration=0)
        self._edges()

    def name(self, label: str) -> None:
        """Describe the scene for screen readers."""
        if self.scene.props.get("aria-label") != label:
            self.scene.props["aria-label"] = label
            self.scene.update()

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
        lower, upper, centre = self.box.lower, self.box.upper, self.box.centre
        corners = [
            [((upper if i >> a & 1 else lower)[a] - centre[a]) * self._scale for a in range(3)] for i in range(8)
        ]
        with self.scene:
            for i in range(8):
                for a in range(3):
                    if not i >> a & 1:
                        self.scene.line(corners[i], corners[i | 1 << a]).material(EDGE)
