"""A run in progress: its stage, loss, a measured and a predicted view, slices and surface of the field."""

from __future__ import annotations

import math
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import ui

from nerif.app.forms.elements import card, html, images_html, refusals, select
from nerif.app.project.jobs import CommandRun
from nerif.app.project.workspace import Workspace
from nerif.app.views.result_volumes import film_progress
from nerif.app.views.surfaces import LiveSurface, caption_of
from nerif.common.conventions import unit_shown
from nerif.common.files import ending
from nerif.data.quantity_names import name_of
from nerif.geometry import Box
from nerif.plotting.drawing import colour_range, map_range
from nerif.report.slice_images import slice_axes
from nerif.report.view_images import image_address
from nerif.results.directory import LIVE, LIVE_FIELD
from nerif.results.live import LiveSnapshot, read_live, read_snapshot

__all__ = ["LiveView", "curve_options", "snapshot_html", "status_html"]

EVERY = 1.0  # seconds
CURVES = ("loss", "residual", "residual_over_sigma", "fit_loss")
GREY, COLOURS = "#76838f", ["#2f86c9", "#d9721f"]  # visible on light and dark
GRID: dict[str, Any] = {"axisLabel": {"color": GREY}, "nameTextStyle": {"color": GREY}}
GRID["splitLine"] = {"lineStyle": {"color": "#76838f55"}}
BUTTONS = {
    "pause": ("Pause", "pause", ("running",)), "stop": ("Stop", "stop", ("running", "queued")),
    "resume": ("Go on", "play_arrow", ("paused", "stopped", "failed")),
}  # fmt: skip
"""Labels and icons of methods of Jobs, and the states in which they are offered."""


class LiveView:
    """One of the runs of nerif reconstruct and nerif sequence, by default the first open one."""

    def __init__(self, work: Workspace) -> None:
        self.work, self.job = work, ""
        self._cache: dict[str, Any] = {}
        with card("The run"):
            self.choice = select("Run", {}).on_value_change(lambda event: self.follow(event.value))
            self.status = html().classes("status").props('aria-live="off"')
            self.bar = ui.linear_progress(0.0, show_value=False).props('aria-label="Progress"')
            with ui.row().classes("gap-2"):
                self.buttons = {
                    name: ui.button(text, icon=icon, on_click=lambda n=name: self._do(n)).props("outline dense")
                    for name, (text, icon, _) in BUTTONS.items()
                }
            self.chart = ui.echart(curve_options({})).classes("curve").style("height: 260px; width: 100%")
            self.surface = LiveSurface()
            self.images = html()
        self.chart.set_visibility(False)
        ui.timer(EVERY, self._refresh)

    def follow(self, id: str | None) -> None:
        """Show this run."""
        if id and id != self.job:
            self.job, self._cache = id, {}
            self.images.set_content("")
            self.surface.clear()

    async def _do(self, action: str) -> None:
        with refusals():
            getattr(self.work.jobs, action)(self.job)
        await self._refresh()

    async def _refresh(self) -> None:
        jobs = [job for job in await self.work.in_thread(self.work.jobs.all) if job.resumable]
        options = {job.id: f"{job.title} ({job.state})" for job in jobs}
        if not self.job and jobs:
            self.follow(jobs[0].id)
        if options != self.choice.options or self.choice.value != self.job:
            self.choice.set_options(options, value=self.job if self.job in options else None)
        job = next((job for job in jobs if job.id == self.job), None)
        for name, button in self.buttons.items():
            state = "" if job is None or (job.request and job.state == "running") else job.state
            button.set_visibility(state in BUTTONS[name][2])
        self.bar.set_visibility(job is not None)
        self.choice.set_visibility(bool(jobs))
        if job is not None:
            await self._show(job)
        elif not jobs:
            self.status.set_content("No run has been started in this folder yet.")

    async def _show(self, job: CommandRun) -> None:
        out = self.work.project.path(job.out)
        if ending(out) == ".zarr":
            share, title = await self.work.in_thread(film_progress, out)
            self.status.set_content(status_html(job, {}, title))
            self.bar.set_value(share)
            self.chart.set_visibility(False)
            return
        cache = self._cache
        live, news = await self.work.in_thread(_update, out, cache)
        if cache is not self._cache:  # another run has been selected meanwhile
            return
        self.status.set_content(status_html(job, live))
        self.bar.set_value(float(live.get("progress") or 0.0) if live else float(job.state == "done"))
        if live and live.get("curve"):
            self.chart.set_visibility(True)
            self.chart.options.update(curve_options(live["curve"]))
        if news is not None:
            images, box, caption = news
            self.images.set_content(images)
            if caption:
                self.surface.show(job.out, cache[LIVE_FIELD], box, caption)


