"""Toy techniques, and the rig on which techniques and projectors are tried."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.forward.forward_model import ForwardModel, Light, Weights
from nerif.geometry import Box, Rays, Ring

BOX = Box((-10.0, -8.0, -6.0), (9.0, 11.0, 7.0))
RING = Ring(views=5, image_size=(18, 23), pixel_pitch=0.13, distance=400.0, background_distance=300.0)


@dataclass(frozen=True)
class Knife(ForwardModel):
    """Deflections across and along an edge, weaker the deeper, and a little of the field itself."""

    name, measured, sigma = "knife", "grey", "grey_sigma"
    channels = ("across", "along", "open")
    unit = "1"
    limits = (1e-9, 1e9)
    quantity = "index_excess"

    @classmethod
    def of(cls, light: Light, model: str) -> ForwardModel:
        return cls()

    def weights(self, rays: Rays, s: Float[Tensor, "n m"], step: Float[Tensor, "n m"]) -> Weights:
        up = rays.direction.new_tensor([[0.0, 0.0, 1.0]]).expand_as(rays.direction)
        side = torch.linalg.cross(rays.direction, up)
        depth = (s - rays.near[:, None]) / 40
        value = rays.near.new_tensor([300.0, 100.0, 200.0]).expand(len(rays), 3)
        slope = 3e3 * torch.stack([side, torch.linalg.cross(side, rays.direction), 0 * side], dim=1)
        return Weights(torch.exp(-depth) * step, value=value, slope=slope)


@dataclass(frozen=True)
class Cubic(Knife):
    """A profile antisymmetric about the middle of the ray, but not linear."""

    name, channels = "cubic", ("",)

    def weights(self, rays: Rays, s: Float[Tensor, "n m"], step: Float[Tensor, "n m"]) -> Weights:
        middle = 0.5 * (rays.near + rays.far)[:, None]
        return Weights(((s - middle) / 10) ** 3 * step, value=step.new_ones(len(rays), 1))
