"""A form for a run of nerif: settings, command line, a button that queues the run, and its status."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from nicegui import ui

from nerif.app.forms.elements import CommandLine, refusals, text_html
from nerif.app.forms.form import Form
from nerif.app.forms.form_view import FormView
from nerif.app.project.jobs import CommandRun
from nerif.app.project.workspace import Workspace
from nerif.common.conventions import InputError

__all__ = ["JobForm", "JobStatus"]

EVERY = 0.7  # seconds
LINES, NOTE = 3, "note: "  # of the log; beginning of a note
STATES = {
    "queued": "It waits in the queue.", "held": "Start it under Runs: another server queued it.",
    "running": "It is running.", "paused": "It is paused.", "done": "It is done.",
    "failed": "It failed; end of the log:", "stopped": "It was stopped.",
}  # fmt: skip
ENDS = ("done", "failed", "stopped")


class JobForm:
    """A form, its command line, a button and the status, added to the page under construction.

    Parameters
    ----------
    work : workspace of the project
    name : key of the draft that restores the values after a reload
    form : settings without those in `words`
    words : returns the verb and the arguments before the settings of the form
    button : label of the button
    main : names of the fields at the top of the form
    out : returns the output, relative to the project; its folder is created
    before : called before the run is queued; an InputError prevents the run
    ready : returns whether what the page sets besides the form is complete
    subject : subject of the run, part of the key that restores its status after a reload
    status : further arguments of `JobStatus`
    """

    def __init__(
        self, work: Workspace, name: str, form: Form[Any], words: Callable[[], Sequence[str]], button: str,
        main: Sequence[str] = (), out: Callable[[], str] | None = None,
        before: Callable[[], Awaitable[None]] | None = None, subject: str = "",
        ready: Callable[[], bool] = lambda: True, **status: Any,
    ) -> None:  # fmt: skip
        self.work, self.name, self.words, self.out, self.before, self.ready = work, name, words, out, before, ready
        self.view = FormView(form, self._on_change, work.draft(name), main)
        self.command = CommandLine()
        self.button = ui.button(button, icon="playlist_add", on_click=self._start).props("unelevated")
        self.status = JobStatus(work, f"{name}.run {subject}".strip(), **status)
        self.show()

    @property
    def arguments(self) -> list[str]:
        """Arguments of nerif for the run."""
        return [*self.words(), *self.view.arguments]

    def show(self) -> None:
        """Update the command line and the button."""
        if hasattr(self, "command"):
            self.command.show(self.arguments)
            self.button.set_enabled(self.view.valid and self.ready())

    def _on_change(self) -> None:
        self.work.keep(self.name, self.view.form.changed(self.view.values))
        self.show()

    async def _start(self) -> None:
        with refusals():
            self.view.record()
            if self.before is not None:
                await self.before()
            if self.out is not None:
                self.work.project.path(self.out()).parent.mkdir(parents=True, exist_ok=True)
            words = self.arguments
            title = f"{words[0].capitalize()} {self.work.project.title(words[1])}"
            self.status.follow(self.work.jobs.add(words, title))


class JobStatus:
    """State and log of one run, added to the page under construction and restored after a reload.

    Parameters
    ----------
    work : workspace of the project
    name : key of the draft with the id of the run
    on_end : called when the run has ended
    on_continue : called by a button that continues with the output; None for no button
    lines : number of log lines shown after success, besides all notes
    """

    def __init__(
        self, work: Workspace, name: str, on_end: Callable[[CommandRun], Awaitable[None]] | None = None,
        on_continue: Callable[[str], Awaitable[None]] | None = None, lines: int = LINES,
    ) -> None:  # fmt: skip
        self.work, self.name, self.job = work, name, str(work.draft(name).get("job", ""))
        self._on_end, self._on_continue, self._lines = on_end, on_continue, {"done": lines, "failed": 30}
        self._content: tuple[str, ...] = ()
        with ui.element("div"):
            self.place = ui.element("div").props("role=status aria-live=polite")
            self.further = ui.element("div")
            ui.timer(EVERY, self._look)

    def follow(self, job: CommandRun) -> None:
        """Show this run."""
        self.job = job.id
        self.work.keep(self.name, {"job": job.id})
        self.further.clear()
        self._show(STATES["queued"])

    def _show(self, *content: str) -> None:
        """Show the state and lines of the log."""
        if self._content == content:
            return
        self._content = content
        self.place.clear()
        with self.place:
            text_html(content[0], classes="status")
            if content[1:]:
                text_html("\n".join(content[1:]), "pre", "output")

    def _forget(self) -> None:
        """Show no run; the draft of a run started in another tab stays."""
        if self.work.draft(self.name).get("job") == self.job:
            self.work.keep(self.name, {})
        self.job = ""

    async def _look(self) -> None:
        if not (id := self.job):
            return
        try:
            job = await self.work.in_thread(self.work.jobs.get, id)
            log = await self.work.in_thread(self.work.jobs.log, id)
        except InputError:  # removed in another tab
            if id == self.job:
                self._forget()
            return
        if id != self.job:  # another run has started meanwhile
            return
        over = job.state in ENDS
        last = len(log) - (self._lines.get(job.state, LINES) if over else 1)
        lines = [line for i, line in enumerate(log) if i >= last or (over and line.startswith(NOTE))]
        self._show(STATES[job.state], *(line.rpartition("\r")[2] for line in lines))  # the last of a progress bar
        if not over:
            return
        self._forget()
        if self._on_continue is not None and job.state == "done" and job.file:
            on_continue, file = self._on_continue, self.work.project.relative(job.file)
            self.further.clear()
            with self.further:
                button = ui.button(f"Go on with {file}", icon="arrow_forward", on_click=lambda: on_continue(file))
                button.props("unelevated")
        if self._on_end is not None:
            await self._on_end(job)
