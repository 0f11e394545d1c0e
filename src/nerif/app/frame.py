"""The frame of every page: header with the project, links to the pages on the left, runs on the right."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from nicegui import ui

from nerif.app.jobs_drawer import JobsDrawer
from nerif.app.workspace import READ_ONLY, Workspace

if TYPE_CHECKING:
    from nerif.app.pages import Page

__all__ = ["frame"]

ASSETS = Path(__file__).parent / "assets"


@dataclass(frozen=True)
class Frame:
    """Parts of the frame that a page uses."""

    drawer: JobsDrawer


@cache
def _style() -> str:
    return (ASSETS / "app.css").read_text()


@contextmanager
def frame(work: Workspace, page: Page, pages: Sequence[Page]) -> Iterator[Frame]:
    """Build the frame of a page; controls created in the context go into its main part."""
    ui.add_css(_style())
    ui.page_title(f"{page.title} – {work.project.name} – nerif")
    dark = ui.dark_mode(None)
    ui.add_body_html('<a class="skip" href="#main">Skip to the page</a>')
    with ui.header(elevated=False).classes("top"):
        menu = ui.button(icon="menu").props('flat round aria-label="Pages"')
        ui.html(
            f"<span class=brand>nerif</span><span class=project title='{escape(str(work.project.folder))}'>"
            f"{escape(str(work.project.folder))}</span>", sanitize=False,
        ).classes("where")  # fmt: skip
        ui.space()
        drawer = JobsDrawer(work)
        _switch(dark)
    with ui.left_drawer(value=True, bordered=True).props("width=208 breakpoint=900").classes("side") as left:
        menu.on_click(left.toggle)
        links = "".join(
            f"<li><a href='{p.path}'{' aria-current=page' if p is page else ''}>"
            f"<span class=number>{i}</span>{escape(p.title)}</a></li>"
            for i, p in enumerate(pages, start=1)
        )
        ui.html(f"<nav aria-label='Pages'><ol>{links}</ol></nav>", sanitize=False)
    drawer.build()
    with ui.element("main").props('id="main" tabindex="-1"').classes("page"):
        ui.html(f"<h1>{escape(page.title)}</h1><p class=lead>{escape(page.about)}</p>", sanitize=False)
        if not work.project.writable:
            ui.html(f"<ul class=notes><li role=status>{READ_ONLY}</li></ul>", sanitize=False)
        yield Frame(drawer)


def _switch(dark: ui.dark_mode) -> None:
    """Add the menu for light or dark colours."""
    names = {None: "As the system", False: "Light", True: "Dark"}
    icons = {None: "brightness_auto", False: "light_mode", True: "dark_mode"}
    with ui.button(icon=icons[None]).props('flat round aria-label="Light or dark"') as button, ui.menu():
        for value, name in names.items():

            def choose(value: bool | None = value) -> None:
                dark.set_value(value)
                button.props(f"icon={icons[value]}")

            ui.menu_item(name, choose)
