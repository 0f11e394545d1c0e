"""nerif velocity: velocity and pressure from a film of densities."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nerif.cli.arguments import check_output
from nerif.cli.commands.output import MONITOR, figures_bar
from nerif.cli.commands.settings import Flat, Settings, command
from nerif.data.velocity_sequence import VelocitySequence
from nerif.reconstruction.velocity.assimilation import Iterate, VelocityFit
from nerif.workflow.reports import write_sequence_report
from nerif.workflow.velocity import velocity_of_film

__all__ = ["Velocity", "main", "run"]


@dataclass(frozen=True)
class Velocity(Settings):
    """Compute velocity and pressure of a flow from the densities of its film, by its equations of motion.

    The same command continues an interrupted run.
    """

    film: Annotated[Path, tyro.conf.Positional]
    """Result of nerif sequence (.zarr), complete, or true fields over time."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Velocity (.zarr) to write; its report lies beside it."""
    frames: tuple[int, int] | None = None
    """First frame, and the one after the last (default: all)."""
    force: bool = False
    """Overwrite an existing result."""
    fit: Annotated[VelocityFit, Flat] = field(default_factory=VelocityFit)


def run(settings: Velocity) -> VelocitySequence:
    """Compute the velocity, and write its report."""
    check_output(settings.out, settings.force, endings=(".zarr",))
    with figures_bar("velocity") as bar:

        def update(iterate: Iterate) -> None:
            figures = f"grid {iterate.level + 1}/{iterate.levels} | iteration {iterate.iterations} | "
            figures += f"residual {iterate.misfit:.2f} sigma | {iterate.seconds:.0f} s"
            limit = settings.fit.time_limit
            done = min(iterate.seconds / limit, 1.0) if limit else iterate.level / iterate.levels
            bar(done, figures, iterate.seconds)

        result = velocity_of_film(
            settings.film,
            settings.out,
            settings.fit,
            frames=settings.frames,
            force=settings.force,
            on_iterate=update,
            say=MONITOR.say,
        )
    write_sequence_report(settings.out, monitor=MONITOR)
    return result


main = command("velocity", Velocity, run)
