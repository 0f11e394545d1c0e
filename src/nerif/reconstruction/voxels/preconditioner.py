"""A preconditioner in Fourier space, which finds early the components that few views leave nearly undetermined.

    z = (S + weight T)^-1 s,      S = spectrum of F^T F,   T = spectrum of L^T L

F^T F is nearly a convolution: S is the spectrum of its response to a single voxel in the middle of the box. S is small
for waves whose wave vector lies in none of the image planes, so it must not be averaged over directions. The
preconditioner changes the path of conjugate gradients, not their limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

__all__ = ["filtered", "response", "spectrum_of_differences"]

MIN_RESPONSE = 1e-2  # of the largest value of S


def response(
    normal: Callable[[Tensor], Tensor], empty: Float[Tensor, "z y x"], free: Bool[Tensor, "z y x"] | None
) -> Float[Tensor, "z y k"]:
    """Return S, from the response of F^T F to the free voxel nearest to the middle.

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
    return spectrum.clamp_min(MIN_RESPONSE * largest) if largest > 0 else torch.ones_like(spectrum)


def spectrum_of_differences(x: Float[Tensor, "z y x"], inverse: Sequence[float]) -> Float[Tensor, "z y k"]:
    """Return the spectrum of squared differences between neighbours, sum_axis (2 - 2 cos k) inverse^2.

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
