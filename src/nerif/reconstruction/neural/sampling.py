"""A batch of the training: random rays, and the samples along them.

A ray has one random sample in each of N intervals (paper, Eq. (sample)). The paper's intervals are equal. Adaptive ones
are short where the present field varies: their bounds are quantiles of a density that follows |grad N| on a coarse
grid, and each sample is weighted by the length of its interval. This keeps the expectation of the integral and removes
most of its scatter.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as functional
from jaxtyping import Float, Int
from torch import Tensor

from nerif.common.transfer import to_device
from nerif.fields.network import NeuralField
from nerif.geometry import Rays
from nerif.reconstruction.neural.losses import Evaluator, MixedPrecision
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.schedule import Schedule
from nerif.reconstruction.neural.training_data import TrainingData, shuffled
from nerif.reconstruction.neural.training_settings import TrainingSettings
from nerif.reconstruction.target import TechniqueData

__all__ = ["Batch", "PixelSampling", "RayBatch", "Sampler", "SamplingDensity", "sample_count", "sample_rays"]

EVEN_SHARE = 0.1  # of the samples, spread evenly
DENSITY_BINS = 40  # along a ray
DENSITY_GRID = 24  # cells along each edge of the cube of network coordinates
DENSITY_EVERY = 60  # steps between updates of the density
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
    share = (torch.arange(count, device=device) + to_device(draw, device)) / count
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
class PixelSampling:
    """Sampling of a pixel: rays through its lens (1 without a lens), and samples per ray."""

    rays: int
    samples: int

    def rays_of(self, part: TechniqueData, generator: torch.Generator) -> Rays:
        """Return the rays of the pixels: their own, or several consecutive ones through the lens of each."""
        return part.rays if part.rays.lens is None else part.rays.spread(self.rays, generator)


@dataclass(frozen=True)
class RayBatch:
    """Rays of one technique in a step."""

    part: TechniqueData  #: pixels, measured values and forward model
    rays: Rays  #: of the pixels; with a lens several consecutive ones each
    s: Tensor  #: (n, m) path lengths of the samples, mm
    interval: Tensor  #: (n, m) path lengths of their intervals, mm
    numbers: int
    """Measured values of this process. If it is 0, a ray of another process stands in with weight 0, so that all
    processes average the same terms and the gradients of the same weights."""


@dataclass(frozen=True)
class Batch:
    """The rays of a step."""

    pieces: list[RayBatch]  #: one per technique, this process's share
    numbers: int  #: measured values of all processes
    low: bool = False  #: whether the network is evaluated in low precision

    @property
    def own_numbers(self) -> int:
        """Measured values of this process."""
        return sum(piece.numbers for piece in self.pieces)


class Sampler:
    """Draws batches: the next rays of a random order with each once per epoch, and samples along them."""

    def __init__(
        self, settings: TrainingSettings, data: TrainingData, field: NeuralField, network: MixedPrecision,
        generator: torch.Generator, ranks: Ranks,
    ) -> None:  # fmt: skip
        self.settings, self.data, self.network = settings, data, network
        self.generator, self.ranks = generator, ranks
        self.density = SamplingDensity(field)

    def batch(self, schedule: Schedule) -> Batch:
        """Draw the batch of the next step and count its rays."""
        settings, draw = self.settings, self.draw(schedule.progress)
        rays = self.pixels(draw)
        index = shuffled(schedule.rays_done, rays, len(self.data), settings.seed)
        schedule.count(rays)
        if settings.sampling == "adaptive" and schedule.step and schedule.step % DENSITY_EVERY == 0:
            self.density.update(self.network)
        return self.of(index, draw, schedule.progress < settings.full_precision_from)

    def of(self, index: Int[Tensor, " b"], draw: PixelSampling, low: bool = False) -> Batch:
        """Return the batch of pixels by index."""
        parts = self.data.batch(index)
        return Batch([self._piece(part, draw) for part in parts], sum(part.measured.numel() for part in parts), low)

    def draw(self, progress: float) -> PixelSampling:
        """Draw the sampling of the pixels of a step."""
        samples = sample_count(progress, *self.data.samples, self.settings.sample_jitter, self.generator)
        return self._draw(progress, samples)

    @property
    def mean_draw(self) -> PixelSampling:
        """The mean sampling of a run."""
        return self._draw(0.5, round(sum(self.data.samples) / 2))

    def _draw(self, progress: float, samples: int) -> PixelSampling:
        last = self.data.lens_rays
        if last == 1:
            return PixelSampling(1, samples)
        first = max(2, 2 * (last // 6))
        rays = 2 * round((first + (last - first) * min(progress, 1.0)) / 2)
        return PixelSampling(rays, max(MIN_LENS_SAMPLES, round((1 + (last - 2) / FULL_RAYS) * samples / rays)))

    def pixels(self, draw: PixelSampling) -> int:
        """Return the pixels of a step with that sampling."""
        return min(max(self.ranks.size, self.settings.points_per_batch // (draw.rays * draw.samples)), len(self.data))

    def _piece(self, part: TechniqueData, draw: PixelSampling) -> RayBatch:
        rays, pixels = draw.rays_of(part, self.generator), self.ranks.share
        numbers = part.measured[pixels].numel()
        pixels = pixels if numbers else slice(0, 1)
        each = len(rays) // max(len(part), 1)
        s, interval = sample_rays(rays, draw.samples, self.generator, self.settings.sampling, self.density, each)
        if self.ranks.size > 1:
            index = torch.arange(len(part), device=rays.near.device)[pixels]
            index = (index[:, None] * each + torch.arange(each, device=index.device)).flatten()
            rays, s, interval = rays[index], s[index], interval[index]
        return RayBatch(part[pixels], rays, s, interval, numbers)
