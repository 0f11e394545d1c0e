"""The ensemble of a result directory: its members one by one, each kept as soon as it is done, and their spread."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.atomic import atomic
from nerif.conventions import InputError
from nerif.evaluation import evaluate_views, rms_text
from nerif.fields.base import Field
from nerif.geometry import Grid
from nerif.measurement import Measurement
from nerif.monitor import QUIET, Monitor
from nerif.physics.quantities import GasSettings, derive_all, masked_lines
from nerif.prediction import reproject
from nerif.reconstruction.base import Outcome, Reconstruction, Reconstructor
from nerif.reconstruction.ensemble import Ensemble, Spread
from nerif.reconstruction.files import FIELD
from nerif.reconstruction.fingerprint import fingerprint
from nerif.result import ResultDirectory
from nerif.volume import Volume

__all__ = ["Members", "all_quantities"]

ASKED = "asked.json"


def all_quantities(result: Reconstruction, gas: GasSettings, voxels: int) -> list[Volume]:
    """Sample a reconstruction as all that follows from it, such as density, `voxels` along the longest edge."""
    return derive_all(result.volume(Grid.of_resolution(result.box, voxels)), gas)


@dataclass(frozen=True)
class Members:
    """Members of an ensemble in a result directory.

    Parameters
    ----------
    out : the directory, with the main result in it
    ensemble : how many members, and what they see
    reconstructor : settings of the main result
    training : what that was reconstructed from
    start : field that every member starts from, or None
    made_of : what else the members depend on; those made of anything else are done again
    monitor : told how the work goes
    """

    out: ResultDirectory
    ensemble: Ensemble
    reconstructor: Reconstructor
    training: Measurement
    start: Field | None = None
    made_of: Mapping[str, str] = field(default_factory=dict)
    monitor: Monitor = QUIET

    def add_to(self, main: Reconstruction, gas: GasSettings, voxels: int) -> None:
        """Reconstruct the members, and write mean and standard deviation of every quantity beside the main result.

        Members that an interrupted run of the same settings has left are not done again. An interruption leaves those
        done so far. A member that diverges is left out, and told.
        """
        say, started = self.monitor.say, time.monotonic()
        noise, source = self._noise(main)
        spread, left_out, diverged = Spread(), [], []
        for number in range(1, self.ensemble.members + 1):
            result = self._member(number, noise)
            if result.outcome.reason == "interrupted":
                say(f"ensemble: interrupted after {spread.count} of {self.ensemble.members} members; --resume goes on")
                break
            if result.outcome.failed:
                say(f"ensemble: member {number} {result.outcome.reason} and is left out: {result.outcome.message}")
                diverged.append(number)
                continue
            spread.add(all_quantities(result, gas, voxels))
            out = self.ensemble.left_out(number, self.training)
            if out:
                left_out += _compared(result, self.training.select(out), out)
        if spread.count < 2:
            say(f"ensemble: {spread.count} members are too few for a standard deviation; none is written")
            return
        volumes = [*all_quantities(main, gas, voxels), *spread.volumes()]
        self.out.write_volumes(volumes)
        about: dict[str, Any] = {
            "members": spread.count, "diverged": diverged, "noise": source,
            "leave_one_out": self.ensemble.leave_one_out, "left_out": left_out,
            "seconds": time.monotonic() - started,
        }  # fmt: skip
        self.out.add_metrics({"ensemble": about})
        for line in masked_lines(volumes):
            say(line)
        excess = next(v for v in volumes if v.quantity == f"{volumes[0].quantity}_std")
        largest = float(volumes[0].values.abs().max())
        rms = float(excess.values.square().mean().sqrt())
        share = f"{rms / largest:.2%} of the largest"
        say(f"ensemble of {spread.count}: rms standard deviation of {volumes[0].quantity} {rms:.3g}, {share}")
        for v in left_out:
            say(f"left out {v['name']}: CC {v['cc']:.4f}, rms error {rms_text(v)}")

    def _noise(self, main: Reconstruction) -> tuple[dict[str, Float[Tensor, "view row column c"]], str]:
        """Standard deviation of every pixel's noise by technique: the file's, else the rms residual of each view."""
        training = self.training
        noise = {o.technique.name: o.sigma for o in training.observations if o.sigma is not None}
        noise = {name: sigma.nan_to_num(0.0, 0.0, 0.0) for name, sigma in noise.items()}
        unknown = [o for o in training.observations if o.sigma is None]
        if not unknown:
            return noise, "sigma of the measurement"
        instead = "noise of the size of each view's rms residual is added"
        names = " and ".join(o.technique.sigma for o in unknown)
        self.monitor.say(f"ensemble: the measurement has no {names}; {instead}")
        views = {(v["measured"], v["name"]): v["rms"] for v in _compared(main, training)}
        for o in unknown:
            # none for a view of which no ray crosses the box
            rms = torch.tensor([views.get((o.technique.measured, name), 0.0) for name in training.names])
            noise[o.technique.name] = rms.nan_to_num(0.0)[:, None, None, None].expand(o.values.shape).clone()
        return noise, "rms residual"

    def _member(self, number: int, noise: Mapping[str, Float[Tensor, "view row column c"]]) -> Reconstruction:
        """One member: read if it is there already, made by the same settings from the same data; else reconstructed."""
        directory = self.out.member(number)
        reconstructor, noisy = self.ensemble.member(number, self.reconstructor, self.training, noise)
        made_of = self._made_of(reconstructor, noisy)
        if directory.has(FIELD) and directory.has(ASKED) and (directory / ASKED).read_text() == made_of:
            try:
                kept, settings = Outcome("converged", "read from disc"), dataclasses.asdict(reconstructor)  # type: ignore[call-overload]
                return Reconstruction(*directory.field(), [], kept, settings, quantity=directory.quantity())
            except InputError as error:
                self.monitor.say(f"{error}; this member is done again")
        out = "".join(f", without {name}" for name in self.ensemble.left_out(number, self.training))
        with self.monitor.training(f"member {number} of {self.ensemble.members}{out}") as told:
            result = reconstructor(noisy, told, None, self.start)
        if result.outcome.reason != "interrupted" and not result.outcome.failed:
            directory.path.mkdir(parents=True, exist_ok=True)
            (directory / ASKED).unlink(missing_ok=True)
            directory.write_field(dataclasses.replace(result, state=None))
            with atomic(directory / ASKED) as part:
                part.write_text(made_of)
        return result

    def _made_of(self, reconstructor: Reconstructor, data: Measurement) -> str:
        """What a member was made by and from, as text: another one of either gives another text."""
        asked = {
            "data": fingerprint(data),
            **self.made_of,
            **dataclasses.asdict(reconstructor),  # type: ignore[call-overload]
        }
        return json.dumps(asked, indent=1, default=str) + "\n"


def _compared(result: Reconstruction, data: Measurement, held_out: Collection[str] = ()) -> list[dict[str, Any]]:
    """How well the views of some data are predicted."""
    return evaluate_views(reproject(result.field, data, held_out, result.device, model=result.model))
