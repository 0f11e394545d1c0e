"""The guide of a demo project (`nerif app --demo`): a hint on each page, drawn by the frame that all pages share."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from nicegui import ui

from nerif.app.forms.elements import html, refusals
from nerif.app.pages.page import Page
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


def guide(work: Workspace, page: Page, all_pages: Sequence[Page]) -> None:
    """Build the hint of a page of a demo project."""
    if page.hint is None or not is_demo(work.project.folder):
        return
    hint, pages = page.hint, [p for p in all_pages if p.hint is not None]

    def fill_in() -> None:
        """Put the values into the drafts of the page's forms, and build the page again with them."""
        with refusals():
            for key, values in hint.values.items():
                work.keep(key, {**work.draft(key), **values})
            ui.navigate.to(page.path)

    def hide(hidden: bool) -> None:
        work.keep(DRAFT, {"hidden": hidden})
        box.set_visibility(not hidden)
        show.set_visibility(hidden)

    async def refresh() -> None:
        sentence, word, other = await work.in_thread(state, work, page, pages)
        kind = "next" if sentence == OPEN else "next ready"
        link.set_content(f'<a class="{kind}" href="{other.path[1:]}">{word} {escape(other.title)}</a>' if other else "")
        status.set_content(escape(sentence))

    with ui.element("div").classes("guide-place"):
        show = ui.button("Show the guide", icon="school", on_click=lambda: hide(False)).props("flat dense")
        with ui.element("section").classes("guide").props('aria-label="Guide"') as box:
            rows = (("This page", hint.purpose), ("Now", hint.click), ("Look at", hint.look))
            lines = "".join(f"<div><dt>{escape(a)}</dt><dd>{escape(b)}</dd></div>" for a, b in rows)
            step = f"Guide, step {pages.index(page) + 1} of {len(pages)}: {escape(page.title)}"
            html(f"<h2>{step}</h2><dl>{lines}</dl>")
            with ui.element("div").classes("side-by-side"):
                if hint.values:
                    ui.button("Fill in the values", icon="edit_note", on_click=fill_in).props("outline dense")
                link = html()
                status = html().classes("status").props('role=status aria-live="polite"')
                ui.space()
                ui.button("Hide the guide", on_click=lambda: hide(True)).props("flat dense")
    hidden = bool(work.draft(DRAFT).get("hidden"))
    box.set_visibility(not hidden)
    show.set_visibility(hidden)
    ui.timer(EVERY, refresh)
    ui.timer(0.05, refresh, once=True)
