"""Deflection: background-oriented schlieren, the apparent displacement d (px) of a pattern behind the flow.

    d = integral (s_b - s) S grad(n) / n_ambient ds      lever_arm (default)
    d = (s_b - s_mid) integral S grad(n) / n_ambient ds  paraxial: one lever arm for the whole ray (paper, Eq. (3))
    d = integral (s_b - s) S [grad(n)(x + delta) - theta dn/ds] / n ds
                                                         curved: the ray bent by delta and theta, to second order

In a gas n is within 3e-4 of n_ambient. ray_tracing.py has rays to every order.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch

from nerif.forward.forward_model import ForwardModel, Light, Samples, SampleVectors, Weights
from nerif.geometry import Rays

__all__ = ["Curved", "Deflection", "LeverArm", "Paraxial"]


@dataclass(frozen=True)
class Deflection(ForwardModel):
    """Displacement of a background by refraction (docs/conventions.md; paper, Eqs. (1) and (3))."""

    name = "deflection"
    tomography = "background-oriented schlieren tomography"
    measured, sigma = "displacement", "sigma"
    channels: ClassVar[tuple[str, ...]] = ("u", "v")
    unit = "px"
    misscaled = "binning, or another lever arm"
    limits = (1e-6, 1e5)
    quantity = "index_excess"
    gauge = background = traced = windowed = True

    n_ambient: float = 1.0

    @classmethod
    def of(cls, light: Light, model: str) -> ForwardModel:
        return MODELS[model](light.n_ambient)

    @abstractmethod
    def lever(self, rays: Rays, s: Samples) -> Samples:
        """Return the lever arm (mm) of a deflection at path length s."""

    def weights(self, rays: Rays, s: Samples, step: Samples) -> Weights:
        return Weights(self.lever(rays, s) * step, slope=rays.ends.sensitivity / self.n_ambient)


@dataclass(frozen=True)
class LeverArm(Deflection):
    """A lever arm for each sample: exact to first order in the deflection."""

    def lever(self, rays: Rays, s: Samples) -> Samples:
        return rays.ends.distance[:, None] - s


@dataclass(frozen=True)
class Paraxial(Deflection):
    """One lever arm for the whole ray (paper, Eq. (3))."""

    def lever(self, rays: Rays, s: Samples) -> Samples:
        return (rays.ends.distance - 0.5 * (rays.near + rays.far))[:, None].expand_as(s)


@dataclass(frozen=True)
class Curved(LeverArm):
    """Samples on the ray as bent by the field: correct to second order in the deflection."""

    straight = linear = False

    @property
    def linear_twin(self) -> ForwardModel:
        return LeverArm(self.n_ambient)

    def bend(
        self, value: Samples, gradient: SampleVectors, rays: Rays, s: Samples, step: Samples
    ) -> tuple[SampleVectors, SampleVectors]:
        """Return delta (mm) and theta dn/ds + grad(n) (n - n_ambient) / n_ambient (1/mm).

        theta(s) = integral_near^s grad_perp(n) / n ds',   delta(s) = integral_near^s (s - s') grad_perp(n) / n ds'
        """
        along = torch.einsum("nmi,ni->nm", gradient, rays.direction)
        turn = (gradient - along[..., None] * rays.direction[:, None]) * (step / self.n_ambient)[..., None]
        before = turn.cumsum(1) - turn  # of the intervals before the sample's own, of which half lies behind it
        offset = s[..., None] * before - ((s[..., None] * turn).cumsum(1) - s[..., None] * turn)
        angle = before + turn / 2
        slower = gradient * (value / self.n_ambient)[..., None]  # 1 / n where the weights have 1 / n_ambient
        return offset + turn * (step / 8)[..., None], angle * along[..., None] + slower


# by the names that settings have for them, the default first
MODELS: dict[str, type[Deflection]] = {"lever_arm": LeverArm, "paraxial": Paraxial, "curved": Curved}
