"""What hangs on the training loop: everything that is done before the first step and after each.

A callback that ends the run sets `trainer.schedule.outcome`; those that prepare the next step then do nothing.

Collapse. A network that takes too large a step ends at the ambient field, whose gradient is zero. There

    q = |prediction - d|^2 / |d|^2        over the last steps, each over sigma^2

stays at 1. The run then rolls back to its last good state, with a third of the learning rate.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from nerif.common.pauses import pause
from nerif.fields.field import Field
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Rays
from nerif.reconstruction.neural.losses import DATA_TERMS
from nerif.reconstruction.neural.sampling import sample_rays
from nerif.reconstruction.neural.schedule import Resumable
from nerif.reconstruction.neural.warm_start import copy_weights, fit_network
from nerif.reconstruction.reconstructor import OnStep, Outcome, State, Step
from nerif.reconstruction.rig_refinement import MOMENTUM
from nerif.reconstruction.target import Part

if TYPE_CHECKING:
    from nerif.reconstruction.neural.trainer import Trainer

__all__ = [
    "Bins", "Callback", "Convergence", "DivergenceGuard", "FitMonitor", "GoodState", "History", "Progress", "Readings",
    "RigRefinement", "Stages", "Synchronise", "WarmStart",
]  # fmt: skip

INCOMPARABLE = "; loss values before and after cannot be compared"
MAX_ROLLBACKS = 5
PACE_FROM = 0.1  # share of the run after which its pace is known
LOG_EVERY, SAVE_EVERY = 20, 200  # steps
FIT_PACE_STEP = 10  # of a fit to the initial field, after which its pace is known
LOG_SECONDS = 5.0  # after which a record is due as well, so that slow steps have a history
NUISANCE_SAMPLES = 24  # per ray
RIG_SAMPLES, RIG_LENS_RAYS, RIG_BATCH = 16, 4, 512  # samples of a thin ray, rays through a lens, pixels
RIG_FROM, RIG_EVERY, RIG_UNTIL, RIG_SLOW_FROM = 0.1, 0.04, 0.94, 0.75  # shares of the run
SIGN_UNTIL, EARLY, EARLY_FACTOR = 0.5, 0.26, 1.7  # a pose error must show by then; early ones by this factor clearer


class Callback:
    """A callback of the training loop; each method does nothing unless overridden."""

    def on_start(self, trainer: Trainer) -> None:
        """Prepare the first step."""

    def after_step(self, trainer: Trainer, loss: Tensor, terms: dict[str, Tensor]) -> None:
        """Act after a step, with its loss and the terms before they were weighted."""

    def on_data(self, trainer: Trainer, new_stage: bool) -> None:
        """Adapt to other bins of pixels, or to the data of a new stage."""

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint stores: tensors, numbers, texts and lists of them."""
        return {}

    def load_state_dict(self, trainer: Trainer, state: dict[str, Any]) -> None:
        """Continue from the state of a checkpoint."""


