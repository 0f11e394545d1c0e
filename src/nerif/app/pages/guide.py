"""The guide of a demo project (`nerif app --demo`): a hint on each page, drawn by the frame that all pages share."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from nicegui import ui

from nerif.app.forms.elements import refusals
from nerif.app.pages.page import Hint, Page
from nerif.app.project.demo_project import is_demo
from nerif.app.project.workspace import Workspace

__all__ = ["guide", "state"]

EVERY = 1.5  # seconds
DRAFT = "guide"
OPEN = "Not done yet."
LAST = "This was the last page. For images of your own: nerif app FOLDER."


def state(work: Workspace, page: Page, pages: Sequence[Page]) -> tuple[str, str, Page | None]:
    """Return the state of a page's step in words, the word of the link, and the page that it leads to, if any."""
    assert page.hint is not None
    for before in pages:
        if before.hint and before.name == page.hint.before and before.hint.done and not before.hint.done(work):
            return f"First complete the step {before.title}.", "Back to", before
    after = next(iter(pages[pages.index(page) + 1 :]), None)
    if page.hint.done is None:
        return "" if after else LAST, "Next:", after
    return "Done." if page.hint.done(work) else OPEN, "Next:", after


def guide(work: Workspace, page: Page, pages: Sequence[Page]) -> None:
    """Build the hint of a page of a demo project."""
    if page.hint is not None and is_demo(work.project.folder):
        GuideView(work, page, page.hint, pages)


class GuideView:
    """The hint of a page in one tab.

    Parameters
    ----------
    work : Workspace
    page : the page
    hint : its hint
    pages : all pages in their order
    """

    def __init__(self, work: Workspace, page: Page, hint: Hint, pages: Sequence[Page]) -> None:
        self.work, self.page, self.hint, self.pages = work, page, hint, [p for p in pages if p.hint is not None]
        with ui.element("div").classes("guide-place"):
            self.show_button = ui.button("Show the guide", icon="school", on_click=lambda: self._hide(False))
            self.show_button.props("flat no-caps dense")
            with ui.element("section").classes("guide").props('aria-label="Guide"') as self.box:
                self._build()
        self._show_or_hide()
        ui.timer(EVERY, self._refresh)
        ui.timer(0.05, self._refresh, once=True)

    def _build(self) -> None:
        rows = (("This page", self.hint.purpose), ("Now", self.hint.click), ("Look at", self.hint.look))
        lines = "".join(f"<div><dt>{escape(a)}</dt><dd>{escape(b)}</dd></div>" for a, b in rows)
        step = f"Guide, step {self.pages.index(self.page) + 1} of {len(self.pages)}: {escape(self.page.title)}"
        ui.html(f"<h2>{step}</h2><dl>{lines}</dl>", sanitize=False)
        with ui.element("div").classes("side-by-side"):
            if self.hint.values:
                fill = ui.button("Fill in the values", icon="edit_note", on_click=self._fill_in)
                fill.props("outline no-caps dense")
            self.link = ui.html("", sanitize=False)
            self.status = ui.html("", sanitize=False).classes("status").props('role=status aria-live="polite"')
            ui.space()
            ui.button("Hide the guide", on_click=lambda: self._hide(True)).props("flat no-caps dense")

    async def _refresh(self) -> None:
        """Show the state of the step as it is now."""
        sentence, word, page = await self.work.in_thread(state, self.work, self.page, self.pages)
        kind = "next" if sentence == OPEN else "next ready"
        link = f'<a class="{kind}" href="{page.path[1:]}">{word} {escape(page.title)}</a>' if page else ""
        self.link.set_content(link)
        self.status.set_content(escape(sentence))

    def _fill_in(self) -> None:
        """Put the values into the drafts of the page's forms, and build the page again with them."""
        with refusals():
            for key, values in self.hint.values.items():
                self.work.keep(key, {**self.work.draft(key), **values})
            ui.navigate.to(self.page.path)

    def _hide(self, hidden: bool) -> None:
        self.work.keep(DRAFT, {"hidden": hidden})
        self._show_or_hide()

    def _show_or_hide(self) -> None:
        hidden = bool(self.work.draft(DRAFT).get("hidden"))
        self.box.set_visibility(not hidden)
        self.show_button.set_visibility(hidden)
