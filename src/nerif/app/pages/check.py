"""Check: do the views of a measurement agree, and which correction is offered where they do not?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from nicegui import ui
from PIL import Image

from nerif.analysis.consistency_file import CheckFindings, read_findings
from nerif.app.forms.elements import CommandLine, FileChoice, card, items_html, refusals, table_html, text_html
from nerif.app.forms.form import Form
from nerif.app.forms.job_form import JobForm, JobStatus
from nerif.app.pages.page import Hint, Page
from nerif.app.project.folder import OWN
from nerif.app.project.jobs import CommandRun
from nerif.app.project.workspace import Workspace
from nerif.cli.commands.body import BodyInFlow
from nerif.cli.commands.check import Check

__all__ = ["PAGE", "findings_file"]

AGREE = "Each is predicted by a quick reconstruction from the others."
MODEL = "A body that hides a part of the background: give its surface."
MODEL_SETTINGS = ("unit", "rotation", "translation", "refine", "margin")
NO_MODEL = "A file of its surface in the folder (.stl, .obj, .ply) can be added here."
REFINE = "Cameras are refined together with a quick field."
VIEW_SETTINGS = ("voxels", "aperture")
RIG_LINES = 60  # of its output: a table of the views and the findings
RIG_SETTINGS = ("pose_sigma_mm", "pose_sigma_deg", "time_limit", "aperture")
NOT_COMPARED = "The views have not been compared yet."
CHANGED = "The measurement has changed since this comparison; compare the views again."


def findings_file(measurement: str) -> str:
    """Return the file with the findings of a measurement, relative to the project."""
    return f"{OWN}/checks/{measurement.removesuffix('.nc')}.json"


class CheckPage:
    """The page in one tab.

    Parameters
    ----------
    work : Workspace
    measurements : their names
    models : names of the surfaces of bodies
    """

    def __init__(self, work: Workspace, measurements: Sequence[str], models: Sequence[str]) -> None:
        self.work = work
        with ui.element("div").classes("columns"):
            with ui.element("div").classes("stack"):
                with card("Do the views agree?", AGREE), ui.element("div").classes("form"):
                    name = work.draft(PAGE.name).get("measurement")
                    self.choice = FileChoice("Measurement", measurements, name, work.measurements, self._on_choice)
                    self.views = JobForm(
                        work, f"{PAGE.name}.views", Form(self._record(), only=VIEW_SETTINGS), self._view_words,
                        "Compare the views", out=lambda: findings_file(self.choice.name), lines=0,
                        on_end=self._on_end,
                    )  # fmt: skip
                with card("Is the rig as it was calibrated?", REFINE), ui.element("div").classes("form"):
                    record = replace(self._record(), refine=("cameras",))
                    self.rig = JobForm(
                        work, f"{PAGE.name}.rig", Form(record, only=RIG_SETTINGS), self._refine_words, "Refine",
                        lines=RIG_LINES,
                    )  # fmt: skip
                with card("Is there a model in the flow?", MODEL), ui.element("div").classes("form"):
                    self._build_model(models)
            with ui.element("div").classes("stack"):
                with card("Findings"):
                    self.findings = ui.element("div").classes("stack").props('aria-live="polite"')
                with card("Outlines of the model") as self.outline_card:
                    self.outlines = ui.element("div")
                with card("Undone") as self.correction:
                    self.correction_status = JobStatus(work, f"{PAGE.name}.undone", on_continue=self.choice.choose)
        self.correction.set_visibility(bool(self.correction_status.job))
        self._show_outlines()
        self.show()

    def _build_model(self, models: Sequence[str]) -> None:
        """The form that adds a body to the measurement."""
        self.body: JobForm | None = None
        if not models:
            text_html(NO_MODEL, classes="status")
            return
        work = self.work
        name = work.draft(f"{PAGE.name}.body").get("model")
        self.model = FileChoice("Model", models, name, work.models, self._on_model)
        self.body = JobForm(
            work, f"{PAGE.name}.body.form", Form(BodyInFlow(Path()), only=MODEL_SETTINGS), self._body_words,
            "Add the model", out=self._with_model, on_end=self._on_body,
        )  # fmt: skip

    def _with_model(self) -> str:
        """The measurement with the model, in place of an earlier one."""
        return f"{self.choice.name.removesuffix('.nc')}.body.nc"

    def _body_words(self) -> list[str]:
        return ["body", self.choice.name, self.model.name, "--out", self._with_model(), "--force"]

    def _on_model(self) -> None:
        self.work.keep(f"{PAGE.name}.body", {"model": self.model.name})
        assert self.body is not None
        self.body.show()

    async def _on_body(self, job: CommandRun) -> None:
        self._show_outlines()

    def _show_outlines(self) -> None:
        """Show the outlines of the model over the measured values, once there is a measurement with it."""
        figure = self.work.project.path(self._with_model().removesuffix(".nc") + ".bodies.png")
        self.outlines.clear()
        self.outline_card.set_visibility(figure.is_file())
        if figure.is_file():
            with self.outlines, Image.open(figure, formats=("PNG",)) as image:
                ui.image(image.copy()).props('alt="Outlines of the model in each view"')

    def _record(self) -> Check:
        return Check(self.work.project.path(self.choice.name))

    def _view_words(self) -> list[str]:
        return ["check", self.choice.name, "--findings", findings_file(self.choice.name)]

    def _refine_words(self) -> list[str]:
        return ["check", self.choice.name, "--refine", "cameras"]

    def _on_choice(self) -> None:
        self.work.keep(PAGE.name, {"measurement": self.choice.name})
        self.correction.set_visibility(bool(self.correction_status.job))
        self.views.show()
        self.rig.show()
        if self.body is not None:
            self.body.show()
        self._show_outlines()
        self.show()

    async def _on_end(self, job: CommandRun) -> None:
        """Show what the run has written."""
        if job.state == "done":
            self.show()

    def show(self) -> None:
        """Show the findings of the selected measurement, which outlive page and server."""
        name, result = self.choice.name, None
        messages: list[str] = []
        with refusals(messages.append):
            result, note = self._read(name)
            messages += [note] if note else []
        self.findings.clear()
        with self.findings:
            for text in messages:
                text_html(text, classes="status")
            if result is not None:
                self._show(name, result)

    def _read(self, name: str) -> tuple[CheckFindings | None, str]:
        """Return the findings of a measurement, None before its first comparison, and a note about them."""
        path, measurement = map(self.work.project.path, (findings_file(name), name))
        if not path.is_file():
            return None, NOT_COMPARED
        result = self.work.project.from_cache(findings_file(name), "findings", read_findings)
        return result, CHANGED if path.stat().st_mtime_ns < measurement.stat().st_mtime_ns else ""

    def _show(self, name: str, result: CheckFindings) -> None:
        """The verdicts, and the correction that is offered."""
        ui.html(views_table(result), sanitize=False)
        if result.findings:
            ui.html(f"<h3>Found</h3>{items_html([str(finding) for finding in result.findings])}", sanitize=False)
        elif result.views:
            text_html("No problems found.", classes="status")
        if result.remarks:
            ui.html(f"<h3>Notes</h3>{items_html(result.remarks, '')}", sanitize=False)
        if result.correctable:
            out = self.work.project.free_name(f"{name.removesuffix('.nc')}.corrected.nc")
            arguments = ["check", name, "--out", out, *self.views.view.arguments]
            text_html("The mistakes can be undone, in a new file:", "h3")
            line = CommandLine()
            line.show(arguments)

            def correct() -> None:
                with refusals():
                    self.correction_status.follow(self.work.jobs.add(arguments, f"Correct {name}"))
                    self.correction.set_visibility(True)
                    button.disable()

            button = ui.button("Correct the mistakes", icon="auto_fix_high", on_click=correct)
            button.props("unelevated no-caps")
        elif result.views and not result.findings:
            link = "<a href='reconstruct'>Go on to Reconstruct</a>"
            ui.html(f"<p>{link}</p>", sanitize=False)


def views_table(result: CheckFindings) -> str:
    """Return the agreement of every view as HTML; nothing where there are too few views."""
    if not result.views:
        return ""
    rows = {
        v.name: (v.measured, f"{v.valid:.1%}", f"{v.agreement:.2f}", f"{v.gain:.2f}", v.verdict or "fits")
        for v in result.views
    }
    return table_html("Agreement of the views", ("View", "Measured", "Valid", "Agreement", "Gain", "Verdict"), rows)


async def build(work: Workspace) -> None:
    """Build the page."""
    measurements = await work.measurements()
    if not measurements:
        text_html("There is no measurement in the folder yet: Displacement makes one of images.", classes="status")
        return
    CheckPage(work, measurements, await work.models())


HINT = Hint(
    "Predicts each view from the others, and so detects mirrored, exchanged or wrongly signed images.",
    "Fill in the values: few voxels, for a quick comparison. Press Compare the views.",
    "All views should agree: an agreement of about 0.7 or more, a gain near 1, and no problems.",
    before="displacement",
    values={"check.views": {"voxels": 12}},
    done=lambda work: any((work.project.folder / OWN / "checks").rglob("*.json")),
)
ABOUT = "Errors of the data and of the calibration, before the reconstruction."
PAGE = Page("check", "Check", "/check", ABOUT, build, HINT)
