"""From a film to a store of volumes: all that `nerif sequence` does, as a Python call."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

from nerif.common.conventions import InputError
from nerif.common.interruption import Interrupted
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.geometry import Grid
from nerif.reconstruction.aperture import seen_through
from nerif.reconstruction.bounds import field_bounds
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.symmetry import axis_of, symmetry_asked, with_axis
from nerif.workflow.sequence.cluster import check_workers, open_cluster
from nerif.workflow.sequence.plan import SequencePlan, SequenceSettings
from nerif.workflow.sequence.run import Progress, outcome_table, run_sequence
from nerif.workflow.sequence.store import MISSING, SequenceStore

__all__ = ["reconstruct_sequence"]


def reconstruct_sequence(
    out: str | os.PathLike[str],
    measurement: str | os.PathLike[str],
    reconstructor: NeRIF,
    settings: SequenceSettings | None = None,
    *,
    cluster: str = "local",
    workers: int = 0,
    threads: int = 0,
    dashboard: bool = False,
    retry: bool = False,
    force: bool = False,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    say: Callable[[str], None] = lambda line: None,
) -> SequenceStore:
    """Reconstruct every frame of a measurement sequence that a store lacks.

    A script that calls it has to have an `if __name__ == "__main__":` around the call, since workers of this machine
    are processes that import the script.

    Parameters
    ----------
    out : store to make (.zarr), or to go on with
    measurement : store of the measurement sequence
    reconstructor : settings of the method
    settings : of the sequence
    cluster : "local", tcp://HOST:PORT of a Dask scheduler, or a YAML file for SLURM (docs/sequences.md)
    workers : of a local cluster; 0 for one for each GPU, or for each two cores
    threads : of each worker on a CPU; 0 for its share of the cores
    dashboard : serve Dask's dashboard on 127.0.0.1, where every user of this machine can look at it
    retry : try again frames that failed in an earlier run
    force : begin anew, whatever `out` holds
    on_progress : told as frames are settled
    say : told lines about how the work goes

    Raises
    ------
    InputError
        If anything asked cannot be, or `out` was begun with other settings; what is there stays as it is.
    """
    out, measurement, settings = Path(out), Path(measurement), settings or SequenceSettings()
    for name, value in (("workers", workers), ("threads", threads)):
        if value < 0:
            raise InputError(f"expected 0 or more, got {value}", field=name)
    if out.suffix != ".zarr":
        raise InputError(f"expected a name ending in .zarr, got '{out.name}'", field="out")
    if not isinstance(reconstructor, NeRIF):
        raise InputError(f"expected NeRIF for a sequence, got {type(reconstructor).__name__}", field="reconstructor")
    if reconstructor.time_limit:
        raise InputError(
            "expected none in a sequence, whose frames are to be repeatable; give --max-steps", field="time_limit"
        )
    if reconstructor.source in ("images", "both"):
        raise InputError(f"expected auto or displacements for a sequence, got '{reconstructor.source}'", field="from")
    if reconstructor.refine:
        raise InputError(
            "expected nothing to refine in a sequence; refine one frame with nerif reconstruct, and give its "
            "calibration.toml to the measurement",
            field="refine",
        )
    sequence = MeasurementSequence.read(measurement)
    like = seen_through(sequence.fullest(), reconstructor.aperture)
    like.without(settings.withhold)
    settings = settings.for_measurement(like)
    shape = reconstructor.resolved_by(like).network
    reconstructor = replace(reconstructor, network=shape, wave_pixels=0, source="displacements")
    plan = SequencePlan(measurement.resolve(), out.resolve(), reconstructor, settings, threads)
    store = _store(plan, sequence, like, force, say)
    if store.symmetry is not None:
        plan = replace(plan, cold=with_axis(plan.cold, store.symmetry))
    if retry:
        say(f"{store.forget_failures()} failed frames are tried again")
    missing = int((store.status == MISSING).sum())
    if missing:
        say(f"{out}: {missing} of {len(sequence)} frames to do, in chunks of {settings.chunk}")
        try:
            with open_cluster(cluster, workers, out.parent.resolve(), dashboard) as (client, share):
                if dashboard and client.dashboard_link:
                    say(f"dashboard: {client.dashboard_link}")
                say("waiting for workers")
                check_workers(client)
                run_sequence(client, replace(plan, threads=threads or share), on_progress)
        except KeyboardInterrupt:
            say(outcome_table(store))
            kept = f"frames that are done are kept in {out}; the same command goes on with the others"
            raise Interrupted(kept) from None
    say(outcome_table(store))
    return store


def _store(
    plan: SequencePlan, sequence: MeasurementSequence, like: Measurement, force: bool, say: Callable[[str], None]
) -> SequenceStore:
    """The store that is there if it was begun with the same settings, else a new one, which has one axis for all."""
    bounds = field_bounds(like, plan.cold.lower, plan.cold.upper)
    limits = [bound if math.isfinite(bound) else None for bound in bounds]  # JSON knows no infinity
    kept = {"frames": len(sequence), "bounds": limits, **plan.kept}
    if plan.out.exists() and not force:
        store = SequenceStore(plan.out)
        store.check_same(kept)
        return store
    axis = axis_of(plan.cold, like.without(plan.settings.withhold))
    if axis is not None:
        for line in axis.sentences:
            say(line)
        asked = symmetry_asked(with_axis(plan.cold, axis.symmetry), like)
        assert asked is not None
        kept["symmetry"] = asdict(asked)
    grid = Grid.of_resolution(like.box, plan.settings.voxels)
    return SequenceStore.begin(plan.out, sequence, grid, plan.settings.quantities, plan.cold.network, kept)
