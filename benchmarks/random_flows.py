"""Random flows, smooth and sharp, each from an integer; test cases of the verdict (measurements.py)."""

from __future__ import annotations

import math
import random

import torch
from torch import Tensor

from nerif.common.arrays import Points, Values, Vectors
from nerif.fields.field import Field
from nerif.fields.turbulence import inertial_scalar
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box

CONTRAST = 2.2e-4
EDGE = 50.0  # mm


class Bodies(Field):
    """Bodies of hot gas, wrinkled or cloudy: n - n_ambient = -w sum_k A_k exp(-e rho_k^2 / 2) (1 + tanh h_k) / 2,

        h_k = (s (1 - rho_k) + b g) / d,      rho_k = |M_k (x - c_k)|,      w = (1 - u^8)^2 (1 - v^8)^2,

    where g is a random scalar (turbulence.py), and u, v go from -1 to 1 between the side faces, which are ambient. With
    s = 1, e = 0 it is 1 inside a front of thickness d that g wrinkles; with s = 0, e = 1 a Gaussian that g mottles.

    Parameters
    ----------
    box : Box, mm
    scalar : g
    centres : (k, 3) mm
    shapes : (k, 3, 3) M_k, 1/mm
    amplitudes : (k,) A_k
    front, fade, wrinkling, thickness : s, e, b, d
    """

    def __init__(
        self, box: Box, scalar: VoxelField, centres: Tensor, shapes: Tensor, amplitudes: Tensor,
        front: float, fade: float, wrinkling: float, thickness: float,
    ) -> None:  # fmt: skip
        self.box, self.scalar, self.centres, self.shapes, self.amplitudes = box, scalar, centres, shapes, amplitudes
        self.front, self.fade, self.wrinkling, self.thickness = front, fade, wrinkling, thickness

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        g, slope = self.scalar.value_and_gradient(points)
        value, gradient = torch.zeros_like(g), torch.zeros_like(slope)
        for centre, shape, amplitude in zip(self.centres, self.shapes, self.amplitudes, strict=True):
            m = shape.to(points)
            across = (points - centre.to(points)) @ m.T
            rho = (across.square().sum(-1) + 1e-4).sqrt()  # rounded in the middle
            outward = (across @ m) / rho[..., None]
            inside = torch.tanh((self.front * (1 - rho) + self.wrinkling * g) / self.thickness)
            envelope = -float(amplitude) * torch.exp(-0.5 * self.fade * rho.square())
            filled, steep = 0.5 * (1 + inside), 0.5 * (1 - inside.square()) / self.thickness
            value = value + envelope * filled
            change = self.wrinkling * slope - self.front * outward
            fading = (self.fade * rho * filled)[..., None] * outward
            gradient = gradient + envelope[..., None] * (steep[..., None] * change - fading)
        middle, half = points.new_tensor(self.box.centre), 0.5 * points.new_tensor(self.box.edges)
        u = ((points - middle) / half) * points.new_tensor([1.0, 1.0, 0.0])
        sides = 1 - u**8
        window = sides.prod(-1).square()
        fall = -16 * u**7 / (half * sides.clamp_min(1e-9))  # of log w
        return window * value, window[..., None] * (gradient + value[..., None] * fall)


def random_flow(seed: int) -> tuple[Bodies, bool]:
    """Return a random flow, and whether it is a mottled Gaussian rather than bodies within fronts."""
    rng, box = random.Random(104_729 * seed + 7), Box.cube(EDGE)
    cloudy = rng.random() < 0.5
    longest = rng.uniform(0.2, 0.6)
    if cloudy:
        shortest = longest * math.exp(rng.uniform(math.log(0.05), math.log(0.5)))
        scalar = inertial_scalar(box, seed, max(shortest, 0.02), longest, rng.uniform(1.0, 4.0))
        places = _places(box, rng, rng.choice((1, 1, 2, 4)), (0.06, 0.12))
        wrinkling = rng.choice((0.0, 0.4, 1.2))
        return Bodies(box, scalar, *places, front=0.0, fade=1.0, wrinkling=wrinkling, thickness=1.0), True
    shortest = longest * math.exp(rng.uniform(math.log(0.1), math.log(0.7)))
    scalar = inertial_scalar(box, seed, max(shortest, 0.03), longest, rng.uniform(1.5, 4.0))
    places = _places(box, rng, rng.choice((1, 1, 2, 3, 5)), (0.09, 0.2))
    thickness = math.exp(rng.uniform(math.log(0.05), math.log(0.3)))
    wrinkling = rng.choice((0.0, 0.1, 0.3))
    return Bodies(box, scalar, *places, front=1.0, fade=0.0, wrinkling=wrinkling, thickness=thickness), False


def _places(box: Box, rng: random.Random, count: int, sizes: tuple[float, float]) -> tuple[Tensor, Tensor, Tensor]:
    """Centres, shapes and amplitudes of bodies clear of the sides; one in three reaches through bottom and top."""
    generator = torch.Generator().manual_seed(rng.randrange(1 << 30))
    centres, shapes = [], []
    for _ in range(count):
        radius = [rng.uniform(*sizes) * EDGE * min(1.0, 1.6 / count**0.5) for _ in range(3)]
        room = [0.5 * EDGE - 1.7 * max(radius[:2])] * 2 + [0.3 * EDGE]
        if rng.random() < 1 / 3:
            radius[2] = 0.8 * EDGE
        centre = [c + rng.uniform(-1, 1) * max(r, 0.0) * 0.8 for c, r in zip(box.centre, room, strict=True)]
        angle = rng.uniform(0, math.pi)
        turn = torch.tensor(
            [[math.cos(angle), math.sin(angle), 0], [-math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
        ).double()
        centres.append(torch.tensor(centre).double())
        shapes.append(torch.diag(1 / torch.tensor(radius).double()) @ turn)
    amplitudes = CONTRAST * (0.5 + 0.5 * torch.rand(count, generator=generator, dtype=torch.float64)) / count**0.5
    return torch.stack(centres), torch.stack(shapes), amplitudes
