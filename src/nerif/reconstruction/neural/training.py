"""The training loop.

    batch of rays -> samples -> terms of the loss (objective.py) -> one step of the optimiser

The loop ends at a limit or, without one, at convergence (schedule.py).

On large images the first steps use bins of pixels; after the share PACE_FROM of the run it changes to the smallest bins
of which the rest of the run can use all (bins.py). If the loss or the weights turn non-finite or the field collapses
to the ambient one, the run rolls back to its last good state, with a third of the learning rate.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.pauses import pause
from nerif.fields.base import Field
from nerif.fields.network import UNBOUNDED
from nerif.reconstruction.base import OnStep, Outcome, Reconstruction, State, Step
from nerif.reconstruction.bounds import check_resumed
from nerif.reconstruction.device import Cores, float32_products, peak_memory
from nerif.reconstruction.files import check_fingerprint
from nerif.reconstruction.neural.losses import DATA_TERMS, MixedPrecision
from nerif.reconstruction.neural.objective import Objective, Piece
from nerif.reconstruction.neural.optimiser import NetworkOptimiser
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.schedule import Budget, FitMonitor
from nerif.reconstruction.neural.settings import TrainingSettings
from nerif.reconstruction.neural.training_data import TrainingData, shuffled
from nerif.reconstruction.neural.warm_start import copy_weights, fit_network

__all__ = ["Training"]

MAX_ROLLBACKS = 5
PACE_FROM = 0.1  # share of the run after which its pace is known
DENSITY_EVERY = 60  # steps between updates of the density of samples
LEVEL_POINTS = 1 << 14  # for the ambient level at the end
LOG_EVERY, SAVE_EVERY = 20, 200  # steps
LOG_SECONDS = 5.0  # after which a record is due as well, so that slow steps have a history
SCALARS = {"retries": "rollbacks", "rate": "rate_factor", "running": "mean_loss", "settled": "bins_final"}
SCALARS |= {"drawn": "ray_count"}
"""Attributes of Training by the keys of checkpoints."""


class Training:
    """One run: data, network, optimiser and loop.

    It continues from the state of an earlier run (`resume`), or begins with a fit of the network to a field (`start`).
    """

    def __init__(
        self, settings: TrainingSettings, data: TrainingData, resume: State | None = None, start: Field | None = None
    ) -> None:
        self.settings, self.data, self.device = settings, data, data.device
        self.ranks = Ranks.from_environment()
        self.ranks.join(self.device)
        self.cores = Cores(self.device)
        if len(data) < self.ranks.size:
            raise InputError(
                f"expected at least one ray per process, got {len(data)} rays for {self.ranks.size}", field="torchrun"
            )
        self.generator = torch.Generator().manual_seed(settings.seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            self.field = data.initial_field()
        network = self.field.network
        self.optimiser = NetworkOptimiser(
            settings.optimiser, network, settings.betas, settings.momentum, settings.rates_by_shape
        )
        self.network = MixedPrecision(network, self.device, settings.precision, settings.compile)
        self.objective = Objective(settings, data, self.field, self.network, self.generator, self.ranks)
        self.budget = Budget(settings, len(data), self.ranks, self.device)  # its clock starts here, after the imports
        self.history: list[dict[str, float]] = []
        self.notes: list[str] = []  # for the next report
        self.bin_edge, self.bins_final = data.coarsest, data.coarsest == 1
        self.monitor = FitMonitor(data.noise, settings.learning_rate)
        self.rollbacks, self.rate_factor = 0, 1.0
        self.ray_count = 0  # rays of all batches, in bins of any size
        self.best_weights: dict[str, Tensor] = {}  # at the end of the best cycle
        self.best_data: dict[str, Tensor] = {}  # nuisance parameters and rig there
        self.initial_loss, self.mean_loss = self._initial_loss(), math.nan  # the latter a running mean
        if resume is not None:
            check_fingerprint(resume.scalars.get("fingerprint"), data.fingerprint)
            self.load_state_dict(resume)
            check_resumed(self.field.bounds, data.bounds)
        self.start = start if resume is None else None
        self.first_state = self.good_state = self.state_dict()

    # -- the loop ------------------------------------------------------------------------------------------------

    def run(self, on_step: OnStep | None = None) -> Reconstruction:
        """Train until the end and return the result."""
        with self.cores, float32_products("highest"):
            return self._run(on_step)

    def _run(self, on_step: OnStep | None) -> Reconstruction:
        settings, budget = self.settings, self.budget
        budget.synchronise()
        outcome = budget.exhausted() or self._begin(on_step)
        budget.restart_pace()
        while outcome is None:
            self._synchronise()
            if not self.bins_final and budget.progress >= PACE_FROM:
                self._choose_bins()
            label = self.data.label
            if self.data.advance(budget.progress):
                self._begin_stage(label)
            self.objective.refine_rig(budget.progress)
            pieces, numbers = self._batch()
            self.network.low = budget.progress < settings.full_precision_from
            terms, own_numbers = self.objective.terms(pieces), sum(piece.numbers for piece in pieces)
            loss = sum(getattr(settings.weights, name) * term for name, term in terms.items())
            assert isinstance(loss, Tensor)
            rate = self._learning_rate()
            self.optimiser.zero_grad()
            self.network.backward(loss)
            self.ranks.average_gradients(self.field.network, own_numbers, numbers)
            self.optimiser.step({"adam": rate, "muon": rate * settings.matrix_rate})
            budget.step += 1
            outcome = self._end_cycle() or self._outcome()
            due = outcome is not None or self._log_due(budget.step)
            if self.device.type == "cuda" and not due:
                continue  # reading a number waits for the GPU
            empty = self.objective.ambient_term([p.part for p in pieces], [p.numbers for p in pieces])
            own_means = torch.stack([term.detach().float() for term in (*terms.values(), loss, empty)])
            means = self.ranks.average(own_means, own_numbers, numbers).tolist()
            values = dict(zip((*terms, "loss"), means, strict=False))
            if not math.isfinite(values["loss"]) or (outcome is not None and not self._finite()):
                outcome = self._roll_back("the loss turned non-finite")
                continue
            self._update_means(values, means[-1])
            if self.monitor.collapsed(outcome is not None):
                outcome = self._roll_back("the field collapsed") or budget.exhausted()
                continue
            speed = budget.rays_per_second
            if due:
                self._log({**values, "rays_per_second": speed})
            if budget.step % SAVE_EVERY == 0 and self.monitor.healthy and self._finite():
                self.good_state = self.state_dict()
            if self._report(on_step, values, speed, outcome is not None) and outcome is None:
                outcome = Outcome("interrupted", "stopped on request; --resume continues the run")
        return self._result(outcome)

    def _begin(self, on_step: OnStep | None) -> Outcome | None:
        """Copy the field that the run starts from, or fit the network to it; then the learning rate is smaller."""
        if self.start is None:
            return None
        settings, outcome = self.settings, None

        def report(step: int, loss: float) -> bool:
            nonlocal outcome
            values = {"fit_step": float(step), "fit_loss": loss}
            if self._log_due(step):
                self._log(values)
            self._synchronise()
            outcome = self._outcome()
            if self._report(on_step, values, 0.0) and outcome is None:
                outcome = Outcome("interrupted", "stopped during the fit to the start; --resume continues the run")
            return outcome is not None

        self.network.low = True
        if not copy_weights(self.start, self.field):
            fit_network(
                self.field, self.network, self.start, settings.fit_steps, settings.points_per_batch,
                settings.learning_rate, self.generator, report,
            )  # fmt: skip
        self.objective.density.update(self.network)
        self.rate_factor, self.good_state = settings.rate_after_fit, self.state_dict()
        return outcome

    def _synchronise(self) -> None:
        """Set threads to the free cores, and all clocks to that of the first process (on GPUs rarely: it waits)."""
        pause()
        if self.device.type == "cpu" or self.budget.step % LOG_EVERY == 0:
            self.budget.synchronise()

    def _batch(self) -> tuple[list[Piece], int]:
        """The next rays of a random order with each once per epoch."""
        budget, objective = self.budget, self.objective
        draw = objective.draw(budget.progress)
        rays = objective.pixels(draw)
        index = shuffled(budget.rays_done, rays, len(self.data), self.settings.seed)
        budget.count(rays)
        self.ray_count += rays
        if self.settings.sampling == "adaptive" and budget.step and budget.step % DENSITY_EVERY == 0:
            objective.density.update(self.network)
        return objective.batch(index, draw)

    def _learning_rate(self) -> float:
        """Adam's learning rate of the next step."""
        settings, rate = self.settings, self.rate_factor * self.settings.learning_rate
        if settings.schedule == "cosine":
            warm_up = min(settings.warm_up, settings.max_steps / 6 or math.inf)
            rate *= min(1.0, (self.budget.step + 1) / warm_up)
            rate *= 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(self.budget.progress, 1.0)))
        return rate

    # -- changes of the data ---------------------------------------------------------------------------------------

    def _choose_bins(self) -> None:
        """Change to the smallest bins of which the rest of the run can use all."""
        remaining, rays, edge = self.budget.remaining(self.ray_count), len(self.data), self.bin_edge
        while edge > 1 and 4 * rays <= remaining:
            edge, rays = edge // 2, 4 * rays
        self.bins_final = True
        if edge < self.bin_edge:
            bins = "single pixels" if edge == 1 else f"bins of {edge} px"
            self.notes.append(f"the loss changes from bins of {self.bin_edge} px to {bins} and may jump")
            self._set_bins(edge)

    def _set_bins(self, edge: int) -> None:
        self.bin_edge = edge
        self.data.set_bins(edge)
        self._data_changed()
        self.objective.fit_nuisance()
        self._log({"bin_edge": float(edge)})

    def _begin_stage(self, label: str) -> None:
        """Adapt to the data of a new stage, and fit its nuisance parameters; `label` is that of the stage before."""
        if self.data.label != label:
            self.notes.append(f"the loss changes from {label} to {self.data.label} and jumps")
        self._data_changed()
        self.monitor = FitMonitor(self.data.noise, self.settings.learning_rate)
        self.monitor.step = self.budget.step
        self.objective.fit_nuisance()
        self._log({"part": float(self.data.stage)})

    def _data_changed(self) -> None:
        self.budget.set_rays(len(self.data))
        self.monitor.noise = self.data.noise
        self.initial_loss = self._initial_loss()

    # -- the end, and rolling back -----------------------------------------------------------------------------------

    def _outcome(self) -> Outcome | None:
        """Why the run is over, if it is."""
        outcome, share = self.budget.exhausted(), self.settings.stop_ratio
        if outcome is None and share and self.mean_loss <= share * self.initial_loss:
            return Outcome("converged", f"the loss fell to {share:g} of that of the ambient field")
        return outcome

    def _end_cycle(self) -> Outcome | None:
        """Test for convergence on withheld pixels at the end of a cycle, and save the weights of the best one."""
        budget, cycles, withheld = self.budget, self.budget.cycles, self.data.withheld
        if cycles is None or budget.progress < 1:
            return None
        (error,) = self.ranks.broadcast([self._error()], self.device)
        noise = float(withheld is not None and withheld.sigma_known)
        label = "residual" if withheld is None else "residual of withheld pixels"
        outcome = cycles.end(error, noise, budget.step, budget.seconds, label)
        self._log({"withheld_residual": math.sqrt(error)})
        if cycles.best:
            self.best_weights, self.best_data = self._weights(), self.data.state_dict()
        self.objective.fit_nuisance()
        self.bins_final = self.bin_edge == 1  # the pace is better known now
        return outcome

    def _error(self) -> float:
        """Mean square of the residual of withheld pixels; without any, running mean of the loss."""
        return self.mean_loss**2 if self.data.withheld is None else self.objective.withheld_residual()

    def _update_means(self, values: dict[str, float], empty: float) -> None:
        """Add a step to the running means of loss and residual."""
        weights = {name: getattr(self.settings.weights, name) for name in DATA_TERMS if name in values}
        residual = sum(weight * values[name] for name, weight in weights.items()) / sum(weights.values())
        power = 1 if self.settings.norm == "squared" else 2
        self.monitor.update(residual**power, empty**power, self.budget.step)
        loss = self._root(values["loss"])
        if math.isnan(self.mean_loss):
            self.mean_loss = loss
        self.mean_loss += 0.1 * (loss - self.mean_loss)

    def _initial_loss(self) -> float:
        """Loss that `stop_ratio` refers to."""
        return self._root(self.objective.ambient_loss()) if self.settings.stop_ratio else math.nan

    def _root(self, loss: float) -> float:
        """Root of a squared loss, so that ratios mean the same for both norms."""
        return math.sqrt(loss) if self.settings.norm == "squared" else loss

    def _finite(self) -> bool:
        """Whether the weights are finite; a finite loss can have a non-finite gradient."""
        return all(bool(torch.isfinite(w).all()) for w in self.field.network.parameters())

    def _roll_back(self, cause: str) -> Outcome | None:
        """Return to the last good state, or to the first if no field has been found, with a third of the rate."""
        rollbacks, rate, seconds = self.rollbacks + 1, self.rate_factor / 3, self.budget.seconds
        unexplained = self.monitor.unexplained
        empty = self.monitor.collapsed(final=True) and not self.monitor.has_fitted
        self.load_state_dict(self.first_state if empty else self.good_state)
        self.budget.load_state_dict({**self.budget.state_dict(), "seconds": seconds})
        self.rollbacks, self.rate_factor = rollbacks, rate
        self._log({"taken_back": float(rollbacks)})
        if empty and (rollbacks > MAX_ROLLBACKS or self.budget.exhausted()):
            return Outcome(
                "collapsed",
                f"no field was found: after {rollbacks} attempt(s) {min(unexplained, 9.99):.0%} of the squared signal "
                "without noise is not explained; try a smaller --learning-rate, and nerif check on the measurement",
            )
        if rollbacks > MAX_ROLLBACKS:
            return Outcome(
                "diverged",
                f"{cause} {rollbacks} times; returned the last good state, of step {self.budget.step}; "
                "try a smaller --learning-rate or --precision float32",
            )
        return None

    # -- reports and states ------------------------------------------------------------------------------------------

    def _log_due(self, step: int) -> bool:
        """Whether a step has a record in the history: the first, every LOG_EVERYth, and LOG_SECONDS after the last."""
        if step == 1 or step % LOG_EVERY == 0:
            return True
        last = self.history[-1]["seconds"] if self.history else 0.0
        return self.budget.seconds - last >= LOG_SECONDS

    def _log(self, values: dict[str, float]) -> None:
        self.history.append({**self.budget.record(), **values})

    def _report(self, on_step: OnStep | None, values: dict[str, float], speed: float, final: bool = False) -> bool:
        """Call back after a step; return whether the first process requests to stop."""
        budget = self.budget
        progress, note = 1.0 if final else min(budget.share, 1.0), "; ".join(self.notes)
        self.notes.clear()
        epoch_steps = len(self.data) * self.bin_edge**2 / self.objective.pixels(self.objective.mean_draw)
        step = Step(
            budget.step, budget.epoch, budget.seconds, progress, values, speed, self.state_dict, lambda: self.field,
            note, epoch_steps,
        )  # fmt: skip
        stop = on_step is not None and bool(on_step(step))
        return bool(self.ranks.broadcast([float(stop)], self.device)[0])

    def _weights(self) -> dict[str, Tensor]:
        return {name: value.detach().clone() for name, value in self.field.network.state_dict().items()}

    def state_dict(self) -> State:
        """Return all that a run needs to continue from here."""
        groups = {"network": self._weights(), "optimiser": self.optimiser.state_dict(), "data": self.data.state_dict()}
        groups |= {"best": self.best_weights, "beside": self.best_data}
        tensors = {f"{group}.{name}": value for group, items in groups.items() for name, value in items.items()}
        tensors["generator"] = self.generator.get_state().clone()
        if self.objective.density.values is not None:
            tensors["density"] = self.objective.density.values.clone()
        scalars: dict[str, Any] = {key: getattr(self, name) for key, name in SCALARS.items()}
        scalars |= {"scale": self.field.scale, "offset": self.field.offset, "edge": self.bin_edge}
        scalars |= {"budget": self.budget.state_dict(), "watch": self.monitor.state_dict(), "stage": self.data.stage}
        return State(tensors, {**scalars, "history": list(self.history), "fingerprint": self.data.fingerprint})

    def load_state_dict(self, state: State) -> None:
        """Continue from a state."""
        tensors, scalars = state.tensors, state.scalars
        try:
            self.field.network.load_state_dict(state.under("network."))
            self.best_weights, self.best_data = state.under("best."), state.under("beside.")
            self.field.scale, self.field.offset = float(scalars["scale"]), float(scalars["offset"])
        except (RuntimeError, KeyError):
            raise InputError(
                "the checkpoint is of another network; give the same settings (for a run of a version before "
                "--network.directions: 3)",
                field="resume",
            ) from None
        self.optimiser.load_state_dict(state.under("optimiser."))
        self.generator.set_state(tensors["generator"])
        density = tensors.get("density")
        self.objective.density.values = None if density is None else density.clone().to(self.device)
        self.history = list(scalars["history"])
        self.monitor.load_state_dict(scalars["watch"])
        if int(scalars["edge"]) != self.bin_edge:
            self._set_bins(int(scalars["edge"]))
            self.history.pop()
        self.data.load_state_dict(int(scalars.get("stage", 0)), state.under("data."))
        self._data_changed()
        self.budget.load_state_dict(scalars["budget"])
        for key, name in SCALARS.items():
            setattr(self, name, scalars.get(key, getattr(self, name)))

    def _result(self, outcome: Outcome) -> Reconstruction:
        state, cycles = self.state_dict(), self.budget.cycles
        if cycles is not None and self.best_weights:
            (error,) = self.ranks.broadcast([self._error()], self.device)
            if not error <= min(cycles.errors):  # also if it is NaN
                self.field.network.load_state_dict(self.best_weights)
                if self.best_data:
                    self.data.load_state_dict(self.data.stage, self.best_data)
        if not outcome.failed:
            again = f"; rolled back {self.rollbacks} time(s) to the last good state" if self.rollbacks else ""
            outcome = Outcome(outcome.reason, outcome.message + again + self.monitor.remark + self.network.remark)
        self.field.network.eval().requires_grad_(False)
        ambient = self.objective.ambient_values(LEVEL_POINTS, torch.Generator().manual_seed(0))
        if ambient is not None and self.data.gauge_free and self.field.network.limits == UNBOUNDED:
            self.field.offset = float(ambient.mean())
        rig = [] if self.data.refinement is None else self.data.refinement.table()
        return Reconstruction(
            self.field, self.data.box, self.data.n_ambient, self.history, outcome, asdict(self.settings),
            self.budget.seconds, peak_memory(self.device), str(self.device), state, self.data.quantity, rig,
            self.data.axis,
        )  # fmt: skip
