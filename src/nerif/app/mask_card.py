"""Card for the flow masks of a measurement: drawn in some views, by threshold in the others."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from html import escape
from pathlib import Path

from nicegui import ui

from nerif.app.elements import dialog, refusals, select, text_html
from nerif.app.forms import Form
from nerif.app.job_form import JobForm
from nerif.app.mask_editor import MaskEditor
from nerif.app.mask_edits import MaskEdits
from nerif.app.project import OWN
from nerif.app.view_maps import magnitude_address, threshold_address
from nerif.app.workspace import Workspace
from nerif.cli.commands.mask import Mask
from nerif.data.measurement import Measurement
from nerif.imaging.masks import MaskSettings, write_masks

__all__ = ["MaskCard"]

SETTINGS = ("threshold", "smooth", "smallest", "grow", "sigma")


class MaskCard:
    """Mask editor, threshold settings and the run that applies them.

    Parameters
    ----------
    work : Workspace
    page : name of the page whose draft stores the shapes
    name : measurement file, relative to the project
    measurement : Measurement
    offer : called with the file of the masked measurement
    """

    def __init__(
        self, work: Workspace, page: str, name: str, measurement: Measurement, offer: Callable[[str], Awaitable[None]]
    ) -> None:
        self.work, self.page, self.name, self.measurement = work, page, name, measurement
        self.edits = MaskEdits(measurement.names, work.draft(page).get("masks", {}).get(name))
        self.view = select("View", list(measurement.names), measurement.names[0]).classes("short")
        self.view.props["aria-label"] = "View to draw in"
        with ui.element("div").classes("numbers"):
            for label, icon, step in (("Undo", "undo", self.edits.undo), ("Redo", "redo", self.edits.redo)):
                button = ui.button(label, icon=icon, on_click=lambda step=step: self._step(step()))
                button.props("outline no-caps dense")
            button = ui.button("Show the threshold's mask", icon="contrast", on_click=self._threshold)
            button.props("flat no-caps dense")
        self.place = ui.element("div").classes("stack")
        self.status = ui.html("", sanitize=False).classes("status").props('aria-live="polite"')
        record = Mask(Path(name), Path("masked.nc"))
        self._writing = asyncio.Lock()
        form = Form(record, only=SETTINGS)
        self.job = JobForm(
            work, f"{page}.mask", form, self._words, "Apply the masks", SETTINGS[:1], first=self._write, about=name,
            offer=offer,
        )  # fmt: skip
        self.view.on_value_change(self._edit)
        self._edit()

    @property
    def folder(self) -> str:
        """Folder of the drawn masks, relative to the project."""
        return f"{OWN}/masks/{self.name.removesuffix('.nc')}"

    @property
    def out(self) -> str:
        """Name of the new measurement."""
        return self.work.project.free_name(f"{self.name.removesuffix('.nc')}.masked.nc")

    def _words(self) -> list[str]:
        option = ["--drawn", self.folder] if self.edits.drawings else []
        return ["mask", self.name, "--out", self.out, *option]

    def _edit(self) -> None:
        """Build the editor of the selected view."""
        self.place.clear()
        with self.place:
            index = self.measurement.names.index(str(self.view.value))
            shape = self.measurement.cameras[index].image_size
            address = magnitude_address(self.measurement, index)
            MaskEditor(str(self.view.value), shape, address, self.edits, self._changed)
        self._show_views()

    def _step(self, view: str) -> None:
        if not view:
            ui.notify("Nothing to undo or redo.")
            return
        self.view.set_value(view)
        self._edit()
        self._changed()

    def _changed(self) -> None:
        """Store the shapes in the draft and as the images that `nerif mask` reads."""
        draft = self.work.draft(self.page)
        masks = {**draft.get("masks", {}), self.name: self.edits.state}
        self.work.keep(self.page, {**draft, "masks": masks})
        self.job.show()
        self._show_views()
        ui.timer(0.0, self._written, once=True)

    async def _written(self) -> None:
        with refusals():
            await self._write()

    async def _write(self) -> None:
        """Write the masks as images in a thread, one write at a time."""
        async with self._writing:
            drawings, folder = self.edits.drawings, self.work.project.path(self.folder)
            sizes = {camera.name: camera.image_size for camera in self.measurement.cameras}

            def work() -> None:
                for old in folder.glob("*.png"):  # also those of views that have no shapes any more
                    old.unlink()
                if drawings:
                    write_masks(folder, drawings, sizes)

            await self.work.in_thread(work)

    def _show_views(self) -> None:
        views = ", ".join(self.edits.drawings) or "no view"
        self.status.set_content(escape(f"Drawn in {views}."))

    async def _threshold(self) -> None:
        index = self.measurement.names.index(str(self.view.value))
        with refusals():
            record = self.job.view.record()
            settings: MaskSettings = record.masks
            address = await self.work.in_thread(threshold_address, self.measurement, index, settings, record.sigma)
            with dialog():
                text_html(f"Threshold mask of view {self.view.value}; white: flow", "h3")
                image = ui.element("img").style("width: min(70vw, 600px); image-rendering: pixelated")
                image.props["src"], image.props["alt"] = address, "Threshold mask"
