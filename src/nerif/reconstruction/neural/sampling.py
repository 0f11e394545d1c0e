"""Where a ray is sampled: one random point in each of N intervals (paper, Eq. (sample)).

The paper's intervals are equal. The adaptive ones are short where the field found so far varies and long where it does
not: their bounds are quantiles of a density that follows |grad N| on a coarse grid, and each sample counts for the
length of its interval. The integral keeps its expectation and loses most of its scatter.
"""

from __future__ import annotations

import torch
import torch.nn.functional as functional
from jaxtyping import Float
from torch import Tensor

from nerif.common.transfer import sent
from nerif.fields.network import NeuralField
from nerif.geometry import Rays
from nerif.reconstruction.neural.losses import Evaluator

__all__ = ["SamplingDensity", "sample_count", "sample_rays"]

EVEN = 0.1  # share of the samples that are spread evenly, whatever the field is
BINS = 40  # along a ray, in each of which the density is constant
RESOLUTION = 24  # of the grid, along each edge of the cube that the network's coordinates span


class SamplingDensity:
    """Density of samples in space, high where the field varies: the largest |grad N| of each voxel and its neighbours.

    Parameters
    ----------
    field : whose box and coordinates it is in
    """

    def __init__(self, field: NeuralField) -> None:
        self.field = field
        self.values: Float[Tensor, "z y x"] | None = None  # nothing known yet

    @torch.no_grad()
    def update(self, network: Evaluator) -> None:
        """Look at a network as it is now."""
        device = next(self.field.network.parameters()).device
        axis = (torch.arange(RESOLUTION, device=device) + 0.5) / RESOLUTION * 2 - 1
        z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
        points = torch.stack([x, y, z], dim=-1).reshape(-1, 3)
        slopes = network.value_and_gradient(points, False)[1].float().norm(dim=-1)
        self.values = functional.max_pool3d(slopes.reshape(1, 1, *x.shape), 3, 1, 1)[0, 0]

    def along(self, rays: Rays) -> Float[Tensor, "n bins"]:
        """Return the density of samples in equal bins along each ray; its mean along a ray is 1."""
        assert self.values is not None
        share = (torch.arange(BINS, device=rays.near.device) + 0.5) / BINS
        p = self.field.normalise(rays.at(rays.near[:, None] + share * (rays.far - rays.near)[:, None]))
        found = functional.grid_sample(
            self.values[None, None], p[None, :, :, None], padding_mode="border", align_corners=False
        )[0, 0, :, :, 0]
        found = found / found.mean(dim=1, keepdim=True).clamp_min(1e-12)
        density = EVEN + (1 - EVEN) * found
        return density / density.mean(dim=1, keepdim=True)


def sample_count(progress: float, first: int, last: int, jitter: int, generator: torch.Generator) -> int:
    """Draw N ~ Uniform(M - jitter, M + jitter), M growing from `first` to `last` with progress 0 to 1."""
    m = round(first + (last - first) * min(progress, 1.0))
    return max(2, m + int(torch.randint(-jitter, jitter + 1, (1,), generator=generator)))


def sample_rays(
    rays: Rays, count: int, generator: torch.Generator, sampling: str = "random",
    density: SamplingDensity | None = None, of_pixel: int = 1,
) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m"]]:  # fmt: skip
    """Return path lengths t_i ~ U(t_n + (i-1)/N (t_f - t_n), t_n + i/N (t_f - t_n)) and the length each stands for, mm.

    Parameters
    ----------
    sampling : "random" (one draw an interval, the paper's), "shifted" (one draw a ray, the same in each interval),
        "adaptive" (as shifted, in intervals as the density has them) or "regular" (midpoints)
    density : for "adaptive"; equal intervals as long as it knows nothing
    of_pixel : rays in a row that are those of a pixel; where one draw serves a ray, theirs are evenly apart
    """
    n, device = len(rays), rays.near.device
    if sampling == "random":
        draw = torch.rand(n, count, generator=generator)
    elif sampling == "regular":
        draw = torch.full((1, 1), 0.5)
    else:
        draw = torch.rand(n // of_pixel, 1, generator=generator)
        draw = ((draw + torch.arange(of_pixel) / of_pixel) % 1).reshape(n, 1)
    share = (torch.arange(count, device=device) + sent(draw, device)) / count
    length = (rays.far - rays.near)[:, None]
    if sampling != "adaptive" or density is None or density.values is None:
        return rays.near[:, None] + share * length, (length / count).expand(n, count)
    local = density.along(rays)
    reached = functional.pad(local.cumsum(dim=1) / BINS, (1, 0))  # share of the samples before each bin
    cell = torch.searchsorted(reached, share, right=True).clamp(1, BINS) - 1
    here = local.gather(1, cell)
    share = (cell + (share - reached.gather(1, cell)) * BINS / here) / BINS
    return rays.near[:, None] + share * length, length / (count * here)
