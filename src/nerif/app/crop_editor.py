"""Editor of a view's crop: drawn with the mouse or typed, with rotation and flip."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import replace
from html import escape
from typing import Any

from nicegui import ui

from nerif.app.elements import refusals, select
from nerif.imaging.readers.crop import Crop

__all__ = ["CropEditor"]

FLIPS = {"": "None", "horizontal": "Left and right", "vertical": "Top and bottom", "both": "Both"}
TURNS = {0: "0°", 90: "90° left", 180: "180°", 270: "90° right"}
LEAST = 4  # px along an edge drawn with the mouse: less is a slip of the hand
NUMBERS = {"column": "Left", "row": "Top", "width": "Width", "height": "Height"}
DRAG = """(event) => { const me = event.currentTarget, r = me.getBoundingClientRect(), mark = me.querySelector('.mark');
const at = (e) => [Math.min(Math.max((e.clientX - r.left) / r.width, 0), 1),
  Math.min(Math.max((e.clientY - r.top) / r.height, 0), 1)];
if (event.button !== 0) return;
event.preventDefault(); me.setPointerCapture(event.pointerId); const from = at(event);
const corners = (e) => { const to = at(e); return [Math.min(from[0], to[0]), Math.min(from[1], to[1]),
  Math.max(from[0], to[0]), Math.max(from[1], to[1])]; };
const move = (e) => { const [a, b, c, d] = corners(e); Object.assign(mark.style,
  {left: 100 * a + '%', top: 100 * b + '%', width: 100 * (c - a) + '%', height: 100 * (d - b) + '%'}); };
const end = (e) => { me.removeEventListener('pointermove', move); emit(corners(e)); };
me.addEventListener('pointermove', move); me.addEventListener('pointerup', end, {once: true}); }"""


class CropEditor:
    """Controls of one view's crop, added to the page under construction.

    Parameters
    ----------
    name : name of the view
    shape : (height, width) of its frames, px
    crop : initial crop
    address : address of the image of the whole frame
    on_change : called with the new crop
    """

    def __init__(
        self, name: str, shape: tuple[int, int], crop: Crop, address: str, on_change: Callable[[Crop], Awaitable[None]]
    ) -> None:
        self.shape, self.crop, self._on_change = shape, crop, on_change
        height, width = shape
        with ui.element("div").classes("cropper").on("pointerdown", self._on_drag, js_handler=DRAG) as place:
            place.style(f"aspect-ratio: {width / height:.4f}; --aspect: {width / height:.4f}")
            image = ui.element("img").props("draggable=false")
            image.props["src"], image.props["alt"] = address, f"Whole frame of {name}"
            self._mark = ui.element("div").classes("mark")
        with ui.element("div").classes("numbers"):
            self._numbers = {key: self._number(key, text) for key, text in NUMBERS.items()}
            self._flip = self._choice("Flip", FLIPS, "flip")
            self._rotate = self._choice("Rotate", TURNS, "rotate")
        self._error = ui.html("", sanitize=False).classes("error")
        self._show()

    def _number(self, key: str, text: str) -> ui.number:
        low = 0 if key in ("row", "column") else 1
        control = ui.number(text, value=0, min=low, step=1, suffix="px").props("outlined dense debounce=250")
        control.props(f'name="{key}" aria-label="{text} (px)"')

        async def update() -> None:
            value = control.value
            if value is None or int(value) == self._value(key):
                return
            await self._put(**{key: int(value)})

        return control.on_value_change(update)

    def _choice(self, label: str, options: dict[Any, str], key: str) -> ui.select:
        control = select(label, options, getattr(self.crop, key))

        async def update() -> None:
            if control.value != getattr(self.crop, key):
                await self._put(**{key: control.value})

        return control.on_value_change(update)

    def _value(self, key: str) -> int:
        """Return the value of a number control: a crop size of 0 reaches to the edge."""
        value = int(getattr(self.crop, key))
        whole = {"width": self.shape[1] - self.crop.column, "height": self.shape[0] - self.crop.row}
        return value or whole.get(key, 0)

    async def _on_drag(self, event: Any) -> None:
        height, width = self.shape
        left, top, right, bottom = event.args
        column, row = round(left * width), round(top * height)
        size = {"width": round(right * width) - column, "height": round(bottom * height) - row}
        if min(size.values()) < LEAST:
            self._show()
            return
        await self._put(row=row, column=column, **size)

    async def _put(self, **values: Any) -> None:
        """Change the crop if it is valid, or show the error."""
        errors: list[str] = []
        with refusals(errors.append):
            crop = replace(self.crop, **values)
            crop.shape_of(self.shape)
            self.crop = crop
        self._error.set_content("")
        if errors:
            text = errors[0].removeprefix("crop: ")
            self._error.set_content(f"<span role=alert>{escape(text[:1].upper() + text[1:])}</span>")
            return
        self._show()
        await self._on_change(self.crop)

    def put(self, crop: Crop) -> None:
        """Show another crop."""
        self.crop = crop
        self._error.set_content("")
        self._show()

    def _show(self) -> None:
        for key, control in self._numbers.items():
            control.set_value(self._value(key))
        self._flip.set_value(self.crop.flip)
        self._rotate.set_value(self.crop.rotate)
        height, width = self.shape
        self._mark.style(
            replace=f"left: {100 * self.crop.column / width:.3f}%; top: {100 * self.crop.row / height:.3f}%; "
            f"width: {100 * self._value('width') / width:.3f}%; height: {100 * self._value('height') / height:.3f}%"
        )
        self._mark.update()
