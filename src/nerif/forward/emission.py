"""Emission: light that a medium gives off, such as chemiluminescence, radiance per length e.

L = integral e ds,       optically thin: the medium does not absorb its own light
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.forward.base import ForwardModel, Light
from nerif.forward.line_integral import LineIntegral, share_below

__all__ = ["Emission"]

NEGATIVE = 0.05  # of the largest radiance, by which a dark image may be a little off
TOLERATED = 0.01  # share of such pixels


@dataclass(frozen=True)
class Emission(LineIntegral):
    """Radiance, the integral of what is given off along the ray."""

    name = "emission"
    tomography = "emission tomography"
    measured, sigma = "radiance", "radiance_sigma"
    quantity = "emission"
    misscaled = "another gain or exposure"
    additive = True
    gains = True
    bounds = (0.0, math.inf)

    @classmethod
    def of(cls, light: Light, model: str) -> ForwardModel:
        return cls()

    @property
    def weight(self) -> float:
        return 1.0

    @classmethod
    def detected(
        cls, values: Float[Tensor, "*n c"], counts: float, generator: torch.Generator
    ) -> tuple[Float[Tensor, "*n c"], Float[Tensor, "*n c"]]:
        """Return radiances of so many quanta where they are largest; sigma is that of a quantum at least."""
        quantum = float(values.nan_to_num().max()) / counts or 1.0
        seen = torch.poisson((values.nan_to_num() / quantum).clamp_min(0), generator) * quantum
        return torch.where(values.isnan(), values, seen), (seen * quantum).clamp_min(quantum**2).sqrt()

    @classmethod
    def check(
        cls,
        values: Float[Tensor, "row column c"],
        sigma: Float[Tensor, "row column c"] | None,
        usable: Bool[Tensor, "row column"],
    ) -> None:
        largest = float(values[usable].abs().max()) if bool(usable.any()) else 0.0
        share = share_below(-NEGATIVE * largest, values, sigma, usable)
        if share > TOLERATED:
            raise InputError(
                f"expected 0 or more, got less at {share:.0%} of the pixels; "
                "is the dark image that was subtracted the right one?",
                field="radiance",
            )
