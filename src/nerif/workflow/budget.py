"""The time limit of a reconstruction into a directory: it counts everything, from the start to the report."""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass
from typing import TypeVar

import torch

from nerif.analysis.prediction import VALIDATION_VOXELS, evaluations
from nerif.data.measurement import Measurement
from nerif.fields.network import Network
from nerif.fields.network_kinds import network_in
from nerif.geometry import Grid
from nerif.reconstruction.device import resolve_device
from nerif.reconstruction.neural.schedule import duration
from nerif.reconstruction.neural.training_settings import TrainingSettings
from nerif.reconstruction.reconstructor import Reconstructor
from nerif.reconstruction.shared_settings import SHORT_RUN
from nerif.reconstruction.voxels.voxel_reconstructor import VoxelReconstructor

__all__ = ["Budget"]

REPORT, PER_PIXEL = 4.5, 1.6e-6  # s: files, verdict and report; scores and images of the views
LEAST = 0.1  # of the limit, for the fits
PROBE = 16384  # points
STEP = 7.5  # time of a training step per point, in evaluations: measured on a CPU, thin rays (6.9 to 8.1)
FEW = 0.5  # of the steps to the first convergence check: fits of fewer are poor (docs/decisions/020)
TRAINING = "steps", "the time in which this machine evaluates the network"
ITERATIONS = "iterations on the finest grid", "the speed of a usual CPU"
LITTLE = 1 / 3  # of the limit: too little for the fits

R = TypeVar("R", bound=Reconstructor)


@dataclass(frozen=True)
class Budget:
    """A time limit, shared among the fits of a run."""

    limit: float  #: s; 0: none
    start: float  #: time from which it counts, s since the epoch
    reserve: float  #: s, for what follows the fits
    steps: int = 0  #: of the main fit, that are enough; 0 if unknown
    pace: float = 0.0  #: s per step; 0 if unknown
    words: tuple[str, str] = TRAINING  #: name of these steps, and what the pace follows from
    validation: float = 0.0  #: s, to predict views in the cross-validation

    @classmethod
    def of(cls, reconstructor: Reconstructor, measurement: Measurement, voxels: int, start: float | None) -> Budget:
        """Return the budget of a run; the time to evaluate its field is measured on this machine.

        Parameters
        ----------
        voxels : of the written volume along the longest edge
        start : s since the epoch; None for now
        """
        start = time.time() if start is None else start
        limit = float(getattr(reconstructor, "time_limit", 0.0))
        if not limit:
            return cls(0.0, start, 0.0)
        pixels = sum(c.image_size[0] * c.image_size[1] for c in measurement.cameras)
        reserve = REPORT + PER_PIXEL * pixels
        if isinstance(reconstructor, VoxelReconstructor) and resolve_device(reconstructor.device).type == "cpu":
            finest = Grid.of_resolution(measurement.box, reconstructor.voxels)
            pace = reconstructor.iteration_seconds(measurement, finest, torch.get_num_threads())
            return cls(limit, start, reserve, reconstructor.iterations, pace, ITERATIONS)
        if not isinstance(reconstructor, TrainingSettings):
            return cls(limit, start, reserve)
        network, device = _network(reconstructor, measurement), resolve_device(reconstructor.device)
        each = _evaluation_seconds(network, device)
        reserve += each * evaluations(network, measurement.cameras, measurement.box, voxels, device)
        validation = each * math.prod(Grid.of_resolution(measurement.box, VALIDATION_VOXELS).shape)
        steps = min(reconstructor.first_cycle, reconstructor.max_steps or reconstructor.first_cycle)
        return cls(limit, start, reserve, steps, STEP * each * reconstructor.points_per_batch, TRAINING, validation)

    def with_reserve(self, seconds: float) -> Budget:
        """Return the budget with more time in reserve."""
        return dataclasses.replace(self, reserve=self.reserve + seconds) if self.limit else self

    @property
    def left(self) -> float:
        """Time until the limit, less the reserve; inf without a limit, s."""
        return self.start + self.limit - self.reserve - time.time() if self.limit else math.inf

    @property
    def over(self) -> bool:
        """Whether the limit has passed."""
        return bool(self.limit) and time.time() > self.start + self.limit

    def limited(self, reconstructor: R, share: float = 1.0) -> R:
        """Return settings with a share of the time that is left for fits; unchanged without a limit."""
        if not self.limit:
            return reconstructor
        return dataclasses.replace(reconstructor, time_limit=share * self._for_fits)  # type: ignore[type-var]

    @property
    def _for_fits(self) -> float:
        return max(self.left, LEAST * self.limit)

    def shortage(self, trials: int, validated: bool) -> str:
        """Return that the limit leaves too little time for the fit, and what it would take; empty if it does not.

        Parameters
        ----------
        trials : of the bootstrap
        validated : whether a cross-validation comes first
        """
        if not self.limit:
            return ""
        budget, fits = self.with_reserve(self.validation * validated), 1 + trials + SHORT_RUN * validated
        seconds, rest, required = budget._for_fits / fits, self.limit - budget.left, self.steps * self.pace
        if budget.left >= LITTLE * self.limit and seconds >= FEW * required:
            return ""
        text = f"--time-limit {self.limit:g} is too short: reading, prediction and report take about "
        text += f"{duration(rest)}, which leaves {duration(seconds)} for the fit"
        if self.pace:
            name, basis = self.words
            text += f", about {seconds / self.pace:.0f} {name}; {self.steps} take {duration(required)}, by {basis}"
        enough = rest + max(fits * required, rest)  # at least half of it for the fits
        return f"{text}. Give --time-limit {math.ceil(enough / 10) * 10} or more"


def _network(settings: TrainingSettings, measurement: Measurement) -> Network:
    """Return a network as the one that is trained."""
    with torch.random.fork_rng(devices=[]):
        shape = settings.resolved_by(measurement).network
        return network_in(measurement.box, shape, bodies=measurement.bodies)


def _evaluation_seconds(network: Network, device: torch.device) -> float:
    """Return the time to evaluate a network at a point, by a few points on this machine, s."""
    network = network.to(device)
    points = torch.zeros(PROBE, 3, device=device)
    times = []
    for _ in range(4):  # the first is slower
        start = time.perf_counter()
        with torch.no_grad():
            float(network(points).sum())  # waits for a GPU
        times.append(time.perf_counter() - start)
    return min(times) / PROBE
