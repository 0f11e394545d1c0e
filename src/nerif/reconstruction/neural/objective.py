"""What a training minimises: a batch of rays, the samples on them, and the terms of the loss."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor

from nerif.fields.network import NeuralField
from nerif.forward.path_integral import LENS_RAYS, PathIntegral, project
from nerif.geometry import Rays
from nerif.reconstruction.neural.losses import DATA, loss_terms, reduce
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.precision import MixedPrecision
from nerif.reconstruction.neural.sampling import SamplingDensity, sample_count, sample_rays
from nerif.reconstruction.neural.settings import TrainingSettings
from nerif.reconstruction.neural.training_data import TrainingData, shuffled
from nerif.reconstruction.rig.refinement import MOMENTUM
from nerif.reconstruction.target import Part

__all__ = ["Objective", "Piece"]

GAUGE_POINTS = 256  # a step
EMPTY_RAYS = 1 << 14  # that the loss of the ambient field is taken over
JUDGED_SAMPLES, JUDGED_AT_ONCE = 64, 128  # of a thin ray that is held back, of a pixel with a lens four times as many
SETTLING = 24  # samples of a ray that brightness is fitted by
REFINED_SAMPLES, REFINED_RAYS, REFINED_AT_ONCE = 16, 4, 512
REFINED_FROM, REFINED_EVERY, REFINED_UNTIL, SLOWED_FROM = 0.1, 0.04, 0.94, 0.75  # shares of a run
SHOWN_EARLY, SHOWN_UNTIL = 0.26, 0.5  # shares by which data have shown that a rig is off: clearly, or at all
CLEARLY = 1.7
FEWEST = 4  # samples of a ray through a lens
MORE = 5  # rays through a lens, beyond two, that ask for as many samples as a thin ray has (docs/decisions/025)


@dataclass(frozen=True)
class Draw:
    """How a pixel is sampled: by so many rays through its lens, with so many samples each.

    Parameters
    ----------
    each : rays; 1 for a thin one
    samples : of a ray
    """

    each: int
    samples: int

    @property
    def points(self) -> int:
        """Samples of a pixel."""
        return self.each * self.samples

    def rays_of(self, part: Part, generator: torch.Generator) -> Rays:
        """Return the rays of pixels: their own, or so many through the lens in a row for each."""
        if part.rays.lens is None:
            return part.rays
        return part.rays.spread(self.each, generator)


@dataclass(frozen=True)
class Piece:
    """Rays of one technique in a step.

    Parameters
    ----------
    part : pixels, what they measured, and the forward model
    rays : theirs, or several through the lens in a row for each
    s, interval : (n, m) path lengths of the samples, and the length that each stands for, mm
    numbers : measured numbers of this process; 0 where it has no ray of the technique, and one of another process
        stands in, which counts for nothing: all processes average the same terms, and gradients of the same weights
    """

    part: Part
    rays: Rays
    s: Tensor
    interval: Tensor
    numbers: int


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

    def draw(self, progress: float) -> Draw:
        """Draw how a pixel is sampled in a step at that progress."""
        samples = sample_count(progress, *self.data.samples, self.settings.sample_jitter, self.generator)
        return self._draw(progress, samples)

    @property
    def typical(self) -> Draw:
        """How a pixel is sampled on average."""
        return self._draw(0.5, round(sum(self.data.samples) / 2))

    def _draw(self, progress: float, samples: int) -> Draw:
        last = self.data.lens_rays
        if last == 1:
            return Draw(1, samples)
        first = max(2, 2 * (last // 6))
        each = 2 * round((first + (last - first) * min(progress, 1.0)) / 2)
        return Draw(each, max(FEWEST, round((1 + (last - 2) / MORE) * samples / each)))

    def pixels(self, draw: Draw) -> int:
        """Return how many pixels a step has that are sampled so."""
        return min(max(self.ranks.size, self.settings.points_per_batch // draw.points), len(self.data))

    def batch(self, index: Int[Tensor, " b"], draw: Draw) -> tuple[list[Piece], int]:
        """Return this process's share of the pixels of those numbers, sampled so, and how many measured numbers all
        processes have.
        """
        batch = self.data.batch(index)
        pieces = [self._piece(part, draw) for part in batch]
        return pieces, sum(part.measured.numel() for part in batch)

    def _piece(self, part: Part, draw: Draw) -> Piece:
        """This process's share of a part, with its samples."""
        rays, mine = draw.rays_of(part, self.generator), self.ranks.share
        numbers = part.measured[mine].numel()
        mine = mine if numbers else slice(0, 1)
        each = len(rays) // max(len(part), 1)
        s, interval = sample_rays(rays, draw.samples, self.generator, self.settings.sampling, self.density, each)
        if self.ranks.size > 1:
            chosen = torch.arange(len(part), device=rays.near.device)[mine]
            own = (chosen[:, None] * each + torch.arange(each, device=chosen.device)).flatten()
            rays, s, interval = rays[own], s[own], interval[own]
        return Piece(part[mine], rays, s, interval, numbers)

    def terms(self, pieces: list[Piece]) -> dict[str, Tensor]:
        """Return the terms of the loss, each the mean over all measured numbers of the pieces."""
        settings = self.settings
        terms: dict[str, Tensor] = {}
        for piece, share in zip(pieces, shares([piece.numbers for piece in pieces]), strict=True):
            found = loss_terms(
                self.field, self.network, piece.part, piece.rays, piece.s, piece.interval, settings.weights,
                settings.norm,
            )  # fmt: skip
            for name, term in found.items():
                terms[name] = terms[name] + share * term if name in terms else share * term
        ambient = self.at_ambient(GAUGE_POINTS, self.generator)
        if ambient is not None:
            terms["gauge"] = ambient.square().mean()
        return terms

    def of_nothing(self, parts: Sequence[Part], numbers: Sequence[int]) -> Tensor:
        """Return what each of the terms that compare with the measured would be in the ambient field.

        Parameters
        ----------
        parts : rays, of one technique each
        numbers : measured numbers of each, by which they are weighed
        """
        terms = (reduce(part.of_nothing, self.settings.norm) for part in parts)
        empty = sum(share * term for share, term in zip(shares(numbers), terms, strict=True))
        assert isinstance(empty, Tensor)
        return empty

    def empty_loss(self) -> float:
        """Return the loss of the ambient field, near which a network begins, over as many rays as EMPTY_RAYS."""
        data, weights = self.data, self.settings.weights
        index = shuffled(0, min(EMPTY_RAYS, len(data)), len(data), self.settings.seed)
        parts = data.batch(index)
        term = self.of_nothing(parts, [part.measured.numel() for part in parts])
        return float(term) * sum(getattr(weights, name) for name in DATA)

    def look(self) -> None:
        """Look at where the field varies."""
        self.density.update(self.network)

    @torch.no_grad()
    def settle(self) -> None:
        """Fit what is open beside the field, such as the brightness of images, to the field so far."""
        for part in self.data.unsettled:
            rays = replace(part.rays, lens=None)
            seen = project(PathIntegral(part.model.integral, SETTLING), self.field, rays, self.data.device)
            part.model.settle(seen, part.measured, part.inverse_scale, rays)

    @torch.no_grad()
    def refine(self, progress: float) -> None:
        """Move the rig by a step of its refinement (refinement.py), the field as it is, where one is due."""
        data, rig = self.data, self.data.refinement
        if rig is None:
            return
        due = math.ceil((min(progress, REFINED_UNTIL) - REFINED_FROM) / REFINED_EVERY)
        if rig.done > max(due, 0) + 1:  # of the cycle before
            rig.done = 0
        if rig.done >= due or (progress > SHOWN_UNTIL and not rig.off):
            return

        def predict(part: Part, rays: Rays) -> Tensor:
            drawn = torch.Generator().manual_seed(rig.done)  # the same samples wherever the cameras are
            seen = []
            for some in torch.arange(len(rays)).split(REFINED_AT_ONCE):
                few = rays[some]
                each = 1 if few.lens is None else REFINED_RAYS
                few = few if each == 1 else few.spread(each, drawn)
                count = REFINED_SAMPLES if each == 1 else REFINED_SAMPLES // 2
                s, step = sample_rays(few, count, drawn, "adaptive", self.density, each)
                integral = PathIntegral(part.model.integral).along(self.field, few, s, step)
                seen.append(integral if each == 1 else few.mean_of(each, integral))
            return torch.cat(seen)

        momentum = MOMENTUM if progress < SLOWED_FROM else 0.0
        ask = CLEARLY if progress < SHOWN_EARLY else 1.0
        rig.step(data.refined_by(rig.done), predict, data.sigma_known, momentum, ask)

    def at_ambient(self, count: int, generator: torch.Generator) -> Tensor | None:
        """Return what the network gives where it should give 0, in full precision; None where no place is known."""
        points = self.data.ambient_points(count, generator)
        return None if points is None else self.field.network(self.field.normalise(points))

    @torch.no_grad()
    def withheld(self) -> float:
        """Return the mean square of the residual over sigma (over 1, where it is not known) on the rays held back."""
        low, self.network.low, drawn = self.network.low, False, torch.Generator().manual_seed(0)
        self.data.judge_alike()
        held, weights, total = self.data.withheld, self.settings.weights, 0.0
        assert held is not None
        for part in held.parts:
            thin = part.rays.lens is None
            at_once = JUDGED_AT_ONCE if thin else JUDGED_AT_ONCE // 4
            for first in range(0, len(part), at_once):
                some = self.data.refined(part[first : first + at_once], withheld=True)
                draw = Draw(1, JUDGED_SAMPLES) if thin else Draw(LENS_RAYS, 4 * JUDGED_SAMPLES // LENS_RAYS)
                rays = draw.rays_of(some, drawn)
                s, interval = sample_rays(rays, draw.samples, drawn, "adaptive", self.density, draw.each)
                terms = loss_terms(self.field, self.network, some, rays, s, interval, weights, "squared")
                data = [(getattr(weights, name), float(terms[name])) for name in DATA if name in terms]
                mean = sum(weight * term for weight, term in data) / sum(weight for weight, _ in data)
                total += mean * some.measured.numel()
        self.network.low = low
        return total / held.numbers * held.chi_square


def shares(numbers: Sequence[int]) -> list[float]:
    """Return the share that each has of all; of none, 0."""
    total = max(sum(numbers), 1)
    return [number / total for number in numbers]
