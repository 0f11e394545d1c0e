"""NeRIF: a coordinate network trained until the displacements it predicts match those measured (paper, Alg. 1)."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from torch import Tensor

from nerif.conventions import InputError, parse_faces
from nerif.fields.base import Field
from nerif.fields.mlp import Network, NetworkShape, NeuralField
from nerif.measurement import Measurement
from nerif.physics.deflection import MODELS
from nerif.reconstruction.base import OnStep, Outcome, Reconstruction, Reconstructor, State, Step
from nerif.reconstruction.device import peak_memory, resolve_device
from nerif.reconstruction.gauge import AmbientRegion
from nerif.reconstruction.losses import LossWeights, loss_terms
from nerif.reconstruction.optimiser import OPTIMISERS, NetworkOptimiser
from nerif.reconstruction.parallel import Ranks
from nerif.reconstruction.precision import MixedPrecision
from nerif.reconstruction.sampling import Guide, sample_count, sample_rays
from nerif.reconstruction.target import Target
from nerif.reconstruction.warm_start import adopt, fit_network

__all__ = ["NeRIF"]

CHOICES = {
    "model": MODELS,
    "optimiser": OPTIMISERS,
    "sampling": ("adaptive", "random", "shifted", "regular"),
    "norm": ("l2", "squared"),
    "schedule": ("cosine", "constant"),
    "precision": ("auto", "float32", "tf32", "bf16"),
    "compile": ("auto", "on", "off"),
}
RETRIES = 5  # times a run that turned non-finite is taken back before it gives up
GAUGE_POINTS = 256  # a step
GUIDE_EVERY = 60  # steps between looks at where the field varies
LOG_EVERY, KEEP_EVERY = 20, 200  # steps


@dataclass(frozen=True)
class NeRIF(Reconstructor):
    """Neural refractive index field."""

    network: NetworkShape = field(default_factory=NetworkShape)
    """Size of the network."""
    weights: LossWeights = field(default_factory=LossWeights)
    """Weights of the terms of the loss."""
    norm: str = "squared"
    """Either "squared" residuals (maximum likelihood for Gaussian noise) or "l2", the paper's."""
    model: str = "lever_arm"
    """Forward model: lever_arm, paraxial, or curved (along the ray that the present field bends)."""
    samples: tuple[int, int] = (12, 24)
    """M at the start and at the end; a step samples N ~ Uniform(M - jitter, M + jitter) points a ray."""
    sample_jitter: int = 4
    """Half-range of the random number of samples a ray, see samples."""
    sampling: str = "adaptive"
    """In equal intervals, one draw each ("random", the paper's), one a ray ("shifted") or midpoints ("regular"), or
    "adaptive", where the field varies."""
    points_per_batch: int = 8192
    """Sample points of a step; a step takes points_per_batch / N rays."""
    optimiser: str = "muon"
    """Muon for weight matrices and Adam for the rest, or adam for all (the paper's)."""
    learning_rate: float = 1.5e-2
    """Adam's, at its highest."""
    betas: tuple[float, float] = (0.9, 0.99)
    """Adam's decay rates."""
    matrix_rate: float = 2.0
    """Muon's learning rate, in units of Adam's."""
    momentum: float = 0.9
    """Muon's."""
    warm_up: int = 50
    """Steps over which the learning rate rises; with the cosine schedule."""
    schedule: str = "cosine"
    """Learning rate: "cosine" to 1 % of the learning rate, or "constant" (the paper's)."""
    epochs: float = 40.0
    """Stop after so many passes over all rays (the paper's n_outer)."""
    max_steps: int = 0
    """Stop after so many steps; 0 for no limit."""
    time_limit: float = 0.0
    """Stop after so many seconds; 0 for no limit."""
    stop_ratio: float = 0.0
    """Stop when the loss is below this share of the initial loss; 0 never (paper: 0.005)."""
    fit_steps: int = 400
    """Steps in which the network is fitted to the field it starts from (--start-from)."""
    rate_after_fit: float = 0.3
    """Share of the learning rate that a run goes on with from such a start."""
    ambient_faces: tuple[str, ...] = ()
    """Faces on which the index is ambient; empty: those of the measurement."""
    open_faces: tuple[str, ...] = ()
    """Faces through which flow leaves the box; rays that cross them are dropped."""
    seed: int = 0
    """Of weights and samples; makes a CPU run repeatable."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, ..."""
    precision: str = "auto"
    """One of auto, float32, tf32, bf16 (mixed; the last part of the run in float32)."""
    full_precision_from: float = 0.85
    """Share of the run after which bf16 gives way to float32."""
    compile: str = "auto"
    """Compile the network: on, off, or auto (on CUDA only)."""

    def __post_init__(self) -> None:
        for name, allowed in CHOICES.items():
            if getattr(self, name) not in allowed:
                raise InputError(f"{name}: expected one of {', '.join(allowed)}, got '{getattr(self, name)}'")
        for name in (
            "epochs",
            "learning_rate",
            "matrix_rate",
            "points_per_batch",
            "fit_steps",
            "rate_after_fit",
            "warm_up",
        ):
            if not getattr(self, name) > 0:
                raise InputError(f"{name}: expected a positive number, got {getattr(self, name)}")
        for name in ("max_steps", "time_limit", "stop_ratio", "sample_jitter"):
            if not getattr(self, name) >= 0:
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")
        if not (len(self.samples) == 2 and min(self.samples) > self.sample_jitter):
            raise InputError(
                f"samples: expected two counts above sample_jitter ({self.sample_jitter}), got {self.samples}"
            )
        if self.points_per_batch < max(self.samples) + self.sample_jitter:
            raise InputError(
                f"points_per_batch: expected room for one ray ({max(self.samples) + self.sample_jitter} points), "
                f"got {self.points_per_batch}"
            )
        if (self.weights.head or self.weights.consistency) and not self.network.gradient_head:
            raise InputError("weights: the head and consistency terms need gradient_head = true")
        parse_faces(self.ambient_faces)
        parse_faces(self.open_faces, "open_faces")

    def __call__(
        self,
        measurement: Measurement,
        on_step: OnStep | None = None,
        resume: State | None = None,
        start: Field | None = None,
    ) -> Reconstruction:
        return _Training(self, measurement, resume, start).run(on_step)


