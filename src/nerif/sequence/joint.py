"""One network over space and time for all frames of a chunk, so that frames share what they know. Runs in a worker.

min  mean over rays of all frames |d(x, t) - d|^2 / sigma^2  +  mean |N|^2 over the ambient region at random times
"""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerif.conventions import InputError
from nerif.fields.space_time import AtTimes, SpaceTimeField, SpaceTimeNetwork
from nerif.geometry import Rays
from nerif.measurement import Measurement
from nerif.measurement_sequence import MeasurementSequence
from nerif.reconstruction.base import State
from nerif.reconstruction.device import keep_freed_memory, resolve_device
from nerif.reconstruction.files import CHECKPOINT, read_state, write_state
from nerif.reconstruction.gauge import AmbientRegion
from nerif.reconstruction.losses import loss_terms
from nerif.reconstruction.neural import GAUGE_POINTS, GUIDE_EVERY
from nerif.reconstruction.optimiser import NetworkOptimiser
from nerif.reconstruction.precision import MixedPrecision
from nerif.reconstruction.sampling import Guide, sample_count, sample_rays
from nerif.reconstruction.target import Target
from nerif.sequence.frames import ATTEMPTS, Event, Plan, finished_frame
from nerif.sequence.store import DONE, MISSING, SequenceStore, chunk_tau

__all__ = ["Film", "reconstruct_jointly"]

CHECKPOINT_EVERY = 60.0  # seconds
GUIDE_TIMES = 4  # instants looked at for where the fields vary
TELL_EVERY = 50  # steps


@dataclass(frozen=True)
class Film:
    """The rays of a chunk of frames and what they measured: the geometry once, the displacements of every frame.

    Parameters
    ----------
    rays : (r) Rays of all pixels that see the box
    displacement : (frame, r, 2) px, NaN where not measured
    inverse_scale : (frame, r, 2) 1/px; see Target
    tau : (frame,) instants in [-1, 1]
    index_scale : see Target
    """

    rays: Rays
    displacement: Float[Tensor, "f r 2"]
    inverse_scale: Float[Tensor, "f r 2"]
    tau: Float[Tensor, " f"]
    index_scale: float

    @classmethod
    def of(cls, frames: list[Measurement], tau: Float[Tensor, " f"], open_faces: tuple[str, ...] = ()) -> Film:
        """Collect the frames; cameras are the same in all, though one may be missing in a frame."""
        targets = [Target.of(frame, open_faces) for frame in frames]
        whole = max(frames, key=lambda m: len(m.cameras))
        if any(name not in whole.names for frame in frames for name in frame.names):
            raise InputError("joint: expected a frame in which all views measured, got none; hold the lost ones out")
        keys = [_keys(frame, whole, open_faces) for frame in frames]
        known, first = np.unique(np.concatenate(keys), return_index=True)
        places = [np.searchsorted(known, key) for key in keys]
        every = Rays.concatenate([t.rays for t in targets])[torch.from_numpy(first)]
        displacement = torch.full((len(frames), len(known), 2), float("nan"))
        inverse = torch.zeros_like(displacement)
        mean_square = float(np.mean([t.displacement.square().mean() for t in targets])) or 1.0
        for i, (target, place) in enumerate(zip(targets, places, strict=True)):
            displacement[i, place] = target.displacement
            # each target is scaled so that its own mean square is 1; together they are weighed by their sigma
            undo = math.sqrt(target.chi_square_scale) if target.chi_square_scale else _rms(target)
            inverse[i, place] = target.inverse_scale * undo
        sigma_known = all(t.chi_square_scale for t in targets)
        good = torch.isfinite(displacement)
        scale = float((displacement[good] * inverse[good]).square().mean()) if sigma_known else 1.0
        inverse = inverse / math.sqrt(scale) if sigma_known else inverse / math.sqrt(mean_square)
        index_scale = float(np.sqrt(np.mean([t.index_scale**2 for t in targets])))
        return cls(every, displacement, inverse, tau, index_scale)

    def measured(self) -> Int[Tensor, " n"]:
        """Return the places, frame r + ray, that hold a measurement."""
        return torch.isfinite(self.displacement).all(-1).reshape(-1).nonzero()[:, 0]

    def batch(self, places: Int[Tensor, " b"], device: torch.device) -> tuple[Target, Float[Tensor, " b"]]:
        """Return those rays with what they measured, and the instants."""
        frame, ray = places // len(self.rays), places % len(self.rays)
        target = Target(self.rays[ray], self.displacement[frame, ray], self.inverse_scale[frame, ray], self.index_scale)
        return target.to(device), self.tau[frame].to(device)


