"""The training of a network, on one frame or on several at once: the loop, and what it does when something goes wrong.

    batch of rays -> samples -> terms of the loss (objective.py) -> one step of the optimiser

until the budget is used up or, where there is no limit, until more brings nothing (convergence.py).

Of large images the first steps see bins of pixels, and those after PIONEERS of the run the smallest bins of which it
can see all (bins.py). A loss or weights that turn non-finite, and a field that is or becomes empty (watch.py), take the
run back to its last good state with a third of the learning rate.
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
from nerif.reconstruction.neural.losses import DATA
from nerif.reconstruction.neural.objective import Objective, Piece
from nerif.reconstruction.neural.optimiser import NetworkOptimiser
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.precision import MixedPrecision
from nerif.reconstruction.neural.schedule import Budget
from nerif.reconstruction.neural.settings import TrainingSettings
from nerif.reconstruction.neural.training_data import TrainingData, shuffled
from nerif.reconstruction.neural.warm_start import adopt, fit_network
from nerif.reconstruction.neural.watch import Watch

__all__ = ["Training"]

RETRIES = 5  # times a run is taken back before it gives up
PIONEERS = 0.1  # share of the run after which its pace is known
DENSITY_EVERY = 60  # steps between looks at where the field varies
LEVEL_POINTS = 1 << 14  # at which the ambient level is taken at the end
LOG_EVERY, KEEP_EVERY = 20, 200  # steps
LOG_SECONDS = 5.0  # after which a record is due as well, so that slow steps have a history


class Training:
    """One run: the data, the network, its optimiser, and the loop.

    Parameters
    ----------
    settings : TrainingSettings
    data : TrainingData, on its device
    resume : State of an earlier run to go on from, or None
    start : Field to fit the network to before the first step, or None; unused when resuming

    Raises
    ------
    InputError
        If there are fewer rays than processes, or the state is of other data or another network.
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
                f"expected at least a ray a process, got {len(data)} rays for {self.ranks.size}", field="torchrun"
            )
        self.generator = torch.Generator().manual_seed(settings.seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            self.field = data.untrained()
        network = self.field.network
        self.optimiser = NetworkOptimiser(
            settings.optimiser, network, settings.betas, settings.momentum, settings.rates_by_shape
        )
        self.network = MixedPrecision(network, self.device, settings.precision, settings.compile)
        self.objective = Objective(settings, data, self.field, self.network, self.generator, self.ranks)
        # its clock begins here: imports are no training
        self.budget = Budget(settings, len(data), self.ranks, self.device)
        self.history: list[dict[str, float]] = []
        self.notes: list[str] = []  # for the next step that is told
        self.edge, self.settled = data.coarsest, data.coarsest == 1
        self.watch = Watch(data.noise, settings.learning_rate)
        self.retries, self.rate = 0, 1.0
        self.drawn = 0  # rays, counted through bins of any size
        self.best: dict[str, Tensor] = {}  # weights at the end of the best cycle
        self.beside: dict[str, Tensor] = {}  # what was fitted beside them
        self.initial_loss, self.running = self._initial_loss(), float("nan")
        if resume is not None:
            check_fingerprint(resume.scalars.get("fingerprint"), data.fingerprint)
            self._restore(resume)
            check_resumed(self.field.bounds, data.bounds)
        self.start = start if resume is None else None
        self.first = self.good = self._capture()

    # -- the loop ------------------------------------------------------------------------------------------------

    def run(self, on_step: OnStep | None = None) -> Reconstruction:
        """Train until something says stop, and return what there is."""
        with self.cores, float32_products("highest"):
            return self._run(on_step)

    def _run(self, on_step: OnStep | None) -> Reconstruction:
        settings, budget = self.settings, self.budget
        budget.agree()
        outcome = budget.exhausted() or self._fit(on_step)
        budget.begin_pace()
        while outcome is None:
            self._agree()
            if not self.settled and budget.progress >= PIONEERS:
                self._settle()
            before = self.data.met
            if self.data.advance(budget.progress):
                self._begin_part(before)
            self.objective.refine(budget.progress)
            pieces, whole = self._batch()
            self.network.low = budget.progress < settings.full_precision_from
            terms, mine = self.objective.terms(pieces), sum(piece.numbers for piece in pieces)
            loss = sum(getattr(settings.weights, name) * term for name, term in terms.items())
            assert isinstance(loss, Tensor)
            rate = self._learning_rate()
            self.optimiser.zero_grad()
            self.network.backward(loss)
            self.ranks.average_gradients(self.field.network, mine, whole)
            self.optimiser.step({"adam": rate, "muon": rate * settings.matrix_rate})
            budget.step += 1
            outcome = self._judge() or self._outcome()
            due = outcome is not None or self._due(budget.step)
            if self.device.type == "cuda" and not due:
                continue  # looking at a number waits for the GPU, so look now and then
            empty = self.objective.of_nothing([p.part for p in pieces], [p.numbers for p in pieces])
            found = (*terms.values(), loss, empty)
            figures = torch.stack([term.detach().float() for term in found])
            means = self.ranks.average(figures, mine, whole).tolist()
            values = dict(zip((*terms, "loss"), means, strict=False))
            if not math.isfinite(values["loss"]) or (outcome is not None and not self._finite()):
                outcome = self._take_back()
                continue
            self._follow(values, means[-1])
            if self.watch.collapsed(outcome is not None):
                outcome = self._take_back("the field was lost") or budget.exhausted()
                continue
            speed = budget.rays_per_second
            if due:
                self._log({**values, "rays_per_second": speed})
            if budget.step % KEEP_EVERY == 0 and self.watch.healthy and self._finite():
                self.good = self._capture()
            if self._asked(on_step, self._tell(values, speed, outcome is not None)) and outcome is None:
                outcome = Outcome("interrupted", "stopped on request; --resume goes on from here")
        return self._result(outcome)

    def _agree(self) -> None:
        """Take the cores there are; let all processes go by the clock of the first (on GPUs now and then: it waits)."""
        pause()
        if self.device.type == "cpu" or self.budget.step % LOG_EVERY == 0:
            self.budget.agree()

    def _asked(self, on_step: OnStep | None, step: Step) -> bool:
        """Tell of a step, and whether the first process is asked to stop."""
        asked = on_step is not None and bool(on_step(step))
        return bool(self.ranks.decided([float(asked)], self.device)[0])

    def _fit(self, on_step: OnStep | None) -> Outcome | None:
        """Take over the field that the run starts from, or fit the network to it; the steps after it are smaller."""
        if self.start is None:
            return None
        settings, outcome = self.settings, None

        def log(step: int, loss: float) -> bool:
            nonlocal outcome
            values = {"fit_step": float(step), "fit_loss": loss}
            if self._due(step):
                self._log(values)
            self._agree()
            outcome = self._outcome()
            if self._asked(on_step, self._tell(values, 0.0)) and outcome is None:
                outcome = Outcome("interrupted", "stopped while fitting the start; --resume goes on from here")
            return outcome is not None

        self.network.low = True
        if not adopt(self.field, self.start):
            fit_network(
                self.field, self.network, self.start, settings.fit_steps, settings.points_per_batch,
                settings.learning_rate, self.generator, log,
            )  # fmt: skip
        self.objective.look()
        self.rate, self.good = settings.rate_after_fit, self._capture()
        return outcome

    # -- a step --------------------------------------------------------------------------------------------------

    def _batch(self) -> tuple[list[Piece], int]:
        """The next rays, of a random order that has each once an epoch."""
        budget, objective = self.budget, self.objective
        draw = objective.draw(budget.progress)
        rays = objective.pixels(draw)
        index = shuffled(budget.rays_done, rays, len(self.data), self.settings.seed)
        budget.count(rays)
        self.drawn += rays
        if self.settings.sampling == "adaptive" and budget.step and budget.step % DENSITY_EVERY == 0:
            objective.look()
        return objective.batch(index, draw)

    def _settle(self) -> None:
        """Go on with the smallest bins of which the rest of the run can see all."""
        left, rays, edge = self.budget.left(self.drawn), len(self.data), self.edge
        while edge > 1 and 4 * rays <= left:
            edge, rays = edge // 2, 4 * rays
        self.settled = True
        if edge < self.edge:
            pixels = "single pixels" if edge == 1 else f"bins of {edge} px"
            self._note(f"the loss is of {pixels} from here on, of bins of {self.edge} px before: it may jump")
            self._refine(edge)

    def _refine(self, edge: int) -> None:
        self.edge = edge
        self.data.refine(edge)
        self._recount()
        self.objective.settle()
        self._log({"bin_edge": float(edge)})

    def _begin_part(self, before: str) -> None:
        """Meet what the data give from now on, what is open beside the field fitted to the field so far.

        Parameters
        ----------
        before : what was met until now
        """
        if self.data.met != before:
            self._note(f"the loss is of {self.data.met} from here on, of {before} before: it jumps")
        self._recount()
        self.watch = Watch(self.data.noise, self.settings.learning_rate)
        self.watch.step = self.budget.step
        self.objective.settle()
        self._log({"part": float(self.data.stage)})

    def _recount(self) -> None:
        self.budget.recount(len(self.data))
        self.watch.noise = self.data.noise
        self.initial_loss = self._initial_loss()

    def _learning_rate(self) -> float:
        """Adam's, of the next step."""
        settings, rate = self.settings, self.rate * self.settings.learning_rate
        if settings.schedule == "cosine":
            warm_up = min(settings.warm_up, settings.max_steps / 6 or math.inf)
            rate *= min(1.0, (self.budget.step + 1) / warm_up)
            rate *= 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(self.budget.progress, 1.0)))
        return rate

    # -- whether to stop, or to go back --------------------------------------------------------------------------

    def _outcome(self) -> Outcome | None:
        """Why the run is over, if it is."""
        outcome, share = self.budget.exhausted(), self.settings.stop_ratio
        if outcome is None and share and self.running <= share * self.initial_loss:
            return Outcome("converged", f"loss fell to {share:g} of that of the ambient field")
        return outcome

    def _judge(self) -> Outcome | None:
        """At the end of a cycle, what the rays held back say of going on; the weights of the best are kept."""
        budget, cycles, held = self.budget, self.budget.cycles, self.data.withheld
        if cycles is None or budget.progress < 1:
            return None
        (error,) = self.ranks.decided([self._error()], self.device)
        known = held is not None and held.sigma_known
        judged = "what was measured is" if held is None else "rays held back are"
        outcome = cycles.judge(error, float(known), budget.step, budget.seconds, judged)
        self._log({"withheld_residual": math.sqrt(error)})
        if cycles.best:
            self.best, self.beside = self._weights(), self.data.kept()
        self.objective.settle()
        self.settled = self.edge == 1  # the pace is better known now
        return outcome

    def _error(self) -> float:
        """The mean square of the residual on rays held back; where there are none, the running mean of the loss."""
        return self.running**2 if self.data.withheld is None else self.objective.withheld()

    def _weights(self) -> dict[str, Tensor]:
        return {name: value.detach().clone() for name, value in self.field.network.state_dict().items()}

    def _follow(self, values: dict[str, float], empty: float) -> None:
        """A running mean of the loss, and of what the watch needs."""
        weights, squared = self.settings.weights, self.settings.norm == "squared"
        data = {name: getattr(weights, name) for name in DATA if name in values}
        residual = sum(weight * values[name] for name, weight in data.items()) / sum(data.values())
        power = 1 if squared else 2
        self.watch.follow(residual**power, empty**power, self.budget.step)
        loss = self._rooted(values["loss"])
        if math.isnan(self.running):
            self.running = loss
        self.running += 0.1 * (loss - self.running)

    def _initial_loss(self) -> float:
        """The loss that the stopping rule takes a share of; NaN where there is no rule."""
        return self._rooted(self.objective.empty_loss()) if self.settings.stop_ratio else math.nan

    def _rooted(self, loss: float) -> float:
        """The root of a squared loss, so that ratios mean the same for both norms."""
        return math.sqrt(loss) if self.settings.norm == "squared" else loss

    def _finite(self) -> bool:
        """Whether the weights are: a finite loss can have a gradient that is not."""
        return all(bool(torch.isfinite(w).all()) for w in self.field.network.parameters())

    def _take_back(self, why: str = "loss turned non-finite") -> Outcome | None:
        """Return to the last good state, or to the first if nothing was found since, with a third of the rate."""
        retries, rate, seconds, left = self.retries + 1, self.rate / 3, self.budget.seconds, self.watch.left
        empty = self.watch.collapsed(over=True) and not self.watch.found
        self._restore(self.first if empty else self.good)
        self.budget.restore({**self.budget.used(), "seconds": seconds})
        self.retries, self.rate = retries, rate
        self._log({"taken_back": float(retries)})
        if empty and (retries > RETRIES or self.budget.exhausted()):
            return Outcome(
                "collapsed",
                f"no field was found: after {retries} attempt(s) {min(left, 9.99):.0%} of what was "
                "measured, squared and noise apart, is not explained; try a smaller --learning-rate, and nerif check "
                "on the measurement",
            )
        if retries > RETRIES:
            return Outcome(
                "diverged",
                f"{why} {retries} times; kept the last good state of step {self.budget.step}; "
                "try a smaller --learning-rate or --precision float32",
            )
        return None

    # -- what is told and kept -----------------------------------------------------------------------------------

    def _due(self, step: int) -> bool:
        """Whether a step has a record in the history: the first, each LOG_EVERYth, and LOG_SECONDS after the last."""
        if step == 1 or step % LOG_EVERY == 0:
            return True
        last = self.history[-1]["seconds"] if self.history else 0.0
        return self.budget.seconds - last >= LOG_SECONDS

    def _log(self, values: dict[str, float]) -> None:
        self.history.append({**self.budget.where(), **values})

    def _note(self, text: str) -> None:
        self.notes.append(text)

    def _tell(self, values: dict[str, float], speed: float, over: bool = False) -> Step:
        budget = self.budget
        progress = 1.0 if over else min(budget.share, 1.0)
        capture, note = self._capture, "; ".join(self.notes)
        self.notes.clear()
        steps = len(self.data) * self.edge**2 / self.objective.pixels(self.objective.typical)
        return Step(
            budget.step, budget.epoch, budget.seconds, progress, values, speed, capture, lambda: self.field, note, steps
        )  # fmt: skip

    def _capture(self) -> State:
        groups = {"network": self._weights(), "optimiser": self.optimiser.tensors(), "data": self.data.kept()}
        groups |= {"best": self.best, "beside": self.beside}
        tensors = {f"{group}.{name}": value for group, some in groups.items() for name, value in some.items()}
        tensors["generator"] = self.generator.get_state().clone()
        if self.objective.density.values is not None:
            tensors["density"] = self.objective.density.values.clone()
        names = ("retries", "rate", "running", "settled", "drawn")
        scalars: dict[str, Any] = {name: getattr(self, name) for name in names}
        scalars |= {"scale": self.field.scale, "offset": self.field.offset}
        kept = {"budget": self.budget.used(), "history": list(self.history), "fingerprint": self.data.fingerprint}
        scalars |= {"edge": self.edge, "stage": self.data.stage, "watch": self.watch.kept()}
        return State(tensors, {**scalars, **kept})

    def _restore(self, state: State) -> None:
        tensors, scalars = state.tensors, {k: v for k, v in state.scalars.items() if k != "fingerprint"}
        try:
            self.field.network.load_state_dict(state.under("network."))
            self.best, self.beside = state.under("best."), state.under("beside.")
            self.field.scale, self.field.offset = float(scalars.pop("scale")), float(scalars.pop("offset"))
        except (RuntimeError, KeyError):
            raise InputError(
                "the checkpoint is of another network; give the same settings (of a run of a version before "
                "--network.directions there are 3)",
                field="resume",
            ) from None
        self.optimiser.restore(state.under("optimiser."))
        self.generator.set_state(tensors["generator"])
        density = tensors.get("density")
        self.objective.density.values = None if density is None else density.clone().to(self.device)
        self.history = list(scalars.pop("history"))
        self.watch.restore(scalars.pop("watch"))
        edge = int(scalars.pop("edge"))
        if edge != self.edge:
            self._refine(edge)
            self.history.pop()
        self.data.restore(int(scalars.pop("stage", 0)), state.under("data."))
        self._recount()
        self.budget.restore(scalars.pop("budget"))
        for name, value in scalars.items():
            setattr(self, name, value)

    def _result(self, outcome: Outcome) -> Reconstruction:
        state, cycles = self._capture(), self.budget.cycles
        if cycles is not None and self.best:
            (error,) = self.ranks.decided([self._error()], self.device)
            if not error <= min(cycles.errors):  # or it is none
                self.field.network.load_state_dict(self.best)
                if self.beside:
                    self.data.restore(self.data.stage, self.beside)
        if not outcome.failed:
            again = f"; taken back {self.retries} time(s) to the last good state" if self.retries else ""
            outcome = Outcome(outcome.reason, outcome.message + again + self.watch.remark + self.network.remark)
        self.field.network.eval().requires_grad_(False)
        ambient = self.objective.at_ambient(LEVEL_POINTS, torch.Generator().manual_seed(0))
        if ambient is not None and self.data.open and self.field.network.limits == UNBOUNDED:
            self.field.offset = float(ambient.mean())  # the constant that the data leave open
        return Reconstruction(
            field=self.field,
            box=self.data.box,
            n_ambient=self.data.n_ambient,
            history=self.history,
            outcome=outcome,
            settings=asdict(self.settings),
            seconds=self.budget.seconds,
            peak_memory_bytes=peak_memory(self.device),
            device=str(self.device),
            state=state,
            quantity=self.data.quantity,
            rig=[] if self.data.refinement is None else self.data.refinement.table(),
            axis=self.data.axis,
        )
