"""Bootstrap trials in a result directory, and the standard deviations from them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from nerif.analysis.prediction import reproject
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.field import Field
from nerif.geometry import Grid
from nerif.physics.medium import Medium, derive_all, masked_lines
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.reconstructor import Reconstruction
from nerif.reconstruction.uncertainty.bootstrap import BootstrapDeviations, Maps, Original
from nerif.reconstruction.uncertainty.deviations import Deviations, certainty
from nerif.results.directory import ResultDirectory
from nerif.workflow.checkpointed import CheckpointedRun
from nerif.workflow.reconstruction_run import ReconstructionRun, StepOutputs

__all__ = ["all_quantities", "bootstrap", "write_deviations"]


def all_quantities(result: Reconstruction, medium: Medium, voxels: int) -> list[Volume]:
    """Sample a field and all derived quantities, `voxels` along the longest edge."""
    return derive_all(result.volume(Grid.of_resolution(result.box, voxels)), medium)


def write_deviations(
    out: ResultDirectory, monitor: Monitor, quantities: Sequence[Volume], deviations: Deviations,
    entries: dict[str, Any],
) -> None:  # fmt: skip
    """Write the standard deviations of all quantities beside them, and the section of metrics.json."""
    volumes = [*quantities, *deviations.volumes()]
    std = next(v for v in volumes if v.quantity == f"{volumes[0].quantity}_std")
    volumes.append(certainty(volumes[0], std))
    out.write_volumes(volumes)
    out.add_metrics(uncertainty={**entries, "trials": deviations.count})
    for line in masked_lines(volumes):
        monitor.say(line)
    rms, largest = float(std.values.square().nanmean().sqrt()), float(volumes[0].values.nan_to_num(0.0).abs().max())
    size = f"rms standard deviation of {volumes[0].quantity} {rms:.3g}, {rms / largest:.2%} of the maximum"
    samples = {"bootstrap": "trials", "posterior": "draws from the posterior"}[entries["source"]]
    monitor.say(f"uncertainty from {deviations.count} {samples}: {size}")


def bootstrap(run: ReconstructionRun, so_far: StepOutputs) -> StepOutputs:
    """Add standard deviations to the volumes, from trials; writes and resumes from trials/.

    Complete trials of an interrupted run are read; a diverged one is excluded.
    """
    main, count, monitor = so_far.the_result, run.trials.members, run.watching(withheld=False, snapshots=False)
    if not count or so_far.has_error_draws or main.outcome.reason == "interrupted":
        return so_far
    if main.outcome.failed:
        run.monitor.say(f"uncertainty: skipped: the main run {main.outcome.reason}")
        return so_far

    def projections(field: Field, measurement: Measurement) -> Maps:
        with monitor.counting("projecting the field") as bar:
            return reproject(field, measurement, (), main.device, bar, main.model).maps

    say, start, diverged = monitor.say, time.monotonic(), []
    base = Original(main, run.reconstructor, run.inputs.training, projections, so_far.rig)
    deviations = BootstrapDeviations(so_far.quantities[0], run.settings.substance, base)
    for number in range(1, count + 1):
        member, every = run.trials.member(number, base), run.settings.checkpoint_every
        settings = so_far.budget.limited(member.reconstructor, 1 / (count - number + 1))
        trial = CheckpointedRun(run.out.member(number), settings, member.measurement, run.start, every, monitor)
        result = trial(f"trial {number} of {count}")
        if result.outcome.reason == "interrupted":
            say(f"uncertainty: interrupted after {number - 1} of {count} trials; continue with --resume")
            break
        if result.outcome.failed:
            say(f"uncertainty: trial {number} {result.outcome.reason} and is excluded: {result.outcome.message}")
            diverged.append(number)
            continue
        deviations.add_trial(member, result)
    if not deviations.count:
        say("uncertainty: no trial succeeded, so no standard deviation is written")
        return so_far
    entries: dict[str, Any] = {"kind": run.trials.kind, "source": "bootstrap", "diverged_trials": diverged}
    entries["seconds"] = time.monotonic() - start
    write_deviations(run.out, monitor, so_far.quantities, deviations, entries)
    return so_far
