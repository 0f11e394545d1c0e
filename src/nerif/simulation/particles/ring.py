"""A vortex ring: an incompressible flow of exact velocity, for particles to move in.

    u(x) = Gamma / (4 pi) sum_i t_i x (x - y_i) / r_i^3 q(r_i / core),      r_i = |x - y_i|
    q(s) = erf(s / sqrt 2) - sqrt(2 / pi) s exp(-s^2 / 2)

t_i (mm) are the segments at y_i of a circle of vorticity, each blurred by a Gaussian (law of Biot and Savart). Each
term is a curl, so that the divergence is 0; far away the velocity decays as 1 / r^3.

Source: Leonard, Vortex methods for flow simulation, J. Comput. Phys. 37 (1980) 289; the Gaussian core of Winckelmans &
Leonard, J. Comput. Phys. 109 (1993) 247.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.settings import Length, check_settings
from nerif.geometry import Box
from nerif.simulation.particles.cloud import Particles

__all__ = ["VortexRing"]

SEGMENTS = 128  # of the circle
MIN_CORE = 0.05  # of the radius: thinner cores need more segments
CHUNK = 2048  # points at a time
PROFILE_POINTS = 201  # across the ring, to find the largest velocity
NEAR = 1e-2  # core radii, below which q(s) / s^3 is replaced by its limit


@dataclass(frozen=True)
class VortexRing:
    """A stationary vortex ring around the z-axis with velocity along +z in its middle."""

    radius: Length  #: of the circle, mm
    core: Length  #: standard deviation of the vorticity around it, mm
    circulation: float  #: Gamma, mm^2/s
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: mm

    def __post_init__(self) -> None:
        check_settings(self)
        if self.core < MIN_CORE * self.radius:
            raise InputError(
                f"expected at least {MIN_CORE} of the radius, {self.radius} mm, got {self.core}", field="core"
            )

    @classmethod
    def within(cls, box: Box, speed: float) -> VortexRing:
        """Return a ring in a box, of a largest speed (mm/s): radius 0.3 of the z edge, core 0.3 of that."""
        radius = 0.3 * box.edges[2]
        unit = cls(radius, 0.3 * radius, 1.0)
        across = torch.zeros(PROFILE_POINTS, 3, dtype=torch.float64)
        across[:, 0] = torch.linspace(0, 2 * radius, PROFILE_POINTS)
        fastest = float(unit.velocity(across).norm(dim=1).max())  # in the plane of the ring
        return cls(radius, 0.3 * radius, speed / fastest, box.centre)

    def velocity(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return the velocity, mm/s, at points, mm."""
        points = points.double()
        angle = torch.arange(SEGMENTS, dtype=torch.float64) * (2 * math.pi / SEGMENTS)
        zero = torch.zeros_like(angle)
        outward = torch.stack([angle.cos(), angle.sin(), zero], dim=1)
        along = torch.stack([-angle.sin(), angle.cos(), zero], dim=1) * (2 * math.pi * self.radius / SEGMENTS)
        where = points.new_tensor(self.centre) + self.radius * outward
        parts = []
        for part in points.split(CHUNK):
            apart = part[:, None] - where
            s = apart.norm(dim=-1) / self.core
            inside = torch.erf(s / math.sqrt(2)) - math.sqrt(2 / math.pi) * s * torch.exp(-(s**2) / 2)
            safe = s.clamp_min(NEAR)
            factor = torch.where(s > NEAR, inside / safe**3, math.sqrt(2 / math.pi) / 3)
            parts.append(torch.einsum("nm,nmi->ni", factor, torch.linalg.cross(along.expand_as(apart), apart)))
        return torch.cat(parts) * (self.circulation / (4 * math.pi * self.core**3))

    def advect(self, particles: Particles, seconds: float, steps: int = 8) -> Particles:
        """Return the particles after a time, by Runge-Kutta steps of fourth order, without those outside their box."""
        if steps < 1:
            raise InputError(f"expected at least 1, got {steps}", field="steps")
        x, h = particles.positions.double(), seconds / steps
        for _ in range(steps):
            k1 = self.velocity(x)
            k2 = self.velocity(x + 0.5 * h * k1)
            k3 = self.velocity(x + 0.5 * h * k2)
            k4 = self.velocity(x + h * k3)
            x = x + (h / 6) * (k1 + 2 * k2 + 2 * k3 + k4)
        return particles.moved_to(x)
