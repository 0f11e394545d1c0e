"""The frames of a chunk of time as the training data of one network over space and time.

The geometry of the rays is there once, what they measured for every frame; each instant has the ambient region of its
own flow masks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.transfer import sent
from nerif.data.measurement import Measurement
from nerif.fields.network import UNBOUNDED
from nerif.fields.space_time import SpaceTimeField, SpaceTimeNetwork
from nerif.forward.base import ForwardModel
from nerif.geometry import Rays
from nerif.geometry.symmetry import NO_SYMMETRY
from nerif.reconstruction.bounds import in_units
from nerif.reconstruction.device import resolve_device
from nerif.reconstruction.files import digest
from nerif.reconstruction.neural.settings import TrainingSettings
from nerif.reconstruction.neural.training import LEVEL_POINTS
from nerif.reconstruction.neural.training_data import FrameData, TrainingData
from nerif.reconstruction.target import Part, Target

__all__ = ["ChunkData"]

INSTANTS = 4  # looked at for where the fields vary
AMBIENT_FRAMES = 8  # at whose instants the ambient is pinned in one step


class ChunkData(TrainingData):
    """The rays of some frames with what they measured, and the ambient region of each.

    Parameters
    ----------
    settings : TrainingSettings
    frames : FrameData of each, on the CPU; the same cameras in all, though some may be missing in a frame
    tau : (frame,) instants in [-1, 1]
    time_octaves : of the encoding of time

    Raises
    ------
    InputError
        If no frame has all the views that the others have, or a symmetry is asked for.
    """

    def __init__(
        self, settings: TrainingSettings, frames: Sequence[FrameData], tau: Float[Tensor, " f"], time_octaves: int
    ) -> None:
        if settings.symmetry != NO_SYMMETRY:
            raise InputError(
                f"symmetry: expected {NO_SYMMETRY} for frames trained together, got '{settings.symmetry}'; reconstruct "
                "frame by frame"
            )
        parts = {name: digest(f.fingerprint[name] for f in frames) for name in frames[0].fingerprint}
        parts["settings"] = digest([settings, tau, time_octaves])
        like = frames[0]
        device = resolve_device(settings.device)
        super().__init__(device, like.box, like.n_ambient, parts, like.open, like.quantity)
        self.bounds, self.shape, self.samples, self.lens_rays = like.bounds, like.shape, like.samples, like.lens_rays
        self.tau, self.time_octaves = tau, time_octaves
        self._tau = tau.to(device)
        self.regions = [frame.ambient for frame in frames]
        targets = [frame.target for frame in frames]
        squares = [target.chi_square for target in targets]
        # each target is scaled so that its own mean square is 1; together they are weighed by their sigma
        mean = math.fsum(c * t.numbers for c, t in zip(squares, targets, strict=True)) / sum(t.numbers for t in targets)
        weights = [math.sqrt(c / mean) for c in squares]
        places = _places([f.measurement for f in frames], targets)
        self.films = [
            Film.of([t.parts[i] for t in targets], [p[i] for p in places], weights).to(device)
            for i in range(len(targets[0].parts))
        ]
        self.noise = 1 / mean if all(t.sigma_known for t in targets) else 0.0
        self.scale = float(np.sqrt(np.mean([t.scale**2 for t in targets])))

    def __len__(self) -> int:
        return sum(len(film) for film in self.films)

    def batch(self, index: Int[Tensor, " b"]) -> list[tuple[Part, Float[Tensor, " n"] | None]]:
        found: list[tuple[Part, Float[Tensor, " n"] | None]] = []
        first = 0
        for film in self.films:
            own = index[(index >= first) & (index < first + len(film))] - first
            if len(own):
                part, frame = film[sent(own, self.device)]
                found.append((part, self._tau[frame]))
            first += len(film)
        return found

    def ambient_points(
        self, count: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]] | None:
        chosen = torch.randint(len(self.regions), (AMBIENT_FRAMES,), generator=generator).tolist()
        known = [(i, region) for i in chosen for region in [self.regions[i]] if region is not None]
        if not known:
            return None
        points = [region.sample(count // AMBIENT_FRAMES, generator) for _, region in known]
        tau = torch.cat([self.tau[i].expand(len(p)) for (i, _), p in zip(known, points, strict=True)])
        return sent(torch.cat(points), self.device), sent(tau, self.device)

    @property
    def instants(self) -> list[Float[Tensor, " 1"] | None]:
        return [*torch.linspace(-1, 1, INSTANTS, device=self.device)[:, None]]

    def untrained(self) -> SpaceTimeField:
        network = SpaceTimeNetwork(self.shape, self.time_octaves, in_units(self.bounds, self.scale)).to(self.device)
        return SpaceTimeField(network, self.box, 0.0, self.scale)

    @torch.no_grad()
    def field(self, trained: SpaceTimeField, frame: int) -> SpaceTimeField:
        """Return the field at the instant of a frame, its ambient level taken off where the data leave it open."""
        field = SpaceTimeField(trained.network, self.box, float(self.tau[frame]), self.scale)
        region = self.regions[frame]
        if region is not None and self.open and trained.network.limits == UNBOUNDED:
            points = region.sample(LEVEL_POINTS, torch.Generator().manual_seed(0)).to(self.device)
            field.offset = float((field(points) / self.scale).mean())
        return field


@dataclass(frozen=True)
class Film:
    """What the rays of one technique measured over the frames; the rays are there once.

    Parameters
    ----------
    model : ForwardModel
    rays : (ray,) Rays
    measured, inverse_scale : (frame, ray, c) as a Part of a Target has them; 0 where nothing was measured
    known : (n,) which were measured, frame x rays + ray
    """

    model: ForwardModel
    rays: Rays
    measured: Float[Tensor, "f r c"]
    inverse_scale: Float[Tensor, "f r c"]
    known: Int[Tensor, " n"]

    @classmethod
    def of(cls, parts: Sequence[Part], places: Sequence[np.ndarray], weights: Sequence[float]) -> Film:
        """Lay the parts of all frames, whose rays have such places, over one another."""
        union, first = np.unique(np.concatenate(places), return_index=True)
        rays = Rays.concatenate([part.rays for part in parts])[torch.from_numpy(first)]
        measured = torch.zeros(len(parts), len(union), parts[0].measured.shape[1])
        inverse, known = torch.zeros_like(measured), torch.zeros(measured.shape[:2], dtype=torch.bool)
        for i, (part, place, weight) in enumerate(zip(parts, places, weights, strict=True)):
            row = torch.from_numpy(np.searchsorted(union, place))
            measured[i, row], inverse[i, row], known[i, row] = part.measured, part.inverse_scale * weight, True
        return cls(parts[0].model, rays, measured, inverse, known.reshape(-1).nonzero()[:, 0])

    def __len__(self) -> int:
        return len(self.known)

    def to(self, device: torch.device) -> Film:
        """Return the same on another device."""
        moved = {name: getattr(self, name).to(device) for name in ("rays", "measured", "inverse_scale", "known")}
        return replace(self, **moved)

    def __getitem__(self, index: Int[Tensor, " b"]) -> tuple[Part, Int[Tensor, " b"]]:
        """Return the rays of those numbers, and their frames."""
        place = self.known[index]
        frame, ray = place // len(self.rays), place % len(self.rays)
        return Part(self.model, self.rays[ray], self.measured[frame, ray], self.inverse_scale[frame, ray]), frame


def _places(frames: list[Measurement], targets: list[Target]) -> list[list[np.ndarray]]:
    """A number for each ray of each part of a target: the same pixel of the same view has the same in every frame."""
    whole = max(frames, key=lambda m: len(m.cameras))
    if any(name not in whole.names for frame in frames for name in frame.names):
        raise InputError("joint: expected a frame in which all views measured, got none; hold the lost ones out")
    _, height, width = whole.shape
    found = []
    for frame, target in zip(frames, targets, strict=True):
        number = torch.tensor([whole.names.index(name) for name in frame.names])
        numbers = []
        for part in target.parts:
            column, row = part.rays.pixel.round().long().unbind(-1)
            numbers.append(((number[part.rays.view.long()] * height + row) * width + column).numpy())
        found.append(numbers)
    return found
