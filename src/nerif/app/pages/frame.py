"""The frame of every page: header with the project, links to the pages on the left, runs on the right."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from html import escape
from pathlib import Path

from nicegui import ui

from nerif.app.forms.elements import dialog, refusals, text_html
from nerif.app.pages.guide import guide
from nerif.app.pages.page import Page
from nerif.app.project.jobs import OPEN, CommandRun
from nerif.app.project.workspace import READ_ONLY, Workspace
from nerif.app.views.result_volumes import film_progress
from nerif.common.files import ending
from nerif.results.live import read_live

__all__ = ["JobsDrawer", "frame"]

ASSETS = Path(__file__).parents[1] / "assets"
EVERY = 1.0  # seconds
LIMIT = 30  # runs in the drawer
ACTIONS = {
    "running": ("pause", "stop"),
    "queued": ("first", "earlier", "later", "stop"),
    "paused": ("resume", "stop", "remove"),
    "done": ("remove",),
    "failed": ("resume", "remove"),
    "stopped": ("resume", "remove"),
    "held": ("start", "remove"),
}
NAMES = {
    "pause": "Pause", "stop": "Stop", "resume": "Go on", "remove": "Forget", "first": "Next", "earlier": "Earlier",
    "later": "Later", "start": "Start",
}  # fmt: skip


@cache
def _style() -> str:
    return (ASSETS / "app.css").read_text(encoding="utf-8")


@contextmanager
def frame(work: Workspace, page: Page, pages: Sequence[Page]) -> Iterator[None]:
    """Build the frame of a page; controls created in the context go into its main part."""
    ui.add_css(_style())
    ui.page_title(f"{page.title} – {work.project.name} – nerif")
    dark = ui.dark_mode(None)
    ui.add_body_html('<a class="skip" href="#main">Skip to the page</a>')
    with ui.header(elevated=False).classes("top"):
        menu = ui.button(icon="menu").props('flat round aria-label="Pages"')
        ui.html(
            f"<span class=brand>nerif</span><span class=project title='{escape(str(work.project.folder))}'>"
            f"<span class=parent>{escape(str(work.project.folder).removesuffix(work.project.name))}</span>"
            f"{escape(work.project.name)}</span>", sanitize=False,
        ).classes("where")  # fmt: skip
        ui.space()
        drawer = JobsDrawer(work)
        _switch(dark)
    with ui.left_drawer(value=None, bordered=True).props("width=208 breakpoint=900").classes("side") as left:
        menu.on_click(left.toggle)
        links = "".join(
            f"<li><a href='{p.path[1:]}'{' aria-current=page' if p is page else ''}>"
            f"<span class=number>{i}</span>{escape(p.title)}</a></li>"
            for i, p in enumerate(pages, start=1)
        )
        ui.html(f"<nav aria-label='Pages'><ol>{links}</ol></nav>", sanitize=False)
    drawer.build()
    with ui.element("main").props('id="main" tabindex="-1"').classes("page"):
        ui.html(f"<h1>{escape(page.title)}</h1><p class=lead>{escape(page.about)}</p>", sanitize=False)
        if not work.project.writable:
            ui.html(f"<ul class=notes><li role=status>{READ_ONLY}</li></ul>", sanitize=False)
        guide(work, page, pages)
        yield


def _switch(dark: ui.dark_mode) -> None:
    """Add the menu for light or dark colours."""
    names = {None: "As the system", False: "Light", True: "Dark"}
    icons = {None: "brightness_auto", False: "light_mode", True: "dark_mode"}
    with ui.button(icon=icons[None]).props('flat round aria-label="Light or dark"') as button, ui.menu():
        for value, name in names.items():

            def choose(value: bool | None = value) -> None:
                dark.set_value(value)
                button.set_icon(icons[value])

            ui.menu_item(name, choose)


class JobsDrawer:
    """A button with the number of open runs, and the drawer that it opens."""

    def __init__(self, work: Workspace) -> None:
        self.work, self._state = work, ""
        self.button = ui.button("Runs", icon="playlist_play", on_click=self.toggle)
        self.button.props('flat no-caps aria-label="Runs" aria-expanded=false')

    def build(self) -> None:
        """Build the drawer beside the page."""
        with ui.right_drawer(value=False, bordered=True).props("width=380 overlay").classes("runs") as self.drawer:
            with ui.element("div").classes("drawer-head"):
                ui.html("<h2>Runs</h2>", sanitize=False)
                ui.button(icon="close", on_click=self.drawer.hide).props('flat round dense aria-label="Close the runs"')
            self._at_once = ui.number(
                "At the same time", value=self.work.jobs.at_once, min=1, max=64, on_change=self._set
            ).props("dense outlined")
            self.place = ui.element("div").props('role="list" aria-label="Runs"')
        self.drawer.on_value_change(self._on_toggle)
        ui.timer(EVERY, self._refresh)

    def toggle(self) -> None:
        """Open or close the drawer."""
        self.drawer.toggle()

    def _on_toggle(self) -> None:
        """Report the state to screen readers, also after a tap beside the drawer."""
        self.button.props["aria-expanded"] = "true" if self.drawer.value else "false"

    def _set(self) -> None:
        with refusals():
            self.work.jobs.at_once = int(self._at_once.value or 1)

    async def _refresh(self) -> None:
        jobs, progress = await self.work.in_thread(self._jobs)
        open_ = sum(job.state in OPEN for job in jobs)
        self.button.set_text(f"Runs ({open_})" if open_ else "Runs")
        state = repr([(j.id, j.state, j.request, j.place) for j in jobs]) + repr(progress)
        if state == self._state:
            return
        self._state = state
        self.place.clear()
        with self.place:
            for job in jobs[:LIMIT]:
                self._row(job, *progress[job.id])
            if not jobs:
                text_html("No runs yet.", classes="note")

    def _jobs(self) -> tuple[list[CommandRun], dict[str, tuple[float, str]]]:
        """The runs, and the progress of each by its id."""
        jobs = self.work.jobs.all()
        return jobs, {job.id: _progress(self.work, job) for job in jobs}

    def _row(self, job: CommandRun, share: float, title: str) -> None:
        state = f"{job.state}, {job.request} requested" if job.state == "running" and job.request else job.state
        with ui.element("div").classes(f"run {job.state}").props('role="listitem"'):
            ui.html(
                f"<b>{escape(job.title)}</b><span class=state>{escape(state)} {escape(title)}</span>"
                f"<code>{escape(job.line)}</code>", sanitize=False,
            )  # fmt: skip
            if job.state == "held":
                text_html("Queued with an earlier server. Read its command line before you start it.", classes="note")
            if job.state == "running" and share:
                ui.linear_progress(share, show_value=False).props["aria-label"] = job.title
            with ui.row().classes("gap-1"):
                for action in ACTIONS[job.state]:
                    if action != "pause" or job.resumable:
                        name = "Cancel" if (action, job.state) == ("stop", "queued") else NAMES[action]
                        button = ui.button(name, on_click=lambda a=action, i=job.id: self._do(a, i))
                        button.props("flat dense no-caps").props["aria-label"] = f"{name}: {job.title}"
                ui.button("Log", on_click=lambda i=job.id: self._log(i)).props("flat dense no-caps")

    async def _do(self, action: str, id: str) -> None:
        with refusals():
            getattr(self.work.jobs, action)(id)
        await self._refresh()

    def _log(self, id: str) -> None:
        with refusals(), dialog("log"):
            job = self.work.jobs.get(id)
            text = "\n".join(self.work.jobs.log(id)) or "The log is empty."
            began = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(job.started)) if job.started else "not started"
            text_html(job.title, "h2")
            text_html(began, classes="note")
            ui.html(f"<pre tabindex=0>{escape(text)}</pre>", sanitize=False)


def _progress(work: Workspace, job: CommandRun) -> tuple[float, str]:
    """Return the progress of a run, 0 to 1, and its stage; 0 and an empty text if unavailable."""
    if ending(job.out) == ".zarr" and job.state in ("running", "paused"):
        return film_progress(work.project.path(job.out))
    live = read_live(work.project.path(job.out)) if job.out and job.state in ("running", "paused") else {}
    if not live or live["written"] < job.started:
        return 0.0, ""
    return float(live["progress"] or 0.0), str(live["title"])
