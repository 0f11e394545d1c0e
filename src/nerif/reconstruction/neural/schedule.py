"""The schedule of a training: its limits, cycles until convergence, learning rates and bins of pixels.

Cycles. A run without a limit consists of cycles, each twice as long as the one before. Each ends at the smallest
learning rate, so that the ends can be compared. With e the mean square of the residual over sigma on withheld pixels,
of which the noise is 1, the run has converged when the last PATIENCE cycles have reduced e by no more than

    min e before them - min e of them <= max(FALL (e - 1), SCATTER e)

One cycle is not enough: few pixels are withheld, so e scatters from cycle to cycle.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, ClassVar

import torch

from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.training_settings import TrainingSettings
from nerif.reconstruction.reconstructor import Outcome, Reconstructor, Step

__all__ = ["Cycles", "Pace", "Schedule", "duration"]


class Resumable:
    """An object whose STATE attributes are stored in checkpoints."""

    STATE: ClassVar[tuple[str, ...]]

    def state_dict(self) -> dict[str, Any]:
        """Return the attributes that a checkpoint stores."""
        return {name: getattr(self, name) for name in self.STATE}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from the state of a checkpoint."""
        for name, value in state.items():
            setattr(self, name, value)


PATIENCE = 2  # cycles
FALL = 0.08  # of the excess over the noise: a doubling that gains less leaves 5 % of its root to the next two
SCATTER = 0.003  # of e: smaller changes are random
MAX_CYCLES = 6
PACE_FROM = 0.1  # share of the run after which its pace is known, for the choice of bins


class Cycles(Resumable):
    """The cycles of a run without a limit; `first` steps in the first."""

    STATE = ("length", "step", "errors", "verdict")

    def __init__(self, first: int) -> None:
        self.first, self.length = first, first
        self.step = 0  # at which the present cycle began
        self.errors: list[float] = []
        self.verdict = ""  # why the run has converged

    @property
    def least_steps(self) -> int:
        """Steps of a run that converges as soon as possible."""
        return self.first * (2 ** (PATIENCE + 1) - 1)

    @property
    def most_steps(self) -> int:
        """Steps of all cycles."""
        return self.first * (2**MAX_CYCLES - 1)

    def progress(self, step: int) -> float:
        """Return the share of the present cycle: 0 at its start, 1 at its end."""
        return (step - self.step) / self.length

    def end(self, error: float, noise: float, step: int, label: str = "residual of withheld pixels") -> Outcome | None:
        """End a cycle at a step of the run: begin the next, or return why there is none.

        `error` is the mean square of the residual over sigma, `noise` its part due to noise; 0 if sigma is unknown.
        """
        self.errors.append(error)
        before, least = min(self.errors[:-PATIENCE], default=math.inf), min(self.errors[-PATIENCE:])
        length = self.length
        self.step, self.length = step, 2 * length
        level = f"{label} {math.sqrt(min(self.errors)):.3g}{' sigma' if noise else ''}"
        if before - least <= max(FALL * (least - noise), SCATTER * least):
            self.verdict = f"{level}, not reduced by the last {length + length // 2} steps"
        elif len(self.errors) == MAX_CYCLES:
            self.verdict = f"{level} after {MAX_CYCLES} cycles, the maximum"
        return self.outcome

    @property
    def outcome(self) -> Outcome | None:
        """Outcome of a run that has converged."""
        return Outcome("converged", self.verdict) if self.verdict else None

    @property
    def best(self) -> bool:
        """Whether the last cycle has the smallest error so far."""
        return self.errors[-1] <= min(self.errors)


