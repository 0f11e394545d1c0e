"""Check: do the views of a measurement agree, and which correction is offered where they do not?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from nicegui import ui

from nerif.analysis.consistency import Consistency, check_consistency
from nerif.app.elements import (
    CommandLine,
    FileChoice,
    card,
    items_html,
    refusals,
    table_html,
    text_html,
    work_in_progress,
)
from nerif.app.form_view import FormView
from nerif.app.forms import Form
from nerif.app.frame import Page
from nerif.app.job_form import JobForm, JobStatus
from nerif.app.workspace import Workspace
from nerif.cli.commands.check import Check
from nerif.data.measurement import Measurement

__all__ = ["PAGE"]

AGREE = "Each is predicted by a quick reconstruction from the others."
REFINE = "Cameras are refined together with a quick field."
VIEW_SETTINGS = ("voxels", "aperture")
RIG_LINES = 60  # of its output: a table of the views and the findings
RIG_SETTINGS = ("pose_sigma_mm", "pose_sigma_deg", "time_limit", "aperture")


class CheckPage:
    """The page in one tab.

    Parameters
    ----------
    work : Workspace
    measurements : their names
    """

    def __init__(self, work: Workspace, measurements: Sequence[str]) -> None:
        self.work = work
        draft = work.draft(PAGE.name)
        with ui.element("div").classes("columns"):
            with ui.element("div").classes("stack"):
                with card("Do the views agree?", AGREE), ui.element("div").classes("form"):
                    name = draft.get("measurement")
                    self.choice = FileChoice("Measurement", measurements, name, work.measurements, self._on_choice)
                    self.form = FormView(Form(self._record(), only=VIEW_SETTINGS), self._on_change, draft.get("values"))
                    self.button = ui.button("Compare the views", icon="rule", on_click=self.compare)
                    self.button.props("unelevated no-caps")
                with card("Is the rig as it was calibrated?", REFINE), ui.element("div").classes("form"):
                    record = replace(self._record(), refine=("cameras",))
                    self.rig = JobForm(
                        work, f"{PAGE.name}.rig", Form(record, only=RIG_SETTINGS), self._refine_words, "Refine",
                        lines=RIG_LINES,
                    )  # fmt: skip
            with ui.element("div").classes("stack"):
                with card("The same on the command line"):
                    self.command = CommandLine()
                with card("Findings"):
                    self.notice = ui.element("div").classes("stack").props('aria-live="polite"')
                    with self.notice:
                        text_html("The views have not been compared yet.", classes="status")
                with card("Undone") as self.correction:
                    self.correction_status = JobStatus(work, f"{PAGE.name}.undone", on_continue=self.choice.choose)
        self.correction.set_visibility(bool(self.correction_status.job))
        self.show()

    def _keep(self) -> None:
        values = self.form.form.changed(self.form.values)
        self.work.keep(PAGE.name, {"measurement": self.choice.name, "values": values})

    def _record(self) -> Check:
        return Check(self.work.project.path(self.choice.name))

    def _refine_words(self) -> list[str]:
        return ["check", self.choice.name, "--refine", "cameras"]

    def show(self) -> None:
        """Show the command line as it is now."""
        self.command.show(self.arguments)
        self.button.set_enabled(self.form.valid)

    def _on_change(self) -> None:
        self._keep()
        self.show()

    @property
    def arguments(self) -> list[str]:
        """Arguments of nerif that compare the views."""
        return ["check", self.choice.name, *self.form.arguments]

    def _on_choice(self) -> None:
        self._keep()
        self.correction.set_visibility(bool(self.correction_status.job))
        self.notice.clear()
        self.show()
        self.rig.show()

    async def compare(self) -> None:
        """Compare the views and show the findings."""
        name, arguments = self.choice.name, self.arguments
        progress = [0.0]

        def step(count: int, total: int) -> None:
            progress[0] = count / max(total, 1)

        def work(settings: Check) -> Consistency:
            measurement = Measurement.read(self.work.project.path(name))
            return check_consistency(measurement, settings.voxels, step, settings.aperture)

        messages: list[str] = []
        result = None
        with work_in_progress(self.button, self.notice), refusals(messages.append):
            with self.notice:
                bar = ui.linear_progress(0, show_value=False).props('aria-label="Comparing the views"')
                ui.timer(0.3, lambda: bar.set_value(progress[0]))
            result = await self.work.in_thread(work, self.form.record())
        with self.notice:
            for text in messages:
                text_html(text, classes="status")
            if result is not None:
                self._show(name, arguments, result)

    def _show(self, name: str, words: Sequence[str], result: Consistency) -> None:
        """The verdicts, and the correction that is offered."""
        ui.html(views_table(result), sanitize=False)
        if result.findings:
            ui.html(f"<h3>Found</h3>{items_html([str(finding) for finding in result.findings])}", sanitize=False)
        elif result.views:
            text_html("No problems found.", classes="status")
        if result.remarks:
            ui.html(f"<h3>Notes</h3>{items_html(result.remarks, '')}", sanitize=False)
        if result.corrections:
            out = self.work.project.free_name(f"{name.removesuffix('.nc')}.corrected.nc")
            arguments = [*words, "--out", out]
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
            link = "<a href='/reconstruct'>Go on to Reconstruct</a>"
            ui.html(f"<p>{link}</p>", sanitize=False)


def views_table(result: Consistency) -> str:
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
    CheckPage(work, measurements)


PAGE = Page("check", "Check", "/check", "Errors of the data and of the calibration, before the reconstruction.", build)
