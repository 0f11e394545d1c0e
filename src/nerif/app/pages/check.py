"""Check: do the views of a measurement agree, and which correction is offered where they do not?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from nicegui import ui
from PIL import Image

from nerif.analysis.consistency_file import CheckFindings, read_findings
from nerif.app.forms.elements import CommandLine, FileChoice, card, html, items_html, refusals, table_html, text_html
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
    """The page in one tab, from the names of measurements and of surfaces of bodies."""

    def __init__(self, work: Workspace, measurements: Sequence[str], models: Sequence[str]) -> None:
        self.work = work
        with ui.element("div").classes("columns"):
            with ui.element("div").classes("stack"):
                with card("Do the views agree?", AGREE), ui.element("div").classes("form"):
                    name = work.draft(PAGE.name).get("measurement")
                    self.choice = FileChoice("Measurement", measurements, name, work.measurements, self._on_choice)
                    record = Check(work.project.path(self.choice.name))
                    self.views = JobForm(
                        work, f"{PAGE.name}.views", Form(record, only=VIEW_SETTINGS),
                        lambda: ["check", self.choice.name, "--findings", findings_file(self.choice.name)],
                        "Compare the views", out=lambda: findings_file(self.choice.name), lines=0, on_end=self._on_end,
                    )  # fmt: skip
                with card("Is the rig as it was calibrated?", REFINE), ui.element("div").classes("form"):
                    rig = JobForm(
                        work, f"{PAGE.name}.rig", Form(replace(record, refine=("cameras",)), only=RIG_SETTINGS),
                        lambda: ["check", self.choice.name, "--refine", "cameras"], "Refine", lines=RIG_LINES,
                    )  # fmt: skip
                self.forms = [self.views, rig]
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
        self.show()

    def _build_model(self, models: Sequence[str]) -> None:
        if not models:
            text_html(NO_MODEL, classes="status")
            return
        draft = f"{PAGE.name}.body"

        def on_model() -> None:
            self.work.keep(draft, {"model": model.name})
            body.show()

        model = FileChoice("Model", models, self.work.draft(draft).get("model"), self.work.models, on_model)
        body = JobForm(
            self.work, f"{draft}.form", Form(BodyInFlow(Path()), only=MODEL_SETTINGS),
            lambda: ["body", self.choice.name, model.name, "--out", self._with_model(), "--force"], "Add the model",
            out=self._with_model, on_end=self._on_end,
        )  # fmt: skip
        self.forms.append(body)

    def _with_model(self) -> str:
        """The measurement with the model, in place of an earlier one."""
        return f"{self.choice.name.removesuffix('.nc')}.body.nc"

    def _on_choice(self) -> None:
        self.work.keep(PAGE.name, {"measurement": self.choice.name})
        for form in self.forms:
            form.show()
        self.correction.set_visibility(bool(self.correction_status.job))
        self.show()

    async def _on_end(self, job: CommandRun) -> None:
        self.show()

    def show(self) -> None:
        """Show findings, which outlive page and server, and outlines of a model of the selected measurement."""
        figure = self.work.project.path(self._with_model().removesuffix(".nc") + ".bodies.png")
        self.outlines.clear()
        self.outline_card.set_visibility(figure.is_file())
        if figure.is_file():
            with self.outlines, Image.open(figure, formats=("PNG",)) as image:
                ui.image(image.copy()).props('alt="Outlines of the model in each view"')
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
        html(views_table(result))
        if result.findings:
            html(f"<h3>Found</h3>{items_html([str(finding) for finding in result.findings])}")
        elif result.views:
            text_html("No problems found.", classes="status")
        if result.remarks:
            html(f"<h3>Notes</h3>{items_html(result.remarks, '')}")
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

            button = ui.button("Correct the mistakes", icon="auto_fix_high", on_click=correct).props("unelevated")
        elif result.views and not result.findings:
            html("<p><a href='reconstruct'>Go on to Reconstruct</a></p>")


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
PAGE = Page("check", "Check", ABOUT, build, HINT)
