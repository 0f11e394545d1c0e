"""`report.html` of a sequence: the page of a result with a time slider, and the fit of all frames."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nerif.common.conventions import InputError, with_unit
from nerif.data.quantity_names import field_of
from nerif.data.volume_sequence import StoredViewScores, VolumeSequence
from nerif.forward.registry import technique, technique_of
from nerif.plotting.drawing import COLOURS, plain
from nerif.plotting.notebook import number
from nerif.report.html import flat, render_page, svg
from nerif.report.scene import scene_over_time
from nerif.report.summary import Statement
from nerif.report.volume_movie import finished_frames

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["frame_rows", "render_sequence"]

MAX_FRAMES = 60  # on the page


def render_sequence(store: VolumeSequence) -> str:
    """Return the page of a sequence, complete or not."""
    frames = finished_frames(store)
    if not frames:
        raise InputError("expected at least one finished frame, got none; run nerif sequence again", field=store.path)
    field = field_of(store.quantities)
    if field is None:
        raise InputError(
            f"expected index_excess among its quantities, got {', '.join(store.quantities)}", field=store.path
        )
    places = np.linspace(0, len(frames) - 1, min(len(frames), MAX_FRAMES)).round().astype(int)
    sample = [frames[i] for i in np.unique(places)]
    scene, arrays = scene_over_time(store, sample, field)
    about = store.attributes
    measurement = about.get("measurement")
    kinds = [technique(name) for name in about.get("techniques", ())] or [technique_of(field)]
    missing = len(store) - len(frames)
    complete = Statement("good", f"All {len(store)} frames are available.")
    incomplete = Statement("warning", f"{missing} of {len(store)} frames are missing; see below.")
    return render_page(
        kind=" and ".join(kind.tomography for kind in kinds),
        title=store.path.resolve().name,
        source=Path(str(measurement)).name if measurement else "",
        headline=incomplete if missing else complete,
        statements=_statements(store),
        cards=(("Frames", frame_rows(store, frames)), ("Fit", _fit_rows(store, frames))),
        scene=scene,
        arrays=arrays,
        curves=_curves(store, frames),
        settings=flat({k: v for k, v in about.items() if k not in ("settings", "network", "references")})
        + flat(about.get("settings", {})),
        shown_of=(len(sample), len(frames)),
    )


def _statements(store: VolumeSequence) -> list[Statement]:
    if "status" not in store.group:
        return [Statement("note", "These volumes were simulated or imported, not reconstructed.")]
    status = np.asarray(store.array("status")[:])
    remarks = []
    missing, failed = int((status == 0).sum()), np.flatnonzero(status == 2)
    if missing:
        text = f"{missing} of {len(status)} frames are missing; the same command again reconstructs them."
        remarks.append(Statement("warning", text))
    if len(failed):
        first = f"frame {failed[0]}: {store.array('reason')[:][failed[0]]}"
        remarks.append(Statement("warning", f"{len(failed)} frame{'s' * (len(failed) > 1)} failed, {first}"))
    if not store.attributes.get("withhold", ()):
        remarks.append(Statement("note", "No view was withheld, so the fields are not validated on independent data."))
    return remarks


def frame_rows(store: VolumeSequence, frames: Sequence[int]) -> list[tuple[str, str]]:
    """Return number, instants and grid of the finished frames of a store."""
    times = store.times
    rows = [
        ("Frames", f"{len(frames)} of {len(store)}"),
        ("Time", f"{times[0] * 1e3:.10g} to {times[-1] * 1e3:.10g} ms"),
    ]
    if len(times) > 1:
        rows.append(("Frames per second", number((len(times) - 1) / (times[-1] - times[0]), 4)))
    return [*rows, ("Voxels", " × ".join(str(n) for n in store.grid.shape[::-1]))]


def _fit_rows(store: VolumeSequence, frames: list[int]) -> list[tuple[str, str]]:
    scores = store.view_scores
    if not scores:
        return [("Truth", "volumes as stored")]
    withheld = np.array([v in store.attributes.get("withhold", ()) for v in store.attributes["views"]])
    rows = []
    groups = (("Fitted views", ~withheld), ("Withheld views", withheld))
    for (name, group), of in itertools.product(groups, scores):
        cc, rms = (np.asarray(array[:])[frames][:, group] for array in (of.cc, of.rms))
        if np.isfinite(rms).any():
            least, most = number(float(np.nanmin(cc)), 4), number(float(np.nanmax(rms)), 3)
            text = f"CC at least {least}, rms residual at most {with_unit(most, of.technique.unit)}"
            rows.append((name + _suffix(of, scores), text))
    seconds = np.asarray(store.array("seconds")[:])[frames]
    return [*rows, ("Time per frame", f"{number(float(np.median(seconds)), 3)} s (median)")]


def _curves(store: VolumeSequence, frames: list[int]) -> list[tuple[str, str]]:
    """Residuals and computing time over time."""
    scores = store.view_scores
    if not scores:
        return []
    times = np.array(store.times)[frames] * 1e3
    names, withheld = store.attributes["views"], store.attributes.get("withhold", ())
    seconds = np.asarray(store.array("seconds")[:])[frames]

    def draw_rms(of: StoredViewScores, axes: Axes) -> None:
        rms = np.asarray(of.rms[:])[frames]
        for i, name in enumerate(names):
            if np.isfinite(rms[:, i]).any():
                style, label = ("--", f"{name} (withheld)") if name in withheld else ("-", name)
                axes.plot(times, rms[:, i], lw=1.2, ls=style, label=plain(label))
        axes.set(xlabel="time [ms]", ylabel=f"rms residual [{of.technique.unit}]")
        axes.set_ylim(bottom=0)
        axes.legend(fontsize=7, ncols=2)

    def draw_seconds(axes: Axes) -> None:
        axes.plot(times, seconds, ".", color=COLOURS["blue"])
        axes.set(xlabel="time [ms]", ylabel="computing time [s]")
        axes.set_ylim(bottom=0)

    views = [(f"Every view over time{_suffix(of, scores)}", svg(partial(draw_rms, of))) for of in scores]
    return [*views, ("Computing time of each frame", svg(draw_seconds))]


def _suffix(one: StoredViewScores, scores: list[StoredViewScores]) -> str:
    return f", {one.technique.measured}" if len(scores) > 1 else ""
