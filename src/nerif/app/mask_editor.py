"""Editor of the flow mask of one view: polygons and brush strokes, by pointer or by typed coordinates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui

from nerif.app.elements import refusals
from nerif.app.mask_edits import MaskEdits
from nerif.imaging.masks import MaskShape

__all__ = ["MaskEditor"]

TOOLS = {"polygon": "Polygon", "brush": "Brush"}
EFFECTS = {True: "Flow is here", False: "No flow here"}
STROKE = """(event) => { const me = event.currentTarget, r = me.getBoundingClientRect(), points = [];
if (event.button !== 0) return;
const add = (e) => points.push([(e.clientX - r.left) / r.width, (e.clientY - r.top) / r.height]);
event.preventDefault(); me.setPointerCapture(event.pointerId); add(event);
const end = (e) => { me.removeEventListener('pointermove', add); emit(points.slice(0, 2000)); };
me.addEventListener('pointermove', add); me.addEventListener('pointerup', end, {once: true}); }"""


class MaskEditor:
    """Tools, the image of the view and the shapes over it.

    Parameters
    ----------
    name : name of the view
    shape : height and width, px
    address : address of its image
    edits : shapes of all views, changed in place
    changed : called after each step
    """

    def __init__(
        self, name: str, shape: tuple[int, int], address: str, edits: MaskEdits, changed: Callable[[], None]
    ) -> None:
        self.name, self.shape, self.edits, self._changed = name, shape, edits, changed
        self.corners: list[tuple[float, float]] = []
        height, width = shape
        with ui.element("div").classes("numbers"):
            self._tool = ui.toggle(TOOLS, value="polygon").props('no-caps aria-label="Tool"')
            self._inside = ui.toggle(EFFECTS, value=True).props('no-caps aria-label="Effect of the shape"')
            self._width = ui.number("Width of the brush", value=8, min=1, step=1, suffix="px").props("outlined dense")
            self._width.props["aria-label"] = "Width of the brush (px)"
        with ui.element("div").classes("cropper").on("pointerdown", self._stroke, js_handler=STROKE) as place:
            place.style(f"aspect-ratio: {width / height:.4f}; --aspect: {width / height:.4f}")
            image = ui.element("img").props("draggable=false")
            image.props["src"], image.props["alt"] = address, f"Magnitude of the signal in view {name}"
            self._over = ui.html("", sanitize=False).classes("over")
        with ui.element("div").classes("numbers"):
            self._x, self._y = self._number("Column", width), self._number("Row", height)
            self._button("Add a corner", "add", self._typed)
            self._button("Close the polygon", "pentagon", self._close)
            self._button("Clear the view", "layers_clear", lambda: self._put(()))
        self.show()

    def _number(self, label: str, size: int) -> ui.number:
        control = ui.number(label, value=0, min=0, max=size - 1, step=1, suffix="px").props("outlined dense")
        control.props["aria-label"] = f"{label} of the next corner (px)"
        return control

    def _button(self, label: str, icon: str, act: Callable[[], None]) -> None:
        ui.button(label, icon=icon, on_click=lambda: act()).props("outline no-caps dense")

    def _stroke(self, event: Any) -> None:
        height, width = self.shape
        points = [(x * width - 0.5, y * height - 0.5) for x, y in event.args]
        if not points:
            return
        if self._tool.value == "brush":
            with refusals():
                brush = MaskShape("brush", tuple(points), bool(self._inside.value), float(self._width.value or 0))
                self._put((*self.edits.shapes[self.name], brush))
            return
        self.corners.append(points[-1])
        self.show()

    def _typed(self) -> None:
        self.corners.append((float(self._x.value or 0), float(self._y.value or 0)))
        self.show()

    def _close(self) -> None:
        with refusals():
            polygon = MaskShape("polygon", tuple(self.corners), bool(self._inside.value))
            self._put((*self.edits.shapes[self.name], polygon))

    def _put(self, shapes: tuple[MaskShape, ...]) -> None:
        self.corners = []
        self.edits.put(self.name, shapes)
        self.show()
        self._changed()

    def show(self) -> None:
        """Draw the shapes and the open polygon."""
        height, width = self.shape
        shapes = "".join(map(_svg, self.edits.shapes[self.name]))
        dots = "".join(f"<circle cx={x:.2f} cy={y:.2f} r={width / 120:.2f} />" for x, y in self.corners)
        path = " ".join(f"{x:.2f},{y:.2f}" for x, y in self.corners)
        draft = f"<g class=draft><polyline points='{path}' />{dots}</g>" if self.corners else ""
        box = f"-0.5 -0.5 {width} {height}"
        self._over.set_content(f"<svg viewBox='{box}' preserveAspectRatio=none aria-hidden=true>{shapes}{draft}</svg>")


def _svg(shape: MaskShape) -> str:
    points, kind = " ".join(f"{x:.2f},{y:.2f}" for x, y in shape.points), "flow" if shape.inside else "none"
    if shape.kind == "polygon":
        return f"<polygon class={kind} points='{points}' />"
    if len(shape.points) == 1:
        (x, y), r = shape.points[0], shape.width / 2
        return f"<circle class='{kind} dot' cx={x:.2f} cy={y:.2f} r={r:.2f} />"
    return f"<polyline class='{kind} brush' stroke-width={shape.width:.2f} points='{points}' />"
