"""Editor of the flow masks of a measurement: drawn in some views, by threshold in the others."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from nicegui import ui

from nerif.app.forms.elements import dialog, html, image, refusals, select, text_html
from nerif.app.forms.form import Form
from nerif.app.forms.job_form import JobForm
from nerif.app.project.folder import OWN
from nerif.app.project.workspace import Workspace
from nerif.app.views.edits import Edits, UndoButtons
from nerif.app.views.view_maps import magnitude_address, threshold_address
from nerif.cli.commands.mask import Mask
from nerif.data.measurement import Measurement
from nerif.imaging.masks import MaskShape, write_masks

__all__ = ["MaskCard"]

Shapes = tuple[MaskShape, ...]

SETTINGS = ("threshold", "smooth", "smallest", "grow", "sigma")
TOOLS = {"polygon": "Polygon", "brush": "Brush"}
EFFECTS = {True: "Flow is here", False: "No flow here"}
STROKE = """(event) => { const me = event.currentTarget, r = me.getBoundingClientRect(), points = [];
if (event.button !== 0) return;
const add = (e) => points.push([(e.clientX - r.left) / r.width, (e.clientY - r.top) / r.height]);
event.preventDefault(); me.focus({preventScroll: true}); me.setPointerCapture(event.pointerId); add(event);
const end = (e) => { me.removeEventListener('pointermove', add); emit(points.slice(0, 2000)); };
me.addEventListener('pointermove', add); me.addEventListener('pointerup', end, {once: true}); }"""

KEYS = """(event) => { if (event.target.matches('input, textarea, select')) return;
const key = event.key.toLowerCase(), command = event.ctrlKey || event.metaKey;
let act = {'[': 'smaller', ']': 'larger'}[key];
if (!act && key === 'e' && !command && !event.altKey) act = 'effect';
if (!act && command && key === 'z') act = event.shiftKey ? 'redo' : 'undo';
if (!act && event.ctrlKey && key === 'y') act = 'redo';
if (!act) return;
event.preventDefault(); emit(act); }"""
"""Keys of the editor, active while the focus is in it: single letters must not act elsewhere (WCAG 2.1.4)."""
KEY_HELP = (
    "Keys, after a click into the image: <kbd>[</kbd> and <kbd>]</kbd> width of the brush, <kbd>E</kbd> flow or no "
    "flow, <kbd>Ctrl</kbd>+<kbd>Z</kbd> undo, <kbd>Ctrl</kbd>+<kbd>Shift</kbd>+<kbd>Z</kbd> redo."
)
GROWTH = 1.25  # of the brush, per key


@dataclass
class Brush:
    """Tool, effect and width of strokes; they stay from view to view."""

    tool: str = "polygon"  #: of TOOLS
    inside: bool = True  #: whether the flow is where it draws
    width: float | None = 8  #: of the brush, px

    def resize(self, larger: bool, limit: int) -> None:
        """Change the width by a quarter, at least by one pixel, between 1 and `limit`."""
        now = self.width or 1
        width = max(now + 1, round(now * GROWTH)) if larger else min(now - 1, round(now / GROWTH))
        self.width = min(max(width, 1), limit)


class MaskCard:
    """Mask editor, threshold settings and the run that applies them.

    Parameters
    ----------
    work : Workspace
    page : name of the page whose draft stores the shapes
    name : measurement file, relative to the project
    measurement : Measurement
    on_continue : called with the file of the masked measurement
    """

    def __init__(
        self, work: Workspace, page: str, name: str, measurement: Measurement,
        on_continue: Callable[[str], Awaitable[None]],
    ) -> None:  # fmt: skip
        self.work, self.page, self.name, self.measurement = work, page, name, measurement
        original: dict[str, Shapes] = dict.fromkeys(measurement.names, ())
        self.edits = Edits(original, _shapes, work.draft(page).get("masks", {}).get(name))
        self.brush, self._lock = Brush(), asyncio.Lock()
        self.corners: list[tuple[float, float]] = []  # of the polygon that is not closed yet
        self.view = select("View", list(measurement.names)).classes("short")
        self.view.props["aria-label"] = "View to draw in"
        with ui.element("div").classes("numbers"):
            self.undo = UndoButtons(self.edits, self._step)
            ui.button("Show the threshold's mask", icon="contrast", on_click=self._threshold).props("flat dense")
        self.place = ui.element("div").classes("stack").on("keydown", self._key, js_handler=KEYS)
        self.status = html().classes("status").props('aria-live="polite"')
        form = Form(Mask(Path(name), Path("masked.nc")), only=SETTINGS)
        self.job = JobForm(
            work, f"{page}.mask", form, self._words, "Apply the masks", SETTINGS[:1], before=self._write, subject=name,
            on_continue=on_continue,
        )  # fmt: skip
        self.view.on_value_change(self._build_editor)
        self._build_editor()

    @property
    def folder(self) -> str:
        """Folder of the drawn masks, relative to the project."""
        return f"{OWN}/masks/{self.name.removesuffix('.nc')}"

    def _words(self) -> list[str]:
        out = self.work.project.free_name(f"{self.name.removesuffix('.nc')}.masked.nc")
        return ["mask", self.name, "--out", out, *(["--drawings", self.folder] if self.edits.changes else [])]

    @property
    def _index(self) -> int:
        return self.measurement.names.index(self.view.value)

    @property
    def _shape(self) -> tuple[int, int]:
        """Height and width of the selected view, px."""
        return self.measurement.cameras[self._index].image_size

    # -- the editor ----------------------------------------------------------------------------------------------

    def _build_editor(self) -> None:
        """Build tools, image and shapes of the selected view."""
        name, brush, (height, width) = self.view.value, self.brush, self._shape
        self.corners = []
        self.place.clear()
        with self.place:
            with ui.element("div").classes("numbers"):
                tool = ui.toggle(TOOLS, value=brush.tool).props('aria-label="Tool"')
                tool.on_value_change(lambda event: setattr(brush, "tool", event.value))
                self._effect = ui.toggle(EFFECTS, value=brush.inside).props('aria-label="Effect of the shape"')
                self._effect.on_value_change(lambda event: setattr(brush, "inside", event.value))
                self._size = ui.number("Width of the brush", value=brush.width, min=1, step=1, suffix="px")
                self._size.props["aria-label"] = "Width of the brush (px)"
                self._size.on_value_change(lambda event: setattr(brush, "width", event.value))
            with ui.element("div").classes("cropper").on("pointerdown", self._stroke, js_handler=STROKE) as self._image:
                self._image.style(f"aspect-ratio: {width / height:.4f}; --aspect: {width / height:.4f}")
                self._image.props('tabindex=0 role=group aria-keyshortcuts="[ ] E Control+Z Control+Shift+Z"')
                self._image.props["aria-label"] = f"Drawing in view {name}"
                address = magnitude_address(self.measurement, self._index)
                image(address, f"Magnitude of the signal in view {name}").props("draggable=false")
                self._over = html().classes("over")
            html(f"<p>{KEY_HELP}</p>").classes("help")
            with ui.element("div").classes("numbers"):
                x, y = self._number("Column", width), self._number("Row", height)

                def add_corner() -> None:
                    self.corners.append((float(x.value or 0), float(y.value or 0)))
                    self._draw()

                for text, icon, act in (
                    ("Add a corner", "add", add_corner), ("Close the polygon", "pentagon", self._close),
                    ("Clear the view", "layers_clear", lambda: self._put(())),
                ):  # fmt: skip
                    ui.button(text, icon=icon, on_click=act).props("outline dense")
        self._draw()

    def _number(self, label: str, size: int) -> ui.number:
        control = ui.number(label, value=0, min=0, max=size - 1, step=1, suffix="px")
        control.props["aria-label"] = f"{label} of the next corner (px)"
        return control

    def _stroke(self, event: Any) -> None:
        height, width = self._shape
        points = [(x * width - 0.5, y * height - 0.5) for x, y in event.args]
        if not points:
            return
        if self.brush.tool == "brush":
            self._add("brush", points, float(self.brush.width or 0))
        else:
            self.corners.append(points[-1])
            self._draw()

    def _key(self, event: Any) -> None:
        """Do what a key of KEYS stands for."""
        if event.args in ("smaller", "larger"):
            self.brush.resize(event.args == "larger", max(self._shape))
            self._size.set_value(self.brush.width)
        elif event.args == "effect":
            self._effect.set_value(not self.brush.inside)
        elif event.args == "undo" and self.corners:
            self.corners.pop()
            self._draw()
        else:
            self.undo.step(event.args == "undo")
            focus = f"getHtmlElement({self._image.id})?.focus({{preventScroll: true}})"
            ui.run_javascript(f"setTimeout(() => {focus}, 50)")  # a new editor is on the page only then

    def _close(self) -> None:
        self._add("polygon", self.corners)

    def _add(self, kind: Any, points: Sequence[tuple[float, float]], *width: float) -> None:
        with refusals():
            shape = MaskShape(kind, tuple(points), bool(self.brush.inside), *width)
            self._put((*self.edits.now[self.view.value], shape))

    def _put(self, shapes: Shapes) -> None:
        self.corners = []
        self.edits.put(self.view.value, shapes)
        self._draw()
        self._store()

    def _step(self, view: str) -> None:
        if view == self.view.value:
            self._draw()  # a new editor would lose the focus, and the next key
        else:
            self.view.set_value(view)
        self._store()

    def _draw(self) -> None:
        """Draw the shapes and the open polygon, and name the views that have shapes."""
        height, width = self._shape
        shapes = "".join(map(_svg, self.edits.now[self.view.value]))
        dots = "".join(f"<circle cx={x:.2f} cy={y:.2f} r={width / 120:.2f} />" for x, y in self.corners)
        path = " ".join(f"{x:.2f},{y:.2f}" for x, y in self.corners)
        draft = f"<g class=draft><polyline points='{path}' />{dots}</g>" if self.corners else ""
        box = f"-0.5 -0.5 {width} {height}"
        self._over.set_content(f"<svg viewBox='{box}' preserveAspectRatio=none aria-hidden=true>{shapes}{draft}</svg>")
        self.status.set_content(escape(f"Drawn in {', '.join(self.edits.changes) or 'no view'}."))

    # -- masks ---------------------------------------------------------------------------------------------------

    def _store(self) -> None:
        """Store the shapes in the draft and as the images that `nerif mask` reads."""
        draft = self.work.draft(self.page)
        masks = {**draft.get("masks", {}), self.name: self.edits.draft}
        self.work.keep(self.page, {**draft, "masks": masks})
        self.job.show()
        self.undo.show()

        async def write() -> None:
            with refusals():
                await self._write()

        ui.timer(0.0, write, once=True)

    async def _write(self) -> None:
        """Write the masks as images in a thread, one write at a time."""
        async with self._lock:
            drawings, folder = self.edits.changes, self.work.project.path(self.folder)
            sizes = {camera.name: camera.image_size for camera in self.measurement.cameras}

            def work() -> None:
                for old in folder.glob("*.png"):  # also those of views that have no shapes any more
                    old.unlink()
                if drawings:
                    write_masks(folder, drawings, sizes)

            await self.work.in_thread(work)

    async def _threshold(self) -> None:
        with refusals():
            record: Mask = self.job.view.record()
            what = self.measurement, self._index, record.masks, record.sigma
            address = await self.work.in_thread(threshold_address, *what)
            with dialog():
                text_html(f"Threshold mask of view {self.view.value}; white: flow", "h3")
                image(address, "Threshold mask").style("width: min(70vw, 600px); image-rendering: pixelated")


def _svg(shape: MaskShape) -> str:
    points, kind = " ".join(f"{x:.2f},{y:.2f}" for x, y in shape.points), "flow" if shape.inside else "none"
    if shape.kind == "polygon":
        return f"<polygon class={kind} points='{points}' />"
    if len(shape.points) == 1:
        (x, y), r = shape.points[0], shape.width / 2
        return f"<circle class='{kind} dot' cx={x:.2f} cy={y:.2f} r={r:.2f} />"
    return f"<polyline class='{kind} brush' stroke-width={shape.width:.2f} points='{points}' />"


def _shapes(entries: Sequence[Mapping[str, Any]]) -> Shapes:
    """Return shapes from their entries in the draft."""
    points = (tuple((float(x), float(y)) for x, y in shape["points"]) for shape in entries)
    return tuple(MaskShape(**{**shape, "points": corners}) for shape, corners in zip(entries, points, strict=True))