def _update(out: Path, cache: dict[str, Any]) -> tuple[dict[str, Any], tuple[str, Box, str] | None]:
    """Return the progress of a run and, of a snapshot not in the cache, images, box and caption of the surface."""
    stamp = _stamp(out / LIVE_FIELD)
    news = None
    if stamp and stamp != cache.get(LIVE_FIELD):
        cache[LIVE_FIELD] = stamp
        snapshot = read_snapshot(out)
        if snapshot is not None:
            volume = snapshot.volume  # a 2D field has no surface
            caption = caption_of(snapshot) if min(volume.grid.shape) > 1 else ""
            news = snapshot_html(snapshot), volume.grid.box, caption
    if (stamp := _stamp(out / LIVE)) != cache.get(LIVE):
        cache[LIVE], cache["live"] = stamp, read_live(out)
    return cache.get("live", {}), news


def _stamp(path: Path) -> int:
    return path.stat().st_mtime_ns if path.is_file() else 0


def status_html(job: CommandRun, live: dict[str, Any], title: str = "") -> str:
    """Return the status of a run as HTML; `title` is the progress of a film, which has no live.json."""
    words = {"done": "It has ended.", "paused": "Paused; the checkpoint is saved.", "queued": "It waits in the queue."}
    text = words.get(job.state, job.state.capitalize() + ".")
    if job.state == "running":
        text = {"stop": "Stopping after this step.", "pause": "Pausing after this step."}.get(job.request, "It runs.")
        if not live and not title:
            text += " No progress data yet."
    parts = [text, title] if title else [text]
    if live:
        seconds, share = float(live["seconds"] or 0), float(live["progress"] or 0)
        parts.append(f"{live['title'].capitalize()}: step {live['step']}, {seconds:.0f} s")
        if job.state == "running" and 0.001 < share < 1:
            parts.append(f"{seconds * (1 / share - 1):.0f} s left")
        losses = {name: value for name, value in live["losses"].items() if value is not None}
        parts += [f"{name.replace('_', ' ')} {value:.3g}" for name, value in losses.items()]
    remark = f"<p class=note>{escape(live['remark'])}</p>" if live.get("remark") else ""
    return f"<p>{escape(' · '.join(parts))}</p>{remark}"


def curve_options(curve: dict[str, list[float | None]]) -> dict[str, Any]:
    """Return the options of the chart of the losses over time."""
    series = [
        {
            "name": name.replace("_", " "), "type": "line", "showSymbol": False, "animation": False,
            "data": [[s, y] for s, y in zip(curve["seconds"], curve[name], strict=True) if y is not None and y > 0],
        }
        for name in CURVES if name in curve
    ]  # fmt: skip
    return {
        "grid": {"left": 64, "right": 16, "top": 34, "bottom": 42},
        "legend": {"top": 0, "textStyle": {"color": GREY}}, "color": COLOURS, "tooltip": {"trigger": "axis"},
        "xAxis": {"type": "value", "name": "s", "nameLocation": "middle", "nameGap": 26, **GRID},
        "yAxis": {"type": "log", **GRID}, "series": series, "aria": {"enabled": True},
    }  # fmt: skip


def snapshot_html(snapshot: LiveSnapshot) -> str:
    """Return the images of a snapshot as HTML: measured and predicted view, three central slices."""
    images = []
    unit = unit_shown(snapshot.unit)
    for c, component in enumerate(snapshot.components):
        measured, predicted = snapshot.measured[..., c], snapshot.predicted[..., c]
        limits = map_range(measured[np.isfinite(measured)], True, 0.998)
        ends = f"{limits[0]:.2g} to {limits[1]:.2g} {unit}".strip()
        use = "withheld" if snapshot.withheld else "fitted"
        valid = np.isfinite(measured)
        rms = math.sqrt(float(np.mean((predicted - measured)[valid] ** 2)))
        for kind, image in (("measured", measured), ("predicted", np.where(valid, predicted, np.nan))):
            residual = "" if kind == "measured" else f"; rms residual {rms:.2g} {unit}"
            text = f"{snapshot.view} ({use}), {component} {kind}; {ends}{residual}"
            images.append((image_address(image, limits), text, text))
    z, y, x = (n // 2 for n in snapshot.values.shape)
    limits = colour_range(snapshot.values)
    for normal, image in (("z", snapshot.values[z]), ("y", snapshot.values[:, y]), ("x", snapshot.values[:, :, x])):
        middle = (snapshot.lower["xyz".index(normal)] + snapshot.upper["xyz".index(normal)]) / 2
        text = f"{name_of(snapshot.quantity)} {limits[0]:.2g} to {limits[1]:.2g} at {normal} = {middle:g} mm; "
        text += slice_axes(snapshot.volume.grid.box, normal)
        images.append((image_address(image[::-1], limits), text, text))
    return f"{images_html(images)}<p class=note>After {snapshot.seconds:.0f} s, {escape(snapshot.title)}.</p>"
