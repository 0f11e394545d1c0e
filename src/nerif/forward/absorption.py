"""Absorption: light or X-rays attenuated by the extinction coefficient mu, 1/mm (Beer-Lambert).

    A = -ln(I / I0) = integral mu ds

Where A is large few quanta are left, and the noise of A is skewed. Transmittances (`intensity`) have uniform noise if
it is that of the detector, their square roots (`poisson`) if it is shot noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.forward.forward_model import ForwardModel, Light, Map, Mask, PerRay
from nerif.forward.line_integral import MAX_NOISE, LineIntegral, share_below
from nerif.geometry import Rays

__all__ = ["Absorption", "absorbance"]

MAX_SHARE = 0.01  # of the pixels with impossible values
MIN_ABSORBANCE = -0.25  # from light that varies between images


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

    @classmethod
    def check(cls, values: Map, sigma: Map | None, usable: Mask) -> None:
        share = share_below(MIN_ABSORBANCE, values, sigma, usable)
        if share > MAX_SHARE:
            raise InputError(
                f"expected -ln(I / I0) of 0 or more, as I is at most I0, got much less (to "
                f"{float(values[usable].min()):.3g}) at {share:.0%} of the pixels; subtract the offset of pixels "
                "beside the medium",
                field="absorbance",
            )

    @classmethod
    def detect(cls, values: Tensor, counts: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return absorbances with the shot noise of `counts` quanta a pixel without the medium, and none of I0."""
        passed = torch.poisson(counts * torch.exp(-values.nan_to_num()), generator)
        noisy, sigma = absorbance(passed.numpy(), np.full(passed.shape, counts), reference_images=math.inf)
        result = torch.where(values.isnan(), values, torch.from_numpy(noisy).to(values))
        return result, torch.from_numpy(sigma).to(values)


@dataclass(frozen=True)
class Intensity(Absorption):
    """A power of the transmittance, y = exp(-p A), with sigma_y = p y sigma_A.

    p = 1 has uniform noise if it is that of the detector, p = 1/2 if it is shot noise: the variance of the square root
    of a Poisson variable is 1/4, whatever its mean (Bartlett, J. R. Stat. Soc. Suppl. 3, 1936).
    """

    linear = False
    power: float = 1.0  # p

    @property
    def linear_twin(self) -> ForwardModel:
        return Absorption()

    def read(self, prediction: PerRay, rays: Rays) -> PerRay:
        return torch.exp(-self.power * prediction)

    def reading(self, values: PerRay, sigma: PerRay | None, rays: Rays) -> tuple[PerRay, PerRay | None]:
        read = self.read(values, rays)
        return read, None if sigma is None else self.power * read * sigma


# readings by the names that settings have for them, the default first
MODELS: dict[str, Callable[[], Absorption]] = {
    "absorbance": Absorption, "intensity": Intensity, "poisson": partial(Intensity, 0.5)
}  # fmt: skip


def absorbance(
    intensity: Float[np.ndarray, "*n"], reference: Float[np.ndarray, "*n"],
    dark: Float[np.ndarray, "*n"] | float = 0.0, electrons_per_count: float = 1.0, read_noise: float = 0.0,
    reference_images: float = 1.0,
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:  # fmt: skip
    """Return absorbance and its standard deviation from images with and without the medium.

        A = -ln((I - D) / (I0 - D)),    sigma^2 = var(I) / (I - D)^2 + var(I0) / (I0 - D)^2 / N,
        var(I) = (I - D) / g + r^2

    Where no light is left, I - D is half a quantum, with the variance of a whole one: such a pixel shows that the
    absorbance is large, and omitting it would bias towards its brighter neighbours. Pixels without a reference are NaN.
    It is an error if, by more than their noise, intensities are negative or I exceeds I0.

    Parameters
    ----------
    intensity, reference, dark : I, I0 and D, counts
    electrons_per_count : g, detected quanta per count
    read_noise : r, standard deviation, counts
    reference_images : N, images averaged in the reference
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
        share = float(np.mean(x < -MAX_NOISE * np.sqrt(variance)))
        if share > MAX_SHARE:
            message = f"expected counts of 0 or more, got negative ones at {share:.0%} of the pixels; is dark right?"
            raise InputError(message, field=name)
    brighter = float(np.mean(passed - whole > MAX_NOISE * np.sqrt(noise[0] + noise[1])))
    if brighter > MAX_SHARE:
        raise InputError(
            f"expected at most the reference I0, got more at {brighter:.0%} of the pixels; "
            "are the two exchanged, or did the light change? Scale them by pixels beside the medium",
            field="intensity",
        )
    passed, whole = np.maximum(passed, 0.5 * quantum), np.where(whole > 0, whole, np.nan)
    return -np.log(passed / whole), np.sqrt(noise[0] / passed**2 + noise[1] / whole**2)
