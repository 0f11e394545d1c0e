"""How one run goes, told where it was asked for: it waits, what it says, how it ended."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence

from nicegui import ui

from nerif.app.jobs import Job
from nerif.app.pieces import text_html
from nerif.app.workspace import Workspace
from nerif.conventions import InputError

__all__ = ["JobTold"]

EVERY = 0.7  # seconds
LINES = {"done": 3, "failed": 30, "stopped": 3}  # of the log, by the state in which it ended
SAID = {"done": "It is done.", "failed": "It failed; what it said:", "stopped": "It was stopped."}


class JobTold:
    """A few lines about one run, where the page is being built.

    Parameters
    ----------
    work : Workspace
    keep : told the number of the run that is followed, or an empty text once it has ended
    ended : done when it has
    job : number of the run to begin with; empty if there is none
    """

    def __init__(
        self, work: Workspace, keep: Callable[[str], None], ended: Callable[[Job], Awaitable[None]] | None = None,
        job: str = "",
    ) -> None:  # fmt: skip
        self.work, self.job, self._keep, self._ended = work, job, keep, ended
        self._shown: tuple[str, ...] = ()
        self.place = ui.element("div").props("role=status aria-live=polite")
        with ui.element("div"):
            ui.timer(EVERY, self._look)

    def follow(self, job: Job) -> None:
        """Tell of that run from now on."""
        self.job = job.id
        self._keep(self.job)
        self._say("It waits in the queue.")

    def _say(self, text: str, log: Sequence[str] = ()) -> None:
        if self._shown == (text, *log):
            return
        self._shown = (text, *log)
        self.place.clear()
        with self.place:
            text_html(text, classes="told")
            if log:
                text_html("\n".join(log), "pre", "said")

    async def _look(self) -> None:
        if not self.job:
            return
        try:
            job = await self.work.beside(self.work.jobs.get, self.job)
        except InputError:  # forgotten in another tab
            self.job = ""
            self._keep("")
            return
        log = await self.work.beside(self.work.jobs.log, job.id, LINES.get(job.state, 1))
        lines = [line.rpartition("\r")[2] for line in log]  # of a progress bar, as it stands
        if job.id != self.job:  # another one has been started meanwhile
            return
        if job.state not in SAID:
            self._say("It waits in the queue." if job.state == "queued" else f"It is {job.state}.", lines)
            return
        self._say(SAID[job.state], lines)
        self.job = ""
        self._keep("")
        if self._ended is not None:
            await self._ended(job)
