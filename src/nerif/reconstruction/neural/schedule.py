"""How much a run has used of what it may: steps, passes over the rays, seconds."""

from __future__ import annotations

import math
import time
from typing import Any

import torch

from nerif.reconstruction.base import Outcome
from nerif.reconstruction.neural.convergence import Cycles
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.settings import TrainingSettings

__all__ = ["Budget"]


class Budget:
    """The steps, rays and seconds of a run, earlier parts of a resumed run included.

    Parameters
    ----------
    settings : epochs, max_steps and time_limit are the limits; where there is none the run goes in Cycles
    rays : of one pass over all of them
    ranks : processes that go by the clock of the first
    device : where the ranks talk to each other
    """

    def __init__(self, settings: TrainingSettings, rays: int, ranks: Ranks, device: torch.device) -> None:
        self.settings, self.rays, self.ranks, self.device = settings, rays, ranks, device
        self.step, self.rays_done = 0, 0
        self.cycles = None if settings.limited else Cycles(settings.first_cycle, settings.longest)
        self._before, self._began, self._agreed = 0.0, time.perf_counter(), 0.0
        self.begin_pace()

    def agree(self) -> None:
        """Let all processes go by the clock of the first."""
        if self.ranks.size > 1:
            (self._agreed,) = self.ranks.decided([self._clock()], self.device)

    @property
    def seconds(self) -> float:
        """Spent on training."""
        return self._clock() if self.ranks.size == 1 else self._agreed

    def _clock(self) -> float:
        return self._before + time.perf_counter() - self._began

    @property
    def epoch(self) -> float:
        """Passes over all rays."""
        return self.rays_done / self.rays

    @property
    def progress(self) -> float:
        """0 at the start, 1 when the first of the limits is reached, or the end of a cycle."""
        settings = self.settings
        if self.cycles is not None:
            return self.cycles.progress(self.step, self.seconds)
        shares = [self.epoch / settings.epochs] if settings.epochs else []
        if settings.max_steps:
            shares.append(self.step / settings.max_steps)
        if settings.time_limit:
            shares.append(self.seconds / settings.time_limit)
        return max(shares)

    @property
    def share(self) -> float:
        """What of the run is done at least: 0 at the start, 1 at the latest end."""
        return self.progress if self.cycles is None else self.seconds / self.cycles.longest

    def count(self, rays: int) -> None:
        """Count rays of a step."""
        self.rays_done += rays
        self._paced += rays

    def begin_pace(self) -> None:
        """Take the pace from now on: other rays, or other work on them, have another one."""
        self._paced, self._paced_from = 0, time.perf_counter()

    @property
    def rays_per_second(self) -> float:
        """The pace since the data last changed or the run was taken back, 1/s."""
        return self._paced / max(time.perf_counter() - self._paced_from, 1e-9)

    def left(self, rays: int) -> float:
        """Return how many rays the run has time or steps for yet, at the pace so far; inf where neither is limited.

        Parameters
        ----------
        rays : done at that pace since the beginning
        """
        settings = self.settings
        shares = [self.step / settings.max_steps] if settings.max_steps else []
        shares += [self.seconds / settings.time_limit] if settings.time_limit else []
        shares += [] if self.cycles is None else [self.share]
        share = max(shares, default=0.0)
        return rays * (1 - share) / share if share else math.inf

    def exhausted(self) -> Outcome | None:
        """Return which limit is reached, if one is."""
        settings = self.settings
        if settings.epochs and self.epoch >= settings.epochs:
            return Outcome("epochs", f"all {settings.epochs:g} epochs done")
        if settings.max_steps and self.step >= settings.max_steps:
            return Outcome("steps", f"all {settings.max_steps} steps done; a larger --max-steps may give more")
        if self.seconds >= settings.latest:
            return Outcome("time_limit", f"time limit of {settings.latest:g} s reached; more time may give more")
        return None if self.cycles is None else self.cycles.outcome

    def recount(self, rays: int) -> None:
        """Count passes over another number of rays from now on."""
        self.rays_done, self.rays = round(self.epoch * rays), rays
        self.begin_pace()

    def where(self) -> dict[str, float]:
        """Return step, epoch and seconds, as the history has them."""
        return {"step": float(self.step), "epoch": self.epoch, "seconds": self.seconds}

    def used(self) -> dict[str, Any]:
        """Return what a checkpoint keeps."""
        used = {"step": self.step, "rays_done": self.rays_done, "seconds": self.seconds}
        return used if self.cycles is None else {**used, "cycles": self.cycles.kept()}

    def restore(self, used: dict[str, Any]) -> None:
        """Go on from what a checkpoint kept."""
        self.step, self.rays_done = int(used["step"]), int(used["rays_done"])
        self._before, self._began = float(used["seconds"]), time.perf_counter()
        self.begin_pace()
        if self.cycles is not None:  # a run that had a limit begins a cycle where it is
            self.cycles.restore(used.get("cycles", {"step": self.step, "seconds": self._before}))