class Convergence(Callback):
    """End the run at a limit, at `stop_ratio`, or when its cycles no longer reduce the residual of withheld pixels."""

    def __init__(self, trainer: Trainer) -> None:
        self.mean_loss = math.nan  # running mean
        self.best_weights: dict[str, Tensor] = {}  # at the end of the best cycle
        self.best_data: dict[str, Tensor] = {}  # nuisance parameters and rig there
        self.on_data(trainer, True)

    def on_start(self, trainer: Trainer) -> None:
        trainer.schedule.synchronise()
        trainer.schedule.outcome = trainer.schedule.limit()

    def after_step(self, trainer: Trainer, loss: Tensor, terms: dict[str, Tensor]) -> None:
        trainer.schedule.outcome = self._end_cycle(trainer) or self.outcome(trainer)

    def on_data(self, trainer: Trainer, new_stage: bool) -> None:
        self.ratio = trainer.settings.stop_ratio
        self.ambient_loss = _root(trainer, trainer.objective.ambient_loss()) if self.ratio else math.nan

    def update(self, trainer: Trainer, loss: float) -> None:
        """Add the loss of a step to the running mean."""
        loss = _root(trainer, loss)
        if math.isnan(self.mean_loss):
            self.mean_loss = loss
        self.mean_loss += 0.1 * (loss - self.mean_loss)

    def outcome(self, trainer: Trainer) -> Outcome | None:
        """Return the limit that is reached, if any."""
        outcome = trainer.schedule.limit()
        if outcome is None and self.ratio and self.mean_loss <= self.ratio * self.ambient_loss:
            return Outcome("converged", f"the loss fell to {self.ratio:g} of that of the ambient field")
        return outcome

    def _end_cycle(self, trainer: Trainer) -> Outcome | None:
        """Test for convergence on withheld pixels at the end of a cycle, and save the weights of the best one."""
        schedule, cycles, withheld = trainer.schedule, trainer.schedule.cycles, trainer.data.withheld
        if cycles is None or schedule.progress < 1:
            return None
        error = self._error(trainer)
        noise = float(withheld is not None and withheld.sigma_known)
        label = "residual" if withheld is None else "residual of withheld pixels"
        outcome = cycles.end(error, noise, schedule.step, label)
        trainer.history.log(trainer, {"withheld_residual": math.sqrt(error)})
        if cycles.best:
            self.best_weights, self.best_data = trainer.weights(), trainer.data.state_dict()
        fit_nuisance(trainer)
        trainer.bins.final = trainer.bins.edge == 1  # the pace is better known now
        return outcome

    def _error(self, trainer: Trainer) -> float:
        """Mean square of the residual of withheld pixels; without any, of the running mean of the loss."""
        if trainer.data.withheld is None:
            error = self.mean_loss**2
        else:
            error = trainer.objective.withheld_residual(trainer.sampler.density)
        return trainer.ranks.broadcast([error], trainer.device)[0]

    def take_best(self, trainer: Trainer) -> None:
        """Return to the weights of the best cycle where the present ones are worse."""
        cycles = trainer.schedule.cycles
        if cycles is None or not self.best_weights or self._error(trainer) <= min(cycles.errors):  # not if it is NaN
            return
        trainer.field.network.load_state_dict(self.best_weights)
        if self.best_data:
            trainer.data.load_state_dict(trainer.data.stage, self.best_data)

    def state_dict(self) -> dict[str, Any]:
        groups = {"weights": self.best_weights, "data": self.best_data}
        tensors = {f"{group}.{name}": value for group, values in groups.items() for name, value in values.items()}
        return {**tensors, "mean_loss": self.mean_loss}

    def load_state_dict(self, trainer: Trainer, state: dict[str, Any]) -> None:
        self.mean_loss = state["mean_loss"]
        self.best_weights, self.best_data = (
            {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
            for prefix in ("weights.", "data.")
        )


class Readings(Callback):
    """Read the loss and its terms, averaged over all processes; on a GPU only where a record is due, as it waits."""

    def __init__(self) -> None:
        self.due = False
        self.values: dict[str, float] | None = None  # None: not read, or rolled back
        self.ambient = 0.0  # what the data terms would be in the ambient field

    def after_step(self, trainer: Trainer, loss: Tensor, terms: dict[str, Tensor]) -> None:
        self.values, self.due = None, trainer.schedule.done or trainer.history.due(trainer)
        if trainer.device.type == "cuda" and not self.due:
            return
        ambient, batch = trainer.objective.ambient_term(trainer.batch), trainer.batch
        own_means = torch.stack([term.detach().float() for term in (*terms.values(), loss, ambient)])
        *means, self.ambient = trainer.ranks.average(own_means, batch.own_numbers, batch.numbers).tolist()
        self.values = dict(zip((*terms, "loss"), means, strict=True))


EMPTY = 0.9  # unexplained share of the signal from which no field counts as found
HALF, LOSS = 0.5, 0.1
HIGH_RESIDUAL = 1.5  # sigma
EMPTY_STEPS, MIN_STEPS = 200, 50  # steps in which the loss must have fallen; steps before any verdict
EMPTY_RATE = 1.5e-2  # learning rate of EMPTY_STEPS: at a smaller one the weights need more steps to move as far
MEMORY = 0.95  # of the running mean, per step


class FitMonitor(Resumable):
    """Unexplained share of the signal, q without the noise.

    Parameters
    ----------
    noise : q of the noise alone; 0 if unknown
    rate : learning rate of the run
    """

    STATE = ("residual", "empty", "lowest", "step", "since")

    def __init__(self, noise: float, rate: float = EMPTY_RATE) -> None:
        self.noise, self.patience = noise, round(EMPTY_STEPS * max(1.0, EMPTY_RATE / rate))
        self.residual, self.empty = 0.0, 0.0  # running mean squares, of the field and of the ambient field
        self.lowest, self.step, self.since = 1.0, 0, 0

    def update(self, residual: float, empty: float, step: int) -> None:
        """Add the mean squares of a step; a step without signal (empty = 0) does not count."""
        steps = max(1, step - self.step)
        self.step = step
        if empty > 0:
            memory = MEMORY**steps
            self.residual = memory * self.residual + (1 - memory) * residual
            self.empty = memory * self.empty + (1 - memory) * empty
            self.since += steps
            if self.since >= MIN_STEPS:
                self.lowest = min(self.lowest, self.unexplained)

    @property
    def unexplained(self) -> float:
        """Share of the squared signal that is neither explained nor noise; 0 without a signal."""
        if not self.empty or self.noise >= EMPTY:
            return 0.0
        return max(0.0, (self.residual / self.empty - self.noise) / (1 - self.noise))

    @property
    def healthy(self) -> bool:
        """Whether the fit is nearly as good as it has been."""
        return self.since < MIN_STEPS or self.unexplained < self.lowest + LOSS

    @property
    def has_fitted(self) -> bool:
        """Whether the field has ever explained most of the signal."""
        return self.lowest < HALF / 2

    def collapsed(self, final: bool) -> bool:
        """Return whether the field has stayed or become ambient; at the end (`final`) fewer steps are enough."""
        if self.has_fitted:
            return self.since >= MIN_STEPS and self.unexplained > HALF
        return self.since >= (MIN_STEPS if final else self.patience) and self.unexplained > EMPTY

    def remark(self, converged: bool) -> str:
        """Return a remark on a poor fit at the end of a run, or nothing."""
        if self.since < MIN_STEPS:
            return ""
        if self.unexplained > HALF:
            return f"; {self.unexplained:.0%} of the squared signal without noise is not explained yet"
        if self.sigmas > HIGH_RESIDUAL:
            remedy = "a larger --network.width" if converged else "a longer run"
            return (
                f"; the residual is {self.sigmas:.1f} sigma: {remedy} lowers it, more views the error, "
                "unless cameras or sigma are wrong (nerif check)"
            )
        return ""

    @property
    def sigmas(self) -> float:
        """Residual, rms over sigma; 0 if sigma is unknown."""
        return math.sqrt(self.residual / self.empty / self.noise) if self.noise and self.empty else 0.0


class DivergenceGuard(Callback):
    """Roll back if loss or weights turn non-finite or the field collapses to the ambient one."""

    def __init__(self, trainer: Trainer) -> None:
        self.rollbacks = 0
        self.on_data(trainer, True)

    def on_data(self, trainer: Trainer, new_stage: bool) -> None:
        if new_stage:
            self.monitor = FitMonitor(trainer.data.noise, trainer.settings.learning_rate)
            self.monitor.step = trainer.schedule.step
        self.monitor.noise = trainer.data.noise

    def after_step(self, trainer: Trainer, loss: Tensor, terms: dict[str, Tensor]) -> None:
        readings, schedule = trainer.readings, trainer.schedule
        values = readings.values
        if values is None:
            return
        if not math.isfinite(values["loss"]) or (schedule.done and not finite(trainer)):
            self._roll_back(trainer, "the loss turned non-finite")
            return
        weights = {name: getattr(trainer.settings.weights, name) for name in DATA_TERMS if name in values}
        residual = sum(weight * values[name] for name, weight in weights.items()) / sum(weights.values())
        power = 1 if trainer.settings.norm == "squared" else 2
        self.monitor.update(residual**power, readings.ambient**power, schedule.step)
        trainer.convergence.update(trainer, values["loss"])
        if self.monitor.collapsed(schedule.done):
            self._roll_back(trainer, "the field collapsed")
            schedule.outcome = schedule.outcome or schedule.limit()

    def _roll_back(self, trainer: Trainer, cause: str) -> None:
        """Return to the last good state, or to the first if no field has been found, with a third of the rate."""
        schedule, states, monitor = trainer.schedule, trainer.states, self.monitor
        rollbacks, rate_factor, seconds = self.rollbacks + 1, schedule.rate_factor / 3, schedule.seconds
        unexplained, empty = monitor.unexplained, monitor.collapsed(final=True) and not monitor.has_fitted
        trainer.load_state_dict(states.first if empty else states.good)
        schedule.load_state_dict({**schedule.state_dict(), "seconds": seconds, "rate_factor": rate_factor})
        self.rollbacks, trainer.readings.values, schedule.outcome = rollbacks, None, None
        trainer.history.log(trainer, {"rolled_back": float(rollbacks)})
        if empty and (rollbacks > MAX_ROLLBACKS or schedule.limit()):
            schedule.outcome = Outcome(
                "collapsed",
                f"no field was found: after {rollbacks} attempt(s) {min(unexplained, 9.99):.0%} of the squared signal "
                "without noise is not explained; try a smaller --learning-rate, and nerif check on the measurement",
            )
        elif rollbacks > MAX_ROLLBACKS:
            schedule.outcome = Outcome(
                "diverged",
                f"{cause} {rollbacks} times; returned the last good state, of step {schedule.step}; "
                "try a smaller --learning-rate or --precision float32",
            )

    def remark(self, converged: bool) -> str:
        """Return a remark at the end of a run, or nothing."""
        again = f"; rolled back {self.rollbacks} time(s) to the last good state" if self.rollbacks else ""
        return again + self.monitor.remark(converged)

    def state_dict(self) -> dict[str, Any]:
        return {"rollbacks": self.rollbacks, "monitor": self.monitor.state_dict()}

    def load_state_dict(self, trainer: Trainer, state: dict[str, Any]) -> None:
        self.rollbacks = state["rollbacks"]
        self.monitor.load_state_dict(state["monitor"])


class GoodState(Callback):
    """Save the states to roll back to: the first one, and the last one with a good fit."""

    first: State
    good: State

    def on_start(self, trainer: Trainer) -> None:
        self.first = self.good = trainer.state_dict()

    def after_step(self, trainer: Trainer, loss: Tensor, terms: dict[str, Tensor]) -> None:
        due = trainer.readings.values is not None and trainer.schedule.step % SAVE_EVERY == 0
        if due and trainer.guard.monitor.healthy and finite(trainer):
            self.good = trainer.state_dict()


class WarmStart(Callback):
    """Copy the field that the run starts from, or fit the network to it; then the learning rate is smaller."""

    def __init__(self, start: Field | None) -> None:
        self.start = start

    def on_start(self, trainer: Trainer) -> None:
        schedule, settings = trainer.schedule, trainer.settings
        if self.start is not None and not schedule.done:
            trainer.network.low = True
            if not copy_weights(self.start, trainer.field):
                fit_network(
                    trainer.field, trainer.network, self.start, settings.fit_steps, settings.points_per_batch,
                    settings.learning_rate, trainer.generator, lambda step, loss: self._report(trainer, step, loss),
                )  # fmt: skip
            trainer.sampler.density.update(trainer.network)
            schedule.rate_factor = settings.rate_after_fit
            trainer.states.good = trainer.state_dict()
        schedule.restart_pace()

    @staticmethod
    def _report(trainer: Trainer, step: int, loss: float) -> bool:
        """Report a step of the fit; return whether to stop."""
        schedule, values = trainer.schedule, {"fit_step": float(step), "fit_loss": loss}
        if step == FIT_PACE_STEP:
            seconds = schedule.seconds / step * trainer.settings.fit_steps
            trainer.progress.notes.append(f"first the network is fitted to the initial field: about {seconds:.0f} s")
        if trainer.history.due(trainer, step):
            trainer.history.log(trainer, values)
        synchronise(trainer)
        schedule.outcome = trainer.convergence.outcome(trainer)
        if trainer.progress.report(trainer, values, 0.0) and not schedule.done:
            message = "stopped during the fit to the start; --resume continues the run"
            schedule.outcome = Outcome("interrupted", message)
        return schedule.done


class History(Callback):
    """Records of the run: the first step, every LOG_EVERYth, and LOG_SECONDS after the last record."""

    def __init__(self) -> None:
        self.records: list[dict[str, float]] = []

    def due(self, trainer: Trainer, step: int | None = None) -> bool:
        """Return whether a step, the last one by default, has a record."""
        step = trainer.schedule.step if step is None else step
        if step == 1 or step % LOG_EVERY == 0:
            return True
        last = self.records[-1]["seconds"] if self.records else 0.0
        return trainer.schedule.seconds - last >= LOG_SECONDS

    def log(self, trainer: Trainer, values: dict[str, float]) -> None:
        """Add a record."""
        self.records.append({**trainer.schedule.record(), **values})

    def after_step(self, trainer: Trainer, loss: Tensor, terms: dict[str, Tensor]) -> None:
        values, due = trainer.readings.values, trainer.readings.due
        trainer.progress.speed = trainer.schedule.rays_per_second
        if values is not None and due:
            self.log(trainer, {**values, "rays_per_second": trainer.progress.speed})

    def state_dict(self) -> dict[str, Any]:
        return {"records": list(self.records)}

    def load_state_dict(self, trainer: Trainer, state: dict[str, Any]) -> None:
        self.records = list(state["records"])


class Progress(Callback):
    """Report each step, and stop on request."""

    def __init__(self, on_step: OnStep | None = None) -> None:
        self.on_step, self.speed = on_step, 0.0
        self.notes: list[str] = []  # for the next report

    def after_step(self, trainer: Trainer, loss: Tensor, terms: dict[str, Tensor]) -> None:
        values, schedule = trainer.readings.values, trainer.schedule
        if values is not None and self.report(trainer, values, self.speed) and not schedule.done:
            schedule.outcome = Outcome("interrupted", "stopped on request; --resume continues the run")

    def report(self, trainer: Trainer, values: dict[str, float], speed: float) -> bool:
        """Call back after a step; return whether the first process requests to stop."""
        schedule, note = trainer.schedule, "; ".join(self.notes)
        progress = 1.0 if schedule.done else min(schedule.to_possible_end, 1.0)
        self.notes.clear()
        epoch_steps = len(trainer.data) * trainer.bins.edge**2 / trainer.sampler.pixels(trainer.sampler.mean_draw)
        step = Step(
            schedule.step, schedule.epoch, schedule.seconds, progress, values, speed, trainer.state_dict,
            lambda: trainer.field, note, epoch_steps, trainer.data.rig,
        )  # fmt: skip
        stop = self.on_step is not None and bool(self.on_step(step))
        return bool(trainer.ranks.broadcast([float(stop)], trainer.device)[0])


def synchronise(trainer: Trainer) -> None:
    """Set threads to the free cores, and all clocks to that of the first process (on GPUs rarely: it waits)."""
    pause()
    if trainer.device.type == "cpu" or trainer.schedule.step % LOG_EVERY == 0:
        trainer.schedule.synchronise()


class Synchronise(Callback):
    """Before each step, take the free cores and the clock of the first process."""

    def on_start(self, trainer: Trainer) -> None:
        if not trainer.schedule.done:
            synchronise(trainer)

    def after_step(self, trainer: Trainer, loss: Tensor, terms: dict[str, Tensor]) -> None:
        self.on_start(trainer)


class Bins(Callback):
    """Change from bins of pixels to the smallest ones of which the rest of the run can use all."""

    def __init__(self, edge: int) -> None:
        self.edge, self.final = edge, edge == 1

    def on_start(self, trainer: Trainer) -> None:
        schedule = trainer.schedule
        if schedule.done or self.final or schedule.progress < PACE_FROM:
            return
        remaining, rays, edge = schedule.remaining, len(trainer.data), self.edge
        while edge > 1 and 4 * rays <= remaining:
            edge, rays = edge // 2, 4 * rays
        self.final = True
        if edge < self.edge:
            bins = "single pixels" if edge == 1 else f"bins of {edge} px"
            trainer.progress.notes.append(f"now fitting {bins}{INCOMPARABLE}")
            self.edge = edge
            trainer.data.set_bins(edge)
            trainer.set_data(new_stage=False)
            fit_nuisance(trainer)
            trainer.history.log(trainer, {"bin_edge": float(edge)})

    def after_step(self, trainer: Trainer, loss: Tensor, terms: dict[str, Tensor]) -> None:
        self.on_start(trainer)

    def state_dict(self) -> dict[str, Any]:
        return {"edge": self.edge, "final": self.final}

    def load_state_dict(self, trainer: Trainer, state: dict[str, Any]) -> None:
        if state["edge"] != self.edge:
            trainer.data.set_bins(state["edge"])
        self.edge, self.final = state["edge"], state["final"]


class Stages(Callback):
    """Change to the data of the next stage of the run, such as from displacements to images (sources.py)."""

    def on_start(self, trainer: Trainer) -> None:
        data, label = trainer.data, trainer.data.label
        if trainer.schedule.done or not data.advance(trainer.schedule.progress):
            return
        if data.label != label:
            trainer.progress.notes.append(f"now fitting {data.label}{INCOMPARABLE}")
        trainer.set_data(new_stage=True)
        fit_nuisance(trainer)
        trainer.history.log(trainer, {"part": float(data.stage)})

    def after_step(self, trainer: Trainer, loss: Tensor, terms: dict[str, Tensor]) -> None:
        self.on_start(trainer)


class RigRefinement(Callback):
    """Steps of the rig refinement with the present field, where they are due."""

    @torch.no_grad()
    def on_start(self, trainer: Trainer) -> None:
        data, rig, progress = trainer.data, trainer.data.refinement, trainer.schedule.progress
        if rig is None or trainer.schedule.done:
            return
        due = math.ceil((min(progress, RIG_UNTIL) - RIG_FROM) / RIG_EVERY)
        if rig.steps > max(due, 0) + 1:  # of the previous cycle
            rig.steps = 0
        if rig.steps >= due or (progress > SIGN_UNTIL and not rig.off):
            return

        def predict(part: Part, rays: Rays) -> Tensor:
            generator = torch.Generator().manual_seed(rig.steps)  # the same samples for all poses
            integrals = []
            for index in torch.arange(len(rays)).split(RIG_BATCH):
                batch, each, count = rays[index], 1, RIG_SAMPLES
                if batch.lens is not None:
                    batch, each, count = batch.spread(RIG_LENS_RAYS, generator), RIG_LENS_RAYS, RIG_SAMPLES // 2
                s, step = sample_rays(batch, count, generator, "adaptive", trainer.sampler.density, each)
                integral = PathIntegral(part.model.integral).along(trainer.field, batch, s, step)
                integrals.append(integral if each == 1 else batch.mean_of(each, integral))
            return torch.cat(integrals)

        momentum = MOMENTUM if progress < RIG_SLOW_FROM else 0.0
        factor = EARLY_FACTOR if progress < EARLY else 1.0
        rig.step(data.rig_pixels(rig.steps), predict, data.sigma_known, momentum, factor)

    def after_step(self, trainer: Trainer, loss: Tensor, terms: dict[str, Tensor]) -> None:
        self.on_start(trainer)


@torch.no_grad()
def fit_nuisance(trainer: Trainer) -> None:
    """Fit the nuisance parameters, such as the brightness of images, to the present field."""
    for part in trainer.data.nuisance_parts:
        rays = replace(part.rays, lens=None)
        integral = project(PathIntegral(part.model.integral, NUISANCE_SAMPLES), trainer.field, rays, trainer.device)
        part.model.settle(integral, part.measured, part.inverse_scale, rays)


def finite(trainer: Trainer) -> bool:
    """Return whether the weights are finite; a finite loss can have a non-finite gradient."""
    return all(bool(torch.isfinite(w).all()) for w in trainer.field.network.parameters())


def _root(trainer: Trainer, loss: float) -> float:
    """Root of a squared loss, so that ratios mean the same for both norms."""
    return math.sqrt(loss) if trainer.settings.norm == "squared" else loss
