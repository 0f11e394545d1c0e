"""The training loop.

    batch of rays with samples (sampling.py) -> loss (objective.py) -> step of the optimiser (optimiser.py)

The schedule (schedule.py) holds steps, time and learning rate. Everything else hangs on the loop by callbacks
(callbacks.py): convergence, rolling back, history, bins of pixels, stages of the data, rig refinement, reports.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.fields.field import Field
from nerif.fields.network import UNBOUNDED
from nerif.reconstruction.bounds import check_same_bounds
from nerif.reconstruction.device import Cores, float32_products, peak_memory
from nerif.reconstruction.field_files import check_fingerprint
from nerif.reconstruction.neural.callbacks import (
    Bins,
    Callback,
    Convergence,
    DivergenceGuard,
    GoodState,
    History,
    Progress,
    Readings,
    RigRefinement,
    Stages,
    Synchronise,
    WarmStart,
)
from nerif.reconstruction.neural.losses import MixedPrecision
from nerif.reconstruction.neural.objective import Objective
from nerif.reconstruction.neural.optimiser import NetworkOptimiser
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.sampling import Batch, Sampler
from nerif.reconstruction.neural.schedule import Schedule
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.reconstruction.neural.training_settings import TrainingSettings
from nerif.reconstruction.reconstructor import OnStep, Outcome, Reconstruction, State

__all__ = ["Trainer"]

LEVEL_POINTS = 1 << 14  # for the ambient level at the end


class Trainer:
    """One run: data, network, optimiser, schedule, callbacks, and the loop.

    Parameters
    ----------
    data : on its device
    resume : state of an earlier run to continue
    start : field to fit the network to before the first step; ignored when resuming
    """

    batch: Batch

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
        self.sampler = Sampler(settings, data, self.field, self.network, self.generator, self.ranks)
        self.objective = Objective(settings, data, self.field, self.network, self.generator)
        self.schedule = Schedule(settings, len(data), self.ranks, self.device)  # its clock starts after the imports
        self.history, self.readings, self.progress, self.states = History(), Readings(), Progress(), GoodState()
        self.bins = Bins(data.coarsest)
        self.convergence, self.guard = Convergence(self), DivergenceGuard(self)
        self.callbacks: tuple[Callback, ...] = (
            self.convergence, self.readings, self.guard, self.history, self.states, self.progress,
            WarmStart(start if resume is None else None), Synchronise(), self.bins, Stages(), RigRefinement(),
        )  # fmt: skip
        if resume is not None:
            check_fingerprint(resume.scalars.get("fingerprint"), data.fingerprint)
            self.load_state_dict(resume)
            check_same_bounds(self.field.bounds, data.bounds)

    def run(self, on_step: OnStep | None = None) -> Reconstruction:
        """Train until the schedule is done and return the result."""
        self.progress.on_step = on_step
        with self.cores, float32_products("highest"):
            for callback in self.callbacks:
                callback.on_start(self)
            while not self.schedule.done:
                self.step()
            return self.result()

    def step(self) -> None:
        """Take one step."""
        self.batch = batch = self.sampler.batch(self.schedule)
        loss, terms = self.objective(batch)
        self.optimiser.zero_grad()
        self.network.backward(loss)
        self.ranks.average_gradients(self.field.network, batch.own_numbers, batch.numbers)
        self.optimiser.step(self.schedule.rates)
        self.schedule.advance()
        for callback in self.callbacks:
            callback.after_step(self, loss, terms)

    def set_data(self, new_stage: bool) -> None:
        """Adapt schedule and callbacks to other bins of pixels, or to the data of a new stage."""
        self.schedule.set_rays(len(self.data))
        for callback in self.callbacks:
            callback.on_data(self, new_stage)

    def result(self) -> Reconstruction:
        """Return the reconstruction at the end of the run."""
        state, outcome = self.state_dict(), self.schedule.outcome
        assert outcome is not None
        self.convergence.take_best(self)
        if not outcome.failed:
            remark = self.guard.remark(outcome.reason == "converged") + self.network.remark
            outcome = Outcome(outcome.reason, outcome.message + remark)
        self.field.network.eval().requires_grad_(False)
        errors = self.objective.gauge_errors(LEVEL_POINTS, torch.Generator().manual_seed(0))
        if errors is not None and self.data.gauge_free and self.field.network.limits == UNBOUNDED:
            self.field.offset = float(errors.mean())
        return Reconstruction(
            field=self.field,
            box=self.data.box,
            n_ambient=self.data.n_ambient,
            history=self.history.records,
            outcome=outcome,
            settings=asdict(self.settings),
            seconds=self.schedule.seconds,
            peak_memory_bytes=peak_memory(self.device),
            device=str(self.device),
            state=state,
            quantity=self.data.quantity,
            rig=self.data.rig(),
            axis=self.data.axis,
            bodies=self.data.measurement.bodies,
        )

    # -- checkpoints -------------------------------------------------------------------------------------------------

    def weights(self) -> dict[str, Tensor]:
        """Return a copy of the weights of the network."""
        return {name: value.detach().clone() for name, value in self.field.network.state_dict().items()}

    def state_dict(self) -> State:
        """Return all that a run needs to continue from here."""
        groups: dict[str, dict[str, Any]] = {
            "network": self.weights(),
            "optimiser": self.optimiser.state_dict(),
            "data": self.data.state_dict(),
        }
        groups |= {type(callback).__name__: callback.state_dict() for callback in self.callbacks}
        named = {f"{group}.{name}": value for group, values in groups.items() for name, value in values.items()}
        tensors = {name: value for name, value in named.items() if isinstance(value, Tensor)}
        scalars = {name: value for name, value in named.items() if not isinstance(value, Tensor)}
        tensors["generator"] = self.generator.get_state().clone()
        if self.sampler.density.values is not None:
            tensors["density"] = self.sampler.density.values.clone()
        scalars |= {"scale": self.field.scale, "offset": self.field.offset, "stage": self.data.stage}
        scalars |= {"schedule": self.schedule.state_dict(), "fingerprint": self.data.fingerprint}
        return State(tensors, scalars)

    def load_state_dict(self, state: State) -> None:
        """Continue from a state."""
        tensors, scalars = state.tensors, state.scalars
        try:
            self.field.network.load_state_dict(state.under("network."))
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
        self.sampler.density.values = None if density is None else density.clone().to(self.device)
        for callback in self.callbacks:
            prefix = f"{type(callback).__name__}."
            values = {name.removeprefix(prefix): value for name, value in scalars.items() if name.startswith(prefix)}
            callback.load_state_dict(self, values | state.under(prefix))
        self.data.load_state_dict(scalars["stage"], state.under("data."))
        self.set_data(new_stage=False)
        self.schedule.load_state_dict(scalars["schedule"])
