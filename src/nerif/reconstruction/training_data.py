"""What a network is trained on: rays with what they measured, and points where the index is known to be ambient.

A frame is one measurement at one instant. Data of several frames (sequence/chunk_data.py) tell the instant of each ray
and of each point as well: tau in [-1, 1].
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerif.fields.mlp import Network, NetworkShape, NeuralField
from nerif.geometry import Box
from nerif.measurement import Measurement
from nerif.reconstruction.bins import coarsest_edge
from nerif.reconstruction.device import resolve_device
from nerif.reconstruction.fingerprint import fingerprint
from nerif.reconstruction.gauge import AmbientRegion
from nerif.reconstruction.settings import TrainingSettings
from nerif.reconstruction.target import Target

__all__ = ["FrameData", "TrainingData"]


class TrainingData(ABC):
    """Rays and ambient points, at one instant or at several.

    Parameters
    ----------
    device : where batches are given
    box : Box, mm
    n_ambient : refractive index that the excess is counted from
    fingerprint : a digest of each part of the data, by its name
    """

    def __init__(self, device: torch.device, box: Box, n_ambient: float, fingerprint: dict[str, str]) -> None:
        self.device, self.box, self.n_ambient, self.fingerprint = device, box, n_ambient, fingerprint

    coarsest: int = 1
    """Edge of the largest bins that the data can be given in, px."""
    noise: float = 0.0
    """Mean square of the noise over that of what was measured; 0 where it is not known."""

    def refine(self, edge: int) -> None:
        """Give bins of another edge, px, from now on."""
        assert edge == 1, "these data are pixels always"

    @abstractmethod
    def __len__(self) -> int:
        """Rays of all instants."""

    @abstractmethod
    def batch(self, index: Int[Tensor, " b"]) -> tuple[Target, Float[Tensor, " b"] | None]:
        """Return the rays of those numbers with what they measured, and their instants."""

    @abstractmethod
    def ambient_points(
        self, count: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"] | None]:
        """Draw about `count` points at which the index is ambient, mm, and their instants."""

    @property
    @abstractmethod
    def instants(self) -> list[Float[Tensor, " 1"] | None]:
        """A few instants that stand for all."""

    @abstractmethod
    def untrained(self, shape: NetworkShape) -> NeuralField:
        """Return a field with random weights, drawn from torch's own generator."""


class FrameData(TrainingData):
    """One measurement.

    Parameters
    ----------
    settings : TrainingSettings
    measurement : Measurement
    coarsest : edge of the bins to begin with, px; None for what a picture of its size can do with
    """

    def __init__(self, settings: TrainingSettings, measurement: Measurement, coarsest: int | None = None) -> None:
        known = fingerprint(measurement, settings.open_faces)
        super().__init__(resolve_device(settings.device), measurement.box, measurement.n_ambient, known)
        self.settings, self.measurement = settings, measurement
        self.coarsest = coarsest_edge(measurement) if coarsest is None else coarsest
        self.ambient = AmbientRegion.of(measurement, settings.ambient_faces or measurement.ambient_faces)
        self.refine(self.coarsest)

    def refine(self, edge: int) -> None:
        self.target = Target.of(self.measurement, self.settings.open_faces, edge).to(self.device)
        self.noise = 1 / self.target.chi_square_scale if self.target.chi_square_scale else 0.0

    def __len__(self) -> int:
        return len(self.target)

    def batch(self, index: Int[Tensor, " b"]) -> tuple[Target, None]:
        return self.target[index.to(self.device)], None

    def ambient_points(self, count: int, generator: torch.Generator) -> tuple[Float[Tensor, "n 3"], None]:
        return self.ambient.sample(count, generator).to(self.device), None

    @property
    def instants(self) -> list[Float[Tensor, " 1"] | None]:
        return [None]

    def untrained(self, shape: NetworkShape) -> NeuralField:
        return NeuralField(Network(shape).to(self.device), self.box, self.target.index_scale)
