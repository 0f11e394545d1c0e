"""Images of the calibration target: detected points, error, and a button that excludes an image."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from html import escape

from nicegui import ui

from nerif.app.forms.elements import text_html
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
        self.work, self.files, self._on_toggle = work, work.files, on_toggle
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
        exclusions : names of images
        """
        self._request += 1
        request = self._request
        self._place.clear()
        for source, title in SOURCES.items():
            if source not in view.sources:
                with self._place:
                    text_html(f"{title}: there is no {view.name}/{source}.", classes="note")
                continue
            try:
                names = await self.work.in_thread(_poses, view, source)
            except InputError as error:
                with self._place:
                    text_html(str(error), classes="note")
                continue
            if request != self._request:
                return
            with self._place, ui.element("div"):
                text_html(title, "h3")
                note, grid = ui.element("div"), ui.element("div").classes("targets")
            missing = []
            for number, pose in enumerate(names):
                name = f"{view.name}/{source}/{pose}"
                try:
                    address = await self.work.in_thread(self.files.image, view, source, number, LARGEST, view.crop)
                    detection = await self.work.in_thread(self.files.detection, view, source, number, targets[source])
                    shape = await self.work.in_thread(self._shape, view, source)
                except InputError as error:
                    with grid:
                        text_html(str(error), classes="missing note")
                    continue
                if request != self._request:
                    return
                if detection is None:
                    missing.append(number)
                with grid:
                    self._cell(name, address, detection, shape, errors, name in exclusions)
            if missing and few_detections(len(names) - len(missing), len(names)):
                text = await self.work.in_thread(self.files.explanation, view, source, missing, targets[source])
                if request != self._request:
                    return
                with note:
                    text_html(f"No {targets[source].label} found: {text}.", classes="note")

    def _shape(self, view: View, source: str) -> tuple[int, int]:
        shape = view.open(source).shape
        return view.crop.shape_of(shape) if view.crop else shape

    def _cell(
        self, name: str, address: str, detection: Detection | None, shape: tuple[int, int],
        errors: Mapping[str, ImageError], exclusion: bool,
    ) -> None:  # fmt: skip
        with ui.element("div").classes("target left-out" if exclusion else "target") as cell:
            error = _error_html(errors.get(name)) or (", not used" if errors and detection is not None else "")
            count = "no target found" if detection is None else f"{len(detection.points)} points found"
            with ui.element("figure"):
                ui.html(
                    f'<span class=shot><img src="{address}" alt="{escape(f"{name}, {count}")}">'
                    f"{_marks(detection, shape)}</span><figcaption><b>{escape(name)}</b><br>{count}{error}"
                    "</figcaption>", sanitize=False,
                )  # fmt: skip
            if detection is None:
                return
            state = [exclusion]
            button = ui.button().props("outline no-caps dense")

            def update() -> None:
                text = "Include" if state[0] else "Exclude"
                button.set_text(text)
                button.props["aria-label"] = f"{text}: {name}"
                button.props["aria-pressed"] = "true" if state[0] else "false"
                button.update()
                cell.classes(replace="target left-out" if state[0] else "target")

            def toggle() -> None:
                state[0] = not state[0]
                update()
                self._on_toggle(name)

            button.on_click(toggle)
            update()


def _poses(view: View, source: str) -> list[str]:
    return pose_names(view.open(source))


def _error_html(error: ImageError | None) -> str:
    if error is None:
        return ""
    return f", rms <b>{error.rms:.3f} px</b>{'' if error.used else ', did not fit'}"


def _marks(detection: Detection | None, shape: tuple[int, int]) -> str:
    """Circles at the detected points as SVG, the first one filled."""
    if detection is None:
        return ""
    height, width = shape
    radius = 0.012 * max(shape)
    first = int(detection.ids.argmin())
    circles = "".join(
        f"<circle{' class=first' if i == first else ''} cx={u + 0.5:.2f} cy={v + 0.5:.2f} r={radius:.2f} />"
        for i, (u, v) in enumerate(detection.pixels)
    )
    return f"<svg viewBox='0 0 {width} {height}' preserveAspectRatio=none aria-hidden=true>{circles}</svg>"