def _rms(target: Target) -> float:
    return float(target.displacement.square().mean().sqrt()) or 1.0


def _keys(frame: Measurement, whole: Measurement, open_faces: tuple[str, ...]) -> np.ndarray:
    """A number for each ray of Target.of(frame): the same pixel of the same view has the same in every frame."""
    height, width = whole.displacement.shape[1:3]
    usable, keys = frame.usable, []
    for i, camera in enumerate(frame.cameras):
        mask = usable[i, : camera.image_size[0], : camera.image_size[1]]
        rows, columns = mask.nonzero(as_tuple=True)
        crosses = camera.rays(camera.pixel_grid()[mask]).clip(frame.box).crosses
        keys.append(((whole.names.index(camera.name) * height + rows) * width + columns)[crosses])
    found = torch.cat(keys)
    rays, _, _ = frame.rays()
    return found[~rays.exit_faces(frame.box, open_faces)].numpy()


def reconstruct_jointly(plan: Plan, first: int, last: int, event: Event = lambda told: None) -> None:
    """Reconstruct the frames first to last - 1 by one network, if the store lacks any of them."""
    if plan.threads:
        torch.set_num_threads(plan.threads)
    keep_freed_memory()
    sequence, store = MeasurementSequence.read(plan.measurement), SequenceStore(plan.out)
    missing = [i for i in range(first, last) if store.status[i] == MISSING]
    if not missing:
        return
    event({"frame": missing[0], "what": "begun"})
    begun = time.perf_counter()
    frames: dict[int, Measurement] = {}
    for i in range(first, last):
        try:
            frame = sequence.frame(i)
            frames[i] = frame.select([name for name in frame.names if name not in plan.hold_out])
        except InputError as error:
            if store.status[i] == MISSING:
                store.fail(i, str(error), 1)
                event({"frame": i, "what": "failed", "reason": str(error)})
    if not frames:
        return
    tau = torch.tensor([chunk_tau(sequence.times, i, first, last) for i in frames], dtype=torch.float32)
    kept = plan.out.with_name(plan.out.name + ".joint") / str(first)
    reason = ""
    for attempt in range(ATTEMPTS):
        careful = replace(plan, cold=replace(plan.cold, learning_rate=plan.cold.learning_rate / 2**attempt))
        try:
            film = Film.of(list(frames.values()), tau, plan.cold.open_faces)
            training = _Training(careful, film, next(iter(frames.values())))
            training.run(kept, lambda share: event({"frame": first, "what": "share", "share": share * len(missing)}))
            break
        except (InputError, ArithmeticError, RuntimeError, MemoryError) as error:
            reason = str(error) or type(error).__name__
            shutil.rmtree(kept, ignore_errors=True)
    else:
        for i in frames:
            if store.status[i] == MISSING:
                store.fail(i, reason, ATTEMPTS)
                event({"frame": i, "what": "failed", "reason": reason})
        return
    seconds = (time.perf_counter() - begun) / len(frames)
    for i, t in zip(frames, tau.tolist(), strict=True):
        if store.status[i] != DONE:
            begun = time.perf_counter()
            found = finished_frame(plan, training.field(t), sequence.frame(i), str(training.device))
            found = replace(found, seconds=seconds + time.perf_counter() - begun, steps=plan.joint_steps)
            store.write_frame(i, found)
            event({"frame": i, "what": "done", "seconds": found.seconds})
    shutil.rmtree(kept, ignore_errors=True)


