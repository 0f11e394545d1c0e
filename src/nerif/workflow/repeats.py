"""Repetitions of a reconstruction in its directory: each kept as soon as it is done, and what they tell of errors."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import torch

from nerif.analysis.evaluation import evaluate_views, rms_text
from nerif.analysis.prediction import reproject
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.base import Field
from nerif.geometry import Grid
from nerif.physics.quantities import GasSettings, derive_all, masked_lines
from nerif.reconstruction.base import Reconstruction, Reconstructor
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.reconstruction.uncertainty.repetition import Found, Maps, Repetitions, certainty
from nerif.results.directory import ResultDirectory
from nerif.workflow.checkpointed import KeptRun

__all__ = ["Members", "all_quantities"]


def all_quantities(result: Reconstruction, gas: GasSettings, voxels: int) -> list[Volume]:
    """Sample a reconstruction as all that follows from it, such as density, `voxels` along the longest edge."""
    return derive_all(result.volume(Grid.of_resolution(result.box, voxels)), gas)


@dataclass(frozen=True)
class Members:
    """Repetitions in a result directory.

    Parameters
    ----------
    out : the directory, with the main result in it
    kind : what is repeated, and how often
    reconstructor : settings of the main result
    training : what that was reconstructed from
    start : field that every one starts from, or None
    made_of : what else they depend on; those made of anything else are done again
    checkpoint_every : seconds
    monitor : told how the work goes
    """

    out: ResultDirectory
    kind: Repetitions
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
        say, started, word = self.monitor.say, time.monotonic(), self.kind.word
        noise = cache(lambda: self._noise(main))  # which not every kind asks for
        found = Found(main, self.reconstructor, self.training, lambda: noise()[0], lambda f: self._seen(f, main))
        with self.monitor.counting("sampling the field"):
            quantities = all_quantities(main, gas, voxels)
        taken = self.kind.taken(found, quantities[0], gas.for_field(quantities[0]))
        left_out, diverged = [], []
        for number in range(1, self.kind.members + 1):
            member = self.kind.member(number, found)
            kept = KeptRun(
                self.out.member(number), member.reconstructor, member.measurement, self.start, self.made_of,
                self.checkpoint_every, self.monitor,
            )  # fmt: skip
            result = kept(f"member {number} of {self.kind.members}{member.about}")
            if result.outcome.reason == "interrupted":
                say(f"{word}: interrupted after {number - 1} of {self.kind.members} members; --resume goes on")
                break
            if result.outcome.failed:
                say(f"{word}: member {number} {result.outcome.reason} and is left out: {result.outcome.message}")
                diverged.append(number)
                continue
            taken.add(member, result)
            if member.left_out:
                out = member.left_out
                left_out += _compared(result, self.training.select(out), out)
        if taken.count < self.kind.fewest:
            say(f"{word}: {taken.count} members are too few for a standard deviation; none is written")
            return
        volumes = [*quantities, *taken.volumes()]
        excess = next(v for v in volumes if v.quantity == f"{volumes[0].quantity}_std")
        volumes.append(certainty(volumes[0], excess))
        self.out.write_volumes(volumes)
        about: dict[str, Any] = {
            **dataclasses.asdict(self.kind), "members": taken.count, "diverged": diverged,  # type: ignore[call-overload]
            "left_out": left_out, "seconds": time.monotonic() - started,
        }  # fmt: skip
        if noise.cache_info().currsize:
            about["noise"] = noise()[1]
        self.out.add_metrics({word: about})
        for line in masked_lines(volumes):
            say(line)
        largest = float(volumes[0].values.abs().max())
        rms = float(excess.values.square().mean().sqrt())
        share = f"{rms / largest:.2%} of the largest"
        say(f"{word} of {taken.count}: rms standard deviation of {volumes[0].quantity} {rms:.3g}, {share}")
        for v in left_out:
            say(f"left out {v['name']}: CC {v['cc']:.4f}, rms error {rms_text(v)}")

    def _seen(self, field: Field, main: Reconstruction) -> Maps:
        """What the views of the reconstruction would see of a field."""
        with self.monitor.counting("measuring the field again") as bar:
            return reproject(field, self.training, (), main.device, bar, main.model).maps

    def _noise(self, main: Reconstruction) -> tuple[Maps, str]:
        """Standard deviation of every pixel's noise by technique: the file's, else the rms residual of each view."""
        training = self.training
        noise = {o.technique.name: o.sigma for o in training.observations if o.sigma is not None}
        noise = {name: sigma.nan_to_num(0.0, 0.0, 0.0) for name, sigma in noise.items()}
        unknown = [o for o in training.observations if o.sigma is None]
        if not unknown:
            return noise, "sigma of the measurement"
        instead = "noise of the size of each view's rms residual is added"
        names = " and ".join(o.technique.sigma for o in unknown)
        self.monitor.say(f"{self.kind.word}: the measurement has no {names}; {instead}")
        views = {(v["measured"], v["name"]): v["rms"] for v in _compared(main, training)}
        for o in unknown:
            # none for a view of which no ray crosses the box
            rms = torch.tensor([views.get((o.technique.measured, name), 0.0) for name in training.names])
            noise[o.technique.name] = rms.nan_to_num(0.0)[:, None, None, None].expand(o.values.shape).clone()
        return noise, "rms residual"


def _compared(result: Reconstruction, data: Measurement, held_out: Collection[str] = ()) -> list[dict[str, Any]]:
    """How well the views of some data are predicted."""
    return evaluate_views(reproject(result.field, data, held_out, result.device, model=result.model))
