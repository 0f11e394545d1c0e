"""A form whose settings become a run of nerif: its command line, a button that queues it, and how the run goes."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from nicegui import ui

from nerif.app.form_view import FormView
from nerif.app.forms import Form
from nerif.app.job_told import LINES, JobTold
from nerif.app.pieces import CommandLine, refusals
from nerif.app.workspace import Workspace

__all__ = ["JobForm"]


class JobForm:
    """A form, its command line and a button, where the page is being built.

    Parameters
    ----------
    work : Workspace
    name : under which what is typed is kept over a reload
    form : settings, all but those that `words` gives
    words : the verb, and what stands before the settings of the form
    button : what it says
    main : names of the fields that are seen at once
    out : what is written, relative to the project; its folder is made
    first : done before the run is put into the queue, which it is not where this raises InputError
    about : what the run that goes on is about, by which it is kept over a reload
    offer : done by a button that goes on with what the run has written; None for no button
    lines : of what the run has said, that are shown when it has ended well
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
        self.told = JobTold(work, f"{name}.run {about}".strip(), offer=offer, lines=lines)
        self.show()

    @property
    def arguments(self) -> list[str]:
        """Arguments of nerif."""
        return [*self.words(), *self.view.arguments]

    def show(self) -> None:
        """Show the command line as it is now."""
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
            self.told.follow(self.work.jobs.add(words, f"{words[0].capitalize()} {words[1]}"))
