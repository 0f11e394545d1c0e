"""nerif sequence: every frame of a recording, on one machine or a cluster."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nerif.cli.commands.output import MONITOR, figures_bar
from nerif.cli.commands.settings import Flat, Settings, read_settings, value_given
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.presets import preset
from nerif.workflow.sequence.plan import SequenceSettings
from nerif.workflow.sequence.reconstruct import reconstruct_sequence
from nerif.workflow.sequence.run import Progress
from nerif.workflow.sequence.store import DONE, SequenceStore

__all__ = ["Sequence", "main", "run"]


@dataclass(frozen=True)
class Sequence(Settings):
    """Reconstruct every frame of a measurement sequence into a Zarr store, which xarray opens at any time.

    The same command again does only what is missing. Frames are reconstructed in chunks of time, which run side by
    side; within a chunk each frame starts from the one before it.
    """

    measurement: Annotated[Path, tyro.conf.Positional]
    """Measurement sequence (.zarr), of nerif displacement or nerif simulate --times."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Result to write (.zarr), or to go on with."""
    cluster: str = "local"
    """Either local, tcp://HOST:PORT of a Dask scheduler, or a YAML file for SLURM (docs/sequences.md)."""
    workers: int = 0
    """Of a local cluster; 0 for one for each GPU, or for each two cores."""
    threads: int = 0
    """Of each worker on a CPU; 0 for its share of the cores."""
    dashboard: bool = False
    """Serve Dask's dashboard on 127.0.0.1, where every user of this machine can look at it."""
    retry: bool = False
    """Try again frames that failed in an earlier run."""
    force: bool = False
    """Begin anew, whatever --out holds."""
    preset: str = "auto"
    """One of fast, best, paper; auto is best where there is a GPU, else fast. Single settings below win over it."""
    frames: Annotated[SequenceSettings, Flat] = field(default_factory=SequenceSettings)
    reconstructor: Annotated[NeRIF, Flat] = field(default_factory=NeRIF)


def run(settings: Sequence) -> SequenceStore:
    """Make the store or open it, reconstruct what is missing, and say what came out."""
    with figures_bar("frames") as bar:

        def update(progress: Progress) -> None:
            settled = progress.done + progress.failed
            figures = f"{settled}/{progress.total} | {progress.frames_per_minute:.1f} frames/min"
            figures += f" | {progress.failed} failed"
            if progress.settled:
                figures += f" | {progress.seconds_left:.0f} s left"
            bar(progress.settled / max(progress.total, 1), figures, progress.seconds)

        return reconstruct_sequence(
            settings.out, settings.measurement, settings.reconstructor, settings.frames,
            cluster=settings.cluster, workers=settings.workers, threads=settings.threads,
            dashboard=settings.dashboard, retry=settings.retry, force=settings.force, on_progress=update,
            say=MONITOR.say,
        )  # fmt: skip


def main(arguments: list[str]) -> None:
    """Parse and run."""
    name = value_given("preset", arguments, "auto")
    default = Sequence(measurement=tyro.MISSING, out=tyro.MISSING, preset=name, reconstructor=preset(name))
    if not (run(read_settings(default, arguments, "sequence")).status == DONE).any():
        raise SystemExit(1)
