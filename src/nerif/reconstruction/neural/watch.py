"""Monitoring of a training: loss, convergence, divergence, history and progress reports.

A run whose loss turns non-finite, or whose field collapses to the ambient one (fit_monitor.py), continues from its last
good state with a third of the learning rate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from nerif.common.pauses import pause
from nerif.reconstruction.neural.fit_monitor import FitMonitor
from nerif.reconstruction.neural.losses import DATA_TERMS
from nerif.reconstruction.neural.objective import Objective
from nerif.reconstruction.neural.sampling import Batch, Sampler
from nerif.reconstruction.neural.schedule import Schedule
from nerif.reconstruction.reconstructor import OnStep, Outcome, State, Step

__all__ = ["Watch"]

MAX_ROLLBACKS = 5
LOG_EVERY, SAVE_EVERY = 20, 200  # steps
LOG_SECONDS = 5.0  # after which a record is due as well, so that slow steps have a history
FIT_PACE_STEP = 10  # of a fit to the initial field, after which its pace is known


class Watch:
    """The figures of a run and what follows from them.

    Parameters
    ----------
    capture, restore : return the state of the run, and continue from one

    Attributes
    ----------
    records : history: the first step, every LOG_EVERYth, and LOG_SECONDS after the last record
    notes : lines for the next report
    first, good : states to roll back to: the first one, and the last one with a good fit
    best_weights, best_data : network, nuisance parameters and rig at the end of the best cycle
    """

    first: State
    good: State

    def __init__(
        self, objective: Objective, sampler: Sampler, schedule: Schedule, capture: Callable[[], State],
        restore: Callable[[State], None],
    ) -> None:  # fmt: skip
        self.objective, self.sampler, self.schedule = objective, sampler, schedule
        self.capture, self.restore = capture, restore
        self.settings, self.data, self.field = objective.settings, objective.data, objective.field
        self.ranks = sampler.ranks
        self.on_step: OnStep | None = None
        self.records: list[dict[str, float]] = []
        self.notes: list[str] = []
        self.mean_loss = math.nan  # running mean, of roots of squared losses: ratios then mean the same for both norms
        self.best_weights: dict[str, Tensor] = {}
        self.best_data: dict[str, Tensor] = {}
        self.rollbacks = 0
        self.set_data(new_stage=True)

    def set_data(self, new_stage: bool) -> None:
        """Adapt to other bins of pixels, or to the data of a new stage."""
        ratio = self.settings.stop_ratio
        self.ambient_loss = self._root(self.objective.ambient_loss()) if ratio else math.nan
        if new_stage:
            self.monitor = FitMonitor(self.data.noise, self.settings.learning_rate, self.schedule.step)
        self.monitor.noise = self.data.noise

    def start(self, on_step: OnStep | None) -> None:
        """Begin to watch a run."""
        self.on_step = on_step
        self.schedule.synchronise()
        self.schedule.outcome = self.schedule.limit()
        self.first = self.good = self.capture()

    def after_fit_step(self, step: int, loss: float) -> bool:
        """Record and report a step of the fit to the initial field; return whether to stop."""
        schedule, values = self.schedule, {"fit_step": float(step), "fit_loss": loss}
        if step == FIT_PACE_STEP:
            seconds = schedule.seconds / step * self.settings.fit_steps
            self.notes.append(f"first the network is fitted to the initial field: about {seconds:.0f} s")
        if self._due(step):
            self.log(values)
        self.synchronise()
        schedule.outcome = schedule.limit()
        self._report(values, 0.0, "stopped during the fit to the start; --resume continues the run")
        return schedule.done

    def after_step(self, batch: Batch, loss: Tensor, terms: dict[str, Tensor]) -> None:
        """End the run or roll it back where that is due; else record and report the step."""
        schedule = self.schedule
        schedule.outcome = self._end_cycle() or schedule.limit() or self._small_loss()
        due = schedule.done or self._due(schedule.step)
        if self.data.device.type != "cpu" and not due:  # reading the loss would wait for the GPU
            return
        values, ambient = self._read(batch, loss, terms)
        if not math.isfinite(values["loss"]) or (schedule.done and not self._finite):
            self._roll_back("the loss turned non-finite")
            return
        self._update(values, ambient)
        if self.monitor.collapsed(schedule.done):
            self._roll_back("the field collapsed")
            schedule.outcome = schedule.outcome or schedule.limit()
            return
        speed = schedule.rays_per_second
        if due:
            self.log({**values, "rays_per_second": speed})
        if schedule.step % SAVE_EVERY == 0 and self.monitor.healthy and self._finite:
            self.good = self.capture()
        self._report(values, speed, "stopped on request; --resume continues the run")

    def synchronise(self) -> None:
        """Set threads to the free cores, and all clocks to that of the first process (on GPUs rarely: it waits)."""
        pause()
        if self.data.device.type == "cpu" or self.schedule.step % LOG_EVERY == 0:
            self.schedule.synchronise()

    def log(self, values: dict[str, float]) -> None:
        """Add a record to the history."""
        self.records.append({**self.schedule.record(), **values})

    def take_best(self) -> None:
        """Return to the weights of the best cycle where the present ones are worse."""
        cycles = self.schedule.cycles
        if cycles is None or not self.best_weights or self._error() <= min(cycles.errors):  # not if it is NaN
            return
        self.field.network.load_state_dict(self.best_weights)
        if self.best_data:
            self.data.load_state_dict(self.data.stage, self.best_data)

    def remark(self, converged: bool) -> str:
        """Return a remark at the end of a run, or nothing."""
        again = f"; rolled back {self.rollbacks} time(s) to the last good state" if self.rollbacks else ""
        return again + self.monitor.remark(converged)

    # -- the end of a run ----------------------------------------------------------------------------------------------

    def _small_loss(self) -> Outcome | None:
        ratio = self.settings.stop_ratio
        if ratio and self.mean_loss <= ratio * self.ambient_loss:
            return Outcome("converged", f"the loss fell to {ratio:g} of that of the ambient field")
        return None

    def _end_cycle(self) -> Outcome | None:
        """Test for convergence on withheld pixels at the end of a cycle, and save the weights of the best one."""
        schedule, cycles, withheld = self.schedule, self.schedule.cycles, self.data.withheld
        if cycles is None or schedule.progress < 1:
            return None
        error = self._error()
        noise = float(withheld is not None and withheld.sigma_known)
        label = "residual" if withheld is None else "residual of withheld pixels"
        outcome = cycles.end(error, noise, schedule.step, label)
        self.log({"withheld_residual": math.sqrt(error)})
        if cycles.best:
            weights = self.field.network.state_dict()
            self.best_weights = {name: value.detach().clone() for name, value in weights.items()}
            self.best_data = self.data.state_dict()
        self.data.fit_nuisance(self.field)
        schedule.final_bins = False  # the pace is better known now
        return outcome

    def _error(self) -> float:
        """Mean square of the residual of withheld pixels; without any, of the running mean of the loss."""
        if self.data.withheld is None:
            error = self.mean_loss**2
        else:
            error = self.objective.withheld_residual(self.sampler.density)
        return self.ranks.broadcast([error], self.data.device)[0]

    def _roll_back(self, cause: str) -> None:
        """Return to the last good state, or to the first if no field has been found, with a third of the rate."""
        schedule, monitor = self.schedule, self.monitor
        rollbacks, rate_factor, seconds = self.rollbacks + 1, schedule.rate_factor / 3, schedule.seconds
        unexplained, empty = monitor.unexplained, monitor.collapsed(final=True) and not monitor.has_fitted
        self.restore(self.first if empty else self.good)
        schedule.load_state_dict({**schedule.state_dict(), "seconds": seconds, "rate_factor": rate_factor})
        self.rollbacks, schedule.outcome = rollbacks, None
        self.log({"rolled_back": float(rollbacks)})
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

    @property
    def _finite(self) -> bool:
        """Whether the weights are finite; a finite loss can have a non-finite gradient."""
        return all(bool(torch.isfinite(w).all()) for w in self.field.network.parameters())

    # -- figures, history and reports ----------------------------------------------------------------------------------

    def _read(self, batch: Batch, loss: Tensor, terms: dict[str, Tensor]) -> tuple[dict[str, float], float]:
        """Loss and terms, and the data term of the ambient field, averaged over all processes."""
        ambient = self.objective.ambient_term([p.part for p in batch.pieces], [p.numbers for p in batch.pieces])
        own_means = torch.stack([term.detach().float() for term in (*terms.values(), loss, ambient)])
        *means, empty = self.ranks.average(own_means, batch.own_numbers, batch.numbers).tolist()
        return dict(zip((*terms, "loss"), means, strict=True)), empty

    def _update(self, values: dict[str, float], ambient: float) -> None:
        """Add the figures of a step to the running means."""
        weights = {name: getattr(self.settings.weights, name) for name in DATA_TERMS if name in values}
        residual = sum(weight * values[name] for name, weight in weights.items()) / sum(weights.values())
        power = 1 if self.settings.norm == "squared" else 2
        self.monitor.update(residual**power, ambient**power, self.schedule.step)
        loss = self._root(values["loss"])
        before = loss if math.isnan(self.mean_loss) else self.mean_loss
        self.mean_loss = before + 0.1 * (loss - before)

    def _root(self, loss: float) -> float:
        return math.sqrt(loss) if self.settings.norm == "squared" else loss

    def _due(self, step: int) -> bool:
        """Whether a step has a record."""
        last = self.records[-1]["seconds"] if self.records else 0.0
        return step == 1 or step % LOG_EVERY == 0 or self.schedule.seconds - last >= LOG_SECONDS

    def _report(self, values: dict[str, float], speed: float, message: str) -> None:
        """Call back after a step, and end the run with a message if the first process requests it."""
        schedule, data, note = self.schedule, self.data, "; ".join(self.notes)
        self.notes.clear()
        progress = 1.0 if schedule.done else min(schedule.to_possible_end, 1.0)
        epoch_steps = len(data) * data.edge**2 / self.sampler.pixels(self.sampler.mean_draw)
        step = Step(
            schedule.step, schedule.epoch, schedule.seconds, progress, values, speed, self.capture,
            lambda: self.field, note, epoch_steps, data.rig,
        )  # fmt: skip
        stop = self.on_step is not None and bool(self.on_step(step))
        if self.ranks.broadcast([float(stop)], data.device)[0] and not schedule.done:
            schedule.outcome = Outcome("interrupted", message)

    # -- checkpoints ---------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint stores, by its names there."""
        best = {"weights": self.best_weights, "data": self.best_data}
        tensors = {f"Convergence.{group}.{name}": v for group, values in best.items() for name, v in values.items()}
        return {
            **tensors, "Convergence.mean_loss": self.mean_loss, "History.records": list(self.records),
            "DivergenceGuard.rollbacks": self.rollbacks, "DivergenceGuard.monitor": self.monitor.state_dict(),
        }  # fmt: skip

    def load_state_dict(self, state: State) -> None:
        """Continue from the state of a checkpoint."""
        values = state.scalars
        self.mean_loss, self.rollbacks = values["Convergence.mean_loss"], values["DivergenceGuard.rollbacks"]
        self.records = list(values["History.records"])
        self.monitor.load_state_dict(values["DivergenceGuard.monitor"])
        self.best_weights, self.best_data = state.under("Convergence.weights."), state.under("Convergence.data.")
