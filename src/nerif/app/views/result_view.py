"""Viewer of a result or film: slices, comparison with another one, time, standard deviation, isosurfaces."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from html import escape
from itertools import pairwise
from statistics import median
from typing import Any

from nicegui import ui

from nerif.analysis.resampling import common_grid, difference, resampled
from nerif.app.forms.elements import html, select, text_html
from nerif.app.forms.sliders import RangeSlider
from nerif.app.project.workspace import Workspace
from nerif.app.views.result_volumes import Source, source_of
from nerif.app.views.slices_view import Panel, SlicesView
from nerif.app.views.surfaces import Surface, SurfaceView
from nerif.common.conventions import InputError, unit_shown
from nerif.common.files import ending
from nerif.data.quantity_names import describe
from nerif.data.volume import Volume
from nerif.plotting.drawing import DIVERGING, LABELS, colours_of, map_range
from nerif.results.directory import SURFACE, VOLUME

__all__ = ["ResultView"]

PLAY_EVERY = 0.25  # seconds a frame
CLOSE = 0.5 + 1e-6  # of the frame interval: largest distance in time of frames that are compared


class ResultView:
    """The images of one result in one tab; `build` opens its source.

    Parameters
    ----------
    work : Workspace
    name : result, relative to the project
    others : results to compare with
    draft : earlier choices, updated in place
    keep : called when the draft has changed
    """

    def __init__(
        self, work: Workspace, name: str, others: Sequence[str], draft: dict[str, Any], keep: Callable[[], None]
    ) -> None:
        self.work, self.name, self.others, self.draft, self.keep = work, name, tuple(others), draft, keep
        self.readable = False  # whether it has a field
        self.step = 0

    # -- controls ------------------------------------------------------------------------------------------------

    async def build(self) -> None:
        """Build controls and images, or the reason why there are none."""
        try:
            self.source = await self.work.in_thread(self._open, self.name)
            quantities = [q for q in self.source.quantities if not q.endswith("_std")]
        except InputError as error:
            text_html(f"{error}.", classes="note")
            return
        if not quantities:
            text_html(f"{self.work.project.title(self.name)}: it contains no field.", classes="note")
            return
        self.readable = True
        options = {q: describe(q)[1].capitalize() for q in quantities}
        with ui.element("div").classes("choices"):
            self.quantity = select("Quantity", options, self.draft.get("quantity"))
            choices = {"": "Nothing", **{name: self.work.project.title(name) for name in self.others}}
            self.against = select("Compare with", choices, self.draft.get("against"))
            self.spread = ui.switch("Standard deviation", value=bool(self.draft.get("spread")))
        for control in (self.quantity, self.against, self.spread):
            control.on_value_change(self._update_draft)
        if len(self.source.frames) > 1:
            self._build_time()
        self.note = html().props("aria-live=polite")
        self.slices = SlicesView(self.work)
        await self.draw()

    def _build_time(self) -> None:
        times, frames = self.source.times, self.source.frames

        async def move(step: int) -> None:
            self.step = step
            await self.draw()

        async def advance() -> None:
            self.step = (self.step + 1) % len(frames)
            time.put(self.step)
            await self.draw()

        def toggle() -> None:
            timer.active = not timer.active
            play.set_icon("pause" if timer.active else "play_arrow")

        def text(step: int) -> str:
            return f"{times[frames[step]] * 1e3:.10g} ms (frame {frames[step] + 1})"

        with ui.element("div").classes("time"):
            play = ui.button(icon="play_arrow", on_click=toggle).props("round unelevated dense")
            play.props["aria-label"] = "Play or pause the film"
            time = RangeSlider("Time", len(frames) - 1, 0, text, move)
        timer = ui.timer(PLAY_EVERY, advance, active=False)

    async def _update_draft(self) -> None:
        spread = bool(self.spread.value)
        self.draft |= {"quantity": self.quantity.value, "against": self.against.value, "spread": spread}
        self.keep()
        await self.draw()

    # -- images ------------------------------------------------------------------------------------------------

    @property
    def frame(self) -> int:
        """The current frame; 0 for a result of one instant."""
        return self.source.frames[self.step]

    async def draw(self) -> None:
        """Draw the selected quantity at the current step."""
        has_std = f"{self.quantity.value}_std" in self.source.quantities
        self.spread.set_visibility(has_std)
        quantity = f"{self.quantity.value}_std" if has_std and self.spread.value else self.quantity.value
        try:
            panels, note = await self.work.in_thread(self._panels, quantity, self.against.value, self.step)
        except InputError as error:
            panels, note = [], f"{error}."
        self.note.set_content(f"<p class=note>{escape(note)}</p>" if note else "")
        await self.slices.show(panels)

    def _open(self, name: str) -> Source:
        return source_of(self.work.project.path(name))

    def _panels(self, quantity: str, against: str, step: int) -> tuple[list[Panel], str]:
        """The panels to draw side by side, and a note about them."""
        source = self.source
        first, limits = source.volume(quantity, source.frames[step]), source.limits(quantity)
        unit, colours = _unit(first), colours_of(quantity)
        if not against:
            return [Panel(describe(quantity)[1].capitalize(), first, limits, unit, colours)], ""
        other = self._open(against)
        if quantity not in other.quantities:
            raise InputError(f"it has no {describe(quantity)[1]} to compare with", field=against)
        second = other.volume(quantity, self._nearest_frame(other, against, step))
        other_limits = other.limits(quantity)
        limits = min(limits[0], other_limits[0]), max(limits[1], other_limits[1])
        grid = common_grid(first, second)
        change = difference(first, second, grid)
        ends = map_range(change.values.numpy(), True, 0.998)
        title, other_title = map(self.work.project.title, (self.name, against))
        volumes = ((title, first), (other_title, second))
        panels = [Panel(name, resampled(volume, grid), limits, unit, colours) for name, volume in volumes]
        panels.append(Panel(f"{other_title} minus {title}", change, ends, unit, DIVERGING))
        if first.grid == second.grid:
            return panels, ""
        shape = " × ".join(str(n) for n in grid.shape[::-1])
        return panels, f"The grids differ: both fields are interpolated trilinearly to {shape} voxels (x, y, z)."

    def _nearest_frame(self, other: Source, against: str, step: int) -> int:
        """The frame of another source that is nearest in time to a step."""
        times = self.source.times
        now = times[self.source.frames[step]]
        nearest = min(other.frames, key=lambda frame: abs(other.times[frame] - now))
        if abs(other.times[nearest] - now) > CLOSE * min(_interval(times), _interval(other.times)):
            at, closest = (f"{time * 1e3:.10g} ms" for time in (now, other.times[nearest]))
            raise InputError(
                f"expected a frame at {at} to compare with, got {closest} as the nearest complete frame; "
                "choose another instant",
                field=against,
            )
        return nearest

    # -- in three dimensions -------------------------------------------------------------------------------------

    async def surfaces(self) -> None:
        """Build the isosurface of the selected quantity."""
        if not self.readable:
            text_html("There is no field to show yet.", classes="note")
            return
        source, quantity, against = self.source, self.quantity.value, self.against.value
        volume, limits, level = await self.work.in_thread(
            lambda: (source.volume(quantity, self.frame), source.limits(quantity), source.level(quantity))
        )
        if min(volume.grid.shape) < 2:
            text_html("The field is a plane and has no isosurface.", classes="note")
            return
        surfaces = [self._surface_of(self.name, self.frame)]
        if against:
            other = await self.work.in_thread(self._open, against)
            surfaces.append(self._surface_of(against, self._nearest_frame(other, against, self.step)))
        SurfaceView(surfaces, quantity, _unit(volume), limits, level, volume.grid.box)

    def _surface_of(self, name: str, frame: int) -> Surface:
        path = self.work.project.path(name)
        file = path / ("zarr.json" if ending(path) == ".zarr" else VOLUME)
        bodies = (path / SURFACE[0]).is_file()
        stamp = file.stat().st_mtime_ns if file.is_file() else 0
        return Surface(name, self.work.project.title(name), frame, stamp, bodies)


def _interval(times: Sequence[float]) -> float:
    """The median time between frames, infinite for a single one."""
    return median(b - a for a, b in pairwise(times)) if len(times) > 1 else math.inf


def _unit(volume: Volume) -> str:
    """The unit for display, empty for a pure number."""
    return unit_shown(LABELS.get(volume.quantity.removesuffix("_std"), ("", volume.unit))[1])
