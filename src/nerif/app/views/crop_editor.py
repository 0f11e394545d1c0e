"""Editor of a view's crop: drawn with the mouse or typed, with rotation and flip; beside it the images as used."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from html import escape
from typing import Any

from nicegui import ui

from nerif.app.forms.elements import card, refusals, select, text_html
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
        self._editor: CropEditor | None = None
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

    async def show(self) -> None:
        """Show the selected view."""
        self._request += 1
        request, view = self._request, self.views.get(self.selection)
        self._place.clear()
        self._editor = None
        if view is None:
            return
        messages: list[str] = []
        first: dict[str, int] = {}
        frame, address = (0, 0), ""
        for source in SOURCES:
            with refusals(messages.append):
                quality = await self.work.in_thread(self.work.files.quality, view, source)
                first[source] = quality.first
                if not address:
                    address = await self.work.in_thread(self.work.files.image, view, source, quality.first, LARGE, None)
                    frame = quality.frame_shape
        if request != self._request:  # another view has been selected meanwhile
            return
        self._first = first
        with self._place, card(view.name, "Drag over the whole frame to crop it, or type; the result is on the right."):
            if not address:
                text_html("There is no image to show: " + " ".join(messages), classes="note")
                return
            with ui.element("div").classes("halves wide"):
                with ui.element("div"):
                    text_html("Whole frame", "h3")
                    self._editor = CropEditor(view.name, frame, self.edits.now[view.name], address, self._edit)
                with ui.element("div"):
                    text_html("Reference and flow as they are used", "h3")
                    self._blink = Blink(view.name)
            self._buttons()
        await self._show_result()

    def _buttons(self) -> None:
        with ui.element("div").classes("side-by-side"):
            self._undo = UndoButtons(self.edits, self._step)
            for text, icon, action in (
                ("Whole frame", "crop_free", self._reset), ("The same for all views", "content_copy", self._for_all),
            ):  # fmt: skip
                ui.button(text, icon=icon, on_click=action).props("outline no-caps dense")
            self._save_button = ui.button("Save to views.toml", icon="save", on_click=self._save)
            self._save_button.props("unelevated no-caps dense")
        self._state = ui.html("", sanitize=False)

    async def _edit(self, crop: Crop) -> None:
        self.edits.put(self.selection, crop)
        await self._show_result()

    async def _reset(self) -> None:
        await self._edit(Crop())
        if self._editor:
            self._editor.put(Crop())

    async def _for_all(self) -> None:
        for name in self.views:
            self.edits.put(name, self.edits.now[self.selection])
        await self._show_result()

    async def _step(self, view: str) -> None:
        if view != self.selection:
            self.selection = view
            await self.show()
            return
        if self._editor:
            self._editor.put(self.edits.now[view])
        await self._show_result()

    async def _show_result(self) -> None:
        """Show the images as they are cropped, and which crops are not in the folder yet."""
        self._on_change()
        view, crop = self.views[self.selection], self.edits.now[self.selection]
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
            one = next(iter(addresses.values()))
            self._blink.show(addresses.get("reference", one), addresses.get("flow", one))

    async def _save(self) -> None:
        with refusals():
            folder = self.work.project.path(self.experiment)
            await self.work.in_thread(write_crops, folder, self.edits.changes)
            ui.notify(f"{self.experiment}/views.toml is written.", type="positive")
            await self._on_save()


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
        control.props["name"], control.props["aria-label"] = key, f"{text} (px)"

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


class Blink:
    """Two images in one place, added to the page under construction.

    Parameters
    ----------
    name : name of the view
    """

    def __init__(self, name: str) -> None:
        self._name = name
        with ui.element("div").classes("blink"):
            with ui.element("div").classes("both") as both:
                both.props["aria-label"] = f"Reference and flow of {name}; the space key changes between them"
                both.props("tabindex=0 role=group").on("keydown", js_handler=SPACE)
                self._images = [ui.element("img").classes(source) for source in SOURCES]
            with ui.element("div").classes("side-by-side"):
                ui.html("<b class=current aria-live=polite>Reference</b>", sanitize=False)
                change = ui.button("Change", icon="swap_horiz").props("outline no-caps dense")
                change.on("click", js_handler=CLICK)
                clock = ui.button("Blink", icon="timer").props("outline no-caps dense aria-pressed=false")
                clock.on("click", js_handler=CLOCK)
                ui.html("<span class='calm note' role=status></span>", sanitize=False)

    def show(self, reference: str, flow: str) -> None:
        """Show two images by their addresses."""
        for image, address, source in zip(self._images, (reference, flow), SOURCES, strict=True):
            image.props["src"] = address
            image.props["alt"] = f"{source.capitalize()} of {self._name}"
            image.update()
