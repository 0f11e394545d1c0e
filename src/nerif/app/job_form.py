"""A form for a run of nerif: settings, command line, a button that queues the run, and its status."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from nicegui import ui

from nerif.app.elements import CommandLine, refusals
from nerif.app.form_view import FormView
from nerif.app.forms import Form
from nerif.app.job_status import LINES, JobStatus
from nerif.app.workspace import Workspace

__all__ = ["JobForm"]


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
    first : called before the run is queued; an InputError prevents the run
    about : subject of the run, part of the key that restores its status after a reload
    offer : called by a button that continues with the output; None for no button
    lines : number of log lines shown after success
    """

    def __init__(
        self, work: Workspace, name: str, form: Form[Any], words: Callable[[], Sequence[str]], button: str,
        main: Sequence[str] = (), out: Callable[[], str] | None = None,
        first: Callable[[], Awaitable[None]] | None = None, about: str = "",
        offer: Callable[[str], Awaitable[None]] | None = None, lines: int = LINES,
    ) -> None:  # fmt: skip
        self.work, self.name, self.words, self.out, self.first = work, name, words, out, first
        self.view = FormView(form, self._changed, work.draft(name), main)
        self.command = CommandLine()
        self.button = ui.button(button, icon="playlist_add", on_click=self._start).props("unelevated no-caps")
        self.status = JobStatus(work, f"{name}.run {about}".strip(), offer=offer, lines=lines)
        self.show()

    @property
    def arguments(self) -> list[str]:
        """Arguments of nerif for the run."""
        return [*self.words(), *self.view.arguments]

    def show(self) -> None:
        """Update the command line and the button."""
        if hasattr(self, "command"):
            self.command.show(self.arguments)
            self.button.set_enabled(self.view.valid)

    def _changed(self) -> None:
        self.work.keep(self.name, self.view.form.changed(self.view.values))
        self.show()

    async def _start(self) -> None:
        with refusals():
            self.view.record()
            if self.first is not None:
                await self.first()
            if self.out is not None:
                self.work.project.path(self.out()).parent.mkdir(parents=True, exist_ok=True)
            words = self.arguments
            self.status.follow(self.work.jobs.add(words, f"{words[0].capitalize()} {words[1]}"))
