"""Calibration: cameras from images of a target, or one from a ruler; detected corners, errors, the rig."""

from __future__ import annotations

from dataclasses import fields
from html import escape
from typing import Any

from nicegui import ui

from nerif.app.forms.elements import card, html, refusals, select, text_field, text_html
from nerif.app.forms.form import Form
from nerif.app.forms.job_form import JobForm
from nerif.app.pages.page import Hint, Page
from nerif.app.project.folder import Contents
from nerif.app.project.jobs import CommandRun
from nerif.app.project.workspace import Workspace
from nerif.app.views.calibration_images import CalibrationImages
from nerif.app.views.rig_scene import read_rig, show_rig
from nerif.cli.commands.calibrate import Calibrate
from nerif.common.conventions import InputError
from nerif.common.files import read_toml
from nerif.common.installation import word_of
from nerif.common.settings import MISSING, merge
from nerif.imaging.calibration.calibration_settings import SimpleRig
from nerif.imaging.calibration.result import ImageError
from nerif.imaging.calibration.targets import CalibrationTarget
from nerif.imaging.readers.views import View

__all__ = ["PAGE"]

RULER = tuple(f.name for f in fields(SimpleRig))
BY_PAGE = ("config", "source", "out", "check", "simple", "force", "leave_out")
MAIN = ("target.kind", "target.columns", "target.rows", "target.pitch", "background_scale", "world")
SIMPLE = ("distance", "mm_per_px", "background_distance", "axis_from", "axis_to", "f_number", "focal_length",
          "pixel_pitch_um", "principal_point", "lower", "upper", "views")  # fmt: skip
SIMPLE_MAIN = SIMPLE[:3]
SETTINGS = "calibrate.toml"
WAYS = {False: "Images of a target", True: "A ruler: one camera, no target"}
EVERY = 0.7  # seconds


def form_of(simple: bool, settings: dict[str, Any] | None = None) -> Form[Calibrate]:
    """Return the form of one of the two ways; its defaults are those of a file of settings, if there is one."""
    record = Calibrate(MISSING)
    if simple:
        return Form(record, only=SIMPLE)
    record = merge(record, settings or {}, SETTINGS)
    return Form(record, without=(*BY_PAGE, *RULER))


