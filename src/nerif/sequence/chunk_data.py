"""The frames of a chunk of time as the training data of one network over space and time.

The geometry of the rays is there once, what they measured for every frame; each instant has the ambient region of its
own flow masks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerif.conventions import InputError
from nerif.fields.mlp import NetworkShape
from nerif.fields.space_time import SpaceTimeField, SpaceTimeNetwork
from nerif.geometry import Rays
from nerif.measurement import Measurement
from nerif.reconstruction.device import resolve_device
from nerif.reconstruction.fingerprint import digest
from nerif.reconstruction.settings import TrainingSettings
from nerif.reconstruction.target import Target
from nerif.reconstruction.training import LEVEL_POINTS
from nerif.reconstruction.training_data import FrameData, TrainingData

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
        If no frame has all the views that the others have.
    """

    def __init__(
        self, settings: TrainingSettings, frames: Sequence[FrameData], tau: Float[Tensor, " f"], time_octaves: int
    ) -> None:
        parts = {name: digest(f.fingerprint[name] for f in frames) for name in frames[0].fingerprint}
        parts["settings"] = digest([settings, tau, time_octaves])
        super().__init__(resolve_device(settings.device), frames[0].box, frames[0].n_ambient, parts)
        self.tau, self.time_octaves = tau, time_octaves
        self.regions = [frame.ambient for frame in frames]
        targets, places = [frame.target for frame in frames], _places([f.measurement for f in frames], settings)
        known, first = np.unique(np.concatenate(places), return_index=True)
        self.rays = Rays.concatenate([t.rays for t in targets])[torch.from_numpy(first)]
        self.displacement = torch.full((len(frames), len(known), 2), float("nan"))
        self.inverse_scale = torch.zeros_like(self.displacement)
        for i, (target, place) in enumerate(zip(targets, places, strict=True)):
            row = np.searchsorted(known, place)
            self.displacement[i, row] = target.displacement
            # each target is scaled so that its own mean square is 1; together they are weighed by their sigma
            own = target.chi_square_scale or float(target.displacement.square().mean()) or 1.0
            self.inverse_scale[i, row] = target.inverse_scale * math.sqrt(own)
        measured = torch.isfinite(self.displacement)
        scaled = self.displacement[measured] * self.inverse_scale[measured]
        mean_square = float(scaled.square().mean()) or 1.0
        self.inverse_scale /= math.sqrt(mean_square)
        self.noise = 1 / mean_square if all(t.chi_square_scale for t in targets) else 0.0
        self.measured = measured.all(-1).reshape(-1).nonzero()[:, 0]  # frame r + ray
        self.index_scale = float(np.sqrt(np.mean([t.index_scale**2 for t in targets])))

    def __len__(self) -> int:
        return len(self.measured)

    def batch(self, index: Int[Tensor, " b"]) -> tuple[Target, Float[Tensor, " b"]]:
        place = self.measured[index]
        frame, ray = place // len(self.rays), place % len(self.rays)
        target = Target(self.rays[ray], self.displacement[frame, ray], self.inverse_scale[frame, ray], self.index_scale)
        return target.to(self.device), self.tau[frame].to(self.device)

    def ambient_points(
        self, count: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
        chosen = torch.randint(len(self.regions), (AMBIENT_FRAMES,), generator=generator).tolist()
        points = [self.regions[i].sample(count // AMBIENT_FRAMES, generator) for i in chosen]
        tau = torch.cat([self.tau[i].expand(len(p)) for i, p in zip(chosen, points, strict=True)])
        return torch.cat(points).to(self.device), tau.to(self.device)

    @property
    def instants(self) -> list[Float[Tensor, " 1"] | None]:
        return [*torch.linspace(-1, 1, INSTANTS, device=self.device)[:, None]]

    def untrained(self, shape: NetworkShape) -> SpaceTimeField:
        network = SpaceTimeNetwork(shape, self.time_octaves).to(self.device)
        return SpaceTimeField(network, self.box, 0.0, self.index_scale)

    @torch.no_grad()
    def field(self, trained: SpaceTimeField, frame: int) -> SpaceTimeField:
        """Return the field at the instant of a frame, its ambient level taken off."""
        field = SpaceTimeField(trained.network, self.box, float(self.tau[frame]), self.index_scale)
        points = self.regions[frame].sample(LEVEL_POINTS, torch.Generator().manual_seed(0)).to(self.device)
        field.offset = float((field(points) / self.index_scale).mean())
        return field


def _places(frames: list[Measurement], settings: TrainingSettings) -> list[np.ndarray]:
    """A number for each ray of each frame's target: the same pixel of the same view has the same in every frame."""
    whole = max(frames, key=lambda m: len(m.cameras))
    if any(name not in whole.names for frame in frames for name in frame.names):
        raise InputError("joint: expected a frame in which all views measured, got none; hold the lost ones out")
    height, width = whole.displacement.shape[1:3]
    places = []
    for frame in frames:
        usable, numbers = frame.usable, []
        for i, camera in enumerate(frame.cameras):
            mask = usable[i, : camera.image_size[0], : camera.image_size[1]]
            rows, columns = mask.nonzero(as_tuple=True)
            crosses = camera.rays(camera.pixel_grid()[mask]).clip(frame.box).crosses
            numbers.append(((whole.names.index(camera.name) * height + rows) * width + columns)[crosses])
        rays, _, _ = frame.rays()
        places.append(torch.cat(numbers)[~rays.exit_faces(frame.box, settings.open_faces)].numpy())
    return places