class _Training:
    """One run over the frames of a chunk."""

    def __init__(self, plan: Plan, film: Film, like: Measurement) -> None:
        self.settings, self.film, self.like = plan.cold, film, like
        settings = plan.cold
        self.steps = plan.joint_steps * len(film.tau)
        self.device = resolve_device(settings.device)
        self.generator = torch.Generator().manual_seed(settings.seed)
        self.ambient = AmbientRegion.of(like, settings.ambient_faces or like.ambient_faces)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            self.network = SpaceTimeNetwork(settings.network, plan.time_octaves).to(self.device)
        self.middle = SpaceTimeField(self.network, like.box, 0.0, film.index_scale)  # scales are those of all instants
        self.low = MixedPrecision(self.network, self.device, settings.precision, settings.compile)
        self.guide = Guide(self.middle)
        self.optimiser = NetworkOptimiser(settings.optimiser, self.network, settings.betas, settings.momentum)
        self.measured, self.order = film.measured(), torch.empty(0, dtype=torch.long)
        self.step, self.parent = 0, os.getppid()

    def run(self, kept: Path, tell: Callable[[float], None]) -> None:
        """Train to the end, from the last checkpoint if there is one."""
        if (kept / CHECKPOINT).is_file():
            self._restore(read_state(kept))
        written = time.monotonic()
        while self.step < self.steps:
            loss = self._loss()
            self.optimiser.zero_grad()
            loss.backward()
            rate = self._rate()
            self.optimiser.step({"adam": rate, "muon": rate * self.settings.matrix_rate})
            self.step += 1
            if os.getppid() != self.parent:  # the command was killed, and may run again
                os._exit(1)
            if self.step % TELL_EVERY == 0:
                if not math.isfinite(float(loss.detach())):
                    raise ArithmeticError(f"joint: the loss is not finite at step {self.step}; try a smaller rate")
                tell(self.step / self.steps)
            if time.monotonic() - written > CHECKPOINT_EVERY:
                kept.mkdir(parents=True, exist_ok=True)
                write_state(kept, self._capture())
                written = time.monotonic()
        self.network.eval().requires_grad_(False)

    def _loss(self) -> Tensor:
        settings, progress = self.settings, self.step / self.steps
        self.low.low = progress < settings.full_precision_from
        count = sample_count(progress, *settings.samples, settings.sample_jitter, self.generator)
        rays = min(max(1, settings.points_per_batch // count), len(self.measured))
        if len(self.order) < rays:
            self.order = torch.cat([self.order, torch.randperm(len(self.measured), generator=self.generator)])
        chosen, self.order = self.order[:rays], self.order[rays:]
        target, tau = self.film.batch(self.measured[chosen], self.device)
        if settings.sampling == "adaptive" and self.step and self.step % GUIDE_EVERY == 0:
            self._look()
        s, interval = sample_rays(target.rays, count, self.generator, settings.sampling, self.guide)
        terms = loss_terms(
            self.middle, AtTimes(self.low, tau), target, s, interval,
            settings.weights, settings.model, settings.norm, self.like.n_ambient,
        )  # fmt: skip
        points = self.middle.normalise(self.ambient.sample(GAUGE_POINTS, self.generator).to(self.device))
        instants = 2 * torch.rand(len(points), generator=self.generator).to(self.device) - 1
        terms["gauge"] = self.network(torch.cat([points, instants[:, None]], dim=1)).square().mean()
        loss = sum(getattr(settings.weights, name) * term for name, term in terms.items())
        assert isinstance(loss, Tensor)
        return loss

    def _look(self) -> None:
        """Where the fields vary: the largest slope of a few instants."""
        largest = None
        for tau in torch.linspace(-1, 1, GUIDE_TIMES, device=self.device):
            self.guide.update(AtTimes(self.low, tau[None]))
            assert self.guide.values is not None
            largest = self.guide.values if largest is None else torch.maximum(largest, self.guide.values)
        self.guide.values = largest

    def _rate(self) -> float:
        rate = self.settings.learning_rate * min(1.0, (self.step + 1) / self.settings.warm_up)
        return rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * self.step / self.steps)))

    @torch.no_grad()
    def field(self, tau: float) -> SpaceTimeField:
        """Return the field at an instant, its ambient level taken off."""
        points = self.ambient.sample(1 << 14, torch.Generator().manual_seed(0)).to(self.device)
        field = SpaceTimeField(self.network, self.like.box, tau, self.film.index_scale)
        field.offset = float((field(points) / self.film.index_scale).mean())
        return field

    def _capture(self) -> State:
        tensors = {f"network.{k}": v.clone() for k, v in self.network.state_dict().items()}
        tensors |= {f"optimiser.{k}": v for k, v in self.optimiser.tensors().items()}
        tensors |= {"generator": self.generator.get_state(), "order": self.order.clone()}
        if self.guide.values is not None:
            tensors["guide"] = self.guide.values.clone()
        return State(tensors, {"step": self.step})

    def _restore(self, state: State) -> None:
        found = state.tensors
        self.network.load_state_dict({k[8:]: v for k, v in found.items() if k.startswith("network.")})
        self.optimiser.restore({k[10:]: v for k, v in found.items() if k.startswith("optimiser.")})
        self.generator.set_state(found["generator"])
        self.order, self.step = found["order"].clone(), int(state.scalars["step"])
        self.guide.values = found["guide"].to(self.device) if "guide" in found else None
