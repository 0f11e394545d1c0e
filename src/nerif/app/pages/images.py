"""Images: those of a folder, their quality, and the crop of each view."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

from nicegui import ui

from nerif.app.forms.elements import CommandLine, card, html, image, items_html, refusals, select, text_html
from nerif.app.pages.page import Hint, Page
from nerif.app.project.workspace import Workspace
from nerif.app.views.crop_editor import SOURCES, CropCard
from nerif.imaging.quality.image_quality import ImageQuality
from nerif.imaging.readers.views import View

__all__ = ["PAGE"]

THUMBNAIL = 280  # px
LAYOUT = "Put images into folders such as run1/cam1/reference and run1/cam1/flow, or name them in run1/views.toml."
WIDTH, HEIGHT = 320, 64  # of a histogram, units of the drawing


class ImagesPage:
    """The page in one tab."""

    def __init__(self, work: Workspace, experiments: Sequence[str]) -> None:
        self.work, draft = work, work.draft(PAGE.name)
        self.drafts: dict[str, Any] = dict(draft.get("edits", {}))  # of the crops, by experiment
        self.views: dict[str, View] = {}
        self._request = 0
        with ui.element("div").classes("stack"):
            with card("Folder of images"):
                choice = select("Experiment", list(experiments), draft.get("experiment")).classes("short")
                self.summary = ui.element("div")
                text_html("The next step on the command line", "h3")
                self.command = CommandLine()
            with card("Views", "The first good image of each, its grey values, and what cannot be used."):
                self.grid = ui.element("div").classes("views")
            self.crop = CropCard(work, self._keep, self._on_save)
        self.experiment = str(choice.value)

        async def on_change() -> None:
            self.experiment = str(choice.value)
            await self.build()

        choice.on_value_change(on_change)

    async def build(self, view: str = "") -> None:
        """Build everything for the selected experiment, with a view in large; images come one after the other."""
        self._request += 1
        request = self._request
        with refusals():
            views = await self.work.in_thread(self.work.project.views, self.experiment)
            self.views = {view.name: view for view in views}
        self.crop.load(self.experiment, self.views, self.drafts.get(self.experiment, {}), view)
        self._keep()
        out = self.work.project.free_name("measurement.nc")
        self.command.show(["displacement", self.experiment, "--calibration", "calibration.toml", "-o", out])
        self.grid.clear()
        with self.grid:
            self.cells = {name: ui.element("article").classes("view") for name in self.views}
        problems: list[str] = []
        await self.crop.show()
        for one in list(self.views.values()):
            problems += await self._cell(one, request)
            if request != self._request:  # another experiment has been selected meanwhile
                return
            self._show_summary(problems)
        self._show_summary(problems)

    def _keep(self) -> None:
        """Store selection and edits in the draft."""
        self.drafts[self.crop.experiment] = self.crop.edits.draft
        draft = {"experiment": self.crop.experiment, "view": self.crop.selection, "edits": self.drafts}
        self.work.keep(PAGE.name, draft)

    async def _on_save(self) -> None:
        self.drafts[self.crop.experiment] = {**self.crop.edits.draft, "now": {}}
        await self.build(self.crop.selection)

    def _show_summary(self, problems: Sequence[str]) -> None:
        self.summary.clear()
        with self.summary:
            text_html(f"{len(self.views)} views. {'' if problems else 'No problems found.'}", classes="status")
            html(items_html(problems, label="What is wrong"))

    async def _cell(self, view: View, request: int) -> list[str]:
        """Fill the cell of a view and return its problems."""
        problems: list[str] = []
        qualities: dict[str, ImageQuality] = {}
        for source in SOURCES:
            with refusals(problems.append):
                qualities[source] = await self.work.in_thread(self.work.files.quality, view, source)
        problems += [f"{name}: {why}" for quality in qualities.values() for name, why in quality.bad]
        problems += [note for quality in qualities.values() for note in quality.notes]
        images: dict[str, str] = {}
        for source, quality in qualities.items():
            what = view, source, quality.first, THUMBNAIL, view.crop
            with refusals(problems.append):
                images[source] = await self.work.in_thread(self.work.files.image, *what)
        if request != self._request:
            return problems
        cell = self.cells[view.name]
        cell.clear()
        with cell:
            text_html(view.name, "h3")
            with ui.element("div").classes("pair"):
                for source in SOURCES:
                    _figure(view, source, qualities.get(source), images.get(source, ""))
            html(items_html(problems))

            async def choose() -> None:
                self.crop.selection = view.name
                self._keep()
                await self.crop.show()
                ui.run_javascript("document.querySelector('.crop-card')?.scrollIntoView({block: 'start'})")

            button = ui.button("Look closer, crop, turn", icon="crop_rotate", on_click=choose)
            button.props("outline dense").props["aria-label"] = f"Look closer at {view.name}, crop or turn it"
        return problems


def _figure(view: View, source: str, quality: ImageQuality | None, address: str) -> None:
    """An image, its grey values, and its figures."""
    if quality is None or not address:
        text_html(f"No {source} image", classes="missing note")
        return
    height, width = quality.shape
    with ui.element("figure"):
        image(address, f"{source.capitalize()} of {view.name}").props("loading=lazy")
        count = f"{quality.count}" if quality.sampled == quality.count else f"{quality.count} ({quality.sampled} read)"
        full = f"{quality.saturated:.2%} saturated" if quality.full > 1 else "saturation unknown"
        label = f"Grey values of {source} of {view.name}, {full}"
        shape = f"{width} × {height} px, <span class=share>{full}</span>"
        bars = _histogram(quality.histogram.tolist(), quality.full, escape(label))
        html(f"<figcaption><b>{source.capitalize()}</b>, {count}<br>{shape}</figcaption>{bars}")


def _histogram(shares: Sequence[float], full: float, label: str) -> str:
    """Return the histogram as HTML; full scale is at the right end.

    Parameters
    ----------
    shares : fraction of the pixels per bin, from 0 to full scale
    full : grey value at full scale
    label : description for screen readers, escaped
    """
    most = max(shares) or 1.0
    step = WIDTH / len(shares)
    bars = "".join(
        f"<rect x='{i * step:.2f}' y='{HEIGHT * (1 - share / most):.2f}' width='{step:.2f}' "
        f"height='{HEIGHT * share / most:.2f}'/>"
        for i, share in enumerate(shares)
        if share > 0
    )
    return (
        f"<figure class=histogram><svg viewBox='0 0 {WIDTH} {HEIGHT}' preserveAspectRatio=none role=img "
        f'aria-label="{label}">{bars}</svg><figcaption><span>0</span><span>grey value</span><span>{full:g}</span>'
        "</figcaption></figure>"
    )


async def build(work: Workspace) -> None:
    """Build the page."""
    experiments = (await work.contents()).experiments
    if not experiments:
        with card("In this folder"):
            text_html("There are no images in this folder yet. " + LAYOUT, classes="note")
        return
    page, view = ImagesPage(work, experiments), str(work.draft(PAGE.name).get("view", ""))
    with ui.element("div"):
        ui.timer(0.01, lambda: page.build(view), once=True)  # the page is there before its images are read


ABOUT = "The images of a folder, their quality, and the crop of each view."
HINT = Hint(
    "Shows the images of each view: the background without flow (reference) and with flow.",
    "Nothing is needed here. Look closer at a view, and press the space key to switch between reference and flow.",
    "The dots shift by less than a pixel: too little to see in one image, enough to measure. No pixel is "
    "saturated, and no problems are listed.",
)
PAGE = Page("images", "Images", ABOUT, build, HINT)
