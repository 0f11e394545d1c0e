"""The trials of the bootstrap in a result directory: each is kept when done; from all of them standard deviations."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from nerif.analysis.prediction import reproject
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.base import Field
from nerif.geometry import Grid
from nerif.physics.quantities import GasSettings, derive_all, masked_lines
from nerif.reconstruction.base import Reconstruction, Reconstructor
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.reconstruction.uncertainty.bootstrap import Deviations, Maps, Original, Trials, certainty
from nerif.results.directory import ResultDirectory
from nerif.workflow.checkpointed import KeptRun

__all__ = ["Members", "all_quantities"]


def all_quantities(result: Reconstruction, gas: GasSettings, voxels: int) -> list[Volume]:
    """Sample a reconstruction as all that follows from it, such as density, `voxels` along the longest edge."""
    return derive_all(result.volume(Grid.of_resolution(result.box, voxels)), gas)


@dataclass(frozen=True)
class Members:
    """Trials of the bootstrap in a result directory.

    Parameters
    ----------
    out : the directory, with the main result in it
    trials : which, and how many
    reconstructor : settings of the main result
    training : what that was reconstructed from
    start : field that every one starts from, or None
    made_of : what else they depend on; those made of anything else are done again
    checkpoint_every : seconds
    monitor : told how the work goes
    """

    out: ResultDirectory
    trials: Trials
    reconstructor: Reconstructor
    training: Measurement
    start: Field | None = None
    made_of: Mapping[str, str] = field(default_factory=dict)
    checkpoint_every: float = 60.0
    monitor: Monitor = QUIET

    def add_to(self, main: Reconstruction, gas: GasSettings, voxels: int) -> None:
        """Reconstruct them, and write standard deviations of every quantity beside the main result.

        Those that an interrupted run of the same settings has left are not done again. An interruption leaves those
        done so far. One that diverges is left out, and told.
        """
        say, started, word, count = self.monitor.say, time.monotonic(), "uncertainty", self.trials.members
        original = Original(main, self.reconstructor, self.training, lambda f: self._seen(f, main))
        with self.monitor.counting("sampling the field"):
            quantities = all_quantities(main, gas, voxels)
        taken = Deviations(quantities[0], gas.for_field(quantities[0]), original)
        diverged = []
        for number in range(1, count + 1):
            member = self.trials.member(number, original)
            kept = KeptRun(
                self.out.member(number), member.reconstructor, member.measurement, self.start, self.made_of,
                self.checkpoint_every, self.monitor,
            )  # fmt: skip
            result = kept(f"trial {number} of {count}")
            if result.outcome.reason == "interrupted":
                say(f"{word}: interrupted after {number - 1} of {count} trials; --resume goes on")
                break
            if result.outcome.failed:
                say(f"{word}: trial {number} {result.outcome.reason} and is left out: {result.outcome.message}")
                diverged.append(number)
                continue
            taken.add(member, result)
        if not taken.count:
            say(f"{word}: no trial succeeded, so no standard deviation is written")
            return
        volumes = [*quantities, *taken.volumes()]
        excess = next(v for v in volumes if v.quantity == f"{volumes[0].quantity}_std")
        volumes.append(certainty(volumes[0], excess))
        self.out.write_volumes(volumes)
        about: dict[str, Any] = {
            "kind": self.trials.kind, "members": taken.count, "diverged": diverged,
            "seconds": time.monotonic() - started,
        }  # fmt: skip
        self.out.add_metrics({word: about})
        for line in masked_lines(volumes):
            say(line)
        largest = float(volumes[0].values.abs().max())
        rms = float(excess.values.square().mean().sqrt())
        share = f"{rms / largest:.2%} of the largest"
        say(f"{word} of {taken.count}: rms standard deviation of {volumes[0].quantity} {rms:.3g}, {share}")

    def _seen(self, field: Field, main: Reconstruction) -> Maps:
        """What the views of the reconstruction would see of a field."""
        with self.monitor.counting("measuring the field again") as bar:
            return reproject(field, self.training, (), main.device, bar, main.model).maps
