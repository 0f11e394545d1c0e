"""Displacement: from images, or vectors of another program, to a measurement; a preview of one view; masks drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from nicegui import ui

from nerif.app.forms.elements import FileChoice, card, html, refusals, select, text_field, text_html
from nerif.app.forms.form import Form
from nerif.app.forms.job_form import JobForm
from nerif.app.pages.page import Hint, Page
from nerif.app.project.demo_project import EDGE
from nerif.app.project.folder import Contents
from nerif.app.project.workspace import Workspace
from nerif.app.views.mask_editor import MaskCard
from nerif.app.views.view_maps import maps_html
from nerif.cli.commands.displacement import Displacement
from nerif.cli.commands.vectors import Vectors
from nerif.common.installation import word_of
from nerif.data.measurement import Measurement
from nerif.imaging.recording import measure_instant

__all__ = ["PAGE"]

BY_PAGE = ("config", "folder", "calibration", "out", "frames", "frame_rate", "frame_offset")
VECTORS_BY_PAGE = ("config", "folder", "calibration", "out", "frame_rate", "force")
VECTORS_MAIN = ("window", "first_image", "y_axis", "vector_unit", "scale", "time_step", "lower", "upper")
MAIN = ("method", "smoothness", "lower", "upper", "max_sigma", "min_correlation", "shake_border", "images")


class DisplacementPage:
    """The page in one tab."""

    def __init__(self, work: Workspace, contents: Contents) -> None:
        self.work, draft = work, work.draft(PAGE.name)
        self.measurement_card: MeasurementCard | None = None
        if contents.experiments and contents.calibrations:
            with ui.element("div").classes("columns"):
                with card("Images to displacements"), ui.element("div").classes("form"):
                    self.experiment = select("Experiment", list(contents.experiments), draft.get("experiment"))
                    calibrations = list(contents.calibrations)
                    self.calibration = select("Calibration", calibrations, draft.get("calibration"))
                    self.out = text_field("Measurement to write", work.project.free_name("measurement.nc"))
                    record = Displacement(Path("."), Path("."), Path("measurement.nc"))
                    self.job = JobForm(
                        work, f"{PAGE.name}.run", Form(record, without=BY_PAGE), self._words, "Find all displacements",
                        MAIN, lambda: str(self.out.value), on_continue=self._on_continue,
                    )  # fmt: skip
                    for control in (self.experiment, self.calibration, self.out):
                        control.on_value_change(self._on_choice)
                with card("Preview of one view", "With these settings, before all views are done."):
                    self.view = select("View", []).classes("short")
                    self.button = ui.button("Preview", icon="visibility", on_click=self.preview).props("outline")
                    self.display = ui.element("div").props('aria-live="polite"')
            self._views()
        elif not (contents.vectors and contents.calibrations):
            images = contents.experiments or contents.vectors
            gap = (
                "is no calibration" if images else "are no images of an experiment, and no vectors of another program,"
            )
            text_html(f"There {gap} in the folder yet; the pages before this one help.", classes="status")
        if contents.vectors and contents.calibrations:
            self._vectors_card(contents)
        self.below = ui.element("div").classes("stack")
        self._show(contents.measurements)

    def _vectors_card(self, contents: Contents) -> None:
        """Add the form that reads vectors of another program."""
        draft = self.work.draft(f"{PAGE.name}.vectors")
        about = "Of PIVlab, OpenPIV, DaVis, Insight, Dynamic Studio, or any table."
        with card("Vectors of another program", about), ui.element("div").classes("form"):
            folder = select("Folder of vectors", list(contents.vectors), draft.get("folder"))
            calibration = select("Calibration", list(contents.calibrations), draft.get("calibration"))
            out = text_field("Measurement to write", self.work.project.free_name("vectors.nc"))

            def words() -> list[str]:
                files = [str(folder.value), "--calibration", str(calibration.value)]
                return ["vectors", *files, "--out", word_of(out.value)]

            record = Vectors(Path("."), Path("."), Path("vectors.nc"))
            job = JobForm(
                self.work, f"{PAGE.name}.vectors.run", Form(record, without=VECTORS_BY_PAGE), words, "Read vectors",
                VECTORS_MAIN, lambda: str(out.value), on_continue=self._show_new,
            )  # fmt: skip
            for control in (folder, calibration, out):
                control.on_value_change(job.show)

    async def _show_new(self, file: str) -> None:
        """Show a measurement that a run has written."""
        self._show(await self.work.measurements())
        if self.measurement_card is not None:
            await self.measurement_card.choice.choose(file)

    def _show(self, measurements: Sequence[str]) -> None:
        if measurements and self.measurement_card is None:
            with self.below:
                self.measurement_card = MeasurementCard(self.work, measurements)

    async def _on_continue(self, file: str) -> None:
        """Show a measurement that a run has written, and give the next one a new name."""
        await self._show_new(file)
        self.out.set_value(self.work.project.free_name("measurement.nc"))

    def _words(self) -> list[str]:
        files = [str(self.experiment.value), "--calibration", str(self.calibration.value)]
        return ["displacement", *files, "--out", word_of(self.out.value)]

    def _on_choice(self) -> None:
        selection = {"experiment": self.experiment.value, "calibration": self.calibration.value}
        self.work.keep(PAGE.name, {**self.work.draft(PAGE.name), **selection})
        self.job.show()
        self._views()

    def _views(self) -> None:
        names: list[str] = []
        with refusals():
            names = [view.name for view in self.work.project.views(str(self.experiment.value))]
        self.view.set_options(names, value=names[0] if names else None)

    async def preview(self) -> None:
        """Find the displacements of one view and show them."""
        lines: list[str] = []
        maps = ""
        self.button.disable()
        self.display.clear()
        with self.display:
            ui.spinner(size="lg").props('aria-label="Working"')
        with refusals(lines.append):
            folder, calibration = map(self.work.project.path, (self.experiment.value, self.calibration.value))
            request = replace(
                self.job.view.record(), folder=folder, calibration=calibration, views=(str(self.view.value),),
                images=False,
            )  # fmt: skip
            numbers = range(request.frame, request.frame + request.average)
            maps = await self.work.in_thread(
                lambda: maps_html(measure_instant(request.recording(), numbers, lines.append, processes=1)[0])
            )
        self.button.enable()
        self.display.clear()
        with self.display:
            for text in lines:
                text_html(text, classes="status")
            html(maps)


class MeasurementCard:
    """Maps of the views of one of the measurements, and the editor of its masks."""

    def __init__(self, work: Workspace, measurements: Sequence[str]) -> None:
        self.work = work
        name = work.draft(PAGE.name).get("measurement")
        with card("What was measured"):
            first = name if name in measurements else measurements[-1]
            self.choice = FileChoice("Measurement", measurements, first, work.measurements, self._on_choice)
            self.choice.select.classes("short")
            self.fold = ui.expansion("Maps of all views", icon="grid_view", on_value_change=self._maps).classes("wide")
            with self.fold:
                self.maps = ui.element("div")
        with card("Where the flow is", "A mask tightens the visual hull. Views without a drawing use the threshold."):
            self.place = ui.element("div").classes("stack")
        ui.timer(0.05, self._masks, once=True)

    async def _on_choice(self) -> None:
        self.work.keep(PAGE.name, {**self.work.draft(PAGE.name), "measurement": self.choice.name})
        self.maps.clear()
        await self._maps()
        await self._masks()

    async def _measurement(self) -> tuple[str, Measurement] | None:
        """Read the selected measurement; None if another one has been selected meanwhile."""
        name = self.choice.name
        read = self.work.project.from_cache
        measurement = await self.work.in_thread(read, name, "measurement", Measurement.read)
        return (name, measurement) if name == self.choice.name else None

    async def _maps(self) -> None:
        """Show the maps unless they are folded or shown already."""
        if not self.fold.value or list(self.maps):
            return
        with refusals():
            if (selection := await self._measurement()) is None:
                return
            maps = await self.work.in_thread(maps_html, selection[1])
            if selection[0] == self.choice.name:
                self.maps.clear()
                with self.maps:
                    html(maps)

    async def _masks(self) -> None:
        self.place.clear()
        with refusals():
            if (selection := await self._measurement()) is None:
                return
            self.place.clear()
            with self.place:
                MaskCard(self.work, PAGE.name, *selection, self.choice.choose)


async def build(work: Workspace) -> None:
    """Build the page."""
    DisplacementPage(work, await work.contents())


HINT = Hint(
    "Compares reference and flow of each view and computes how far the background is displaced.",
    "Fill in the values: the corners of the box around the flow. Press Preview for one view, then Find all "
    "displacements.",
    "The maps of u and v show the edges of the flame; sigma is the noise of each pixel. Below, the flow can be "
    "masked by hand; the demo does not need it.",
    before="calibration",
    values={"displacement.run": {"lower": [-EDGE / 2] * 3, "upper": [EDGE / 2] * 3}},
    done=lambda work: bool(work.project.contents().measurements),
)
ABOUT = "How far the background is shifted, view by view."
PAGE = Page("displacement", "Displacement", ABOUT, build, HINT)
