"""The time limit of a reconstruction into a directory: it counts everything, from the start to the report."""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass
from typing import TypeVar

import torch

from nerif.analysis.prediction import evaluations
from nerif.data.measurement import Measurement
from nerif.fields.network_kinds import network_in
from nerif.geometry import Grid
from nerif.reconstruction.base import Reconstructor
from nerif.reconstruction.device import resolve_device
from nerif.reconstruction.neural.settings import TrainingSettings

__all__ = ["NO_LIMIT", "Budget"]

REPORT, PER_PIXEL = 2.5, 4e-6  # s: files, verdict and report; scores and images of the views
LEAST = 0.1  # of the limit, for the fits
PROBE = 16384  # points

R = TypeVar("R", bound=Reconstructor)


@dataclass(frozen=True)
class Budget:
    """A time limit, shared among the fits of a job.

    Parameters
    ----------
    limit : s; 0: none
    start : time from which it counts, s since the epoch
    reserve : s, for what follows the fits
    """

    limit: float
    start: float
    reserve: float

    @classmethod
    def of(cls, reconstructor: Reconstructor, measurement: Measurement, voxels: int, start: float | None) -> Budget:
        """Return the budget of a job; the time to sample its field is measured on this machine.

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
        return cls(limit, start, REPORT + PER_PIXEL * pixels + _sampling(reconstructor, measurement, voxels))

    def holding(self, seconds: float) -> Budget:
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

    def allot(self, reconstructor: R, share: float = 1.0) -> R:
        """Return settings with a share of the time that is left for fits; unchanged without a limit."""
        if not self.limit:
            return reconstructor
        seconds = share * max(self.left, LEAST * self.limit)
        return dataclasses.replace(reconstructor, time_limit=seconds)  # type: ignore[type-var]


NO_LIMIT = Budget(0.0, 0.0, 0.0)


def _sampling(reconstructor: Reconstructor, measurement: Measurement, voxels: int) -> float:
    """Time to sample a network for the volumes and the views, s: from that of a few points on this machine."""
    if not isinstance(reconstructor, TrainingSettings):
        return 0.0
    device = resolve_device(reconstructor.device)
    with torch.random.fork_rng(devices=[]):
        shape = reconstructor.resolved_by(measurement).network
        network = network_in(measurement.box, shape, bodies=measurement.bodies).to(device)
    points = torch.zeros(PROBE, 3, device=device)
    times = []
    for _ in range(4):  # the first is slower
        start = time.perf_counter()
        with torch.no_grad():
            float(network(points).sum())  # waits for a GPU
        times.append(time.perf_counter() - start)
    count = math.prod(Grid.of_resolution(measurement.box, voxels).shape)
    return min(times) / PROBE * (count + evaluations(network, measurement.cameras, measurement.box, device))
