"""Phantoms: analytic fields with exact gradients, for simulated measurements.

gaussians    random Gaussian balls (paper, Phantom 1)
flame        turbulent Bunsen flame (in place of the paper's Phantoms 2-7)
octahedron   paper, Eq. (SRphantom), for the spatial resolution
turbulence, fire                      turbulent plume and fire front (turbulence.py)
gaussian-jet, plume, underexpanded    axisymmetric flows (jets.py)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.arrays import Points, Values, Vectors
from nerif.common.conventions import InputError
from nerif.fields.field import Field
from nerif.fields.jets import AXISYMMETRIC
from nerif.fields.turbulence import Fire, TurbulentPlume
from nerif.geometry import Box

__all__ = ["Flame", "GaussianBalls", "Octahedron", "Scaled", "make_phantom"]


class GaussianBalls(Field):
    """A sum of Gaussian balls, n - n_ambient = sum_k a_k exp(-|x - c_k|^2 / (2 w_k^2)), c and w in mm."""

    def __init__(
        self, centres: Float[Tensor, "k 3"], widths: Float[Tensor, " k"], amplitudes: Float[Tensor, " k"]
    ) -> None:
        self.centres, self.widths, self.amplitudes = centres, widths, amplitudes

    @classmethod
    def random(cls, box: Box, seed: int, count: int = 12, contrast: float = -2.2e-4) -> GaussianBalls:
        """Return `count` random balls, below 1e-4 of their peaks on the side faces.

        Widths are 5-9 % of the shortest edge, peaks 50-100 % of `contrast`; sums of overlapping balls stay the index of
        a gas lighter than the ambient one.
        """
        uniform, edge = _uniform(seed), min(box.edges)
        widths = edge * (0.05 + 0.04 * uniform(count))
        room = torch.tensor(box.edges, dtype=torch.float64) / 2 - 4.3 * widths[:, None]
        centres = torch.tensor(box.centre, dtype=torch.float64) + (2 * uniform(count, 3) - 1) * room
        amplitudes = contrast * (0.5 + 0.5 * uniform(count))
        return cls(centres, widths, amplitudes)

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        middle = self.centres.mean(dim=0)
        centres, p = (self.centres - middle).to(points), (points - middle.to(points)).reshape(-1, 3)
        inverse, amplitudes = self.widths.to(points) ** -2, self.amplitudes.to(points)
        distance = torch.cdist(p, centres, compute_mode="donot_use_mm_for_euclid_dist")
        ball = amplitudes * torch.exp(-0.5 * inverse * distance.square())
        pull = ball * inverse
        gradient = pull @ centres - pull.sum(dim=1, keepdim=True) * p
        return ball.sum(dim=1).reshape(points.shape[:-1]), gradient.reshape(points.shape)


class Flame(Field):
    """A wrinkled Bunsen flame: cold core, hot products, ambient gas around.

    n - n_ambient = -A H((r - R_i(z) + a) / d_i) H((R_o(z) - r + b) / d_o),   H(s) = (1 + tanh s) / 2

    The flame front R_i is a cone closed at the tip, the outer edge R_o of the products widens upward. The wrinkles
    a, b are sums of plane waves over an 8 : 1 range of wavelengths, convected upward at `speed` and changing slowly.
    A, the contrast, is the index decrease from cold to hot; 2.2e-4 of 2.7e-4 is a density ratio of 5.5.
    """

    shortest, longest = 3.5, 28.0  # wavelengths of the wrinkles, mm
    front, edge = 0.48, 2.4  # d_i and d_o, mm: layers of 2 d = 0.96 mm (thermal thickness) and 4.8 mm
    speed = 1.5e4  # mm/s
    base_radius, taper = 6.0, 0.28  # flame front: radius at the bottom (mm), closing per mm of height
    product_radius, widening = 12.0, 0.03  # outer edge of the products
    waves = 32
    wrinkling = (0.7, 1.3)  # rms of a and b, mm
    lifetime = 1.0e-3  # s, in which a wrinkle of the longest wavelength loses its shape

    def __init__(self, box: Box, time: float = 0.0, seed: int = 0, contrast: float = 2.2e-4) -> None:
        self.box, self.contrast = box, contrast
        uniform = _uniform(seed)
        # lengths above are for a 50 mm box; other flames are scaled to their box
        self.scale = min(box.edges[:2]) / 50.0
        ratio = torch.linspace(0, 1, self.waves, dtype=torch.float64)
        wavelength = self.longest * (self.shortest / self.longest) ** ratio
        cos_polar = 2 * uniform(self.waves) - 1
        azimuth = 2 * math.pi * uniform(self.waves)
        sin_polar = (1 - cos_polar**2).sqrt()
        unit = torch.stack([sin_polar * azimuth.cos(), sin_polar * azimuth.sin(), cos_polar], dim=-1)
        self.wave_vectors = (2 * math.pi / wavelength)[:, None] * unit  # 1/mm
        turnover = (2 * math.pi / self.lifetime) * (wavelength / self.longest) ** (-2 / 3)  # inertial range
        drift = turnover * (2 * uniform(self.waves) - 1)
        phases = 2 * math.pi * uniform(self.waves) - (self.wave_vectors[:, 2] * self.speed + drift) * time
        self.phases = phases.remainder(2 * math.pi)  # single precision does not hold those of late instants
        # velocity ~ wavelength^(1/3) over a turnover time ~ wavelength^(2/3): every scale is equally steep
        amplitude = wavelength.clone()
        amplitude = amplitude / (0.5 * amplitude.square().sum()).sqrt()
        self.amplitudes = amplitude[:, None] * torch.tensor(self.wrinkling, dtype=torch.float64)

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        shape = points.shape
        value, gradient = zip(*(self._evaluate(p) for p in torch.split(points.reshape(-1, 3), 1 << 14)), strict=True)
        return torch.cat(value).reshape(shape[:-1]), torch.cat(gradient).reshape(shape)

    def _evaluate(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
        p = (points - points.new_tensor(self.box.centre)) / self.scale
        k, amplitudes = self.wave_vectors.to(p), self.amplitudes.to(p)
        phase = torch.addmm(self.phases.to(p), p, k.T)
        sine, cosine = phase.sin(), phase.cos()
        a, b = sine @ amplitudes[:, 0], cosine @ amplitudes[:, 1]
        grad_a, grad_b = cosine @ (amplitudes[:, :1] * k), -(sine @ (amplitudes[:, 1:] * k))

        x, y, z = p.unbind(-1)
        r = (x * x + y * y + 0.25).sqrt()  # rounded on the axis
        height = z + 25.0  # above the nozzle, mm
        grad_r = torch.stack([x / r, y / r, torch.zeros_like(r)], dim=-1)
        front = (r - (self.base_radius - self.taper * height) + a) / self.front
        grad_front = grad_r + grad_a
        grad_front[:, 2] += self.taper
        edge = ((self.product_radius + self.widening * height) - r + b) / self.edge
        grad_edge = grad_b - grad_r
        grad_edge[:, 2] += self.widening

        inside, outside = torch.tanh(front), torch.tanh(edge)
        h_i, h_o = 0.5 * (1 + inside), 0.5 * (1 + outside)
        slope_i = 0.5 * (1 - inside * inside) / self.front
        slope_o = 0.5 * (1 - outside * outside) / self.edge
        gradient = (slope_i * h_o)[:, None] * grad_front + (slope_o * h_i)[:, None] * grad_edge
        return -self.contrast * h_i * h_o, (-self.contrast / self.scale) * gradient


class Octahedron(Field):
    """n - n_ambient = amplitude (1.5 - |x| - |y| - |z|) inside the octahedron, 0 outside (paper, Eq. (SRphantom)).

    The paper's 4 x 4 x 4 units fill the box: one unit is a quarter of its shortest edge.
    """

    def __init__(self, box: Box, amplitude: float = 2.2e-4 / 1.5) -> None:
        self.box, self.amplitude, self.unit = box, amplitude, min(box.edges) / 4

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        p = (points - points.new_tensor(self.box.centre)) / self.unit
        height = 1.5 - p.abs().sum(-1)
        inside = (height >= 0).to(p)
        return self.amplitude * height * inside, -(self.amplitude / self.unit) * p.sign() * inside[..., None]


class Scaled(Field):
    """Another field times a factor, such as the burnt fraction of a flame as its extinction or emission."""

    def __init__(self, field: Field, factor: float) -> None:
        self.field, self.factor = field, factor

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        value, gradient = self.field.value_and_gradient(points)
        return self.factor * value, self.factor * gradient


def _uniform(seed: int) -> Callable[..., Tensor]:
    """Random numbers in [0, 1) of any shape."""
    return partial(torch.rand, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


FLAME_INTERVAL = 1e-4  # s between the six instants in place of the paper's Phantoms 2-7


def make_phantom(name: str, box: Box, seed: int = 0, time: float = 0.0) -> Field:
    """Return the phantom called `name`: one of those above, or the paper's number 1-7."""
    if name in ("2", "3", "4", "5", "6", "7"):
        return Flame(box, (int(name) - 2) * FLAME_INTERVAL + time, seed)
    makers: dict[str, Callable[[], Field]] = {
        "gaussians": lambda: GaussianBalls.random(box, seed),
        "flame": lambda: Flame(box, time, seed),
        "octahedron": lambda: Octahedron(box),
        "turbulence": lambda: TurbulentPlume(box, seed),
        "fire": lambda: Fire(box, seed),
        **{name: partial(phantom, box) for name, phantom in AXISYMMETRIC.items()},
    }
    name = "gaussians" if name == "1" else name
    if name not in makers:
        raise InputError(
            f"expected {', '.join(makers)}, 1-7 (the paper's) or a .nc or .vti volume, got '{name}'", field="phantom"
        )
    return makers[name]()
