"""Editor of a view's crop: drawn with the mouse or typed, with rotation and flip; beside it the images as used."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from html import escape
from typing import Any

from nicegui import ui

from nerif.app.forms.elements import card, html, image, refusals, select, text_html
from nerif.app.project.workspace import Workspace
from nerif.app.views.edits import Edits, UndoButtons
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.views import View, write_crops

__all__ = ["SOURCES", "CropCard"]

SOURCES = ("reference", "flow")
LARGE = 900  # px
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
CHANGE = """const b = %s.closest('.blink'); const other = b.classList.toggle('other');
b.querySelector('.current').textContent = other ? 'Flow' : 'Reference';"""
SPACE = f"(event) => {{ if (event.key === ' ') {{ event.preventDefault(); {CHANGE % 'event.currentTarget'} }} }}"
CLICK = f"(event) => {{ {CHANGE % 'event.currentTarget'} }}"
# with prefers-reduced-motion there is no timer; the button and the key remain
CLOCK = f"""(event) => {{ const me = event.currentTarget, box = me.closest('.blink');
const stop = () => {{ clearInterval(box.clock); box.clock = 0; me.setAttribute('aria-pressed', 'false'); }};
if (box.clock) {{ stop(); return; }}
if (matchMedia('(prefers-reduced-motion: reduce)').matches) {{
  box.querySelector('.calm').textContent = 'Reduced motion is set: use Change or the space key.'; return; }}
me.setAttribute('aria-pressed', 'true');
box.clock = setInterval(() => {{ if (!box.isConnected) {{ stop(); return; }}
  {CHANGE % "box.querySelector('.both')"} }}, 600);
}}"""


class CropCard:
    """One view in large: its whole frame with the editor of the crop, and its images as they are used.

    Parameters
    ----------
    work : workspace of the project
    on_change : called when a crop or the selected view has changed
    on_save : called when the crops have been written
    """

    def __init__(self, work: Workspace, on_change: Callable[[], None], on_save: Callable[[], Awaitable[None]]) -> None:
        self.work, self._on_change, self._on_save = work, on_change, on_save
        self._request = 0
        self._first: dict[str, int] = {}
        self._shape = (0, 0)  # height and width of the frames of the selected view, px
        self._place = ui.element("div").classes("crop-card")
        self.load("", {}, {}, "")

    def load(self, experiment: str, views: Mapping[str, View], draft: Mapping[str, Any], selection: str) -> None:
        """Take the views of an experiment; `show` shows the selected one.

        Parameters
        ----------
        experiment : folder, relative to the project
        views : its views by name
        draft : draft of the edits
        selection : name of a view; another name selects the first
        """
        self.experiment, self.views = experiment, views
        self.edits = Edits({name: view.crop or Crop() for name, view in views.items()}, lambda c: Crop(**c), draft)
        self.selection = selection if selection in views else next(iter(views), "")

    @property
    def crop(self) -> Crop:
        """The crop of the selected view."""
        return self.edits.now[self.selection]

    async def show(self) -> None:
        """Show the selected view."""
        self._request += 1
        request, view = self._request, self.views.get(self.selection)
        self._place.clear()
        if view is None:
            return
        messages: list[str] = []
        first: dict[str, int] = {}
        shape, address = (0, 0), ""
        for source in SOURCES:
            with refusals(messages.append):
                quality = await self.work.in_thread(self.work.files.quality, view, source)
                first[source] = quality.first
                if not address:
                    address = await self.work.in_thread(self.work.files.image, view, source, quality.first, LARGE, None)
                    shape = quality.frame_shape
        if request != self._request:  # another view has been selected meanwhile
            return
        self._first, self._shape = first, shape
        with self._place, card(view.name, "Drag over the whole frame to crop it, or type; the result is on the right."):
            if not address:
                text_html("There is no image to show: " + " ".join(messages), classes="note")
                return
            with ui.element("div").classes("halves wide"):
                with ui.element("div"):
                    text_html("Whole frame", "h3")
                    self._build_editor(view.name, address)
                with ui.element("div"):
                    text_html("Reference and flow as they are used", "h3")
                    self._images = blinking_images(view.name)
            with ui.element("div").classes("side-by-side"):
                self._undo = UndoButtons(self.edits, self._step)
                ui.button("Whole frame", icon="crop_free", on_click=lambda: self._edit(Crop())).props("outline dense")
                ui.button("The same for all views", icon="content_copy", on_click=self._for_all).props("outline dense")
                self._save_button = ui.button("Save to views.toml", icon="save", on_click=self._save)
                self._save_button.props("unelevated dense")
            self._state = html()
        await self._show_crop()

    # -- the editor ----------------------------------------------------------------------------------------------

    def _build_editor(self, name: str, address: str) -> None:
        height, width = self._shape
        with ui.element("div").classes("cropper").on("pointerdown", self._on_drag, js_handler=DRAG) as place:
            place.style(f"aspect-ratio: {width / height:.4f}; --aspect: {width / height:.4f}")
            image(address, f"Whole frame of {name}").props("draggable=false")
            self._mark = ui.element("div").classes("mark")
        self._controls: dict[str, Any] = {}
        with ui.element("div").classes("numbers"):
            for key, text in NUMBERS.items():
                control = ui.number(text, min=0 if key in ("row", "column") else 1, step=1, suffix="px")
                control.props.update({"name": key, "aria-label": f"{text} (px)"})
                self._controls[key] = control
            self._controls |= {"flip": select("Flip", FLIPS), "rotate": select("Rotate", TURNS)}
        self._error = html().classes("error")
        self._show_controls()
        for key, control in self._controls.items():
            control.on_value_change(lambda event, key=key: self._on_control(key, event.value))

    def _value(self, key: str) -> Any:
        """Return the value of a control: a crop size of 0 reaches to the edge."""
        whole = {"width": self._shape[1] - self.crop.column, "height": self._shape[0] - self.crop.row}
        return getattr(self.crop, key) or whole.get(key, getattr(self.crop, key))

    def _show_controls(self) -> None:
        """Show the crop in the controls and over the frame."""
        self._error.set_content("")
        for key, control in self._controls.items():
            control.set_value(self._value(key))
        left, top, width, height = (
            100 * self._value(key) / self._shape[key in ("column", "width")]
            for key in ("column", "row", "width", "height")
        )
        self._mark.style(replace=f"left: {left:.3f}%; top: {top:.3f}%; width: {width:.3f}%; height: {height:.3f}%")
        self._mark.update()

    async def _on_control(self, key: str, value: Any) -> None:
        if value is not None and value != self._value(key):
            await self._change(**{key: value if key == "flip" else int(value)})

    async def _on_drag(self, event: Any) -> None:
        height, width = self._shape
        left, top, right, bottom = event.args
        column, row = round(left * width), round(top * height)
        size = {"width": round(right * width) - column, "height": round(bottom * height) - row}
        if min(size.values()) < LEAST:
            self._show_controls()
        else:
            await self._change(row=row, column=column, **size)

    async def _change(self, **values: Any) -> None:
        """Change the crop if it is valid, or show the error."""
        errors: list[str] = []
        with refusals(errors.append):
            crop = replace(self.crop, **values)
            crop.shape_of(self._shape)
        if errors:
            text = errors[0].removeprefix("crop: ")
            self._error.set_content(f"<span role=alert>{escape(text[:1].upper() + text[1:])}</span>")
        else:
            await self._edit(crop)

    # -- edits ---------------------------------------------------------------------------------------------------

    async def _edit(self, crop: Crop) -> None:
        self.edits.put(self.selection, crop)
        await self._show_crop()

    async def _for_all(self) -> None:
        for name in self.views:
            self.edits.put(name, self.crop)
        await self._show_crop()

    async def _step(self, view: str) -> None:
        if view != self.selection:
            self.selection = view
            await self.show()
        else:
            await self._show_crop()

    async def _show_crop(self) -> None:
        """Show the crop, the images as they are cropped, and which crops are not in the folder yet."""
        self._on_change()
        self._show_controls()
        view, crop = self.views[self.selection], self.crop
        changes = self.edits.changes
        self._undo.show()
        self._save_button.set_enabled(bool(changes))
        text = "The commands see the views as they are shown here."
        if changes:
            where = f"{self.experiment}/views.toml"
            text = f"{where} is not written yet for {', '.join(changes)}: nerif displacement does not know it before."
        self._state.set_content(f"<p class=note role=status>{escape(text)}</p>")
        addresses: dict[str, str] = {}
        for source, first in self._first.items():
            with refusals():
                addresses[source] = await self.work.in_thread(self.work.files.image, view, source, first, LARGE, crop)
        if addresses and (view, crop) == (self.views.get(self.selection), self.edits.now.get(self.selection)):
            for source, element in self._images.items():
                element.props["src"] = addresses.get(source, next(iter(addresses.values())))

    async def _save(self) -> None:
        with refusals():
            folder = self.work.project.path(self.experiment)
            await self.work.in_thread(write_crops, folder, self.edits.changes)
            ui.notify(f"{self.experiment}/views.toml is written.", type="positive")
            await self._on_save()


def blinking_images(name: str) -> dict[str, ui.element]:
    """Build reference and flow of a view in one place, and what changes between them; return them by source."""
    with ui.element("div").classes("blink"):
        with ui.element("div").classes("both").props("tabindex=0 role=group").on("keydown", js_handler=SPACE) as both:
            both.props["aria-label"] = f"Reference and flow of {name}; the space key changes between them"
            images = {source: image(text=f"{source.capitalize()} of {name}").classes(source) for source in SOURCES}
        with ui.element("div").classes("side-by-side"):
            html("<b class=current aria-live=polite>Reference</b>")
            change = ui.button("Change", icon="swap_horiz").props("outline dense")
            change.on("click", js_handler=CLICK)
            clock = ui.button("Blink", icon="timer").props("outline dense aria-pressed=false")
            clock.on("click", js_handler=CLOCK)
            html("<span class='calm note' role=status></span>")
    return images
