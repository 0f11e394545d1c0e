"""A run as it goes on: how far it is, its loss, a view measured and predicted, slices and surface of the field."""

from __future__ import annotations

import math
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import ui

from nerif.app.jobs import Job
from nerif.app.jobs_drawer import film_progress
from nerif.app.live_surface import LiveSurface, said_of
from nerif.app.pieces import refusals
from nerif.app.workspace import Workspace
from nerif.common.conventions import unit_shown
from nerif.data.volume import name_of
from nerif.geometry import Box
from nerif.plotting.drawing import colour_range, map_range
from nerif.report.view_images import image_address
from nerif.results.directory import LIVE, LIVE_FIELD
from nerif.results.live import Look, read_live, read_look

__all__ = ["LiveView", "curve_options", "look_html", "notice"]

EVERY = 1.0  # seconds
CURVES = ("loss", "residual", "residual_over_sigma", "fit_loss")
SHOWN = {"pause": ("running",), "stop": ("running", "queued"), "resume": ("paused", "stopped", "failed")}  # in states
GREY, COLOURS = "#76838f", ["#2f86c9", "#d9721f"]  # seen on light and dark
GRID: dict[str, Any] = {"axisLabel": {"color": GREY}, "nameTextStyle": {"color": GREY}}
GRID["splitLine"] = {"lineStyle": {"color": "#76838f55"}}
BUTTONS = {"pause": ("Pause", "pause"), "stop": ("Stop", "stop"), "resume": ("Go on", "play_arrow")}


class LiveView:
    """One of the runs of nerif reconstruct, the newest open one unless another is chosen."""

    def __init__(self, work: Workspace) -> None:
        self.work, self.job = work, ""
        self._seen: dict[str, Any] = {}
        with ui.element("section").classes("card").props('aria-label="The run"'):
            ui.html("<h2>The run</h2>", sanitize=False)
            self.choice = ui.select({}, label="Run", on_change=lambda e: self.follow(e.value)).props(
                'outlined dense options-dense aria-label="Run"'
            )
            self.notice = ui.html("", sanitize=False).classes("status").props('aria-live="off"')
            self.bar = ui.linear_progress(0.0, show_value=False).props('aria-label="Progress"')
            with ui.row().classes("gap-2"):
                self.buttons = {
                    name: ui.button(text, icon=icon, on_click=lambda n=name: self._do(n)).props("outline no-caps dense")
                    for name, (text, icon) in BUTTONS.items()
                }
            self.chart = ui.echart(curve_options({})).classes("curve").style("height: 260px; width: 100%")
            self.surface = LiveSurface()
            self.look = ui.html("", sanitize=False)
        self.chart.set_visibility(False)
        ui.timer(EVERY, self._refresh)

    def follow(self, id: str | None) -> None:
        """Show that run from now on."""
        if id and id != self.job:
            self.job, self._seen = id, {}
            self.look.set_content("")
            self.surface.forget()

    async def _do(self, action: str) -> None:
        with refusals():
            getattr(self.work.jobs, action)(self.job)
        await self._refresh()

    async def _refresh(self) -> None:
        jobs = [job for job in await self.work.beside(self.work.jobs.all) if job.resumable]
        options = {job.id: f"{job.title} ({job.state})" for job in jobs}
        if not self.job and jobs:
            self.follow(jobs[0].id)
        if options != self.choice.options or self.choice.value != self.job:
            self.choice.set_options(options, value=self.job if self.job in options else None)
        job = next((job for job in jobs if job.id == self.job), None)
        for name, button in self.buttons.items():
            state = "" if job is None or (job.request and job.state == "running") else job.state
            button.set_visibility(state in SHOWN[name])
        self.bar.set_visibility(job is not None)
        if job is not None:
            await self._show(job)

    async def _show(self, job: Job) -> None:
        out = self.work.project.path(job.out)
        if out.suffix == ".zarr":
            share, title = await self.work.beside(film_progress, out)
            self.notice.set_content(notice(job, {}, title))
            self.bar.set_value(share)
            self.chart.set_visibility(False)
            return
        visible = self._seen
        live, plot = await self.work.beside(_changed, out, visible)
        if visible is not self._seen:  # another run has been chosen meanwhile
            return
        self.notice.set_content(notice(job, live))
        self.bar.set_value(float(live.get("progress") or 0.0) if live else float(job.state == "done"))
        if live and live.get("curve"):
            self.chart.set_visibility(True)
            self.chart.options.clear()
            self.chart.options.update(curve_options(live["curve"]))
        if plot is not None:
            images, box, lines = plot
            self.look.set_content(images)
            if lines:
                self.surface.show(job.out, visible[LIVE_FIELD], box, lines)


