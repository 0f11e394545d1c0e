"""nerif sequence: every frame of a recording, on one machine or a cluster."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from nerif.cli.commands import velocity
from nerif.cli.commands.reconstruct import read_with_preset
from nerif.cli.output import MONITOR, figures_bar
from nerif.cli.settings import Settings, compute
from nerif.common.settings import MISSING, Flat, Natural, Positional
from nerif.flow.velocity_settings import VelocitySettings
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.presets import PRESETS
from nerif.workflow.sequence.plan import SequenceSettings

if TYPE_CHECKING:
    from nerif.workflow.sequence import store
    from nerif.workflow.sequence.run import SequenceProgress

__all__ = ["Sequence", "main", "run"]


@dataclass(frozen=True)
class Sequence(Settings):
    """Reconstruct every frame of a measurement sequence into a Zarr store, which xarray can open at any time.

    The same command continues an incomplete store. Chunks of time run in parallel; within a chunk each frame starts
    from the previous one.
    """

    brief: ClassVar[bool] = True
    measurement: Annotated[Path, Positional]
    """Measurement sequence (.zarr) of nerif displacement --frames or nerif simulate --times."""
    out: Path
    """Result (.zarr) to write or to continue."""
    cluster: str = "local"
    """Where to compute: local, tcp://HOST:PORT of a Dask scheduler, or a YAML file for SLURM (docs/sequences.md); not
    from a settings file, since the latter two can run code here."""
    workers: Natural = 0
    """Workers of a local cluster (0: one per GPU, or per two cores)."""
    threads: Natural = 0
    """Threads of each worker on a CPU (0: its share of the cores)."""
    dashboard: bool = False
    """Serve the Dask dashboard on 127.0.0.1, visible to all users of this machine."""
    retry: bool = False
    """Retry the failed frames of an earlier run."""
    force: bool = False
    """Start again, discarding the content of --out."""
    preset: Literal["auto", *PRESETS] = "auto"  # type: ignore[valid-type]
    """Default settings: fast (CPU), best (GPU), paper, or auto (best with a GPU, else fast)."""
    frames: Annotated[SequenceSettings, Flat] = field(default_factory=SequenceSettings)
    reconstructor: Annotated[NeRIF, Flat] = field(default_factory=NeRIF)
    velocity: Path | None = None
    """Velocity (.zarr) to compute from the complete result, as nerif velocity does."""
    flow: VelocitySettings = field(default_factory=VelocitySettings)
    """Its settings."""


def run(settings: Sequence) -> store.SequenceStore:
    """Reconstruct the missing frames, and print a table of the result; then compute the velocity, if requested."""
    from nerif.workflow.sequence.reconstruct_sequence import reconstruct_sequence

    if settings.velocity is not None:
        velocity.check(settings.velocity, settings.out, settings.frames.quantities, settings.force)
    with figures_bar("frames") as bar:

        def update(progress: SequenceProgress) -> None:
            figures = f"{progress.settled}/{progress.total} | {progress.frames_per_minute:.1f} frames/min"
            figures += f" | {progress.failed} failed"
            figures += f" | {progress.deaths} deaths of workers" * bool(progress.deaths)
            if progress.settled:
                figures += f" | {progress.seconds_left:.0f} s left"
            bar(progress.settled / max(progress.total, 1), figures, progress.seconds)

        result = reconstruct_sequence(
            settings.out, settings.measurement, settings.reconstructor, settings.frames,
            cluster=settings.cluster, workers=settings.workers, threads=settings.threads,
            dashboard=settings.dashboard, retry=settings.retry, force=settings.force, on_progress=update,
            say=MONITOR.say,
        )  # fmt: skip
    if settings.velocity is not None:
        velocity.run(velocity.Velocity(settings.out, settings.velocity, force=settings.force, fit=settings.flow))
    return result


def main(arguments: list[str]) -> None:
    """Parse and run."""
    settings = read_with_preset(Sequence(MISSING, MISSING), arguments, "sequence")
    from nerif.workflow.sequence import store

    status = compute(run, settings).status
    if (status == store.MISSING).any() or not (status == store.DONE).any():
        raise SystemExit(1)
