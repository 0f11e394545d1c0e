"""Emission: light emitted by a medium, such as chemiluminescence; e is radiance per length.

L = integral e ds,       optically thin: the medium does not absorb its own light
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.forward.forward_model import ForwardModel, Light, Map, Mask
from nerif.forward.line_integral import LineIntegral, share_below

__all__ = ["Emission"]

MAX_OFFSET = 0.05  # of the largest radiance: tolerated error of the dark image
MAX_SHARE = 0.01  # of the pixels that are more negative


@dataclass(frozen=True)
class Emission(LineIntegral):
    """Radiance, the integral of the emission along the ray."""

    name = "emission"
    tomography = "emission tomography"
    measured, sigma = "radiance", "radiance_sigma"
    quantity = "emission"
    misscaled = "another gain or exposure"
    additive = gains = True
    bounds = (0.0, math.inf)

    @classmethod
    def of(cls, light: Light, model: str) -> ForwardModel:
        return cls()

    @classmethod
    def detect(cls, values: Tensor, counts: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return radiances with shot noise, `counts` quanta at the largest; sigma is at least that of one quantum."""
        quantum = float(values.nan_to_num().max()) / counts or 1.0
        noisy = torch.poisson((values.nan_to_num() / quantum).clamp_min(0), generator) * quantum
        return torch.where(values.isnan(), values, noisy), (noisy * quantum).clamp_min(quantum**2).sqrt()

    @classmethod
    def check(cls, values: Map, sigma: Map | None, usable: Mask) -> None:
        largest = float(values[usable].abs().max()) if bool(usable.any()) else 0.0
        share = share_below(-MAX_OFFSET * largest, values, sigma, usable)
        if share > MAX_SHARE:
            raise InputError(
                f"expected 0 or more, got less at {share:.0%} of the pixels; is the subtracted dark image right?",
                field="radiance",
            )
