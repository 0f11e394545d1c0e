"""Images of the target of one view: the corners found in each, its error, and a button that leaves it out."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from html import escape

from nicegui import ui

from nerif.app.pieces import text_html
from nerif.app.workspace import Workspace
from nerif.common.conventions import InputError
from nerif.imaging.calibration.result import ImageError
from nerif.imaging.calibration.target_images import pose_names
from nerif.imaging.calibration.targets import CalibrationTarget, Detection
from nerif.imaging.readers.views import View

__all__ = ["TargetImages"]

SOURCES = {"target": "In space", "background": "On the background"}
LARGEST = 420  # px


class TargetImages:
    """The images, where the page is being built.

    Parameters
    ----------
    work : Workspace
    toggled : called with the name of an image that is left out or used again
    """

    def __init__(self, work: Workspace, toggled: Callable[[str], None]) -> None:
        self.work, self.files, self._toggled = work, work.files, toggled
        self._turn = 0
        self._place = ui.element("div").classes("stack")

    async def show(
        self, view: View, targets: Mapping[str, CalibrationTarget], errors: Mapping[str, ImageError],
        left_out: Collection[str],
    ) -> None:  # fmt: skip
        """Show the images of a view, one after the other; a later request replaces an earlier one.

        Parameters
        ----------
        view : of find_views
        targets : to look for in the images in space and on the background
        errors : by the name of the image
        left_out : names of images
        """
        self._turn += 1
        turn = self._turn
        self._place.clear()
        for source, title in SOURCES.items():
            if source not in view.sources:
                with self._place:
                    text_html(f"{title}: there is no {view.name}/{source}.", classes="note")
                continue
            try:
                names = await self.work.beside(_poses, view, source)
            except InputError as error:
                with self._place:
                    text_html(str(error), classes="note")
                continue
            if turn != self._turn:
                return
            with self._place, ui.element("div"):
                text_html(title, "h3")
                grid = ui.element("div").classes("targets")
            for number, pose in enumerate(names):
                name = f"{view.name}/{source}/{pose}"
                try:
                    address = await self.work.beside(self.files.image, view, source, number, LARGEST, view.crop)
                    outcome = await self.work.beside(self.files.result, view, source, number, targets[source])
                    shape = await self.work.beside(self._shape, view, source)
                except InputError as error:
                    with grid:
                        text_html(str(error), classes="missing note")
                    continue
                if turn != self._turn:
                    return
                with grid:
                    self._cell(name, address, outcome, shape, errors, name in left_out)

    def _shape(self, view: View, source: str) -> tuple[int, int]:
        shape = view.open(source).shape
        return view.crop.shape_of(shape) if view.crop else shape

    def _cell(
        self, name: str, address: str, outcome: Detection | None, shape: tuple[int, int],
        errors: Mapping[str, ImageError], left_out: bool,
    ) -> None:  # fmt: skip
        with ui.element("div").classes("target left-out" if left_out else "target") as cell:
            notice = _text(errors.get(name)) or (", not used" if errors and outcome is not None else "")
            lines = "no target found" if outcome is None else f"{len(outcome.points)} points found"
            with ui.element("figure"):
                ui.html(
                    f'<span class=shot><img src="{address}" alt="{escape(f"{name}, {lines}")}">'
                    f"{_marks(outcome, shape)}</span><figcaption><b>{escape(name)}</b><br>{lines}{notice}"
                    "</figcaption>", sanitize=False,
                )  # fmt: skip
            if outcome is None:
                return
            out = [left_out]
            button = ui.button().props("outline no-caps dense")

            def say() -> None:
                text = "Take it again" if out[0] else "Leave it out"
                button.set_text(text)
                button.props["aria-label"] = f"{text}: {name}"
                button.props["aria-pressed"] = "true" if out[0] else "false"
                button.update()
                cell.classes(replace="target left-out" if out[0] else "target")

            def toggle() -> None:
                out[0] = not out[0]
                say()
                self._toggled(name)

            button.on_click(toggle)
            say()


def _poses(view: View, source: str) -> list[str]:
    return pose_names(view.open(source))


def _text(error: ImageError | None) -> str:
    if error is None:
        return ""
    return f", rms <b>{error.rms:.3f} px</b>{'' if error.used else ', did not fit'}"


def _marks(outcome: Detection | None, shape: tuple[int, int]) -> str:
    """A circle around each point, that of the lowest number filled."""
    if outcome is None:
        return ""
    height, width = shape
    radius = 0.012 * max(shape)
    first = int(outcome.ids.argmin())
    circles = "".join(
        f"<circle{' class=first' if i == first else ''} cx={u + 0.5:.2f} cy={v + 0.5:.2f} r={radius:.2f} />"
        for i, (u, v) in enumerate(outcome.pixels)
    )
    return f"<svg viewBox='0 0 {width} {height}' preserveAspectRatio=none aria-hidden=true>{circles}</svg>"
