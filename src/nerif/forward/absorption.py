"""Absorption: light or X-rays that a medium attenuates by its extinction coefficient mu, 1/mm (Beer-Lambert).

    A = -ln(I / I0) = integral mu ds

Where A is large few quanta are left, and their logarithm is skewed. Then what has even noise is compared instead of A:
transmittances, where the noise is the detector's (`intensity`), or their square roots, where it is that of quanta
(`poisson`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.forward.base import ForwardModel, Light
from nerif.forward.line_integral import IMPOSSIBLE, LineIntegral, share_below
from nerif.geometry import Rays

__all__ = ["Absorption", "Intensity", "absorbance"]

TOLERATED = 0.01  # share of pixels with what cannot be
LEAST = -0.25  # absorbance by which light that varies from image to image leads below 0


@dataclass(frozen=True)
class Absorption(LineIntegral):
    """Absorbance -ln(I / I0), the integral of the extinction coefficient."""

    name = "absorption"
    tomography = "absorption tomography"
    measured, sigma = "absorbance", "absorbance_sigma"
    quantity = "extinction"
    misscaled = "another reference image, or another wavelength"
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
        share = share_below(LEAST, values, sigma, usable)
        if share > TOLERATED:
            raise InputError(
                f"expected -ln(I / I0) of 0 or more, as I is at most I0; {share:.0%} of the pixels are "
                f"far below (to {float(values[usable].min()):.3g}): subtract the offset of pixels beside the medium",
                field="absorbance",
            )

    @classmethod
    def detected(
        cls, values: Float[Tensor, "*n c"], counts: float, generator: torch.Generator
    ) -> tuple[Float[Tensor, "*n c"], Float[Tensor, "*n c"]]:
        """Return absorbances of so many quanta a pixel without the medium; the reference has no noise."""
        passed = torch.poisson(counts * torch.exp(-values.nan_to_num()), generator)
        found, sigma = absorbance(passed.numpy(), np.full(passed.shape, counts), reference_images=math.inf)
        seen = torch.where(values.isnan(), values, torch.from_numpy(found).to(values))
        return seen, torch.from_numpy(sigma).to(values)


@dataclass(frozen=True)
class Intensity(Absorption):
    """A power of the transmittance, y = exp(-p A), instead of A, with sigma_y = p y sigma_A.

    p = 1 has even noise where that is the detector's, p = 1/2 where it is that of counted quanta: the variance of the
    square root of a Poisson variable is 1/4, however large it is (Bartlett, J. R. Stat. Soc. Suppl. 3, 1936).

    Parameters
    ----------
    power : p
    """

    linear = False
    power: float = 1.0

    @property
    def linear_twin(self) -> ForwardModel:
        return Absorption()

    def read(self, prediction: Float[Tensor, "n k"], rays: Rays) -> Float[Tensor, "n c"]:
        return torch.exp(-self.power * prediction)

    def reading(
        self, values: Float[Tensor, "n c"], sigma: Float[Tensor, "n c"] | None, rays: Rays
    ) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n c"] | None]:
        read = self.read(values, rays)
        return read, None if sigma is None else self.power * read * sigma


MODELS: dict[str, Callable[[], Absorption]] = {
    "absorbance": Absorption,
    "intensity": Intensity,
    "poisson": partial(Intensity, 0.5),
}
"""What is compared: absorbances, or the transmittances that they stand for, or their square roots."""


def absorbance(
    intensity: Float[np.ndarray, "*n"],
    reference: Float[np.ndarray, "*n"],
    dark: Float[np.ndarray, "*n"] | float = 0.0,
    electrons_per_count: float = 1.0,
    read_noise: float = 0.0,
    reference_images: float = 1.0,
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Return absorbance and its standard deviation from images with and without the medium.

        A = -ln((I - D) / (I0 - D)),    sigma^2 = var(I) / (I - D)^2 + var(I0) / (I0 - D)^2 / N,
        var(I) = (I - D) / g + r^2

    Where no light is left half a quantum is taken, with the variance of a whole one: such a pixel says that the
    absorbance is large, and without it the brighter ones beside it would be left. Pixels without a reference are NaN.

    Parameters
    ----------
    intensity, reference : I and I0, counts
    dark : D, counts without light
    electrons_per_count : g, the detected quanta that one count stands for
    read_noise : r, standard deviation, counts
    reference_images : N, images that the reference is the mean of

    Raises
    ------
    InputError
        If shapes disagree, intensities are negative, or I exceeds I0, by more than their noise.
    """
    for name, image in (("reference", reference), ("dark", np.asarray(dark))):
        if image.shape != intensity.shape and (name, image.shape) != ("dark", ()):
            raise InputError(f"expected images of shape {intensity.shape}, got {image.shape}", field=name)
    if not (electrons_per_count > 0 and read_noise >= 0):
        raise InputError("expected above 0 and 0 or more", field="electrons_per_count, read_noise")
    passed, whole = (np.asarray(x, dtype=np.float64) - dark for x in (intensity, reference))
    quantum = 1 / electrons_per_count
    one, many = (np.maximum(x, quantum) * quantum + read_noise**2 for x in (passed, whole))
    noise = [one, many / reference_images]
    for name, x, variance in (("intensity", passed, noise[0]), ("reference", whole, noise[1])):
        negative = float(np.mean(x < -IMPOSSIBLE * np.sqrt(variance)))
        if negative > TOLERATED:
            where = f"{negative:.0%} of the pixels"
            raise InputError(f"expected counts of 0 or more, got negative ones at {where}; is dark right?", field=name)
    brighter = float(np.mean(passed - whole > IMPOSSIBLE * np.sqrt(noise[0] + noise[1])))
    if brighter > TOLERATED:
        raise InputError(
            f"expected at most the reference I0, got more at {brighter:.0%} of the pixels; "
            "are the two exchanged, or did the light change? Scale them by pixels beside the medium",
            field="intensity",
        )
    passed, whole = np.maximum(passed, 0.5 * quantum), np.where(whole > 0, whole, np.nan)
    return -np.log(passed / whole), np.sqrt(noise[0] / passed**2 + noise[1] / whole**2)