class Schedule:
    """Steps, rays, seconds and learning rate of a run, earlier parts of a resumed run included.

    Parameters
    ----------
    settings : epochs, max_steps and time_limit are the limits; without one the run consists of Cycles
    rays : per epoch
    ranks : all processes follow the clock of the first

    Attributes
    ----------
    outcome : why the run is over; None before
    rate_factor : of the learning rate, below 1 after a fit to a start and after rolling back
    ray_count : rays of all batches, in bins of any size
    final_bins : whether the bins of pixels are the smallest of which the run can use all
    """

    outcome: Outcome | None = None
    final_bins = False

    def __init__(self, settings: TrainingSettings, rays: int, ranks: Ranks, device: torch.device) -> None:
        self.settings, self.rays, self.ranks, self.device = settings, rays, ranks, device
        self.step, self.rays_done, self.ray_count, self.rate_factor = 0, 0, 0, 1.0
        self.cycles = None if settings.limited else Cycles(settings.first_cycle)
        self._before, self._start, self._synchronised = 0.0, time.perf_counter(), 0.0
        self.restart_pace()

    def synchronise(self) -> None:
        """Take over the clock of the first process."""
        if self.ranks.size > 1:
            (self._synchronised,) = self.ranks.broadcast([self._clock()], self.device)

    @property
    def seconds(self) -> float:
        """Time spent on training, s."""
        return self._clock() if self.ranks.size == 1 else self._synchronised

    def _clock(self) -> float:
        return self._before + time.perf_counter() - self._start

    @property
    def done(self) -> bool:
        """Whether the run is over."""
        return self.outcome is not None

    @property
    def rates(self) -> dict[str, float]:
        """Learning rates of the next step, by optimiser."""
        settings, rate = self.settings, self.rate_factor * self.settings.learning_rate
        if settings.schedule == "cosine":
            warm_up = min(settings.warm_up, settings.max_steps / 6 or math.inf)
            rate *= min(1.0, (self.step + 1) / warm_up)
            rate *= 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(self.progress, 1.0)))
        return {"adam": rate, "muon": rate * settings.matrix_rate}

    def advance(self) -> None:
        """Count a step."""
        self.step += 1

    @property
    def epoch(self) -> float:
        """Passes over all rays."""
        return self.rays_done / self.rays

    @property
    def progress(self) -> float:
        """0 at the start, 1 at the first limit or at the end of a cycle."""
        if self.cycles is not None:
            return self.cycles.progress(self.step)
        shares = [self.epoch / self.settings.epochs] if self.settings.epochs else []
        return max(shares + self._shares())

    def _shares(self) -> list[float]:
        """Used shares of the limits of steps and time."""
        settings = self.settings
        shares = [self.step / settings.max_steps] if settings.max_steps else []
        return shares + ([self.seconds / settings.time_limit] if settings.time_limit else [])

    @property
    def to_possible_end(self) -> float:
        """Share of the run for a progress bar: 1 at its limit or, without one, at the next step at which it may end."""
        cycles = self.cycles
        if cycles is None:
            return self.progress
        return self.step / max(cycles.least_steps, cycles.step + cycles.length)

    def count(self, rays: int) -> None:
        """Count the rays of a step."""
        self.rays_done += rays
        self.ray_count += rays
        self._pace_rays += rays

    def restart_pace(self) -> None:
        """Measure the pace from now on, as the rays or the work per ray have changed."""
        self._pace_rays, self._pace_start = 0, time.perf_counter()

    @property
    def rays_per_second(self) -> float:
        """Pace since `restart_pace`, 1/s."""
        return self._pace_rays / max(time.perf_counter() - self._pace_start, 1e-9)

    @property
    def remaining(self) -> float:
        """Rays for which there is still time; inf without a limit of steps or time."""
        latest = [] if self.cycles is None else [self.step / self.cycles.most_steps]
        share = max(self._shares() + latest, default=0.0)
        return self.ray_count * (1 - share) / share if share else math.inf

    def smaller_bins(self, edge: int) -> int:
        """Return the edge (px) of the smallest bins of which the rest of the run can use all, at most the present one.

        It is chosen once, when the pace is known.
        """
        if self.final_bins or self.progress < PACE_FROM:
            return edge
        self.final_bins, rays, remaining = True, self.rays, self.remaining
        while edge > 1 and 4 * rays <= remaining:
            edge, rays = edge // 2, 4 * rays
        return edge

    def limit(self) -> Outcome | None:
        """Return the limit that is reached, if any."""
        settings = self.settings
        if settings.epochs and self.epoch >= settings.epochs:
            return Outcome("epochs", f"all {settings.epochs:g} epochs done")
        if settings.max_steps and self.step >= settings.max_steps:
            return Outcome("steps", f"all {settings.max_steps} steps done; a larger --max-steps may reduce the error")
        if settings.time_limit and self.seconds >= settings.time_limit:
            message = f"stopped at the time limit, after {self.seconds:.0f} s of training"
            return Outcome("time_limit", f"{message}; a longer run may reduce the error")
        return None if self.cycles is None else self.cycles.outcome

    def set_rays(self, rays: int) -> None:
        """Change the number of rays per epoch; the epoch stays."""
        self.rays_done, self.rays = round(self.epoch * rays), rays
        self.restart_pace()

    def record(self) -> dict[str, float]:
        """Return step, epoch and seconds for the history."""
        return {"step": float(self.step), "epoch": self.epoch, "seconds": self.seconds}

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint stores."""
        state = {name: getattr(self, name) for name in ("step", "rays_done", "ray_count", "rate_factor", "seconds")}
        return state if self.cycles is None else {**state, "cycles": self.cycles.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from the state of a checkpoint; a run that had a limit begins a cycle there."""
        self.step, self.rays_done, self.ray_count = (int(state[name]) for name in ("step", "rays_done", "ray_count"))
        self.rate_factor = float(state["rate_factor"])
        self._before, self._start = float(state["seconds"]), time.perf_counter()
        self.restart_pace()
        if self.cycles is not None:
            self.cycles.load_state_dict(state.get("cycles", {"step": self.step}))


