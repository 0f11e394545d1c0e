"""Results: fields, verdicts, comparison, export."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from nicegui import ui

from nerif.app.forms.elements import CommandLine, card, figures, html, refusals, select, text_field, text_html
from nerif.app.forms.form import Form
from nerif.app.forms.job_form import JobForm, JobStatus
from nerif.app.pages.page import Hint, Page
from nerif.app.project.jobs import CommandRun
from nerif.app.project.workspace import Workspace
from nerif.app.views.result_table import Row, result_table, rows_of
from nerif.app.views.result_view import ResultView
from nerif.app.views.routes import report_address, report_file
from nerif.cli.commands.export import Export
from nerif.cli.commands.figures import Figures
from nerif.cli.commands.movie import MovieCommand
from nerif.common.installation import install, word_of
from nerif.common.settings import MISSING
from nerif.data.volume import FORMATS

__all__ = ["PAGE"]

TABS = {"slices": "Slices", "surface": "In 3-D", "report": "Report", "export": "Export"}
PROGRAMS = {
    ".vti": "ParaView (.vti)", ".nc": "NetCDF (.nc)", ".npz": "NumPy (.npz)", ".mat": "MATLAB (.mat)",
    ".csv": "Text (.csv)",
}  # fmt: skip


class ResultsPage:
    """The page in one tab."""

    def __init__(self, work: Workspace, rows: Sequence[Row]) -> None:
        self.work, self.rows = work, rows
        self.draft: dict[str, Any] = dict(work.draft(PAGE.name))
        with ui.element("div").classes("stack"):
            self.table = ui.element("div")
            self.place = ui.element("div").classes("stack")

    @property
    def row(self) -> Row:
        """The result that is shown."""
        return next((row for row in self.rows if row.name == self.draft.get("result")), self.rows[0])

    def keep(self) -> None:
        """Store the choices in the draft."""
        self.work.keep(PAGE.name, self.draft)

    async def choose(self, name: str) -> None:
        """Show another result."""
        self.draft["result"] = name
        await self.build()

    async def build(self) -> None:
        """Build everything for the selected result."""
        self.keep()
        self.table.clear()
        self.place.clear()
        with self.table, card("In this folder"):
            if not self.rows:
                text = "No result in this folder yet: the page Reconstruct makes one, or nerif reconstruct."
                text_html(text, classes="note")
                return
            result_table(self.rows, self.row.name, self.choose)
        with self.place:
            self._verdict()
            await self._views()

    def _verdict(self) -> None:
        with card(self.row.title):
            text_html(self.row.sentence)
            if self.row.figures:
                html(figures([(a, b, "") for a, b in self.row.figures]))

    async def _views(self) -> None:
        with ui.element("section").classes("card").props('aria-label="The result"'):
            with ui.tabs().props("align=left dense") as tabs:
                for name, title in TABS.items():
                    ui.tab(name, title)
            others = [r.name for r in self.rows if r.name != self.row.name and r.film == self.row.film]
            view = ResultView(self.work, self.row.name, others, self.draft, self.keep)
            tab = self.draft.get("tab") if self.draft.get("tab") in TABS else "slices"
            with ui.tab_panels(tabs, value=tab, animated=False).classes("panels-of-tabs") as panels:
                with ui.tab_panel("slices"):
                    await view.build()
                with ui.tab_panel("surface"):
                    surface = ui.element("div").classes("stack")
                with ui.tab_panel("report"):
                    self._report()
                with ui.tab_panel("export"):
                    self._export()

        async def on_change() -> None:
            self.draft["tab"] = panels.value
            self.keep()
            if panels.value == "surface":  # of the quantity in the slices
                surface.clear()
                with surface, refusals():
                    await view.surfaces()

        panels.on_value_change(on_change)
        if panels.value == "surface":
            await on_change()

    # -- report --------------------------------------------------------------------------------------------------

    def _report(self) -> None:
        name = self.row.name
        file = report_file(self.work.project.path(name))
        if file.is_file():
            address = report_address(name, file.stat().st_mtime_ns)
            ui.link("Open the report alone", address, new_tab=True).classes("alone").props("rel=noopener")
            frame = ui.element("iframe").classes("report").props('sandbox="allow-scripts allow-downloads" loading=lazy')
            frame.props.update({"src": address, "title": f"Report of {self.row.title}"})
        else:
            text_html("There is no report yet.", classes="note")
        text_html("The same on the command line", "h3")
        CommandLine().show(["report", name])

        def write() -> None:
            with refusals():
                status.follow(self.work.jobs.add(["report", name], f"Report {self.row.title}"))

        async def on_end(job: CommandRun) -> None:
            if job.state == "done":
                await self.build()

        button = "Write it again" if file.is_file() else "Write the report"
        ui.button(button, icon="playlist_add", on_click=write).props("outline")
        status = JobStatus(self.work, f"{PAGE.name}.report {name}", on_end)

    # -- for others ----------------------------------------------------------------------------------------------

    def _export(self) -> None:
        with ui.element("div").classes("halves"):
            if self.row.film:
                with card("A movie", f"Every frame drawn off-screen; needs {install('movie')}."):
                    movie = MovieCommand(MISSING, MISSING)
                    formats = {".mp4": "H.264 (.mp4)", ".gif": "GIF (.gif)"}
                    self._file_form("movie", movie, formats, "Make the movie", ("style", "every"))
                return
            with card("The field, for other programs", "On any grid: a network has no voxels of its own."):
                formats = {ending: PROGRAMS.get(ending, ending) for ending in FORMATS}
                record = Export(MISSING, MISSING)
                self._file_form("export", record, formats, "Export", ("voxels", "quantities"))
            note = "Vector PDF and PNG, as wide as the columns of a journal."
            with card("Figures for print", note), ui.element("div").classes("form"):
                text_html(f"They are written to {self.row.title}/figures.", classes="note")
                self._form("figures", Figures(MISSING), lambda: [], "Draw the figures")

    def _file_form(self, verb: str, record: Any, formats: Mapping[str, str], button: str, main: Sequence[str]) -> None:
        """Build the form of a command that writes a file, with a choice of its format that changes its name."""

        def name_with(ending: str) -> str:
            return self.work.project.free_name(f"exports/{PurePosixPath(self.row.title).stem}{ending}")

        with ui.element("div").classes("form"):
            choice = select("Format", dict(formats))
            name = text_field("File to write", name_with(choice.value))
            job_form = self._form(
                verb, record, lambda: ["-o", word_of(name.value or "FILE")], button, main, lambda: name.value
            )
        choice.on_value_change(lambda: name.set_value(name_with(choice.value)))
        name.on_value_change(job_form.show)

    def _form(
        self, verb: str, record: Any, words: Callable[[], list[str]], button: str, main: Sequence[str] = (),
        out: Callable[[], str] | None = None,
    ) -> JobForm:  # fmt: skip
        form, name = Form(record, without=("config", "result", "out", "force")), self.row.name
        return JobForm(
            self.work, f"{PAGE.name}.{verb}", form, lambda: [verb, name, *words()], button, main, out, subject=name
        )  # fmt: skip


async def build(work: Workspace) -> None:
    """Build the page."""
    page = ResultsPage(work, await work.in_thread(rows_of, work.project, await work.contents()))
    await page.build()


ABOUT = "Fields, verdicts, comparison, export."
HINT = Hint(
    "Shows the field with its verdict, compares results, and exports them.",
    "Move the sliders of the slices. Then open the tabs In 3-D, Report and Export.",
    "The verdict states whether the field can be used, and why. This result of few steps is to be used with care: a "
    "longer run with a withheld view also estimates the error.",
    before="reconstruct",
)
PAGE = Page("results", "Results", ABOUT, build, HINT)
