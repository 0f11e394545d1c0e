"""Images: what is in the folder, whether it can be used, and which part of the frames is each view's own."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

from nicegui import ui

from nerif.app.blink import Blink
from nerif.app.crop_editor import CropEditor
from nerif.app.crop_edits import CropEdits
from nerif.app.elements import CommandLine, card, items_html, refusals, select, text_html
from nerif.app.frame import Page
from nerif.app.histogram import histogram
from nerif.app.workspace import Workspace
from nerif.common.conventions import InputError
from nerif.imaging.image_quality import ImageQuality
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.views import View, write_crops

__all__ = ["PAGE"]

SOURCES = ("reference", "flow")
THUMBNAIL, LARGE = 280, 900  # px
MOST = 12  # images of a source that are read at first
LAYOUT = "Put images into folders such as run1/cam1/reference and run1/cam1/flow, or name them in run1/views.toml."


class ImagesPage:
    """The page in one tab."""

    def __init__(self, work: Workspace, experiments: Sequence[str]) -> None:
        self.work, self.experiments, self.files = work, experiments, work.files
        memory = work.draft(PAGE.name)
        available = str(memory.get("experiment", ""))
        self.experiment = available if available in experiments else experiments[0]
        self.selection, self.memory, self.most = str(memory.get("view", "")), dict(memory.get("edits", {})), MOST
        self.views: dict[str, View] = {}
        self.turn, self.closer_turn = 0, 0  # of building, and of showing a view large
        self.first: dict[str, int] = {}
        self.editor: CropEditor | None = None
        with ui.element("div").classes("stack"):
            with card("Folder of images"):
                choice = select("Experiment", list(experiments), self.experiment).classes("short")
                self.summary = ui.element("div")
                text_html("The next step on the command line", "h3")
                self.command = CommandLine()
            with card("Views", "The first good image of each, its grey values, and what cannot be used."):
                self.grid = ui.element("div").classes("views")
            self.closer = ui.element("div")

        async def turned() -> None:
            self.experiment, self.selection = choice.value, ""
            await self.build()

        choice.on_value_change(turned)

    async def build(self) -> None:
        """Build everything for the experiment that is chosen; images come one after the other."""
        self.turn += 1
        turn = self.turn
        with refusals():
            outcome = await self.work.in_thread(self.work.project.views, self.experiment)
            self.views = {view.name: view for view in outcome}
        written = {name: view.crop or Crop() for name, view in self.views.items()}
        self.edits = CropEdits(written, self.memory.get(self.experiment))
        if self.selection not in self.views:
            self.selection = next(iter(self.views), "")
        self.keep()
        out = self.work.project.free_name("measurement.nc")
        self.command.show(["displacement", self.experiment, "--calibration", "calibration.toml", "-o", out])
        self.grid.clear()
        with self.grid:
            self.cells = {name: ui.element("article").classes("view") for name in self.views}
        wrong: list[str] = []
        await self._closer()
        for view in list(self.views.values()):
            wrong += await self._cell(view, turn)
            if turn != self.turn:  # another experiment has been chosen meanwhile
                return
            self._sum_up(wrong)
        self._sum_up(wrong)

    def keep(self) -> None:
        """Keep what is chosen and edited over a reload."""
        self.memory[self.experiment] = self.edits.draft
        self.work.keep(PAGE.name, {"experiment": self.experiment, "view": self.selection, "edits": self.memory})

    def _sum_up(self, wrong: Sequence[str]) -> None:
        self.summary.clear()
        with self.summary:
            text_html(f"{len(self.views)} views. {'' if wrong else 'No problems found.'}", classes="status")
            ui.html(items_html(wrong, label="What is wrong"), sanitize=False)

    # -- a view in the grid --------------------------------------------------------------------------------------

    async def _cell(self, view: View, turn: int) -> list[str]:
        """Fill the cell of a view; returns what is wrong with it."""
        wrong: list[str] = []
        looks: dict[str, ImageQuality] = {}
        for source in SOURCES:
            try:
                looks[source] = await self.work.in_thread(self.files.look, view, source, self.most)
            except InputError as error:
                wrong.append(str(error))
        wrong += [f"{name}: {why}" for look in looks.values() for name, why in look.bad]
        wrong += [note for look in looks.values() for note in look.notes]
        images: dict[str, str] = {}
        for source, look in looks.items():
            with refusals(wrong.append):
                images[source] = await self.work.in_thread(
                    self.files.image, view, source, look.first, THUMBNAIL, view.crop
                )
        if turn != self.turn:
            return wrong
        cell = self.cells[view.name]
        cell.clear()
        with cell:
            text_html(view.name, "h3")
            with ui.element("div").classes("pair"):
                for source in SOURCES:
                    _figure(view, source, looks.get(source), images.get(source, ""))
            ui.html(items_html(wrong), sanitize=False)

            async def choose() -> None:
                self.selection = view.name
                self.keep()
                await self._closer()
                ui.run_javascript("document.querySelector('.closer')?.scrollIntoView({block: 'start'})")

            button = ui.button("Look closer, crop, turn", icon="crop_rotate", on_click=choose)
            button.props("outline no-caps dense").props["aria-label"] = f"Look closer at {view.name}, crop or turn it"
        return wrong

    # -- a single view ----------------------------------------------------------------------------------------

    async def _closer(self) -> None:
        """Show the chosen view large, with what it is cropped to."""
        self.closer_turn += 1
        turn, view = self.closer_turn, self.views.get(self.selection)
        self.closer.clear()
        self.editor = None
        if view is None:
            return
        messages: list[str] = []
        first: dict[str, int] = {}
        frame, address = (0, 0), ""
        for source in SOURCES:
            with refusals(messages.append):
                look = await self.work.in_thread(self.files.look, view, source, self.most)
                first[source] = look.first
                if not address:
                    address = await self.work.in_thread(self.files.image, view, source, look.first, LARGE, None)
                    frame = look.frame_shape
        if turn != self.closer_turn:  # another view has been chosen meanwhile
            return
        self.first = first
        with self.closer, card(view.name, "Drag over the whole frame to crop it, or type; the result is on the right."):
            self.closer.classes("closer")
            if not address:
                text_html("There is no image to show: " + " ".join(messages), classes="note")
                return
            with ui.element("div").classes("halves wide"):
                with ui.element("div"):
                    text_html("Whole frame", "h3")
                    self.editor = CropEditor(view.name, frame, self.edits.now[view.name], address, self._edited)
                with ui.element("div"):
                    text_html("Reference and flow as they are used", "h3")
                    self.blink = Blink(view.name)
            self._buttons()
        await self._show_result()

    def _buttons(self) -> None:
        with ui.element("div").classes("side-by-side"):
            self.undo = ui.button("Undo", icon="undo", on_click=lambda: self._step(self.edits.undo))
            self.redo = ui.button("Redo", icon="redo", on_click=lambda: self._step(self.edits.redo))
            ui.button("Whole frame", icon="crop_free", on_click=self._whole).props("outline no-caps")
            ui.button("The same for all views", icon="content_copy", on_click=self._for_all).props("outline no-caps")
            self.save = ui.button("Save to views.toml", icon="save", on_click=self._save).props("unelevated no-caps")
        for button in (self.undo, self.redo):
            button.props("outline no-caps")
        self.state = ui.html("", sanitize=False)

    async def _edited(self, crop: Crop) -> None:
        self.edits.put(self.selection, crop)
        await self._show_result()

    async def _whole(self) -> None:
        await self._edited(Crop())
        if self.editor:
            self.editor.put(Crop())

    async def _for_all(self) -> None:
        for name in self.views:
            self.edits.put(name, self.edits.now[self.selection])
        await self._show_result()

    async def _step(self, step: Any) -> None:
        name = step()
        if name and name != self.selection:
            self.selection = name
            await self._closer()
            return
        if name and self.editor:
            self.editor.put(self.edits.now[name])
        await self._show_result()

    async def _show_result(self) -> None:
        """Show what the crop leaves of the images, and what is not yet in the folder."""
        self.keep()
        view, crop = self.views[self.selection], self.edits.now[self.selection]
        changed = self.edits.changed
        self.undo.set_enabled(bool(self.edits.past))
        self.redo.set_enabled(bool(self.edits.future))
        self.save.set_enabled(bool(changed))
        where = f"{self.experiment}/views.toml"
        text = f"{where} is not written yet for {', '.join(changed)}: nerif displacement does not know it before."
        done = "The commands see the views as they are shown here."
        self.state.set_content(f"<p class=note role=status>{escape(text if changed else done)}</p>")
        display: dict[str, str] = {}
        for source, first in self.first.items():
            with refusals():
                display[source] = await self.work.in_thread(self.files.image, view, source, first, LARGE, crop)
        if display and (view, crop) == (self.views.get(self.selection), self.edits.now.get(self.selection)):
            one = next(iter(display.values()))
            self.blink.show(display.get("reference", one), display.get("flow", one))

    async def _save(self) -> None:
        with refusals():
            folder = self.work.project.path(self.experiment)
            await self.work.in_thread(write_crops, folder, self.edits.changed)
            self.memory[self.experiment] = {**self.edits.draft, "now": {}}
            ui.notify(f"{self.experiment}/views.toml is written.", type="positive")
            await self.build()


def _figure(view: View, source: str, look: ImageQuality | None, address: str) -> None:
    """An image, its grey values, and its figures."""
    if look is None or not address:
        text_html(f"No {source} image", classes="missing note")
        return
    height, width = look.shape
    with ui.element("figure"):
        image = ui.element("img").props("loading=lazy")
        image.props["src"], image.props["alt"] = address, f"{source.capitalize()} of {view.name}"
        visible = f"{look.count}" if look.sampled == look.count else f"{look.count} ({look.sampled} read)"
        full = f"{look.saturated:.2%} saturated" if look.full > 1 else "saturation unknown"
        label = f"Grey values of {source} of {view.name}, {full}"
        ui.html(
            f"<figcaption><b>{source.capitalize()}</b>, {visible}<br>{width} × {height} px, "
            f"<span class=share>{full}</span></figcaption>"
            + histogram(look.histogram.tolist(), look.full, escape(label)), sanitize=False,
        )  # fmt: skip


async def build(work: Workspace) -> None:
    """Build the page."""
    outcome = await work.contents()
    if not outcome.experiments:
        with card("In this folder"):
            text_html("There are no images in this folder yet. " + LAYOUT, classes="note")
        return
    page = ImagesPage(work, outcome.experiments)
    with ui.element("div"):
        ui.timer(0.01, page.build, once=True)  # the page is there before its images are read


ABOUT = "What is in the folder, whether it can be used, and which part of the frames is each view's own."
PAGE = Page("images", "Images", "/images", ABOUT, build)