class _Training:
    """One run: the data, the network, its optimiser, and the loop."""

    def __init__(
        self, settings: NeRIF, measurement: Measurement, resume: State | None, start: Field | None = None
    ) -> None:
        self.settings, self.measurement = settings, measurement
        self.ranks = Ranks.from_environment()
        self.device = resolve_device(settings.device)
        self.ranks.join(self.device)
        self.generator = torch.Generator().manual_seed(settings.seed)
        faces = settings.ambient_faces or measurement.ambient_faces
        self.ambient = AmbientRegion.of(measurement, faces)
        self.target = Target.of(measurement, settings.open_faces).to(self.device)
        self.count = len(self.target)
        if self.count < self.ranks.size:
            raise InputError(
                f"torchrun: expected at least a ray a process, got {self.count} rays for {self.ranks.size}"
            )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            network = Network(settings.network)
        self.field = NeuralField(network.to(self.device), measurement.box, self.target.index_scale)
        self.guide = Guide(self.field)
        self.optimiser = NetworkOptimiser(settings.optimiser, network, settings.betas, settings.momentum)
        self.network = MixedPrecision(network, self.device, settings.precision, settings.compile)
        self.history: list[dict[str, float]] = []
        self.order = torch.empty(0, dtype=torch.long)
        self.step, self.rays_done, self.retries, self.rate = 0, 0, 0, 1.0
        self.initial_loss, self.running = float("nan"), float("nan")
        self.spent, self.started = 0.0, time.perf_counter()
        self.agreed_seconds = 0.0
        if resume is not None:
            self._restore(resume)
            start = None
        self.start = start
        self.good = self._capture()

    # -- the loop ------------------------------------------------------------------------------------------------

    def run(self, on_step: OnStep | None) -> Reconstruction:
        """Train until something says stop, and return what there is."""
        settings, outcome = self.settings, self._stop() or self._fit(on_step)
        clock, rays_then = time.perf_counter(), self.rays_done
        while outcome is None:
            self._agree()
            target, s, interval, rays = self._batch()
            terms = self._terms(target, s, interval)
            loss = sum(getattr(settings.weights, name) * term for name, term in terms.items())
            assert isinstance(loss, Tensor)
            rate = self._learning_rate()
            self.optimiser.zero_grad()
            loss.backward()
            self.ranks.average_gradients(self.field.network, len(target), rays)
            self.optimiser.step({"adam": rate, "muon": rate * settings.matrix_rate})
            self.step += 1
            outcome = self._stop()
            if self.device.type == "cuda" and self.step % LOG_EVERY and outcome is None:
                continue  # looking at a number waits for the GPU, so look now and then
            figures = torch.stack([term.detach().float() for term in (*terms.values(), loss)])
            values = dict(zip((*terms, "loss"), self.ranks.average(figures, len(target), rays).tolist(), strict=True))
            if not math.isfinite(values["loss"]) or (outcome is not None and not self._finite()):
                outcome = self._take_back()
                continue
            self._follow(values["loss"])
            speed = (self.rays_done - rays_then) / max(time.perf_counter() - clock, 1e-9)
            if self.step % LOG_EVERY == 0 or self.step == 1 or outcome is not None:
                self._log(values, speed)
            if self.step % KEEP_EVERY == 0 and self._finite():
                self.good = self._capture()
            if self._asked(on_step, self._tell(values, speed)) and outcome is None:
                outcome = Outcome("interrupted", "stopped on request; --resume goes on from here")
        return self._result(outcome)

    def _agree(self) -> None:
        """Let all processes go by the clock of the first (on GPUs now and then: it waits for them)."""
        if self.ranks.size > 1 and (self.device.type == "cpu" or self.step % LOG_EVERY == 0):
            (self.agreed_seconds,) = self.ranks.decided([self._clock()], self.device)

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
            if step % LOG_EVERY == 0 or step == 1:
                self.history.append({**self._where(), **values})
            self._agree()
            outcome = self._stop()
            if self._asked(on_step, self._tell(values, 0.0)) and outcome is None:
                outcome = Outcome("interrupted", "stopped while fitting the start; --resume goes on from here")
            return outcome is not None

        self.network.low = True
        if not adopt(self.field, self.start):
            fit_network(
                self.field, self.network, self.start, settings.fit_steps, settings.points_per_batch,
                settings.learning_rate, self.generator, log,
            )  # fmt: skip
        self.guide.update(self.network)
        self.rate, self.good = settings.rate_after_fit, self._capture()
        return outcome

    def _batch(self) -> tuple[Target, Tensor, Tensor, int]:
        """The next rays of this epoch's random order and their samples: this process's share, and how many in all."""
        settings = self.settings
        count = sample_count(self.progress, *settings.samples, settings.sample_jitter, self.generator)
        rays = min(max(self.ranks.size, settings.points_per_batch // count), self.count)
        if len(self.order) < rays:
            self.order = torch.cat([self.order, torch.randperm(self.count, generator=self.generator)])
        index, self.order = self.order[:rays], self.order[rays:]
        self.rays_done += rays
        target = self.target[index.to(self.device)]
        if settings.sampling == "adaptive" and self.step and self.step % GUIDE_EVERY == 0:
            self.guide.update(self.network)
        s, interval = sample_rays(target.rays, count, self.generator, settings.sampling, self.guide)
        mine = self.ranks.share
        return target[mine], s[mine], interval[mine], rays

    def _terms(self, target: Target, s: Tensor, interval: Tensor) -> dict[str, Tensor]:
        settings = self.settings
        self.network.low = self.progress < settings.full_precision_from
        terms = loss_terms(
            self.field, self.network, target, s, interval,
            settings.weights, settings.model, settings.norm, self.measurement.n_ambient,
        )  # fmt: skip
        points = self.ambient.sample(GAUGE_POINTS, self.generator).to(self.device)
        terms["gauge"] = self.field.network(self.field.normalise(points)).square().mean()
        return terms

    def _learning_rate(self) -> float:
        settings, rate = self.settings, self.rate * self.settings.learning_rate
        if settings.schedule == "cosine":
            rate *= min(1.0, (self.step + 1) / settings.warm_up)
            rate *= 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(self.progress, 1.0)))
        return rate

    # -- how far, and whether to stop -------------------------------------------------------------------------------

    @property
    def seconds(self) -> float:
        """Spent on training, earlier parts of a resumed run included."""
        return self._clock() if self.ranks.size == 1 else self.agreed_seconds

    def _clock(self) -> float:
        return self.spent + time.perf_counter() - self.started

    @property
    def epoch(self) -> float:
        """Passes over all rays."""
        return self.rays_done / self.count

    @property
    def progress(self) -> float:
        """0 at the start, 1 when the first of the limits is reached."""
        settings = self.settings
        shares = [self.epoch / settings.epochs]
        if settings.max_steps:
            shares.append(self.step / settings.max_steps)
        if settings.time_limit:
            shares.append(self.seconds / settings.time_limit)
        return max(shares)

    def _stop(self) -> Outcome | None:
        settings = self.settings
        if self.epoch >= settings.epochs:
            return Outcome("epochs", f"all {settings.epochs:g} epochs done")
        if settings.max_steps and self.step >= settings.max_steps:
            return Outcome("steps", f"all {settings.max_steps} steps done; a larger --max-steps may give more")
        if settings.time_limit and self.seconds >= settings.time_limit:
            return Outcome("time_limit", f"time limit of {settings.time_limit:g} s reached; more time may give more")
        if settings.stop_ratio and self.running <= settings.stop_ratio * self.initial_loss:
            return Outcome("converged", f"loss fell to {settings.stop_ratio:g} of its initial value")
        return None

    def _follow(self, loss: float) -> None:
        """A running mean of the loss; squares are rooted so that ratios mean the same for both norms."""
        loss = math.sqrt(loss) if self.settings.norm == "squared" else loss
        if math.isnan(self.initial_loss):
            self.initial_loss = self.running = loss
        self.running += 0.1 * (loss - self.running)

    def _finite(self) -> bool:
        """Whether the weights are: a finite loss can have a gradient that is not."""
        return all(bool(torch.isfinite(w).all()) for w in self.field.network.parameters())

    def _take_back(self) -> Outcome | None:
        """Return to the last good state with half the learning rate."""
        retries = self.retries + 1
        rate = self.rate / 2
        seconds = self.seconds
        self._restore(self.good)
        self.retries, self.rate, self.spent = retries, rate, seconds
        self.history.append({**self._where(), "taken_back": float(retries)})
        if retries > RETRIES:
            return Outcome(
                "diverged",
                f"loss turned non-finite {retries} times; kept the last good state of step {self.step}; "
                "try a smaller --learning-rate or --precision float32",
            )
        return None

    # -- what is told and kept -----------------------------------------------------------------------------------

    def _where(self) -> dict[str, float]:
        return {"step": float(self.step), "epoch": self.epoch, "seconds": self.seconds}

    def _log(self, values: dict[str, float], speed: float) -> None:
        self.history.append({**self._where(), **values, "rays_per_second": speed})

    def _tell(self, values: dict[str, float], speed: float) -> Step:
        return Step(self.step, self.epoch, self.seconds, min(self.progress, 1.0), values, speed, self._capture)

    def _capture(self) -> State:
        tensors = {f"network.{k}": v.detach().clone() for k, v in self.field.network.state_dict().items()}
        tensors |= {f"optimiser.{k}": v for k, v in self.optimiser.tensors().items()}
        tensors["generator"] = self.generator.get_state().clone()
        tensors["order"] = self.order.clone()
        if self.guide.values is not None:
            tensors["guide"] = self.guide.values.clone()
        names = ("step", "rays_done", "retries", "rate", "initial_loss", "running")
        scalars: dict[str, Any] = {name: getattr(self, name) for name in names}
        return State(tensors, {**scalars, "seconds": self.seconds, "history": list(self.history)})

    def _restore(self, state: State) -> None:
        network = {k[8:]: v for k, v in state.tensors.items() if k.startswith("network.")}
        try:
            self.field.network.load_state_dict(network)
        except RuntimeError:
            raise InputError("resume: the checkpoint is of another network; give the same settings") from None
        self.optimiser.restore({k[10:]: v for k, v in state.tensors.items() if k.startswith("optimiser.")})
        self.generator.set_state(state.tensors["generator"])
        self.order = state.tensors["order"].clone()
        guide = state.tensors.get("guide")
        self.guide.values = None if guide is None else guide.clone().to(self.device)
        scalars = dict(state.scalars)
        self.history = list(scalars.pop("history"))
        self.spent, self.started = scalars.pop("seconds"), time.perf_counter()
        for name, value in scalars.items():
            setattr(self, name, value)

    def _result(self, outcome: Outcome) -> Reconstruction:
        state = self._capture()
        if self.retries and outcome.reason != "diverged":
            taken_back = f"; taken back {self.retries} time(s) to the last good state after a non-finite loss"
            outcome = Outcome(outcome.reason, outcome.message + taken_back)
        self.field.network.eval().requires_grad_(False)
        self.field.offset = self._ambient_level()
        return Reconstruction(
            field=self.field,
            box=self.measurement.box,
            n_ambient=self.measurement.n_ambient,
            history=self.history,
            outcome=outcome,
            settings=asdict(self.settings),
            seconds=self.seconds,
            peak_memory_bytes=peak_memory(self.device),
            device=str(self.device),
            state=state,
        )

    @torch.no_grad()
    def _ambient_level(self) -> float:
        """Mean network output over the ambient region: the constant that the data leave open."""
        points = self.ambient.sample(1 << 14, torch.Generator().manual_seed(0)).to(self.device)
        return float(self.field.network(self.field.normalise(points)).mean())
