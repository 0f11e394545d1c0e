"""The runs of the project on every page: state, progress and actions."""

from __future__ import annotations

import time
from html import escape
from pathlib import Path

from nicegui import ui

from nerif.app.elements import dialog, refusals, text_html
from nerif.app.jobs import REFUSED, Job
from nerif.app.workspace import Workspace
from nerif.common.conventions import InputError
from nerif.data.volume_sequence import VolumeSequence
from nerif.report.movie import finished_frames
from nerif.results.live import read_live

__all__ = ["JobsDrawer", "film_progress", "progress_of"]

EVERY = 1.0  # seconds
MOST = 30  # runs in the drawer
ACTIONS = {
    "running": ("pause", "stop"),
    "queued": ("first", "earlier", "later", "stop"),
    "paused": ("resume", "stop", "remove"),
    "done": ("remove",),
    "failed": ("resume", "remove"),
    "stopped": ("resume", "remove"),
    "refused": ("remove",),
}
NAMES = {
    "pause": "Pause", "stop": "Stop", "resume": "Go on", "remove": "Forget", "first": "Next", "earlier": "Earlier",
    "later": "Later",
}  # fmt: skip


def progress_of(work: Workspace, job: Job) -> tuple[float, str]:
    """Return the progress of a run, 0 to 1, and its stage; 0 and an empty text if unavailable."""
    if job.out.endswith(".zarr") and job.state in ("running", "paused"):
        return film_progress(work.project.path(job.out))
    live = read_live(work.project.path(job.out)) if job.out and job.state in ("running", "paused") else {}
    if not live or live["written"] < job.started:
        return 0.0, ""
    return float(live["progress"] or 0.0), str(live["title"])


def film_progress(path: Path) -> tuple[float, str]:
    """Return the fraction of complete frames of a film, and the count as text; 0 and empty before there is a store."""
    if not (path / "zarr.json").is_file():
        return 0.0, ""
    try:
        store = VolumeSequence(path)
    except InputError:  # incomplete
        return 0.0, ""
    done, count = len(finished_frames(store)), len(store)
    return done / max(count, 1), f"{done} of {count} frames"


class JobsDrawer:
    """A button with the number of open runs, and the drawer that it opens."""

    def __init__(self, work: Workspace) -> None:
        self.work, self._state = work, ""
        self.button = ui.button("Runs", icon="playlist_play", on_click=self.toggle)
        self.button.props('flat no-caps aria-label="Runs" aria-expanded=false')

    def build(self) -> None:
        """Build the drawer beside the page."""
        with ui.right_drawer(value=False, bordered=True).props("width=380 overlay").classes("runs") as self.drawer:
            ui.html("<h2>Runs</h2>", sanitize=False)
            self._at_once = ui.number(
                "At the same time", value=self.work.jobs.at_once, min=1, max=64, on_change=self._set
            ).props("dense outlined")
            self.place = ui.element("div").props('role="list" aria-label="Runs"')
        ui.timer(EVERY, self._refresh)

    def toggle(self) -> None:
        """Open or close the drawer."""
        self.drawer.toggle()
        self.button.props(f"aria-expanded={'true' if self.drawer.value else 'false'}")

    def _set(self) -> None:
        with refusals():
            self.work.jobs.at_once = int(self._at_once.value or 1)

    async def _refresh(self) -> None:
        jobs, progress = await self.work.beside(self._look)
        open_ = sum(job.state in ("running", "queued", "paused") for job in jobs)
        self.button.set_text(f"Runs ({open_})" if open_ else "Runs")
        state = repr([(j.id, j.state, j.request, j.place) for j in jobs]) + repr(progress)
        if state == self._state:
            return
        self._state = state
        self.place.clear()
        with self.place:
            for job in jobs[:MOST]:
                self._row(job, *progress[job.id])
            if not jobs:
                text_html("No runs yet.", classes="note")

    def _look(self) -> tuple[list[Job], dict[str, tuple[float, str]]]:
        jobs = self.work.jobs.all()
        return jobs, {job.id: progress_of(self.work, job) for job in jobs}

    def _row(self, job: Job, share: float, title: str) -> None:
        state = f"{job.state}, {job.request} requested" if job.state == "running" and job.request else job.state
        with ui.element("div").classes(f"run {job.state}").props('role="listitem"'):
            ui.html(
                f"<b>{escape(job.title)}</b><span class=state>{escape(state)} {escape(title)}</span>"
                f"<code>{escape(job.line)}</code>", sanitize=False,
            )  # fmt: skip
            if job.state == "refused":
                text_html(REFUSED, classes="note")
            if job.state == "running" and share:
                ui.linear_progress(share, show_value=False).props(f'aria-label="{escape(job.title)}"')
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