class CalibrationPage:
    """The page in one tab."""

    def __init__(self, work: Workspace, contents: Contents) -> None:
        self.work, self.contents, self.draft = work, contents, dict(work.draft(PAGE.name))
        self.exclusions: dict[str, list[str]] = {k: list(v) for k, v in self.draft.get("leave_out", {}).items()}
        self.views: dict[str, View] = {}
        self.errors: dict[str, ImageError] = {}
        self.request = 0  # number of the last drawing of the rig
        self._display: tuple[Any, ...] = ()  # `_display_key` of the images on the page
        experiments = list(contents.experiments)
        with ui.element("div").classes("columns"):
            with card("Calibrate"), ui.element("div").classes("form"):
                if not experiments:
                    text_html("There are no images in this folder yet; the page Images says where they go.")
                self.experiment = select("Experiment", experiments, self.draft.get("experiment")).classes("short")
                self.way = select("From", WAYS, bool(self.draft.get("simple", False))).classes("short")
                self.out = text_field("Calibration to write", str(self.draft.get("out", "calibration.toml")))
                self.note = html()
                self.place = ui.element("div").classes("form")
            with ui.element("div").classes("stack"):
                with card("The rig"):
                    self.calibration = select("Calibration", []).classes("short")
                    self.rig = ui.element("div").classes("rig")
                with card("Images of the target", "Circles: detected points, the first one filled. "
                          "Left-out images are part of the command line; calibrate again after it."):  # fmt: skip
                    self.view = select("View", []).classes("short")
                    self.images = CalibrationImages(work, self._toggle)

    # -- the form ------------------------------------------------------------------------------------------------

    async def build(self) -> None:
        """Fill the page and handle changes."""
        await self._update_form()
        await self._choose_calibration()
        for control in (self.experiment, self.way):
            control.on_value_change(self._update_form)
        self.out.on_value_change(self._show)
        self.calibration.on_value_change(self._show_rig)
        self.view.on_value_change(self._show_images)
        await self._show_rig()
        ui.timer(EVERY, self._update_images)

    @property
    def simple(self) -> bool:
        """Whether one camera comes from a ruler."""
        return bool(self.way.value)

    @property
    def settings(self) -> str:
        """The settings file beside the images, relative to the project; empty if there is none."""
        name = f"{self.experiment.value}/{SETTINGS}"
        exists = self.experiment.value and not self.simple and self.work.project.path(name).is_file()
        return name if exists else ""

    async def _update_form(self) -> None:
        self.views, form = {}, form_of(self.simple)
        with refusals():
            if self.experiment.value:
                views = await self.work.in_thread(self.work.project.views, self.experiment.value)
                self.views = {view.name: view for view in views}
        with refusals():
            if self.settings:
                form = form_of(False, read_toml(self.work.project.path(self.settings)))
        self.place.clear()
        with self.place:
            self.job = JobForm(
                self.work, f"{PAGE.name}.{'ruler' if self.simple else 'target'}", form, self._words, "Calibrate",
                SIMPLE_MAIN if self.simple else MAIN, lambda: self.out.value,
                ready=lambda: bool(self.experiment.value and self.out.value), on_end=self._on_end,
            )  # fmt: skip
        names, name = list(self.views), self.draft.get("view")
        self.view.set_options(names, value=name if name in names else next(iter(names), None))
        self._show()

    @property
    def excluded_images(self) -> list[str]:
        """Names of the excluded images of this experiment."""
        return self.exclusions.setdefault(self.experiment.value or "", [])

    def _words(self) -> list[str]:
        words = ["calibrate", self.experiment.value or "FOLDER", "-o", word_of(self.out.value or "NAME.toml")]
        words += ["--config", self.settings] if self.settings else []
        words += ["--force"] if self._exists() else []
        if self.simple:
            return [*words, "--simple"]
        return [*words, "--leave-out", *map(word_of, self.excluded_images)] if self.excluded_images else words

    def _exists(self) -> bool:
        try:
            return bool(self.out.value) and self.work.project.path(self.out.value).exists()
        except InputError:  # outside of the folder: it is refused when it is started
            return False

    def _show(self) -> None:
        self.draft = {
            "experiment": self.experiment.value, "simple": self.simple, "out": self.out.value, "view": self.view.value,
            "leave_out": self.exclusions, "calibration": self.calibration.value,
        }  # fmt: skip
        self.work.keep(PAGE.name, self.draft)
        self.job.show()
        notes = [f"Its settings are those of {self.settings}, but for what is changed here."] if self.settings else []
        notes += [f"{self.out.value} is there; it is replaced."] if self._exists() else []
        self.note.set_content("".join(f"<p class=note>{escape(text)}</p>" for text in notes))

    def _toggle(self, name: str) -> None:
        names = self.excluded_images
        names.remove(name) if name in names else names.append(name)
        self._show()

    async def _on_end(self, job: CommandRun) -> None:
        if job.state == "done":
            self.contents = await self.work.contents()
            await self._choose_calibration(self.work.project.relative(job.file))
            await self._show_rig()
        self._show()

    # -- results -------------------------------------------------------------------------------------------

    async def _choose_calibration(self, name: str | None = None) -> None:
        names = sorted(self.contents.calibrations, key=lambda n: (n.count("/"), n))
        best = [n for n in (name, self.calibration.value, self.draft.get("calibration"), self.out.value) if n in names]
        self.calibration.set_options(names, value=next(iter([*best, *names]), None))

    async def _show_rig(self) -> None:
        """Show the rig of the selected calibration, and its errors beside the images."""
        self.request += 1
        request, name, rig = self.request, self.calibration.value, None
        lines = [] if name else ["There is no calibration in this folder yet."]
        if name:
            with refusals(lines.append):
                rig = await self.work.in_thread(read_rig, self.work.project.path(name))
        if request != self.request:  # another one has been selected meanwhile
            return
        self.errors = {error.name: error for error in rig.errors} if rig else {}
        self.rig.clear()
        with self.rig:
            for text in lines:
                text_html(text, classes="note")
            if rig:
                show_rig(rig)
        self._show()
        await self._show_images()

    async def _show_images(self) -> None:
        view = self.views.get(self.view.value or "")
        if view is None or not self.job.view.valid:
            return
        self._show()
        with refusals():
            targets, self._display = self._targets(), self._display_key()
            await self.images.show(view, targets, self.errors, self.excluded_images)

    def _targets(self) -> dict[str, CalibrationTarget]:
        """The targets to detect; for a ruler, which needs none, those of the form's defaults."""
        record = form_of(False).record if self.simple else self.job.view.record()
        return {"target": record.target, "background": record.target.scaled(record.background_scale)}

    def _display_key(self) -> tuple[Any, ...]:
        return self.experiment.value, self.view.value, *self._targets().values()

    async def _update_images(self) -> None:
        """Detect again if target, experiment or view has changed."""
        if self.job.view.valid and self._display_key() != self._display:
            await self._show_images()


async def build(work: Workspace) -> None:
    """Build the page."""
    page = CalibrationPage(work, await work.contents())
    with ui.element("div"):
        ui.timer(0.01, page.build, once=True)  # the page is there before its images are looked through


ABOUT = "Where the cameras stand and what they see, from images of a target or from a ruler."
HINT = Hint(
    "Computes where the cameras are from images of a chessboard in several poses.",
    "Press Calibrate. The settings come from the file beside the images. It takes about 10 s.",
    "The reprojection errors should be a small fraction of a pixel. Turn the rig in 3-D: six cameras, each with "
    "its background behind the flow.",
    done=lambda work: bool(work.project.contents().calibrations),
)
PAGE = Page("calibration", "Calibration", ABOUT, build, HINT)
