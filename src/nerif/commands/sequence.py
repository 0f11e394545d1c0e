"""nerif sequence: every frame of a recording, on one machine or a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from nerif.commands.output import say
from nerif.commands.settings import Settings, read_settings, value_given
from nerif.conventions import InputError
from nerif.geometry import Grid
from nerif.measurement_sequence import MeasurementSequence
from nerif.physics.quantities import GasSettings
from nerif.reconstruction.neural import NeRIF
from nerif.reconstruction.presets import preset
from nerif.sequence.cluster import check_workers, open_cluster
from nerif.sequence.plan import SequencePlan, warm
from nerif.sequence.run import Progress, outcome_table, run_sequence
from nerif.sequence.store import MISSING, SequenceStore
from nerif.volume import QUANTITIES
from nerif.workflow import check_gas

__all__ = ["Sequence", "main", "run"]


OWN = (
    "chunk",
    "temporal",
    "warm_steps",
    "warm_rate",
    "joint_steps",
    "time_octaves",
    "voxels",
)  # kept in the store


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
    chunk: int = 32
    """Frames of a chunk of time; the first of each starts from nothing."""
    warm_steps: int = 300
    """Steps of a frame that starts from the one before."""
    warm_rate: float = 0.7
    """Share of the learning rate such a frame begins with."""
    temporal: str = "frames"
    """A network for each frame ("frames"), or one over space and time for each chunk ("joint")."""
    joint_steps: int = 300
    """Steps for each frame of a joint network."""
    time_octaves: int = 3
    """Of the encoding of time in a joint network."""
    hold_out: tuple[str, ...] = ()
    """Views kept out of the reconstruction, and compared with it."""
    voxels: int = 100
    """Voxels of the volumes along the longest edge of the box."""
    quantities: tuple[str, ...] = ("index_excess", "density")
    """Written of every frame: index_excess, n, density, temperature."""
    retry: bool = False
    """Try again frames that failed in an earlier run."""
    force: bool = False
    """Begin anew, whatever --out holds."""
    preset: str = "auto"
    """One of fast, best, paper; auto is best where there is a GPU, else fast. Single settings below win over it."""
    gas: GasSettings = field(default_factory=GasSettings)
    """What density and temperature are computed for."""
    reconstructor: Annotated[NeRIF, tyro.conf.arg(name="")] = field(default_factory=NeRIF)


def run(settings: Sequence) -> SequenceStore:
    """Make the store or open it, reconstruct what is missing, and say what came out."""
    for name, least in (
        ("chunk", 1),
        ("warm_steps", 1),
        ("voxels", 1),
        ("threads", 0),
        ("workers", 0),
        ("joint_steps", 1),
        ("time_octaves", 0),
    ):
        if getattr(settings, name) < least:
            raise InputError(f"{name}: expected {least} or more, got {getattr(settings, name)}")
    for quantity in settings.quantities:
        if quantity not in QUANTITIES:
            raise InputError(f"quantities: expected some of {', '.join(QUANTITIES)}, got '{quantity}'")
    if settings.temporal not in ("frames", "joint"):
        raise InputError(f"temporal: expected frames or joint, got '{settings.temporal}'")
    if settings.out.suffix != ".zarr":
        raise InputError(f"out: expected a name ending in .zarr, got '{settings.out.name}'")
    if settings.reconstructor.time_limit:
        raise InputError("time_limit: expected none in a sequence, whose frames are to be repeatable; give --max-steps")
    sequence = MeasurementSequence.read(settings.measurement)
    settings, store = _store(settings, sequence)
    if settings.retry:
        say(f"{store.forget_failures()} failed frames are tried again")
    cold = settings.reconstructor
    plan = SequencePlan(
        measurement=settings.measurement.resolve(),
        out=settings.out.resolve(),
        cold=cold,
        warm=warm(cold, settings.warm_steps, settings.warm_rate),
        voxels=settings.voxels,
        quantities=settings.quantities,
        gas=settings.gas,
        hold_out=settings.hold_out,
        threads=settings.threads,
        joint_steps=settings.joint_steps if settings.temporal == "joint" else 0,
        time_octaves=settings.time_octaves,
    )
    missing = int((store.status == MISSING).sum())
    if missing:
        say(f"{settings.out}: {missing} of {len(sequence)} frames to do, in chunks of {settings.chunk}")
        try:
            with open_cluster(settings.cluster, settings.workers) as (client, threads), _bar() as bar:
                if client.dashboard_link:
                    say(f"dashboard: {client.dashboard_link}")
                check_workers(client)
                run_sequence(client, replace(plan, threads=plan.threads or threads), settings.chunk, bar)
        except KeyboardInterrupt:
            say(outcome_table(store))
            raise
    say(outcome_table(store))
    return store


def _store(settings: Sequence, sequence: MeasurementSequence) -> tuple[Sequence, SequenceStore]:
    """The store to write to: the one that is there if it was begun with the same settings, else a new one."""
    like = sequence.first_good()
    for name in settings.hold_out:
        if name not in like.names:
            raise InputError(f"hold_out: expected views out of {', '.join(like.names)}, got '{name}'")
    if len(set(settings.hold_out)) >= len(like.names):
        raise InputError("hold_out: every view is held out, so none is left to reconstruct from")
    if like.wavelength_nm is not None:
        settings = replace(settings, gas=replace(settings.gas, wavelength_nm=like.wavelength_nm))
    check_gas(settings.gas, like)
    kept: dict[str, Any] = {
        "measurement": str(settings.measurement.resolve()),
        "frames": len(sequence),
        **{name: getattr(settings, name) for name in OWN},
        "hold_out": list(settings.hold_out),
        "quantities": list(settings.quantities),
        "gas": asdict(settings.gas),
        "settings": asdict(settings.reconstructor),
    }
    if settings.out.exists() and not settings.force:
        store = SequenceStore(settings.out)
        store.check_same(kept)
        return settings, store
    grid = Grid.of_resolution(like.box, settings.voxels)
    network = settings.reconstructor.network
    return settings, SequenceStore.begin(settings.out, sequence, grid, settings.quantities, network, kept)


@contextmanager
def _bar() -> Iterator[Callable[[Progress], None]]:
    """One bar for the whole sequence: frames a minute, failures, time left."""
    import sys

    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    columns = (TextColumn("frames"), BarColumn(bar_width=20), TextColumn("{task.fields[figures]}"))
    last = [0.0]
    with Bar(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("frames", total=None, figures="starting workers")

        def update(progress: Progress) -> None:
            settled = progress.done + progress.failed
            figures = f"{settled}/{progress.total} | {progress.frames_per_minute:.1f} frames/min"
            figures += f" | {progress.failed} failed"
            if progress.settled:
                figures += f" | {progress.seconds_left:.0f} s left"
            bar.update(task, completed=progress.settled, total=progress.total, figures=figures)
            if not console.is_terminal and (settled == progress.total or progress.seconds - last[0] >= 15):
                last[0] = progress.seconds
                print(f"frames {figures}", file=sys.stderr, flush=True)

        yield update


def main(arguments: list[str]) -> None:
    """Parse and run."""
    name = value_given("preset", arguments, "auto")
    default = Sequence(measurement=tyro.MISSING, out=tyro.MISSING, preset=name, reconstructor=preset(name))
    run(read_settings(default, arguments, "sequence"))
