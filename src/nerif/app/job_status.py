"""Status of a run on the page that started it: waiting, output, outcome, next steps."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence

from nicegui import ui

from nerif.app.jobs import REFUSED, Job
from nerif.app.pieces import text_html
from nerif.app.workspace import Workspace
from nerif.common.conventions import InputError

__all__ = ["LINES", "JobStatus"]

EVERY = 0.7  # seconds
LINES = 3  # of the log
SAID = {"done": "It is done.", "failed": "It failed; what it said:", "stopped": "It was stopped.", "refused": REFUSED}


class JobStatus:
    """A few lines about one run, where the page is being built; a page that is loaded again goes on with it.

    Parameters
    ----------
    work : Workspace
    name : under which the run is kept over a reload
    ended : done when it has
    offer : done by a button that goes on with the file that the run has written; None for no button
    lines : of what it has said, that are shown when it has ended well
    """

    def __init__(
        self, work: Workspace, name: str, ended: Callable[[Job], Awaitable[None]] | None = None,
        offer: Callable[[str], Awaitable[None]] | None = None, lines: int = LINES,
    ) -> None:  # fmt: skip
        self.work, self.name, self.job = work, name, str(work.draft(name).get("job", ""))
        self._ended, self._offer, self._lines = ended, offer, {"done": lines, "failed": 30}
        self._shown: tuple[str, ...] = ()
        self.place = ui.element("div").props("role=status aria-live=polite")
        self.further = ui.element("div")
        with ui.element("div"):
            ui.timer(EVERY, self._look)

    def follow(self, job: Job) -> None:
        """Follow that run."""
        self.job = job.id
        self.work.keep(self.name, {"job": job.id})
        self.further.clear()
        self._say("It waits in the queue.")

    def _say(self, text: str, log: Sequence[str] = ()) -> None:
        if self._shown == (text, *log):
            return
        self._shown = (text, *log)
        self.place.clear()
        with self.place:
            text_html(text, classes="status")
            if log:
                text_html("\n".join(log), "pre", "said")

    def _forget(self) -> None:
        """Follow nothing; a run that another tab has started meanwhile stays kept."""
        if self.work.draft(self.name).get("job") == self.job:
            self.work.keep(self.name, {})
        self.job = ""

    async def _look(self) -> None:
        if not (id := self.job):
            return
        try:
            job = await self.work.beside(self.work.jobs.get, id)
            log = await self.work.beside(self.work.jobs.log, id, self._lines.get(job.state, LINES))
        except InputError:  # forgotten in another tab
            if id == self.job:
                self._forget()
            return
        if id != self.job:  # another one has been started meanwhile
            return
        lines = [line.rpartition("\r")[2] for line in log]  # of a progress bar, as it stands
        if job.state not in SAID:
            self._say("It waits in the queue." if job.state == "queued" else f"It is {job.state}.", lines[-1:])
            return
        self._say(SAID[job.state], lines)
        self._forget()
        if self._offer is not None and job.state == "done" and job.file:
            self._go_on(self._offer, self.work.project.relative(job.file))
        if self._ended is not None:
            await self._ended(job)

    def _go_on(self, offer: Callable[[str], Awaitable[None]], file: str) -> None:
        self.further.clear()
        with self.further:
            button = ui.button(f"Go on with {file}", icon="arrow_forward", on_click=lambda: offer(file))
            button.props("unelevated no-caps")
