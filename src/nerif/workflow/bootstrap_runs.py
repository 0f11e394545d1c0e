"""Bootstrap trials in a result directory, and the standard deviations from them."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from nerif.analysis.prediction import reproject
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.field import Field
from nerif.geometry import Grid
from nerif.physics.quantities import GasSettings, derive_all, masked_lines
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.reconstruction.reconstructor import Reconstruction, Reconstructor
from nerif.reconstruction.uncertainty.bootstrap import BootstrapDeviations, Maps, Original, Trials
from nerif.reconstruction.uncertainty.deviations import Deviations, certainty
from nerif.reconstruction.uncertainty.rig_posterior import RigPosterior
from nerif.results.directory import ResultDirectory
from nerif.workflow.budget import NO_LIMIT, Budget
from nerif.workflow.checkpointed import CheckpointedRun

__all__ = ["Members", "all_quantities", "write_deviations"]


def all_quantities(result: Reconstruction, gas: GasSettings, voxels: int) -> list[Volume]:
    """Sample a field and all derived quantities, `voxels` along the longest edge."""
    return derive_all(result.volume(Grid.of_resolution(result.box, voxels)), gas)


def write_deviations(
    out: ResultDirectory, monitor: Monitor, quantities: list[Volume], deviations: Deviations, entries: dict[str, Any]
) -> None:
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


@dataclass(frozen=True)
class Members:
    """Bootstrap trials in a result directory.

    Parameters
    ----------
    out : directory with the main result
    trials : kind and number
    reconstructor : settings of the main result
    training : data of the main result, with the calibrated cameras
    rig : the refined rig of the main result, if it was refined
    start : initial field, or None
    checkpoint_every : s
    monitor : of the progress
    budget : time left for the trials
    """

    out: ResultDirectory
    trials: Trials
    reconstructor: Reconstructor
    training: Measurement
    rig: RigPosterior | None = None
    start: Field | None = None
    checkpoint_every: float = 60.0
    monitor: Monitor = QUIET
    budget: Budget = NO_LIMIT

    def add_to(self, main: Reconstruction, quantities: list[Volume], gas: GasSettings) -> None:
        """Run the trials, and write standard deviations beside the quantities of the main result.

        Complete trials of an interrupted run are read; a diverged one is excluded.
        """
        say, start, word, count = self.monitor.say, time.monotonic(), "uncertainty", self.trials.members
        base = Original(main, self.reconstructor, self.training, lambda *data: self._projections(main, *data), self.rig)
        deviations = BootstrapDeviations(quantities[0], gas, base)
        diverged = []
        for number in range(1, count + 1):
            member = self.trials.member(number, base)
            settings = self.budget.allot(member.reconstructor, 1 / (count - number + 1))
            run = CheckpointedRun(
                self.out.member(number), settings, member.measurement, self.start, self.checkpoint_every, self.monitor,
            )  # fmt: skip
            result = run(f"trial {number} of {count}")
            if result.outcome.reason == "interrupted":
                say(f"{word}: interrupted after {number - 1} of {count} trials; continue with --resume")
                break
            if result.outcome.failed:
                say(f"{word}: trial {number} {result.outcome.reason} and is excluded: {result.outcome.message}")
                diverged.append(number)
                continue
            deviations.add_trial(member, result)
        if not deviations.count:
            say(f"{word}: no trial succeeded, so no standard deviation is written")
            return
        entries: dict[str, Any] = {"kind": self.trials.kind, "source": "bootstrap", "diverged_trials": diverged}
        entries["seconds"] = time.monotonic() - start
        write_deviations(self.out, self.monitor, quantities, deviations, entries)

    def _projections(self, main: Reconstruction, field: Field, measurement: Measurement) -> Maps:
        with self.monitor.counting("projecting the field") as bar:
            return reproject(field, measurement, (), main.device, bar, main.model).maps
