"""The guide of a demo project (`nerif app --demo`): a hint on each page, drawn by the frame that all pages share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any

from nicegui import ui

from nerif.app.demo import EDGE, RIG, is_demo
from nerif.app.elements import refusals
from nerif.app.project import OWN
from nerif.app.workspace import Workspace
from nerif.results.directory import VOLUME

if TYPE_CHECKING:
    from nerif.app.frame import Page

__all__ = ["HINTS", "Hint", "Progress", "guide", "progress_of"]

EVERY = 1.5  # seconds
DRAFT = "guide"
HALF = EDGE / 2
SHORT_RUN = {"max_steps": 250, "withhold": ["none"], "voxels": 40}


@dataclass(frozen=True)
class Hint:
    """The texts of one page.

    Parameters
    ----------
    purpose : what the page does
    click : what to click now
    look : what to look at then
    before : page whose step must be done before; empty if there is none
    values : entries that the button fills into the forms of the page, by the key of their draft
    """

    purpose: str
    click: str
    look: str
    before: str = ""
    values: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


HINTS: dict[str, Hint] = {
    "design": Hint(
        "Predicts what a rig measures before it is built: displacement, blur and resolution.",
        "Fill in the values of the rig of this demo. Then move a slider, such as the background distance.",
        "The displacement should be well above its noise, and the resolution finer than the structures of the flow. "
        "The drawing shows the rig from above, to scale.",
        values={"design": {name: list(v) if isinstance(v, tuple) else v for name, v in RIG.items()}},
    ),
    "images": Hint(
        "Shows the images of each view: the background without flow (reference) and with flow.",
        "Nothing is needed here. Look closer at a view, and press the space key to switch between reference and flow.",
        "The dots shift by less than a pixel: too little to see in one image, enough to measure. No pixel is "
        "saturated, and no problems are listed.",
    ),
    "calibration": Hint(
        "Computes where the cameras are from images of a chessboard in several poses.",
        "Press Calibrate. The settings come from the file beside the images. It takes about 10 s.",
        "The reprojection errors should be a small fraction of a pixel. Turn the rig in 3-D: six cameras, each with "
        "its background behind the flow.",
    ),
    "displacement": Hint(
        "Compares reference and flow of each view and computes how far the background is displaced.",
        "Fill in the values: the corners of the box around the flow. Press Preview for one view, then Find all "
        "displacements.",
        "The maps of u and v show the edges of the flame; sigma is the noise of each pixel. Below, the flow can be "
        "masked by hand; the demo does not need it.",
        "calibration",
        {"displacement.run": {"lower": [-HALF] * 3, "upper": [HALF] * 3}},
    ),
    "check": Hint(
        "Predicts each view from the others, and so detects mirrored, exchanged or wrongly signed images.",
        "Fill in the values: few voxels, for a quick comparison. Press Compare the views.",
        "All views should agree: an agreement of about 0.7 or more, a gain near 1, and no problems.",
        "displacement",
        {"check.views": {"voxels": 12}},
    ),
    "reconstruct": Hint(
        "Fits a field of refractive index to all views at once.",
        "Fill in the values: few steps, and no withheld view, to save time. Press Start. It takes about a minute.",
        "The loss falls, the predicted view approaches the measured one, and the isosurface becomes a flame.",
        "displacement",
        {"reconstruct": {"method": "nerif", "preset": "fast", "values": SHORT_RUN}},
    ),
    "results": Hint(
        "Shows the field with its verdict, compares results, and exports them.",
        "Move the sliders of the slices. Then open the tabs In 3-D, Report and Export.",
        "The verdict states whether the field can be used, and why. This short run asks for care: a longer one with a "
        "withheld view also estimates the error.",
        "reconstruct",
    ),
}
"""The hint of each page by its name."""

OPEN, RUNNING, PAUSED, FAILED, DONE = "open", "running", "paused", "failed", "done"
SENTENCES = {
    "": "", OPEN: "Not done yet.", RUNNING: "In progress: it continues if you leave the page.",
    PAUSED: "The run is paused; press Go on.", FAILED: "The last run failed; its log is under Runs.", DONE: "Done.",
}  # fmt: skip
COMMANDS = {
    "calibration": "calibrate", "displacement": "displacement", "check": "check", "reconstruct": "reconstruct",
}  # fmt: skip
"""The command whose output completes the step of a page; the others have no output."""
LAST = "This was the last page. For images of your own: nerif app FOLDER."


@dataclass(frozen=True)
class Progress:
    """How far the steps of a project are.

    Parameters
    ----------
    states : open, running, paused, failed or done, by the name of the page, for pages whose step has an output
    """

    states: Mapping[str, str]

    def sentence(self, page: str, titles: Mapping[str, str]) -> str:
        """Return the state of a page in words, or the step that comes first."""
        before = HINTS[page].before
        if before and self.states[before] != DONE:
            return f"First complete the step {titles[before]}."
        return SENTENCES[self.states.get(page, "")]

    def next_page(self, page: str, order: Sequence[str]) -> str:
        """Return the page to go to: the step that comes first, else the next page; empty after the last."""
        before = HINTS[page].before
        if before and self.states[before] != DONE:
            return before
        return next(iter(order[order.index(page) + 1 :]), "")

    def is_ready(self, page: str) -> bool:
        """Whether it is time to leave a page."""
        before = HINTS[page].before
        return self.states.get(page, DONE) == DONE or bool(before and self.states[before] != DONE)


def progress_of(work: Workspace) -> Progress:
    """Return how far the steps of a project are."""
    outputs, jobs = _outputs(work), work.jobs.all()  # open runs, then ended ones, the latest first
    states = {}
    for page, command in COMMANDS.items():
        state = next((job.state for job in jobs if job.arguments[0] == command), "")
        now = {"queued": RUNNING, "running": RUNNING, "paused": PAUSED}.get(state, DONE if outputs[page] else "")
        states[page] = now or (FAILED if state == "failed" else OPEN)
    return Progress(states)


def _outputs(work: Workspace) -> dict[str, bool]:
    """Whether the output of each step is in the project."""
    contents, folder = work.project.contents(), work.project.folder
    return {
        "calibration": bool(contents.calibrations),
        "displacement": bool(contents.measurements),
        "check": any((folder / OWN / "checks").rglob("*.json")),
        "reconstruct": any((folder / name / VOLUME).is_file() for name in contents.results),
    }


def guide(work: Workspace, page: Page, pages: Sequence[Page]) -> None:
    """Build the hint of a page; nothing unless the project is a demo."""
    if is_demo(work.project.folder):
        GuideView(work, page, pages)


class GuideView:
    """The hint of a page in one tab.

    Parameters
    ----------
    work : Workspace
    page : the page
    pages : all pages in their order
    """

    def __init__(self, work: Workspace, page: Page, pages: Sequence[Page]) -> None:
        self.work, self.page, self.pages = work, page, {p.name: p for p in pages}
        self.titles = {name: p.title for name, p in self.pages.items()}
        with ui.element("div").classes("guide-place"):
            self.show_button = ui.button("Show the guide", icon="school", on_click=lambda: self._hide(False))
            self.show_button.props("flat no-caps dense")
            with ui.element("section").classes("guide").props('aria-label="Guide"') as self.box:
                self._build()
        self._show_or_hide()
        ui.timer(EVERY, self._refresh)
        ui.timer(0.05, self._refresh, once=True)

    def _build(self) -> None:
        hint, number = HINTS[self.page.name], list(self.pages).index(self.page.name) + 1
        rows = (("This page", hint.purpose), ("Now", hint.click), ("Look at", hint.look))
        lines = "".join(f"<div><dt>{escape(a)}</dt><dd>{escape(b)}</dd></div>" for a, b in rows)
        ui.html(
            f"<h2>Guide, step {number} of {len(self.pages)}: {escape(self.page.title)}</h2><dl>{lines}</dl>",
            sanitize=False,
        )
        with ui.element("div").classes("side-by-side"):
            if hint.values:
                fill = ui.button("Fill in the values", icon="edit_note", on_click=self._fill_in)
                fill.props("outline no-caps dense")
            self.link = ui.html("", sanitize=False)
            self.status = ui.html("", sanitize=False).classes("status").props('role=status aria-live="polite"')
            ui.space()
            ui.button("Hide the guide", on_click=lambda: self._hide(True)).props("flat no-caps dense")

    async def _refresh(self) -> None:
        """Show the state of the step as it is now."""
        progress = await self.work.in_thread(progress_of, self.work)
        name = self.page.name
        after = progress.next_page(name, list(self.pages))
        word = "Back to" if after == HINTS[name].before else "Next:"
        kind = "next ready" if progress.is_ready(name) else "next"
        page = self.pages.get(after)
        link = f'<a class="{kind}" href="{page.path}">{word} {escape(page.title)}</a>' if page else ""
        self.link.set_content(link)
        self.status.set_content(escape(progress.sentence(name, self.titles) or ("" if page else LAST)))

    def _fill_in(self) -> None:
        """Put the values into the drafts of the page's forms, and build the page again with them."""
        with refusals():
            for key, values in HINTS[self.page.name].values.items():
                self.work.keep(key, {**self.work.draft(key), **values})
            ui.navigate.to(self.page.path)

    def _hide(self, hidden: bool) -> None:
        self.work.keep(DRAFT, {"hidden": hidden})
        self._show_or_hide()

    def _show_or_hide(self) -> None:
        hidden = bool(self.work.draft(DRAFT).get("hidden"))
        self.box.set_visibility(not hidden)
        self.show_button.set_visibility(hidden)
