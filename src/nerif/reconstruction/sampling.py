"""Where a ray is sampled: one random point in each of N equal intervals (paper, Eq. (sample))."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.geometry import Rays

__all__ = ["sample_count", "sample_rays"]


def sample_count(progress: float, first: int, last: int, jitter: int, generator: torch.Generator) -> int:
    """Draw N ~ Uniform(M - jitter, M + jitter), M growing from `first` to `last` with progress 0 to 1."""
    m = round(first + (last - first) * min(progress, 1.0))
    return max(2, m + int(torch.randint(-jitter, jitter + 1, (1,), generator=generator)))


def sample_rays(
    rays: Rays, count: int, generator: torch.Generator, sampling: str = "random"
) -> tuple[Float[Tensor, "n m"], Float[Tensor, " n"]]:
    """Return path lengths t_i ~ U(t_n + (i-1)/N (t_f - t_n), t_n + i/N (t_f - t_n)) and the interval length, mm.

    Parameters
    ----------
    sampling : "random" (one draw an interval, the paper's), "shifted" (one draw a ray, the same in each interval) or
        "regular" (midpoints)
    """
    n = len(rays)
    if sampling == "random":
        draw = torch.rand(n, count, generator=generator)
    elif sampling == "shifted":
        draw = torch.rand(n, 1, generator=generator)
    else:
        draw = torch.full((1, 1), 0.5)
    step = (rays.far - rays.near) / count
    index = torch.arange(count, device=step.device)
    return rays.near[:, None] + (index + draw.to(step.device)) * step[:, None], step
