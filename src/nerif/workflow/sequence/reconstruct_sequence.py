"""From a measurement sequence to a store of volumes: nerif sequence as a Python call."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

from nerif.common.conventions import InputError
from nerif.common.files import ending
from nerif.common.interruption import if_interrupted
from nerif.common.locks import locked
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.quantity_names import INDEX
from nerif.geometry import Grid
from nerif.reconstruction.aperture import apply_aperture
from nerif.reconstruction.bounds import field_bounds
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.symmetry_axis import axis_of, symmetry_of, with_axis
from nerif.workflow.sequence.cluster import check_workers, open_cluster
from nerif.workflow.sequence.plan import SequencePlan, SequenceSettings
from nerif.workflow.sequence.run import SequenceProgress, outcome_table, run_sequence
from nerif.workflow.sequence.store import MISSING, SequenceStore

__all__ = ["reconstruct_sequence"]


def reconstruct_sequence(
    out: str | os.PathLike[str], measurement: str | os.PathLike[str], reconstructor: NeRIF,
    settings: SequenceSettings | None = None, *, cluster: str = "local", workers: int = 0, threads: int = 0,
    dashboard: bool = False, retry: bool = False, force: bool = False,
    on_progress: Callable[[SequenceProgress], None] = lambda progress: None,
    say: Callable[[str], None] = lambda line: None,
) -> SequenceStore:  # fmt: skip
    """Reconstruct every frame of a measurement sequence that a store lacks.

    Scripts must call it under `if __name__ == "__main__":`, since local workers are processes that import the script.
    The store is left as it is if any input is invalid, or differs from that of an earlier run, or while another run
    writes to it.

    Parameters
    ----------
    out : store (.zarr) to make or to continue
    measurement : store of the measurement sequence
    reconstructor : settings of the method
    settings : of the sequence
    cluster : "local", tcp://HOST:PORT of a Dask scheduler, or a YAML file for SLURM (docs/sequences.md)
    workers : of a local cluster; 0: one per GPU, or per two cores
    threads : of each worker on a CPU; 0: its share of the cores
    dashboard : serve the Dask dashboard on 127.0.0.1, visible to all users of this machine
    retry : retry the failed frames of an earlier run
    force : start again, discarding the content of `out`
    on_progress : called when frames are complete or failed
    say : called with lines of text
    """
    out, measurement, settings = Path(out), Path(measurement), settings or SequenceSettings()
    if ending(out) != ".zarr":
        raise InputError(f"expected a name ending in .zarr, got '{out.name}'", field="out")
    if not isinstance(reconstructor, NeRIF):
        raise InputError(f"expected NeRIF for a sequence, got {type(reconstructor).__name__}", field="reconstructor")
    if reconstructor.time_limit:
        raise InputError("expected 0 for a sequence, which must be reproducible; give --max-steps", field="time_limit")
    if reconstructor.source in ("images", "both"):
        raise InputError(f"expected auto or displacements for a sequence, got '{reconstructor.source}'", field="from")
    if reconstructor.refine:
        raise InputError(
            "expected none for a sequence; refine one frame with nerif reconstruct, and use its calibration.toml for "
            "the measurement",
            field="refine",
        )
    sequence = MeasurementSequence.read(measurement)
    like = apply_aperture(sequence.fullest(), reconstructor.aperture)
    like.without(settings.withhold)
    settings = settings.for_measurement(like)
    if like.quantity == INDEX and (other := settings.substance.not_around(like.n_ambient)):
        say(f"{settings.substance.names[0]}: not computed: {other}")
    network = reconstructor.resolved_by(like).network
    reconstructor = replace(reconstructor, network=network, wave_pixels=0, source="displacements")
    plan = SequencePlan(measurement.resolve(), out.resolve(), reconstructor, settings, threads)
    with locked(plan.out):
        store = _store(plan, sequence, like, force, say)
        if store.symmetry is not None:
            plan = replace(plan, cold=with_axis(plan.cold, store.symmetry))
        if retry:
            say(f"{store.forget_failures()} failed frames are tried again")
        if pending := int((store.status == MISSING).sum()):
            say(f"{out}: {pending} of {len(sequence)} frames to reconstruct, in chunks of {settings.chunk}")
            with (
                if_interrupted(lambda: _kept(store, say)),
                open_cluster(cluster, workers, plan.out.parent, dashboard) as (client, share),
            ):
                if dashboard and client.dashboard_link:
                    say(f"dashboard: {client.dashboard_link}")
                say("waiting for workers")
                check_workers(client)
                progress = run_sequence(client, replace(plan, threads=threads or share), on_progress)
            if progress.loss:
                say(progress.loss)
    say(outcome_table(store))
    return store


def _kept(store: SequenceStore, say: Callable[[str], None]) -> str:
    """Print the outcome of an interrupted run, and return how to continue."""
    say(outcome_table(store))
    return f"complete frames are kept in {store.path}; run the same command again to continue"


def _store(
    plan: SequencePlan, sequence: MeasurementSequence, like: Measurement, force: bool, say: Callable[[str], None]
) -> SequenceStore:
    """Return the existing store if its settings are the same, else a new one, with one axis of symmetry."""
    bounds = field_bounds(like, plan.cold.lower, plan.cold.upper)
    limits = [bound if math.isfinite(bound) else None for bound in bounds]  # no infinity in JSON
    attributes = {"frames": len(sequence), "bounds": limits, **plan.attributes}
    if plan.out.exists() and not force:
        store = SequenceStore(plan.out)
        store.check_same(attributes)
        return store
    axis = axis_of(plan.cold, like.without(plan.settings.withhold))
    if axis is not None:
        for line in axis.sentences:
            say(line)
        symmetry = symmetry_of(with_axis(plan.cold, axis.symmetry), like)
        assert symmetry is not None
        attributes["symmetry"] = asdict(symmetry)
    grid = Grid.of_resolution(like.box, plan.settings.voxels)
    return SequenceStore.begin(plan.out, sequence, grid, plan.settings.quantities, plan.cold.network, attributes)
