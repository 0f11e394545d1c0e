"""`report.html` of a velocity: arrows, streamlines and vorticity, the speed in 3-D over time, and the verdict."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nerif.analysis.velocity_verdict import known_share, relative_deviation, velocity_verdict
from nerif.data.velocity_sequence import VelocitySequence
from nerif.data.volume import COMPONENTS
from nerif.plotting.notebook import image, number
from nerif.report.html import flat, render_page, svg
from nerif.report.scene import scene_over_time
from nerif.report.sequence_page import MAX_FRAMES, frame_rows
from nerif.report.summary import LEVEL_OF_RATING, Statement
from nerif.report.velocity_figure import draw_arrows, draw_streamlines

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["render_velocity"]


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
        cards=(("Film", frame_rows(store, range(len(store)))), ("Velocity", _velocity_rows(store))),
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
    judgement = velocity_verdict(store)
    where = "elsewhere (grey) the density is uniform, so that nothing shows how the fluid moves"
    if store.attributes.get("symmetry"):
        where += ", or a circle about the axis leaves the box"
    statements = [
        Statement(LEVEL_OF_RATING[judgement.rating], judgement.sentence),
        Statement("note", f"Velocity is given in {known_share(store):.0%} of the box; {where}."),
    ]
    if (of_pressure := relative_deviation(store, ("pressure",))) is not None:
        statements.append(Statement("note", f"The standard deviation of the pressure is {of_pressure:.0%} of its rms."))
    return statements


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
