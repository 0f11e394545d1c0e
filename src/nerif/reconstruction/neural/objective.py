"""The objective of the training: the terms of the loss, averaged over the rays of a batch."""

from __future__ import annotations

import torch
from torch import Tensor

from nerif.common.transfer import to_device
from nerif.fields.network import NeuralField
from nerif.forward.path_integral import LENS_RAYS
from nerif.reconstruction.neural.losses import DATA_TERMS, MixedPrecision, loss_terms, reduce
from nerif.reconstruction.neural.sampling import Batch, PixelSampling, SamplingDensity, sample_rays
from nerif.reconstruction.neural.training_data import TrainingData, shuffled
from nerif.reconstruction.neural.training_settings import TrainingSettings
from nerif.reconstruction.target import TechniqueData

__all__ = ["Objective"]

GAUGE_POINTS = 256  # per step
AMBIENT_RAYS = 1 << 14  # for the loss of the ambient field
WITHHELD_SAMPLES, WITHHELD_BATCH = 64, 128  # samples of a thin ray, pixels; with a lens 4 times the samples per pixel


class Objective:
    """The loss of a network on data.

    Parameters
    ----------
    field : with the network in full precision
    network : its network in the precision of the training
    generator : of the points of the gauge
    """

    def __init__(
        self, settings: TrainingSettings, data: TrainingData, field: NeuralField, network: MixedPrecision,
        generator: torch.Generator,
    ) -> None:  # fmt: skip
        self.settings, self.data, self.field, self.network = settings, data, field, network
        self.generator = generator

    def __call__(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of a batch, and its terms before they are weighted."""
        self.network.low = batch.low
        terms = self.terms(batch)
        loss = sum(getattr(self.settings.weights, name) * term for name, term in terms.items())
        assert isinstance(loss, Tensor)
        return loss, terms

    def terms(self, batch: Batch) -> dict[str, Tensor]:
        """Return the terms of the loss, each a mean over all measured values of the batch."""
        settings = self.settings
        terms: dict[str, Tensor] = {}
        for piece, share in zip(batch.pieces, shares([piece.numbers for piece in batch.pieces]), strict=True):
            piece_terms = loss_terms(
                self.field, self.network, piece.part, piece.rays, piece.s, piece.interval, settings.weights,
                settings.norm,
            )  # fmt: skip
            for name, term in piece_terms.items():
                terms[name] = terms[name] + share * term if name in terms else share * term
        errors = self.gauge_errors(GAUGE_POINTS, self.generator)
        if errors is not None:
            terms["gauge"] = errors.square().mean()
        return terms

    def ambient_term(self, parts: list[TechniqueData], numbers: list[int]) -> Tensor:
        """Return the value of each data term in the ambient field, for data with numbers of values that count."""
        terms = (reduce(part.ambient_residual, self.settings.norm) for part in parts)
        total = sum(share * term for share, term in zip(shares(numbers), terms, strict=True))
        assert isinstance(total, Tensor)
        return total

    def ambient_loss(self) -> float:
        """Return the loss of the ambient field, near which a network starts, on AMBIENT_RAYS rays."""
        data, weights = self.data, self.settings.weights
        parts = data.batch(shuffled(0, min(AMBIENT_RAYS, len(data)), len(data), self.settings.seed))
        term = self.ambient_term(parts, [part.measured.numel() for part in parts])
        return float(term) * sum(getattr(weights, name) for name in DATA_TERMS)

    def gauge_errors(self, count: int, generator: torch.Generator) -> Tensor | None:
        """Return the network in full precision less the field where it is known, 0 if ambient; None without a gauge."""
        if self.data.gauge is None:
            return None
        points, values = (to_device(part, self.data.device) for part in self.data.gauge.sample(count, generator))
        return self.field.network(self.field.normalise(points)) - values / self.field.scale

    @torch.no_grad()
    def withheld_residual(self, density: SamplingDensity) -> float:
        """Return the mean square of the residual over sigma (over 1 if unknown) on withheld pixels."""
        low, self.network.low, generator = self.network.low, False, torch.Generator().manual_seed(0)
        self.data.copy_nuisance()
        withheld, weights, total = self.data.withheld, self.settings.weights, 0.0
        assert withheld is not None
        for part in withheld.parts:
            thin = part.rays.lens is None
            size = WITHHELD_BATCH if thin else WITHHELD_BATCH // 4
            samples = (1, WITHHELD_SAMPLES) if thin else (LENS_RAYS, 4 * WITHHELD_SAMPLES // LENS_RAYS)
            draw = PixelSampling(*samples)
            for first in range(0, len(part), size):
                batch = self.data.with_rig(part[first : first + size], withheld=True)
                rays = draw.rays_of(batch, generator)
                s, interval = sample_rays(rays, draw.samples, generator, "adaptive", density, draw.rays)
                terms = loss_terms(self.field, self.network, batch, rays, s, interval, weights, "squared")
                data = [(getattr(weights, name), float(terms[name])) for name in DATA_TERMS if name in terms]
                mean = sum(weight * term for weight, term in data) / sum(weight for weight, _ in data)
                total += mean * batch.measured.numel()
        self.network.low = low
        return total / withheld.numbers * withheld.chi_square


def shares(numbers: list[int]) -> list[float]:
    """Return the share of each in the sum; 0 if the sum is 0."""
    total = max(sum(numbers), 1)
    return [number / total for number in numbers]
