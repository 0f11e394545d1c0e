"""`report.html` of a sequence: the page of a single result, with a slider for time and how the frames went."""

from __future__ import annotations

import itertools
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nerif.common.conventions import InputError, with_unit
from nerif.data.volume import field_of
from nerif.data.volume_sequence import ViewScores, VolumeSequence
from nerif.forward.registry import technique, technique_of
from nerif.plotting.notebook import number
from nerif.report.html import flat, render_page, svg
from nerif.report.movie import frames_there
from nerif.report.scene import scene_over_time
from nerif.report.summary import Statement

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["render_sequence"]

MOST = 60  # frames on the page


def render_sequence(store: VolumeSequence) -> str:
    """Return the page of a sequence, finished or not.

    Raises
    ------
    InputError
        If no frame of it is there, or it holds no reconstructed field.
    """
    there = frames_there(store)
    if not there:
        raise InputError("no frame of it is done yet; run nerif sequence again", field=store.path)
    found = field_of(store.quantities)
    if found is None:
        raise InputError(
            f"expected index_excess among its quantities, got {', '.join(store.quantities)}", field=store.path
        )
    chosen = [there[i] for i in np.unique(np.linspace(0, len(there) - 1, min(len(there), MOST)).round().astype(int))]
    scene, arrays = scene_over_time(store, chosen)
    statements = _statements(store)
    measured = store.attributes.get("measurement")
    techniques = [technique(name) for name in store.attributes.get("techniques", ())]
    kinds = techniques or [technique_of(found)]
    return render_page(
        kind=" and ".join(kind.tomography for kind in kinds),
        title=store.path.resolve().name,
        source=Path(str(measured)).name if measured else "",
        headline=_headline(store, there),
        statements=statements,
        cards=(("The frames", _frames(store, there)), ("The fit", _fit(store, there))),
        scene=scene,
        arrays=arrays,
        curves=_curves(store, there),
        settings=flat({k: v for k, v in store.attributes.items() if k not in ("settings", "network", "references")})
        + flat(store.attributes.get("settings", {})),
        shown_of=(len(chosen), len(there)),
    )


def _statements(store: VolumeSequence) -> list[Statement]:
    """What to know before looking."""
    if "status" not in store.group:
        return [Statement("note", "These are volumes that were simulated or imported, not reconstructed.")]
    status = np.asarray(store.array("status")[:])
    found = []
    missing, failed = int((status == 0).sum()), np.flatnonzero(status == 2)
    if missing:
        found.append(
            Statement("warning", f"{missing} of {len(status)} frames are missing; the same command again does them.")
        )
    if len(failed):
        reasons = [str(r) for r in store.array("reason")[:]]
        first = f"frame {failed[0]}: {reasons[failed[0]]}"
        found.append(Statement("warning", f"{len(failed)} frame{'s' * (len(failed) > 1)} failed, {first}"))
    held = set(store.attributes.get("withhold", ()))
    if not held:
        found.append(Statement("note", "No view was held out, so nothing here is a test on unseen data."))
    return found


def _headline(store: VolumeSequence, there: list[int]) -> Statement:
    """The sum of it."""
    if len(there) < len(store):
        return Statement("warning", f"{len(store) - len(there)} of {len(store)} frames are missing; see below.")
    return Statement("good", f"All {len(store)} frames are there.")


def _frames(store: VolumeSequence, there: list[int]) -> list[tuple[str, str]]:
    times = store.times
    rows = [
        ("Frames", f"{len(there)} of {len(store)}"),
        ("From, to", f"{number(times[0] * 1e3, 4)} to {number(times[-1] * 1e3, 4)} ms"),
    ]
    if len(times) > 1:
        rows.append(("Frames a second", number((len(times) - 1) / (times[-1] - times[0]), 4)))
    rows.append(("Voxels", " × ".join(str(n) for n in store.grid.shape[::-1])))
    return rows


def _fit(store: VolumeSequence, there: list[int]) -> list[tuple[str, str]]:
    scores = store.view_scores
    if not scores:
        return [("Truth", "volumes as they are")]
    held = np.array([v in store.attributes.get("withhold", ()) for v in store.attributes["views"]])
    rows = []
    for (name, which), of in itertools.product((("Training views", ~held), ("Held-out views", held)), scores):
        cc, rms = (np.asarray(array[:])[there][:, which] for array in (of.cc, of.rms))
        if np.isfinite(rms).any():
            least, most = number(float(np.nanmin(cc)), 4), number(float(np.nanmax(rms)), 3)
            said = f"CC at least {least}, rms error at most {with_unit(most, of.technique.unit)}"
            rows.append((name + _of(of, scores), said))
    seconds = np.asarray(store.array("seconds")[:])[there]
    rows.append(("Time for a frame", f"{number(float(np.median(seconds)), 3)} s (median)"))
    return rows


def _curves(store: VolumeSequence, there: list[int]) -> list[tuple[str, str]]:
    """How the frames went, over time."""
    scores = store.view_scores
    if not scores:
        return []
    times = np.array(store.times)[there] * 1e3
    names, held = store.attributes["views"], store.attributes.get("withhold", ())
    seconds = np.asarray(store.array("seconds")[:])[there]

    def draw_rms(of: ViewScores, axes: Axes) -> None:
        rms = np.asarray(of.rms[:])[there]
        for i, name in enumerate(names):
            if not np.isfinite(rms[:, i]).any():
                continue
            out = name in held
            axes.plot(times, rms[:, i], lw=1.2, ls="--" if out else "-", label=f"{name} (held out)" if out else name)
        axes.set_xlabel("time [ms]")
        axes.set_ylabel(f"rms difference from the measurement [{of.technique.unit}]")
        axes.set_ylim(bottom=0)
        axes.legend(fontsize=7, ncols=2)

    def draw_seconds(axes: Axes) -> None:
        axes.plot(times, seconds, ".", color="#0072B2")
        axes.set_xlabel("time [ms]")
        axes.set_ylabel("spent on the frame [s]")
        axes.set_ylim(bottom=0)

    views = [(f"Every view over time{_of(of, scores)}", svg(partial(draw_rms, of))) for of in scores]
    return [*views, ("Time spent on each frame", svg(draw_seconds))]


def _of(one: ViewScores, scores: list[ViewScores]) -> str:
    """What is measured, where that has to be said."""
    return f", {one.technique.measured}" if len(scores) > 1 else ""
