"""nerif velocity: velocity and pressure from a film of densities."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from nerif.cli.arguments import check_output
from nerif.cli.output import MONITOR, figures_bar
from nerif.cli.settings import Settings, command
from nerif.common.conventions import InputError
from nerif.common.settings import Flat, Positional
from nerif.common.times import frame_range
from nerif.data.quantity_names import INDEX
from nerif.flow.velocity_settings import VelocitySettings

if TYPE_CHECKING:
    from nerif.data.velocity_sequence import VelocitySequence
    from nerif.flow.assimilation import FitIterate

__all__ = ["Velocity", "check", "main", "run"]


@dataclass(frozen=True)
class Velocity(Settings):
    """Compute velocity and pressure of a flow from the densities of its film, by its equations of motion.

    The same command continues an interrupted run.
    """

    film: Annotated[Path, Positional]
    """Result of nerif sequence (.zarr), complete, or true fields over time."""
    out: Path
    """Velocity (.zarr) to write; its report lies beside it."""
    frames: str = "all"
    """Frames of the film: all, or FIRST:LAST (LAST excluded)."""
    measurement: Path | None = None
    """Measurement sequence (.zarr) of the film (default: the one that the film names)."""
    density: Literal["auto", "improved", "film"] = "auto"
    """Improved from the displacements of all frames and the velocity, film (as it is), or auto (if possible)."""
    force: bool = False
    """Overwrite an existing result."""
    fit: Annotated[VelocitySettings, Flat] = field(default_factory=VelocitySettings)


def check(out: Path, film: Path, quantities: tuple[str, ...], force: bool) -> None:
    """Check before a film is reconstructed whether its velocity can be computed and written."""
    if out.resolve() == film.resolve():
        raise InputError("expected another place than that of the film", field="velocity")
    if quantities and INDEX not in quantities:
        raise InputError(f"expected {INDEX} among them, which the velocity is computed from", field="quantities")
    check_output(out, force, endings=(".zarr",))


def run(settings: Velocity) -> VelocitySequence:
    """Compute the velocity, and write its report; exit with 1 if it does not explain the film."""
    from nerif.analysis.velocity_verdict import MOST_MISFIT
    from nerif.flow.assimilation import VelocityFit
    from nerif.workflow.film_velocity import velocity_of_film
    from nerif.workflow.reports import write_sequence_report

    check_output(settings.out, settings.force, endings=(".zarr",))
    with figures_bar("velocity") as bar:

        def update(iterate: FitIterate) -> None:
            figures = f"{iterate.what}, stage {iterate.stage + 1}/{iterate.stages} | iteration {iterate.iterations} | "
            figures += f"residual {iterate.misfit:.2f} sigma | {iterate.seconds:.0f} s"
            limit = settings.fit.time_limit
            done = min(iterate.seconds / limit, 0.99) if limit else iterate.stage / iterate.stages
            bar(done, figures, iterate.seconds)

        result = velocity_of_film(
            settings.film,
            settings.out,
            VelocityFit(**vars(settings.fit)),
            frames=None if settings.frames == "all" else frame_range(settings.frames),
            measurement=settings.measurement,
            density=settings.density,
            force=settings.force,
            on_iterate=update,
            say=MONITOR.say,
        )
    write_sequence_report(settings.out, monitor=MONITOR)
    if float(result.attributes["misfit"]) > MOST_MISFIT:
        raise SystemExit(1)
    return result


main = command("velocity", Velocity, run)
