"""The objective of a training: a batch of rays, the samples along them, and the terms of the loss.

A ray has one random sample in each of N intervals (paper, Eq. (sample)). The paper's intervals are equal. Adaptive ones
are short where the present field varies: their bounds are quantiles of a density that follows |grad N| on a coarse
grid, and each sample is weighted by the length of its interval. This keeps the expectation of the integral and removes
most of its scatter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as functional
from jaxtyping import Float, Int
from torch import Tensor

from nerif.common.transfer import sent
from nerif.fields.network import NeuralField
from nerif.forward.path_integral import LENS_RAYS, PathIntegral, project
from nerif.geometry import Rays
from nerif.reconstruction.neural.losses import DATA_TERMS, Evaluator, MixedPrecision, loss_terms, reduce
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.settings import TrainingSettings
from nerif.reconstruction.neural.training_data import TrainingData, shuffled
from nerif.reconstruction.rig.refinement import MOMENTUM
from nerif.reconstruction.target import Part

__all__ = ["Draw", "Objective", "Piece", "SamplingDensity", "sample_count", "sample_rays"]

EVEN_SHARE = 0.1  # of the samples, spread evenly
DENSITY_BINS = 40  # along a ray
DENSITY_GRID = 24  # cells along each edge of the cube of network coordinates
GAUGE_POINTS = 256  # per step
AMBIENT_RAYS = 1 << 14  # for the loss of the ambient field
WITHHELD_SAMPLES, WITHHELD_BATCH = 64, 128  # samples of a thin ray, pixels; with a lens 4 times the samples per pixel
NUISANCE_SAMPLES = 24  # per ray
RIG_SAMPLES, RIG_LENS_RAYS, RIG_BATCH = 16, 4, 512  # samples of a thin ray, rays through a lens, pixels
RIG_FROM, RIG_EVERY, RIG_UNTIL, RIG_SLOW_FROM = 0.1, 0.04, 0.94, 0.75  # shares of the run
SIGN_UNTIL, EARLY, EARLY_FACTOR = 0.5, 0.26, 1.7  # a pose error must show by then; early ones by this factor clearer
MIN_LENS_SAMPLES = 4  # per ray through a lens
FULL_RAYS = 5  # rays through a lens, beyond two, that need as many samples as a thin ray (docs/decisions/025)


class SamplingDensity:
    """Density of samples in space, from the largest |grad N| of each cell and its neighbours."""

    def __init__(self, field: NeuralField) -> None:
        self.field = field
        self.values: Float[Tensor, "z y x"] | None = None  # None before the first update

    @torch.no_grad()
    def update(self, network: Evaluator) -> None:
        """Take the density from the present network."""
        device = next(self.field.network.parameters()).device
        axis = (torch.arange(DENSITY_GRID, device=device) + 0.5) / DENSITY_GRID * 2 - 1
        z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
        points = torch.stack([x, y, z], dim=-1).reshape(-1, 3)
        slopes = network.value_and_gradient(points, False)[1].float().norm(dim=-1)
        self.values = functional.max_pool3d(slopes.reshape(1, 1, *x.shape), 3, 1, 1)[0, 0]

    def along(self, rays: Rays) -> Float[Tensor, "n bins"]:
        """Return the density in equal bins along each ray; its mean is 1."""
        assert self.values is not None
        share = (torch.arange(DENSITY_BINS, device=rays.near.device) + 0.5) / DENSITY_BINS
        p = self.field.normalise(rays.at(rays.near[:, None] + share * (rays.far - rays.near)[:, None]))
        slopes = functional.grid_sample(
            self.values[None, None], p[None, :, :, None], padding_mode="border", align_corners=False
        )[0, 0, :, :, 0]
        slopes = slopes / slopes.mean(dim=1, keepdim=True).clamp_min(1e-12)
        density = EVEN_SHARE + (1 - EVEN_SHARE) * slopes
        return density / density.mean(dim=1, keepdim=True)


def sample_count(progress: float, first: int, last: int, jitter: int, generator: torch.Generator) -> int:
    """Draw N ~ Uniform(M - jitter, M + jitter), M growing from `first` to `last` with progress 0 to 1."""
    m = round(first + (last - first) * min(progress, 1.0))
    return max(2, m + int(torch.randint(-jitter, jitter + 1, (1,), generator=generator)))


def sample_rays(
    rays: Rays, count: int, generator: torch.Generator, sampling: str = "random",
    density: SamplingDensity | None = None, rays_per_pixel: int = 1,
) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m"]]:  # fmt: skip
    """Return path lengths t_i ~ U(t_n + (i-1)/N (t_f - t_n), t_n + i/N (t_f - t_n)) and lengths of the intervals, mm.

    Parameters
    ----------
    sampling : "random" (one draw per interval, the paper's), "shifted" (one draw per ray for all intervals), "adaptive"
        (shifted, in intervals from the density) or "regular" (midpoints)
    density : for "adaptive"; equal intervals before its first update
    rays_per_pixel : consecutive rays of one pixel; except for "random" their samples interleave evenly
    """
    n, device = len(rays), rays.near.device
    if sampling == "random":
        draw = torch.rand(n, count, generator=generator)
    elif sampling == "regular":
        draw = torch.full((1, 1), 0.5)
    else:
        draw = torch.rand(n // rays_per_pixel, 1, generator=generator)
        draw = ((draw + torch.arange(rays_per_pixel) / rays_per_pixel) % 1).reshape(n, 1)
    share = (torch.arange(count, device=device) + sent(draw, device)) / count
    length = (rays.far - rays.near)[:, None]
    if sampling != "adaptive" or density is None or density.values is None:
        return rays.near[:, None] + share * length, (length / count).expand(n, count)
    local = density.along(rays)
    cumulative = functional.pad(local.cumsum(dim=1) / DENSITY_BINS, (1, 0))  # share of the samples before each bin
    cell = torch.searchsorted(cumulative, share, right=True).clamp(1, DENSITY_BINS) - 1
    here = local.gather(1, cell)
    share = (cell + (share - cumulative.gather(1, cell)) * DENSITY_BINS / here) / DENSITY_BINS
    return rays.near[:, None] + share * length, length / (count * here)


@dataclass(frozen=True)
class Draw:
    """Sampling of a pixel: rays through its lens (1 without a lens), and samples per ray."""

    rays: int
    samples: int

    def rays_of(self, part: Part, generator: torch.Generator) -> Rays:
        """Return the rays of the pixels: their own, or several consecutive ones through the lens of each."""
        return part.rays if part.rays.lens is None else part.rays.spread(self.rays, generator)


@dataclass(frozen=True)
class Piece:
    """Rays of one technique in a step.

    Parameters
    ----------
    part : pixels, measured values and forward model
    rays : of the pixels; with a lens several consecutive ones each
    s, interval : (n, m) path lengths of the samples and of their intervals, mm
    numbers : measured values of this process. If it is 0, a ray of another process stands in with weight 0, so that all
        processes average the same terms and the gradients of the same weights
    """

    part: Part
    rays: Rays
    s: Tensor
    interval: Tensor
    numbers: int


class Objective:
    """The loss of a field on data; `network` evaluates its network in the precision of the run."""

    def __init__(
        self, settings: TrainingSettings, data: TrainingData, field: NeuralField, network: MixedPrecision,
        generator: torch.Generator, ranks: Ranks,
    ) -> None:  # fmt: skip
        self.settings, self.data, self.field, self.network = settings, data, field, network
        self.generator, self.ranks = generator, ranks
        self.density = SamplingDensity(field)

    # -- a batch ------------------------------------------------------------------------------------------------

    def draw(self, progress: float) -> Draw:
        """Draw the sampling of the pixels of a step."""
        samples = sample_count(progress, *self.data.samples, self.settings.sample_jitter, self.generator)
        return self._draw(progress, samples)

    @property
    def mean_draw(self) -> Draw:
        """The mean sampling of a run."""
        return self._draw(0.5, round(sum(self.data.samples) / 2))

    def _draw(self, progress: float, samples: int) -> Draw:
        last = self.data.lens_rays
        if last == 1:
            return Draw(1, samples)
        first = max(2, 2 * (last // 6))
        rays = 2 * round((first + (last - first) * min(progress, 1.0)) / 2)
        return Draw(rays, max(MIN_LENS_SAMPLES, round((1 + (last - 2) / FULL_RAYS) * samples / rays)))

    def pixels(self, draw: Draw) -> int:
        """Return the pixels of a step with that sampling."""
        return min(max(self.ranks.size, self.settings.points_per_batch // (draw.rays * draw.samples)), len(self.data))

    def batch(self, index: Int[Tensor, " b"], draw: Draw) -> tuple[list[Piece], int]:
        """Return this process's share of pixels by index, and the number of measured values of all processes."""
        batch = self.data.batch(index)
        pieces = [self._piece(part, draw) for part in batch]
        return pieces, sum(part.measured.numel() for part in batch)

    def _piece(self, part: Part, draw: Draw) -> Piece:
        rays, pixels = draw.rays_of(part, self.generator), self.ranks.share
        numbers = part.measured[pixels].numel()
        pixels = pixels if numbers else slice(0, 1)
        each = len(rays) // max(len(part), 1)
        s, interval = sample_rays(rays, draw.samples, self.generator, self.settings.sampling, self.density, each)
        if self.ranks.size > 1:
            index = torch.arange(len(part), device=rays.near.device)[pixels]
            index = (index[:, None] * each + torch.arange(each, device=index.device)).flatten()
            rays, s, interval = rays[index], s[index], interval[index]
        return Piece(part[pixels], rays, s, interval, numbers)

    # -- the loss -----------------------------------------------------------------------------------------------

    def terms(self, pieces: list[Piece]) -> dict[str, Tensor]:
        """Return the terms of the loss, each a mean over all measured values of the pieces."""
        settings = self.settings
        terms: dict[str, Tensor] = {}
        for piece, share in zip(pieces, shares([piece.numbers for piece in pieces]), strict=True):
            piece_terms = loss_terms(
                self.field, self.network, piece.part, piece.rays, piece.s, piece.interval, settings.weights,
                settings.norm,
            )  # fmt: skip
            for name, term in piece_terms.items():
                terms[name] = terms[name] + share * term if name in terms else share * term
        ambient = self.ambient_values(GAUGE_POINTS, self.generator)
        if ambient is not None:
            terms["gauge"] = ambient.square().mean()
        return terms

    def ambient_term(self, parts: Sequence[Part], numbers: Sequence[int]) -> Tensor:
        """Return the value of each data term in the ambient field, for parts with `numbers` of measured values."""
        terms = (reduce(part.of_nothing, self.settings.norm) for part in parts)
        total = sum(share * term for share, term in zip(shares(numbers), terms, strict=True))
        assert isinstance(total, Tensor)
        return total

    def ambient_loss(self) -> float:
        """Return the loss of the ambient field, near which a network starts, on AMBIENT_RAYS rays."""
        data, weights = self.data, self.settings.weights
        parts = data.batch(shuffled(0, min(AMBIENT_RAYS, len(data)), len(data), self.settings.seed))
        term = self.ambient_term(parts, [part.measured.numel() for part in parts])
        return float(term) * sum(getattr(weights, name) for name in DATA_TERMS)

    def ambient_values(self, count: int, generator: torch.Generator) -> Tensor | None:
        """Return the network in full precision at points that are ambient; None if there are none."""
        if self.data.ambient is None:
            return None
        points = sent(self.data.ambient.sample(count, generator), self.data.device)
        return self.field.network(self.field.normalise(points))

    @torch.no_grad()
    def withheld_residual(self) -> float:
        """Return the mean square of the residual over sigma (over 1 if unknown) on withheld pixels."""
        low, self.network.low, generator = self.network.low, False, torch.Generator().manual_seed(0)
        self.data.copy_nuisance()
        withheld, weights, total = self.data.withheld, self.settings.weights, 0.0
        assert withheld is not None
        for part in withheld.parts:
            thin = part.rays.lens is None
            size = WITHHELD_BATCH if thin else WITHHELD_BATCH // 4
            draw = Draw(1, WITHHELD_SAMPLES) if thin else Draw(LENS_RAYS, 4 * WITHHELD_SAMPLES // LENS_RAYS)
            for first in range(0, len(part), size):
                batch = self.data.with_rig(part[first : first + size], withheld=True)
                rays = draw.rays_of(batch, generator)
                s, interval = sample_rays(rays, draw.samples, generator, "adaptive", self.density, draw.rays)
                terms = loss_terms(self.field, self.network, batch, rays, s, interval, weights, "squared")
                data = [(getattr(weights, name), float(terms[name])) for name in DATA_TERMS if name in terms]
                mean = sum(weight * term for weight, term in data) / sum(weight for weight, _ in data)
                total += mean * batch.measured.numel()
        self.network.low = low
        return total / withheld.numbers * withheld.chi_square

    # -- between steps ------------------------------------------------------------------------------------------

    @torch.no_grad()
    def fit_nuisance(self) -> None:
        """Fit the nuisance parameters, such as the brightness of images, to the present field."""
        for part in self.data.nuisance_parts:
            rays = replace(part.rays, lens=None)
            integral = project(PathIntegral(part.model.integral, NUISANCE_SAMPLES), self.field, rays, self.data.device)
            part.model.settle(integral, part.measured, part.inverse_scale, rays)

    @torch.no_grad()
    def refine_rig(self, progress: float) -> None:
        """Take a step of the rig refinement with the present field, where one is due."""
        data, rig = self.data, self.data.refinement
        if rig is None:
            return
        due = math.ceil((min(progress, RIG_UNTIL) - RIG_FROM) / RIG_EVERY)
        if rig.steps > max(due, 0) + 1:  # of the previous cycle
            rig.steps = 0
        if rig.steps >= due or (progress > SIGN_UNTIL and not rig.off):
            return

        def predict(part: Part, rays: Rays) -> Tensor:
            generator = torch.Generator().manual_seed(rig.steps)  # the same samples for all poses
            integrals = []
            for index in torch.arange(len(rays)).split(RIG_BATCH):
                batch, each, count = rays[index], 1, RIG_SAMPLES
                if batch.lens is not None:
                    batch, each, count = batch.spread(RIG_LENS_RAYS, generator), RIG_LENS_RAYS, RIG_SAMPLES // 2
                s, step = sample_rays(batch, count, generator, "adaptive", self.density, each)
                integral = PathIntegral(part.model.integral).along(self.field, batch, s, step)
                integrals.append(integral if each == 1 else batch.mean_of(each, integral))
            return torch.cat(integrals)

        momentum = MOMENTUM if progress < RIG_SLOW_FROM else 0.0
        factor = EARLY_FACTOR if progress < EARLY else 1.0
        rig.step(data.rig_pixels(rig.steps), predict, data.sigma_known, momentum, factor)


def shares(numbers: Sequence[int]) -> list[float]:
    """Return the share of each in the sum; 0 if the sum is 0."""
    total = max(sum(numbers), 1)
    return [number / total for number in numbers]