MIN_RUN = 100  # steps without which no field is found
PACE_STEPS, PACE_SHARE = 5, 0.05  # steps, or share of the time limit, after which the pace is known


class Pace:
    """Callback that states once how long a run will take, or that its time limit allows too few steps.

    The first step does not count, since it may compile the network. Methods without a network have no pace.

    Parameters
    ----------
    settings : with the time limit of the main training
    say : called with the line
    warning : that there is too little time, if that has been said before
    """

    def __init__(self, settings: Reconstructor, say: Callable[[str], None], warning: str = "") -> None:
        self.settings, self.say, self.warning = settings, say, warning
        self._first: Step | None = None
        self._done = bool(warning) or not isinstance(settings, TrainingSettings)

    def __call__(self, step: Step) -> None:
        settings, first = self.settings, self._first
        if self._done or step.step == 0:  # step 0: the network is being fitted to a start
            return
        assert isinstance(settings, TrainingSettings)
        if first is None or step.step <= first.step:  # another run has begun
            self._first = step
            return
        steps, seconds = step.step - first.step, step.seconds - first.seconds
        limit = settings.time_limit or math.inf
        if steps < PACE_STEPS and seconds < PACE_SHARE * limit:
            return
        self._done = True
        pace, planned = max(seconds / steps, 1e-9), settings.steps(step.pass_steps)
        possible = first.step + (limit - first.seconds) / pace
        if possible < min(MIN_RUN, planned):
            self.warning = _too_slow(pace, limit, possible, planned)
            self.say(self.warning)
        elif not settings.time_limit:
            self.say(_forecast(settings, pace, planned))


def _too_slow(pace: float, limit: float, possible: float, planned: float) -> str:
    count, plan = (planned, "planned steps") if math.isfinite(planned) else (MIN_RUN, "steps")
    return (
        f"slow: {duration(pace)} per step, so the {duration(limit)} of training allow about {possible:.0f} "
        f"steps; {count:.0f} {plan} would take {duration(count * pace)}. Give a longer --time-limit, or fewer "
        "--points-per-batch and a smaller --network.width (--preset fast suits a CPU)"
    )


def _forecast(settings: TrainingSettings, pace: float, planned: float) -> str:
    if math.isfinite(planned):
        return f"{planned:.0f} steps of training take about {duration(planned * pace)} here"
    cycles = Cycles(settings.first_cycle)
    least, most = cycles.least_steps, cycles.most_steps
    times = f"about {duration(least * pace)} to {duration(most * pace)}"
    return f"training converges after {least} to {most} steps, {times} here; Ctrl-C ends it earlier and keeps the field"


def duration(seconds: float) -> str:
    """Return a duration with its unit, to two figures."""
    for unit, name in ((86400, "days"), (3600, "h"), (60, "min")):
        if seconds >= 2 * unit:
            return f"{seconds / unit:.0f} {name}" if seconds >= 10 * unit else f"{seconds / unit:.1f} {name}"
    return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.2g} s"
