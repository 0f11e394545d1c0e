"""The training loop.

    batch of rays with samples (sampling.py) -> loss (objective.py) -> step of the optimiser (optimiser.py)

The schedule (schedule.py) holds steps, time, learning rate and bins of pixels; watch.py monitors the steps.
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
from nerif.reconstruction.device import Cores, float32_products, peak_memory, remark_on
from nerif.reconstruction.field_files import check_fingerprint
from nerif.reconstruction.neural.losses import MixedPrecision
from nerif.reconstruction.neural.objective import Objective
from nerif.reconstruction.neural.optimiser import NetworkOptimiser
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.rig_steps import refine_rig
from nerif.reconstruction.neural.sampling import Sampler
from nerif.reconstruction.neural.schedule import Schedule
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.reconstruction.neural.training_settings import TrainingSettings
from nerif.reconstruction.neural.warm_start import copy_weights, fit_network
from nerif.reconstruction.neural.watch import Watch
from nerif.reconstruction.reconstructor import OnStep, Outcome, Reconstruction, State

__all__ = ["Trainer"]

LEVEL_POINTS = 1 << 14  # for the ambient level at the end
INCOMPARABLE = "; loss values before and after cannot be compared"


class Trainer:
    """One run: data, network, optimiser, schedule, and the loop.

    Parameters
    ----------
    data : on its device
    resume : state of an earlier run to continue
    start : field to fit the network to before the first step; ignored when resuming
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
        self.sampler = Sampler(settings, data, self.field, self.network, self.generator, self.ranks)
        self.objective = Objective(settings, data, self.field, self.network, self.generator)
        self.schedule = Schedule(settings, len(data), self.ranks, self.device)  # its clock starts after the imports
        self.watch = Watch(self.objective, self.sampler, self.schedule, self.state_dict, self.load_state_dict)
        self.start = None if resume is not None else start
        if resume is not None:
            check_fingerprint(resume.scalars.get("fingerprint"), data.fingerprint)
            self.load_state_dict(resume)
            check_same_bounds(self.field.bounds, data.bounds)

    def run(self, on_step: OnStep | None = None) -> Reconstruction:
        """Train until the schedule is done and return the result."""
        with self.cores, float32_products("highest"):
            self.watch.start(on_step)
            if self.start is not None and not self.schedule.done:
                self._start_from(self.start)
            self.schedule.restart_pace()
            self._prepare()
            while not self.schedule.done:
                batch = self.sampler.batch(self.schedule)
                loss, terms = self.objective(batch)
                self.optimiser.zero_grad()
                self.network.backward(loss)
                self.ranks.average_gradients(self.field.network, batch.own_numbers, batch.numbers)
                self.optimiser.step(self.schedule.rates)
                self.schedule.advance()
                self.watch.after_step(batch, loss, terms)
                self._prepare()
            return self.result()

    def _start_from(self, start: Field) -> None:
        """Copy the field that the run starts from, or fit the network to it; then the learning rate is smaller."""
        settings, self.network.low = self.settings, True
        if not copy_weights(start, self.field):
            fit_network(
                self.field, self.network, start, settings.fit_steps, settings.points_per_batch, settings.learning_rate,
                self.generator, self.watch.after_fit_step,
            )  # fmt: skip
        self.sampler.density.update(self.network)
        self.schedule.rate_factor = settings.rate_after_fit
        self.watch.good = self.state_dict()

    def _prepare(self) -> None:
        """Prepare the next step: free cores and clock, smaller bins, the next stage of the data, a step of the rig."""
        data, schedule = self.data, self.schedule
        if schedule.done:
            return
        self.watch.synchronise()
        if (edge := schedule.smaller_bins(data.edge)) < data.edge:
            data.set_bins(edge)
            self._change_data("single pixels" if edge == 1 else f"bins of {edge} px", False, "bin_edge", edge)
        label = data.label
        if data.advance(schedule.progress):
            self._change_data(data.label if data.label != label else "", True, "part", data.stage)
        refine_rig(data, self.field, self.sampler.density, schedule.progress)

    def _change_data(self, label: str, new_stage: bool, name: str, number: int) -> None:
        """Adapt to other bins of pixels or to a new stage; the history has its number, the next report its label."""
        if label:
            self.watch.notes.append(f"now fitting {label}{INCOMPARABLE}")
        self._set_data(new_stage)
        self.data.fit_nuisance(self.field)
        self.watch.log({name: float(number)})

    def _set_data(self, new_stage: bool) -> None:
        self.schedule.set_rays(len(self.data))
        self.watch.set_data(new_stage)

    def result(self) -> Reconstruction:
        """Return the reconstruction at the end of the run."""
        state, outcome = self.state_dict(), self.schedule.outcome
        assert outcome is not None
        self.watch.take_best()
        if not outcome.failed:
            remark = self.watch.remark(outcome.reason == "converged") + self.network.remark + remark_on(self.device)
            outcome = Outcome(outcome.reason, outcome.message + remark)
        self.field.network.eval().requires_grad_(False)
        errors = self.objective.gauge_errors(LEVEL_POINTS, torch.Generator().manual_seed(0))
        if errors is not None and self.data.gauge_free and self.field.network.limits == UNBOUNDED:
            self.field.offset = float(errors.mean())
        return Reconstruction(
            field=self.field, box=self.data.box, n_ambient=self.data.n_ambient, history=self.watch.records,
            outcome=outcome, settings=asdict(self.settings), seconds=self.schedule.seconds,
            peak_memory_bytes=peak_memory(self.device), device=str(self.device), state=state,
            quantity=self.data.quantity, rig=self.data.rig(), axis=self.data.axis, bodies=self.data.measurement.bodies,
        )  # fmt: skip

    # -- checkpoints -------------------------------------------------------------------------------------------------

    def state_dict(self) -> State:
        """Return all that a run needs to continue from here."""
        groups: dict[str, dict[str, Any]] = {
            "network": {name: value.detach().clone() for name, value in self.field.network.state_dict().items()},
            "optimiser": self.optimiser.state_dict(),
            "data": self.data.state_dict(),
            "Bins": {"edge": self.data.edge, "final": self.schedule.final_bins},
        }
        named = {f"{group}.{name}": value for group, values in groups.items() for name, value in values.items()}
        named |= self.watch.state_dict()
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
        self.watch.load_state_dict(state)
        self.schedule.final_bins = scalars["Bins.final"]
        self.data.load_state_dict(scalars["stage"], state.under("data."), scalars["Bins.edge"])
        self._set_data(new_stage=False)
        self.schedule.load_state_dict(scalars["schedule"])
