"""What a training minimises: a batch of rays, the samples on them, and the terms of the loss."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from nerif.fields.mlp import NeuralField
from nerif.fields.space_time import AtTimes, with_time
from nerif.reconstruction.losses import DATA, Evaluator, loss_terms, reduce
from nerif.reconstruction.parallel import Ranks
from nerif.reconstruction.precision import MixedPrecision
from nerif.reconstruction.sampling import SamplingDensity, sample_count, sample_rays
from nerif.reconstruction.settings import TrainingSettings
from nerif.reconstruction.target import Part
from nerif.reconstruction.training_data import TrainingData

__all__ = ["Objective", "Piece"]

GAUGE_POINTS = 256  # a step
JUDGED_SAMPLES, JUDGED_AT_ONCE = 64, 128  # of a ray that is held back; such rays at once


@dataclass(frozen=True)
class Piece:
    """Rays of one technique in a step.

    Parameters
    ----------
    part : rays, what they measured, and the forward model
    tau : (n,) their instants, or None
    s, interval : (n, m) path lengths of the samples, and the length that each stands for, mm
    """

    part: Part
    tau: Tensor | None
    s: Tensor
    interval: Tensor


class Objective:
    """The loss of a network on data.

    Parameters
    ----------
    settings : TrainingSettings
    data : TrainingData
    field : NeuralField, of which loss and samples are
    network : its network, in the precision of the training
    generator : of the samples
    ranks : processes that share a batch
    """

    def __init__(
        self, settings: TrainingSettings, data: TrainingData, field: NeuralField, network: MixedPrecision,
        generator: torch.Generator, ranks: Ranks,
    ) -> None:  # fmt: skip
        self.settings, self.data, self.field, self.network = settings, data, field, network
        self.generator, self.ranks = generator, ranks
        self.density = SamplingDensity(field)

    def samples(self, progress: float) -> int:
        """Draw how many samples a ray has in a step at that progress."""
        settings = self.settings
        return sample_count(progress, *settings.samples, settings.sample_jitter, self.generator)

    def rays(self, count: int) -> int:
        """Return how many rays a step has, of so many samples each."""
        return min(max(self.ranks.size, self.settings.points_per_batch // count), len(self.data))

    def batch(self, index: Int[Tensor, " b"], count: int) -> tuple[list[Piece], int]:
        """Return this process's share of the rays of those numbers, with `count` samples each, and how many measured
        numbers all processes have.
        """
        batch, sampling = self.data.batch(index), self.settings.sampling
        pieces, mine = [], self.ranks.share
        for part, tau in batch:
            s, interval = sample_rays(part.rays, count, self.generator, sampling, self.density)
            pieces.append(Piece(part[mine], None if tau is None else tau[mine], s[mine], interval[mine]))
        return [p for p in pieces if len(p.part)], sum(part.measured.numel() for part, _ in batch)

    def terms(self, pieces: list[Piece]) -> dict[str, Tensor]:
        """Return the terms of the loss, each the mean over all measured numbers of the pieces."""
        settings = self.settings
        terms: dict[str, Tensor] = {}
        for piece, share in shares(pieces):
            found = loss_terms(
                self.field, self._at(piece.tau), piece.part, piece.s, piece.interval, settings.weights, settings.norm
            )
            for name, term in found.items():
                terms[name] = terms[name] + share * term if name in terms else share * term
        ambient = self.at_ambient(GAUGE_POINTS, self.generator)
        if ambient is not None:
            terms["gauge"] = ambient.square().mean()
        return terms

    def of_nothing(self, pieces: list[Piece]) -> Tensor:
        """Return what the loss of the pieces would be in the ambient field."""
        empty = sum(share * reduce(piece.part.of_nothing, self.settings.norm) for piece, share in shares(pieces))
        assert isinstance(empty, Tensor)
        return empty

    def look(self) -> None:
        """Look at where the field varies."""
        self.density.update(*(self._at(tau) for tau in self.data.instants))

    def at_ambient(self, count: int, generator: torch.Generator) -> Tensor | None:
        """Return what the network gives where it should give 0, in full precision; None where no place is known."""
        found = self.data.ambient_points(count, generator)
        if found is None:
            return None
        points, tau = found
        return self.field.network(with_time(self.field.normalise(points), tau))

    @torch.no_grad()
    def held_back(self) -> float:
        """Return the mean square of the residual over sigma (over 1, where it is not known) on the rays held back."""
        low, self.network.low, drawn = self.network.low, False, torch.Generator().manual_seed(0)
        held, weights, total = self.data.held_back, self.settings.weights, 0.0
        assert held is not None
        for part in held.parts:
            for first in range(0, len(part), JUDGED_AT_ONCE):
                some = part[first : first + JUDGED_AT_ONCE]
                s, interval = sample_rays(some.rays, JUDGED_SAMPLES, drawn, "adaptive", self.density)
                terms = loss_terms(self.field, self.network, some, s, interval, weights, "squared")
                data = [(getattr(weights, name), float(terms[name])) for name in DATA if name in terms]
                mean = sum(weight * term for weight, term in data) / sum(weight for weight, _ in data)
                total += mean * some.measured.numel()
        self.network.low = low
        return total / held.numbers * held.chi_square

    def _at(self, tau: Tensor | None) -> Evaluator:
        """The network as a function of space, at the instants given."""
        return self.network if tau is None else AtTimes(self.network, tau)


def shares(pieces: list[Piece]) -> Iterator[tuple[Piece, float]]:
    """Give each piece with its share of all measured numbers."""
    total = sum(piece.part.measured.numel() for piece in pieces)
    for piece in pieces:
        yield piece, piece.part.measured.numel() / total
