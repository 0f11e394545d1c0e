"""What few views leave open, a minimiser finds last: steps scaled in Fourier space to find it early.

    z = (S + weight T)^-1 s,      S = spectrum of F^T F,   T = spectrum of L^T L

F^T F is no convolution, but near one: S is the spectrum of its answer to a single voxel in the middle of the box. Views
see nothing of a wave that runs along none of their images, and S is small there; averaged over directions it is of no
use. For the method of conjugate gradients only the way depends on it, not where it leads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

__all__ = ["filtered", "response", "spectrum_of_differences"]

LEAST = 1e-2  # of the largest value of S: what is taken where there is less


def response(
    normal: Callable[[Tensor], Tensor], empty: Float[Tensor, "z y x"], free: Bool[Tensor, "z y x"] | None
) -> Float[Tensor, "z y k"]:
    """Return S, by the answer of F^T F to one voxel: the free one that is nearest to the middle.

    Parameters
    ----------
    normal : x to F^T F x
    empty : field of zeros
    free : voxels that are not pinned, or None for all
    """
    lines = [torch.arange(n, device=empty.device) - n // 2 for n in empty.shape]
    distance = sum(a**2 for a in torch.meshgrid(*lines, indexing="ij"))
    assert isinstance(distance, Tensor)
    if free is not None:
        distance = torch.where(free.to(distance.device), distance, distance.max() + 1)
    at = torch.unravel_index(distance.argmin(), empty.shape)
    point = empty.clone()
    point[at] = 1
    spectrum = torch.fft.rfftn(normal(point).roll([-int(i) for i in at], (0, 1, 2))).real
    largest = float(spectrum.max())
    return spectrum.clamp_min(LEAST * largest) if largest > 0 else torch.ones_like(spectrum)


def spectrum_of_differences(x: Float[Tensor, "z y x"], inverse: Sequence[float]) -> Float[Tensor, "z y k"]:
    """Return that of the squared differences between neighbours, sum_axis (2 - 2 cos k) inverse^2.

    Parameters
    ----------
    x : any field of the shape
    inverse : factor of the differences along z, y and x
    """
    last = torch.fft.rfftfreq(x.shape[2], dtype=torch.float64)
    waves = [*(torch.fft.fftfreq(n, dtype=torch.float64) for n in x.shape[:2]), last]
    along = [i**2 * (2 - 2 * torch.cos(2 * math.pi * k)) for i, k in zip(inverse, waves, strict=True)]
    return (along[0][:, None, None] + along[1][:, None] + along[2]).to(x)


def filtered(x: Float[Tensor, "z y x"], spectrum: Float[Tensor, "z y k"]) -> Float[Tensor, "z y x"]:
    """Return x with its spectrum divided by another."""
    return torch.fft.irfftn(torch.fft.rfftn(x) / spectrum, s=x.shape)
