"""Absorption: light or X-rays that a medium attenuates by its extinction coefficient mu, 1/mm (Beer-Lambert).

    A = -ln(I / I0) = integral mu ds

Where A is large few counts are left, and their logarithm is skewed: then transmittances exp(-A) are compared instead
(`intensity`), whose noise is even.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.conventions import InputError
from nerif.techniques.base import ForwardModel, Light
from nerif.techniques.line_integral import LineIntegral

__all__ = ["Absorption", "Intensity", "absorbance"]

IMPOSSIBLE = 5.0  # standard deviations beyond which an intensity is not below 0, or above I0, by noise
TOLERATED = 0.01  # share of such pixels
UNKNOWN_SIGMA = 0.05  # of absorbance, where none is given


@dataclass(frozen=True)
class Absorption(LineIntegral):
    """Absorbance -ln(I / I0), the integral of the extinction coefficient."""

    name = "absorption"
    measured, sigma = "absorbance", "absorbance_sigma"
    quantity = "extinction"
    additive = True
    bounds = (0.0, math.inf)

    @classmethod
    def of(cls, light: Light, model: str) -> ForwardModel:
        return MODELS[model]()

    @property
    def weight(self) -> float:
        return 1.0

    @classmethod
    def check(
        cls,
        values: Float[Tensor, "row column c"],
        sigma: Float[Tensor, "row column c"] | None,
        usable: Bool[Tensor, "row column"],
    ) -> None:
        if not bool(usable.any()):
            return
        seen = values[usable]
        least = torch.full_like(seen, UNKNOWN_SIGMA) if sigma is None else sigma[usable].clamp_min(UNKNOWN_SIGMA)
        share = float((seen < -IMPOSSIBLE * least).float().mean())
        if share > TOLERATED:
            raise InputError(
                f"absorbance: expected -ln(I / I0) of 0 or more, as I is at most I0; {share:.0%} of the pixels are far "
                f"below (down to {float(seen.min()):.3g}): subtract the offset that pixels beside the medium show"
            )

    @classmethod
    def detected(
        cls, values: Float[Tensor, "*n c"], counts: float, generator: torch.Generator
    ) -> tuple[Float[Tensor, "*n c"], Float[Tensor, "*n c"]]:
        """Return absorbances of so many quanta a pixel without the medium; the reference has no noise."""
        passed = torch.poisson(counts * torch.exp(-values.nan_to_num()), generator)
        found, sigma = absorbance(passed.numpy(), np.full(passed.shape, counts), reference_pictures=math.inf)
        return torch.from_numpy(found).to(values), torch.from_numpy(sigma).to(values)


@dataclass(frozen=True)
class Intensity(Absorption):
    """Transmittance exp(-A) instead of A: the noise of intensities is even, that of their logarithm is not."""

    linear = False

    @property
    def linear_twin(self) -> ForwardModel:
        return Absorption()

    def read(self, prediction: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        return torch.exp(-prediction)

    def reading(
        self, values: Float[Tensor, "n c"], sigma: Float[Tensor, "n c"] | None
    ) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n c"] | None]:
        passed = torch.exp(-values)
        return passed, None if sigma is None else sigma * passed


MODELS: dict[str, type[Absorption]] = {"absorbance": Absorption, "intensity": Intensity}
"""What is compared: absorbances, or the transmittances that they stand for."""


def absorbance(
    intensity: Float[np.ndarray, "*n"],
    reference: Float[np.ndarray, "*n"],
    dark: Float[np.ndarray, "*n"] | float = 0.0,
    electrons_per_count: float = 1.0,
    read_noise: float = 0.0,
    reference_pictures: float = 1.0,
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Return absorbance and its standard deviation from pictures with and without the medium.

        A = -ln((I - D) / (I0 - D)),    sigma^2 = var(I) / (I - D)^2 + var(I0) / (I0 - D)^2 / N,
        var(I) = (I - D) / g + r^2

    Pixels from which no light is left are NaN: their absorbance is larger than can be measured.

    Parameters
    ----------
    intensity, reference : I and I0, counts
    dark : D, counts without light
    electrons_per_count : g, the detected quanta that one count stands for
    read_noise : r, standard deviation, counts
    reference_pictures : N, pictures that the reference is the mean of

    Raises
    ------
    InputError
        If shapes disagree, intensities are negative, or I exceeds I0, by more than their noise.
    """
    if intensity.shape != reference.shape:
        raise InputError(f"reference: expected pictures of shape {intensity.shape}, got {reference.shape}")
    if not (electrons_per_count > 0 and read_noise >= 0):
        raise InputError("electrons_per_count, read_noise: expected above 0 and 0 or more")
    passed, whole = (np.asarray(x, dtype=np.float64) - dark for x in (intensity, reference))
    one, many = (np.clip(x, 0, None) / electrons_per_count + read_noise**2 for x in (passed, whole))
    noise = [one, many / reference_pictures]
    for name, x, variance in (("intensity", passed, noise[0]), ("reference", whole, noise[1])):
        negative = float(np.mean(x < -IMPOSSIBLE * np.sqrt(np.maximum(variance, 1 / electrons_per_count**2))))
        if negative > TOLERATED:
            where = f"{negative:.0%} of the pixels"
            raise InputError(f"{name}: expected counts of 0 or more, got negative ones at {where}; is dark right?")
    brighter = float(np.mean(passed - whole > IMPOSSIBLE * np.sqrt(noise[0] + noise[1])))
    if brighter > TOLERATED:
        raise InputError(
            f"intensity: expected at most the reference I0, got more at {brighter:.0%} of the pixels; "
            "are the two exchanged, or did the light change? Scale them by pixels beside the medium"
        )
    seen = (passed > 0) & (whole > 0)
    passed, whole = np.where(seen, passed, np.nan), np.where(seen, whole, np.nan)
    return -np.log(passed / whole), np.sqrt(noise[0] / passed**2 + noise[1] / whole**2)
