"""`report.html` of a velocity: arrows, streamlines and vorticity, the speed in 3-D over time, and what it is worth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nerif.data.velocity_sequence import COMPONENTS, VelocitySequence
from nerif.plotting.notebook import image, number
from nerif.report.html import flat, render_page, svg
from nerif.report.scene import scene_over_time
from nerif.report.summary import Statement
from nerif.report.velocity_figure import draw_arrows, draw_streamlines

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["relative_deviation", "render_velocity"]

MAX_FRAMES = 60  # on the page
VERDICTS = (
    (0.2, "good", "Use it"),
    (0.5, "warning", "Use it with care"),
    (math.inf, "warning", "Do not use it: the film hardly determines the velocity"),
)
"""Largest relative standard deviation, kind of statement and verdict."""
WELL = 1.5  # rms of residual / sigma up to which the velocity explains the film


def render_velocity(store: VelocitySequence) -> str:
    """Return the page of a velocity."""
    frames = np.unique(np.linspace(0, len(store) - 1, min(len(store), MAX_FRAMES)).round().astype(int)).tolist()
    scene, arrays = scene_over_time(store, frames, "speed")
    middle = len(store) // 2
    arrows, lines = (
        image(partial(draw, store=store, index=middle), 10, 4.6, 10) for draw in (draw_arrows, draw_streamlines)
    )
    at = f"at {store.times[middle] * 1e3:.10g} ms"
    about = store.attributes
    return render_page(
        kind="Velocity from a film",
        title=store.path.resolve().name,
        source=Path(str(about.get("film", ""))).name,
        headline=_statements(store)[0],
        statements=_statements(store)[1:],
        cards=(("Film", _film_rows(store)), ("Velocity", _velocity_rows(store))),
        scene=scene,
        arrays=arrays,
        plane=[
            (f"Velocity and speed {at}", arrows),
            (f"Streamlines and vorticity {at}", lines),
        ],
        plane_title="Velocity",
        curves=_curves(store),
        settings=flat({k: v for k, v in about.items() if k not in ("settings", "references")})
        + flat(about.get("settings", {})),
        shown_of=(len(frames), len(store)),
    )  # fmt: skip


def _statements(store: VelocitySequence) -> list[Statement]:
    if "misfit" not in store.attributes:
        return [Statement("note", "Velocity measured by other means.")]
    misfit = float(store.attributes["misfit"])
    size = f"the density changes that remain unexplained are {misfit:.2g} times those expected of noise and grid"
    if misfit <= WELL:
        statements = [Statement("good", f"The velocity explains how the density moves: {size}.")]
    else:
        limit = store.attributes.get("settings", {}).get("time_limit") or math.inf
        ended = store.attributes.get("seconds", 0.0) >= limit
        more = "more time (the fit ended at its --time-limit), " if ended else ""
        remedy = f"give {more}a finer grid (--resolution), or check physics and properties"
        statements = [Statement("warning", f"The velocity explains the film in part: {size}; {remedy}.")]
    if (spread := relative_deviation(store, COMPONENTS)) is not None:
        kind, verdict = next((k, words) for limit, k, words in VERDICTS if spread <= limit)
        of_pressure = relative_deviation(store, ("pressure",))
        more = "" if of_pressure is None else f", that of the pressure {of_pressure:.0%}"
        deviation = f"the standard deviation of the velocity is {spread:.0%} of its rms{more}"
        statements.append(Statement(kind, f"{verdict}: {deviation}; errors of the equations come on top."))
    share = float(np.mean([np.isfinite(store.read("u", k)).mean() for k in range(len(store))]))
    where = "elsewhere (grey) the density is uniform, so that nothing shows how the fluid moves"
    if store.attributes.get("symmetry"):
        where += ", or a circle about the axis leaves the box"
    statements.append(Statement("note", f"Velocity is given in {share:.0%} of the box; {where}."))
    if store.attributes.get("physics") == "transport":
        lack = "velocity along surfaces of equal density follows only from continuity and smoothness"
        statements.append(Statement("warning", f"Without an equation of momentum {lack}, and there is no pressure."))
    return statements


def relative_deviation(store: VelocitySequence, quantities: Sequence[str]) -> float | None:
    """Return the rms standard deviation of quantities relative to their rms; None if there is none."""
    if any(f"{name}_std" not in store.group for name in quantities):
        return None
    spread, size = (
        sum(float(np.nansum(np.square(store.read(f"{name}{end}", slice(None))))) for name in quantities)
        for end in ("_std", "")
    )
    return math.sqrt(spread / size) if size > 0 else None


def _film_rows(store: VelocitySequence) -> list[tuple[str, str]]:
    times = store.times
    return [
        ("Frames", str(len(store))),
        ("Time", f"{times[0] * 1e3:.10g} to {times[-1] * 1e3:.10g} ms"),
        ("Voxels", " × ".join(str(n) for n in store.grid.shape[::-1])),
    ]


def _velocity_rows(store: VelocitySequence) -> list[tuple[str, str]]:
    components = np.stack([store.read(name, slice(None)) for name in COMPONENTS])
    speed = np.sqrt(np.square(components).sum(axis=0))
    rows = [("Largest speed", f"{number(float(np.nanmax(speed, initial=0.0)), 3)} m/s")]
    rows += [(f"Rms of {name}", f"{number(float(np.sqrt(np.nanmean(np.square(c)))), 3)} m/s")
             for name, c in zip(COMPONENTS, components, strict=True)]  # fmt: skip
    if "seconds" in store.attributes:
        rows.append(("Computing time", f"{number(float(store.attributes['seconds']), 3)} s"))
    return rows


def _curves(store: VelocitySequence) -> list[tuple[str, str]]:
    """Residuals of the equations over time."""

    def draw(quantity: str, unit: str, axes: Axes) -> None:
        values = store.read(quantity, slice(None))
        rms = [np.sqrt(np.nanmean(np.square(frame))) if np.isfinite(frame).any() else np.nan for frame in values]
        axes.plot(np.array(store.times) * 1e3, rms, lw=1.2)
        axes.set(xlabel="time [ms]", ylabel=f"rms [{unit}]")
        axes.set_ylim(bottom=0)

    residuals = {
        "transport_residual": ("Change of density that the velocity does not explain", "1/s"),
        "momentum_residual": ("Acceleration that the equation of momentum does not explain", "m/s²"),
    }
    return [(title, svg(partial(draw, name, unit))) for name, (title, unit) in residuals.items() if name in store.group]
