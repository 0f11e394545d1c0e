"""The frame of every page: header with the project, links to the pages on the left, runs on the right."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from html import escape
from pathlib import Path

from nicegui import ui

from nerif.app.forms.elements import dialog, html, refusals, text_html
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
RESUME, REMOVE = {"resume": "Go on"}, {"remove": "Forget"}
ACTIONS = {
    "running": {"pause": "Pause", "stop": "Stop"},
    "queued": {"first": "Next", "earlier": "Earlier", "later": "Later", "stop": "Cancel"},
    "paused": {**RESUME, "stop": "Stop", **REMOVE},
    "done": REMOVE,
    "failed": {**RESUME, **REMOVE},
    "stopped": {**RESUME, **REMOVE},
    "held": {"start": "Start", **REMOVE},
}
"""What can be done with a run in a state: methods of Jobs, or MOVES, and labels of their buttons."""
MOVES = {"first": -1_000_000, "earlier": -1, "later": 1}  # places in the queue


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
        folder, name = escape(str(work.project.folder)), escape(work.project.name)
        parent = f"<span class=parent>{folder.removesuffix(name)}</span>"
        html(f"<span class=brand>nerif</span><span class=project title='{folder}'>{parent}{name}</span>").classes(
            "where"
        )
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
        html(f"<nav aria-label='Pages'><ol>{links}</ol></nav>")
    drawer.build()
    with ui.element("main").props('id="main" tabindex="-1"').classes("page"):
        html(f"<h1>{escape(page.title)}</h1><p class=lead>{escape(page.about)}</p>")
        if not work.project.writable:
            html(f"<ul class=notes><li role=status>{READ_ONLY}</li></ul>")
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
        self.button = ui.button("Runs", icon="playlist_play", on_click=lambda: self.drawer.toggle())
        self.button.props('flat aria-label="Runs" aria-expanded=false')

    def build(self) -> None:
        """Build the drawer beside the page."""
        with ui.right_drawer(value=False, bordered=True).props("width=380 overlay").classes("runs") as self.drawer:
            with ui.element("div").classes("drawer-head"):
                html("<h2>Runs</h2>")
                ui.button(icon="close", on_click=self.drawer.hide).props('flat round dense aria-label="Close the runs"')
            at_once = self.work.jobs.at_once
            self._at_once = ui.number("At the same time", value=at_once, min=1, max=64, on_change=self._set)
            self.place = ui.element("div").props('role="list" aria-label="Runs"')
        self.drawer.on_value_change(self._on_toggle)
        ui.timer(EVERY, self._refresh)

    def _on_toggle(self) -> None:
        """Report the state to screen readers, also after a tap beside the drawer."""
        self.button.props["aria-expanded"] = "true" if self.drawer.value else "false"

    def _set(self) -> None:
        with refusals():
            self.work.jobs.at_once = int(self._at_once.value or 1)

    async def _refresh(self) -> None:
        rows = await self.work.in_thread(lambda: [(job, *_progress(self.work, job)) for job in self.work.jobs.all()])
        open_ = sum(job.state in OPEN for job, *_ in rows)
        self.button.set_text(f"Runs ({open_})" if open_ else "Runs")
        if (state := repr(rows)) == self._state:
            return
        self._state = state
        self.place.clear()
        with self.place:
            for row in rows[:LIMIT]:
                self._row(*row)
            if not rows:
                text_html("No runs yet.", classes="note")

    def _row(self, job: CommandRun, share: float, title: str) -> None:
        state = f"{job.state}, {job.request} requested" if job.state == "running" and job.request else job.state
        with ui.element("div").classes(f"run {job.state}").props('role="listitem"'):
            words = f"<b>{escape(job.title)}</b><span class=state>{escape(state)} {escape(title)}</span>"
            html(f"{words}<code>{escape(job.line)}</code>")
            if job.state == "held":
                text_html("Queued with an earlier server. Read its command line before you start it.", classes="note")
            if job.state == "running" and share:
                ui.linear_progress(share, show_value=False).props["aria-label"] = job.title
            with ui.row().classes("gap-1"):
                for action, name in ACTIONS[job.state].items():
                    if action != "pause" or job.resumable:
                        button = ui.button(name, on_click=lambda a=action: self._do(a, job.id)).props("flat dense")
                        button.props["aria-label"] = f"{name}: {job.title}"
                ui.button("Log", on_click=lambda: self._log(job.id)).props("flat dense")

    async def _do(self, action: str, id: str) -> None:
        with refusals():
            if action in MOVES:
                self.work.jobs.move(id, MOVES[action])
            else:
                getattr(self.work.jobs, action)(id)
        await self._refresh()

    def _log(self, id: str) -> None:
        with refusals(), dialog("log"):
            job = self.work.jobs.get(id)
            text = "\n".join(self.work.jobs.log(id)) or "The log is empty."
            began = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(job.started)) if job.started else "not started"
            text_html(job.title, "h2")
            text_html(began, classes="note")
            html(f"<pre tabindex=0>{escape(text)}</pre>")


def _progress(work: Workspace, job: CommandRun) -> tuple[float, str]:
    """Return the progress of a run, 0 to 1, and its stage; 0 and an empty text if unavailable."""
    if ending(job.out) == ".zarr" and job.state in ("running", "paused"):
        return film_progress(work.project.path(job.out))
    live = read_live(work.project.path(job.out)) if job.out and job.state in ("running", "paused") else {}
    if not live or live["written"] < job.started:
        return 0.0, ""
    return float(live["progress"] or 0.0), str(live["title"])