def _changed(out: Path, visible: dict[str, Any]) -> tuple[dict[str, Any], tuple[str, Box, str] | None]:
    """The status of the run; of its last live field, if it is new: images, box, and its surface in words."""
    stamp = _stamp(out / LIVE_FIELD)
    plot = None
    if stamp and stamp != visible.get(LIVE_FIELD):
        visible[LIVE_FIELD] = stamp
        look = read_look(out)
        if look is not None:
            volume = look.volume  # a flat one has no surface
            lines = said_of(look) if min(volume.grid.shape) > 1 else ""
            plot = look_html(look), volume.grid.box, lines
    if (new := _stamp(out / LIVE)) != visible.get(LIVE):
        visible[LIVE], visible["live"] = new, read_live(out)
    return visible.get("live", {}), plot


def _stamp(path: Path) -> int:
    return path.stat().st_mtime_ns if path.is_file() else 0


def notice(job: Job, live: dict[str, Any], title: str = "") -> str:
    """Return in words, as HTML, what a run is doing; `title` says it of a film, which has no live.json."""
    words = {"done": "It has ended.", "paused": "Paused: its checkpoint is kept.", "queued": "It waits for its turn."}
    lines = words.get(job.state, job.state.capitalize() + ".")
    if job.state == "running":
        lines = {"stop": "Stopping after this step.", "pause": "Pausing after this step."}.get(job.request, "It runs.")
        if not live and not title:
            lines += " No report yet."
    parts = [lines, title] if title else [lines]
    if live:
        seconds, share = float(live["seconds"] or 0), float(live["progress"] or 0)
        parts.append(f"{live['title'].capitalize()}: step {live['step']}, {seconds:.0f} s")
        if job.state == "running" and 0.001 < share < 1:
            parts.append(f"{seconds * (1 / share - 1):.0f} s left")
        available = {name: value for name, value in live["losses"].items() if value is not None}
        parts += [f"{name.replace('_', ' ')} {value:.3g}" for name, value in available.items()]
    remark = f"<p class=note>{escape(live['remark'])}</p>" if live.get("remark") else ""
    return f"<p>{escape(' · '.join(parts))}</p>{remark}"


def curve_options(curve: dict[str, list[float | None]]) -> dict[str, Any]:
    """Return the chart of the loss over seconds."""
    names = [name for name in CURVES if name in curve]
    seconds = curve.get("seconds", [])
    series = [
        {
            "name": name.replace("_", " "), "type": "line", "showSymbol": False, "animation": False,
            "data": [[s, y] for s, y in zip(seconds, curve[name], strict=True) if y is not None and y > 0],
        }
        for name in names
    ]  # fmt: skip
    return {
        "grid": {"left": 64, "right": 16, "top": 34, "bottom": 42},
        "legend": {"top": 0, "textStyle": {"color": GREY}},
        "color": COLOURS,
        "tooltip": {"trigger": "axis"},
        "xAxis": {"type": "value", "name": "s", "nameLocation": "middle", "nameGap": 26, **GRID},
        "yAxis": {"type": "log", **GRID}, "series": series, "aria": {"enabled": True},
    }  # fmt: skip


def look_html(look: Look) -> str:
    """Return the images of a look as HTML: view as measured and predicted, three middle slices."""
    figures = []
    unit = unit_shown(look.unit)
    for c, component in enumerate(look.components):
        measured, predicted = look.measured[..., c], look.predicted[..., c]
        limits = map_range(measured[np.isfinite(measured)], True, 0.998)
        ends = f"{limits[0]:.2g} to {limits[1]:.2g} {unit}".strip()
        visible = "withheld" if look.withheld else "not withheld"
        available = np.isfinite(measured)
        rms = math.sqrt(float(np.mean((predicted - measured)[available] ** 2)))
        for what, image in (("measured", measured), ("predicted", np.where(available, predicted, np.nan))):
            apart = "" if what == "measured" else f"; rms apart {rms:.2g} {unit}"
            text = f"{look.view} ({visible}), {component} {what}; {ends}{apart}"
            figures.append((image_address(image, limits), text))
    z, y, x = (n // 2 for n in look.values.shape)
    limits = colour_range(look.values)
    for normal, image in (("z", look.values[z]), ("y", look.values[:, y]), ("x", look.values[:, :, x])):
        middle = (look.lower["xyz".index(normal)] + look.upper["xyz".index(normal)]) / 2
        text = f"{name_of(look.quantity)} at {normal} = {middle:g} mm; {limits[0]:.2g} to {limits[1]:.2g}"
        figures.append((image_address(image[::-1], limits), text))
    inside = "".join(
        f'<figure><img src="{address}" alt="{escape(text)}"><figcaption>{escape(text)}</figcaption></figure>'
        for address, text in figures
    )
    return f"<div class=images>{inside}</div><p class=note>After {look.seconds:.0f} s, {escape(look.title)}.</p>"
