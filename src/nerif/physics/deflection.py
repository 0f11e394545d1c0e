"""The forward model: what displacement the pixels see through a field.

    d = integral (s_b - s) S grad(n) / n ds      lever_arm (default)
    d = (s_b - s_mid) integral S grad(n) / n ds  paraxial: one lever arm for the whole ray (paper, Eq. (3))
    d = integral (s_b - s) S [grad(n)(x + delta) - theta dn/ds] / n ds
                                                 curved: the ray bent by delta and theta, right to second order

Rays are traced through, to every order, in ray_tracing.py.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import InputError
from nerif.fields.base import Field
from nerif.geometry import Rays

__all__ = ["MODELS", "Deflection", "ForwardModel", "bend", "integration_weights", "midpoints", "project"]

MODELS = ("lever_arm", "paraxial", "curved")


class ForwardModel(ABC):
    """From a field and rays to what the pixels see."""

    @abstractmethod
    def __call__(self, field: Field, rays: Rays) -> Float[Tensor, "n 2"]:
        """Return the displacement in px of rays clipped to the box."""


@dataclass(frozen=True)
class Deflection(ForwardModel):
    """First-order deflection along straight rays.

    Parameters
    ----------
    model : "lever_arm", "paraxial" or "curved"
    samples : number of midpoint samples along a ray
    n_ambient : refractive index the excess is counted from

    Source: DESIGN of the forward model in docs/conventions.md; paper, Eqs. (1) and (3).
    """

    model: str = "lever_arm"
    samples: int = 200
    n_ambient: float = 1.0

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise InputError(f"model: expected one of {', '.join(MODELS)}, got '{self.model}'")
        if self.samples < 1:
            raise InputError(f"samples: expected at least one sample along a ray, got {self.samples}")

    def __call__(self, field: Field, rays: Rays) -> Float[Tensor, "n 2"]:
        s, step = midpoints(rays, self.samples)
        value, gradient = field.value_and_gradient(rays.at(s))
        if self.model == "curved":
            offset, angle = bend(gradient, rays, s, step, self.n_ambient)
            along = torch.einsum("nmi,ni->nm", gradient, rays.direction)
            value, gradient = field.value_and_gradient(rays.at(s) + offset)
            gradient = gradient - angle * along[..., None]
        weights = integration_weights(rays, s, step, self.model) / (self.n_ambient + value)
        return torch.einsum("nm,nij,nmj->ni", weights, rays.ends.sensitivity, gradient)


def midpoints(rays: Rays, samples: int) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m"]]:
    """Return the midpoints of `samples` equal intervals between near and far, and their length, both mm."""
    step = ((rays.far - rays.near) / samples)[:, None].expand(-1, samples)
    index = torch.arange(samples, dtype=rays.near.dtype, device=rays.near.device) + 0.5
    return rays.near[:, None] + index * step, step


def integration_weights(
    rays: Rays, s: Float[Tensor, "n m"], step: Float[Tensor, "n m"], model: str
) -> Float[Tensor, "n m"]:
    """Return lever arm times step, mm^2: what each sample of S grad(n) counts for."""
    if model == "paraxial":
        lever = (rays.ends.distance - 0.5 * (rays.near + rays.far))[:, None].expand_as(s)
    else:
        lever = rays.ends.distance[:, None] - s
    return lever * step


def bend(
    gradient: Float[Tensor, "n m 3"], rays: Rays, s: Float[Tensor, "n m"], step: Float[Tensor, "n m"], n_ambient: float
) -> tuple[Float[Tensor, "n m 3"], Float[Tensor, "n m 3"]]:
    """Return how far (mm) and through which angle refraction has carried a ray off its straight line at each sample.

    theta(s) = integral_near^s grad_perp(n) / n ds',      delta(s) = integral_near^s (s - s') grad_perp(n) / n ds'

    Parameters
    ----------
    gradient : index gradient at the samples on the straight ray, 1/mm
    s, step : path lengths of the samples and length of the intervals, mm
    """
    along = torch.einsum("nmi,ni->nm", gradient, rays.direction)
    turn = (gradient - along[..., None] * rays.direction[:, None]) * (step / n_ambient)[..., None]
    before = turn.cumsum(1) - turn  # of the intervals before the sample's own, of which half lies behind it
    offset = s[..., None] * before - ((s[..., None] * turn).cumsum(1) - s[..., None] * turn)
    return offset + turn * (step / 8)[..., None], before + turn / 2


@torch.no_grad()
def project(
    model: ForwardModel, field: Field, rays: Rays, device: torch.device | str = "cpu", chunk: int | None = None
) -> Float[Tensor, "n 2"]:
    """Return the displacement (px) of many rays, chunk by chunk; 0 where a ray misses the box."""
    if chunk is None:  # arrays that stay in the cache of a CPU, and fill a GPU
        chunk = 32 if torch.device(device).type == "cpu" else 4096
    result = torch.zeros(len(rays), 2, dtype=rays.origin.dtype)
    index, field = rays.crosses.nonzero()[:, 0], field.to(device)
    for part in torch.split(index, chunk):
        result[part] = model(field, rays[part].to(device)).to(result)
    return result
