"""Status of one run on the page that started it: state, last lines of the log, and a button to continue."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence

from nicegui import ui

from nerif.app.elements import text_html
from nerif.app.jobs import REFUSED, Job
from nerif.app.workspace import Workspace
from nerif.common.conventions import InputError

__all__ = ["LINES", "JobStatus"]

EVERY = 0.7  # seconds
LINES = 3  # of the log
ENDS = {"done": "It is done.", "failed": "It failed; end of the log:", "stopped": "It was stopped.", "refused": REFUSED}


class JobStatus:
    """State and log of one run, added to the page under construction and restored after a reload.

    Parameters
    ----------
    work : workspace of the project
    name : key of the draft with the id of the run
    on_end : called when the run has ended
    offer : called by a button that continues with the output; None for no button
    lines : number of log lines shown after success
    """

    def __init__(
        self, work: Workspace, name: str, on_end: Callable[[Job], Awaitable[None]] | None = None,
        offer: Callable[[str], Awaitable[None]] | None = None, lines: int = LINES,
    ) -> None:  # fmt: skip
        self.work, self.name, self.job = work, name, str(work.draft(name).get("job", ""))
        self._on_end, self._offer, self._lines = on_end, offer, {"done": lines, "failed": 30}
        self._content: tuple[str, ...] = ()
        self.place = ui.element("div").props("role=status aria-live=polite")
        self.further = ui.element("div")
        with ui.element("div"):
            ui.timer(EVERY, self._look)

    def follow(self, job: Job) -> None:
        """Show this run."""
        self.job = job.id
        self.work.keep(self.name, {"job": job.id})
        self.further.clear()
        self._show("It waits in the queue.")

    def _show(self, text: str, log: Sequence[str] = ()) -> None:
        if self._content == (text, *log):
            return
        self._content = (text, *log)
        self.place.clear()
        with self.place:
            text_html(text, classes="status")
            if log:
                text_html("\n".join(log), "pre", "output")

    def _forget(self) -> None:
        """Show no run; the draft of a run started in another tab stays."""
        if self.work.draft(self.name).get("job") == self.job:
            self.work.keep(self.name, {})
        self.job = ""

    async def _look(self) -> None:
        if not (id := self.job):
            return
        try:
            job = await self.work.beside(self.work.jobs.get, id)
            log = await self.work.beside(self.work.jobs.log, id, self._lines.get(job.state, LINES))
        except InputError:  # removed in another tab
            if id == self.job:
                self._forget()
            return
        if id != self.job:  # another run has started meanwhile
            return
        lines = [line.rpartition("\r")[2] for line in log]  # the last state of a progress bar
        if job.state not in ENDS:
            self._show("It waits in the queue." if job.state == "queued" else f"It is {job.state}.", lines[-1:])
            return
        self._show(ENDS[job.state], lines)
        self._forget()
        if self._offer is not None and job.state == "done" and job.file:
            self._go_on(self._offer, self.work.project.relative(job.file))
        if self._on_end is not None:
            await self._on_end(job)

    def _go_on(self, offer: Callable[[str], Awaitable[None]], file: str) -> None:
        self.further.clear()
        with self.further:
            button = ui.button(f"Go on with {file}", icon="arrow_forward", on_click=lambda: offer(file))
            button.props("unelevated no-caps")
