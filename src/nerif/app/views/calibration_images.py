"""Images of the calibration target: detected points, error, and a button that excludes an image."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from html import escape

from nicegui import ui

from nerif.app.forms.elements import html, text_html
from nerif.app.project.workspace import Workspace
from nerif.common.conventions import InputError
from nerif.imaging.calibration.result import ImageError
from nerif.imaging.calibration.target_images import few_detections, pose_names
from nerif.imaging.calibration.targets import CalibrationTarget, Detection
from nerif.imaging.readers.views import View

__all__ = ["CalibrationImages"]

SOURCES = {"target": "In space", "background": "On the background"}
LARGEST = 420  # px


class CalibrationImages:
    """The target images of one view.

    Parameters
    ----------
    work : Workspace
    on_toggle : called with the name of an image that is excluded or included
    """

    def __init__(self, work: Workspace, on_toggle: Callable[[str], None]) -> None:
        self.work, self._on_toggle = work, on_toggle
        self._request = 0
        self._place = ui.element("div").classes("stack")

    async def show(
        self, view: View, targets: Mapping[str, CalibrationTarget], errors: Mapping[str, ImageError],
        exclusions: Collection[str],
    ) -> None:  # fmt: skip
        """Show the images of a view one after the other; a later call replaces an earlier one.

        Parameters
        ----------
        view : view of an experiment
        targets : targets in space and on the background
        errors : errors by the name of the image
        exclusions : names of images, which `on_toggle` changes
        """
        self._request += 1
        request = self._request
        self._place.clear()
        for source, title in SOURCES.items():
            with self._place:
                section = ui.element("div")
            try:
                if source not in view.sources:
                    raise InputError(f"{title}: there is no {view.name}/{source}.")
                names = await self.work.in_thread(_poses, view, source)
            except InputError as error:
                with section:
                    text_html(str(error), classes="note")
                continue
            if request != self._request:
                return
            with section:
                text_html(title, "h3")
                note, grid = ui.element("div"), ui.element("div").classes("targets")
            missing = []
            for number, pose in enumerate(names):
                try:
                    shot = await self.work.in_thread(self._read, view, source, number, targets[source])
                except InputError as error:
                    with grid:
                        text_html(str(error), classes="missing note")
                    continue
                if request != self._request:
                    return
                if shot[1] is None:
                    missing.append(number)
                with grid:
                    self._cell(f"{view.name}/{source}/{pose}", *shot, errors, exclusions)
            if missing and few_detections(len(names) - len(missing), len(names)):
                explain = self.work.files.explanation
                text = await self.work.in_thread(explain, view, source, missing, targets[source])
                if request != self._request:
                    return
                with note:
                    text_html(f"No {targets[source].label} found: {text}.", classes="note")

    def _read(
        self, view: View, source: str, number: int, target: CalibrationTarget
    ) -> tuple[str, Detection | None, tuple[int, int]]:
        """Return the address of an image, its target, and its shape."""
        address = self.work.files.image(view, source, number, LARGEST, view.crop)
        detection, shape = self.work.files.detection(view, source, number, target), view.open(source).shape
        return address, detection, view.crop.shape_of(shape) if view.crop else shape

    def _cell(
        self, name: str, address: str, detection: Detection | None, shape: tuple[int, int],
        errors: Mapping[str, ImageError], exclusions: Collection[str],
    ) -> None:  # fmt: skip
        count, error, marks = "no target found", "", ""
        if detection is not None:
            count, marks = f"{len(detection.points)} points found", _marks(detection, shape)
            error = ", not used" if errors else ""
        if image := errors.get(name):
            error = f", rms <b>{image.rms:.3f} px</b>{'' if image.used else ', did not fit'}"
        with ui.element("div").classes("target") as cell:
            img = f'<img src="{address}" alt="{escape(f"{name}, {count}")}">'
            caption = f"<figcaption><b>{escape(name)}</b><br>{count}{error}</figcaption>"
            html(f"<span class=shot>{img}{marks}</span>{caption}", "figure")
            if detection is None:
                return
            button = ui.button().props("outline dense")

        def update() -> None:
            text, pressed = ("Include", "true") if name in exclusions else ("Exclude", "false")
            button.set_text(text)
            button.props.update({"aria-label": f"{text}: {name}", "aria-pressed": pressed})
            cell.classes(replace="target left-out" if name in exclusions else "target")

        def toggle() -> None:
            self._on_toggle(name)
            update()

        button.on_click(toggle)
        update()


def _poses(view: View, source: str) -> list[str]:
    return pose_names(view.open(source))


def _marks(detection: Detection, shape: tuple[int, int]) -> str:
    """Circles at the detected points as SVG, the first one filled."""
    height, width = shape
    radius, first = 0.012 * max(shape), int(detection.ids.argmin())
    circles = "".join(
        f"<circle{' class=first' if i == first else ''} cx={u + 0.5:.2f} cy={v + 0.5:.2f} r={radius:.2f} />"
        for i, (u, v) in enumerate(detection.pixels)
    )
    return f"<svg viewBox='0 0 {width} {height}' preserveAspectRatio=none aria-hidden=true>{circles}</svg>"
