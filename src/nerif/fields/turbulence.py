"""Turbulent phantoms from a scalar with the spectrum of the inertial range: a plume, and the fronts of a fire."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nerif.common.arrays import Points, Values, Vectors
from nerif.common.conventions import InputError
from nerif.fields.field import Field
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid

__all__ = ["Fire", "TurbulentPlume", "inertial_scalar"]

LONGEST, SHORTEST = 0.5, 0.0112
"""Wavelengths of the inertial range, shares of the shortest edge: of 50 mm, 25 mm and two pixels of the paper's rig."""


def inertial_scalar(
    box: Box, seed: int, shortest: float = SHORTEST, longest: float = LONGEST, slope: float = 5 / 3
) -> VoxelField:
    """Return a homogeneous, isotropic Gaussian field of mean 0 and variance 1 with E(k) ~ k^-slope.

    The spectrum is 0 outside the wavelengths `shortest` to `longest`, shares of the shortest edge. The field is
    periodic in the box.
    """
    if not 0 < shortest < longest:
        raise InputError(f"expected a share of the edge between 0 and {longest}, got {shortest}", field="shortest")
    edge = min(box.edges)
    shape = [math.ceil(2 * length / (shortest * edge)) for length in reversed(box.edges)]  # z, y, x
    generator = torch.Generator().manual_seed(seed)
    white = torch.fft.rfftn(torch.randn(shape, generator=generator))
    spacing = [length / n for length, n in zip(reversed(box.edges), shape, strict=True)]
    z, y = (torch.fft.fftfreq(n, d) for n, d in zip(shape[:2], spacing[:2], strict=True))
    x = torch.fft.rfftfreq(shape[2], spacing[2])
    k = (z[:, None, None].square() + y[:, None].square() + x.square()).sqrt() * edge  # waves per edge
    inertial = (k >= 1 / longest) & (k <= 1 / shortest)
    # E(k) ~ k^2 |f(k)|^2 ~ k^-slope
    amplitude = torch.where(inertial, k.clamp_min(1e-9) ** (-0.5 * slope - 1), 0.0)
    values = torch.fft.irfftn(white * amplitude, s=shape)
    return VoxelField.through(values / values.std(), Grid(box, tuple(shape)))  # type: ignore[arg-type]


class TurbulentPlume(Field):
    """A hot plume, turbulent down to the pixel: n - n_ambient = -A exp(-r^2 / (2 w^2)) (1 + tanh(b g)) / 2.

    g is an `inertial_scalar` with `seed` and `shortest`, A the contrast.
    """

    width, intensity = 0.13, 0.6  # w in shortest edges; b

    def __init__(self, box: Box, seed: int = 0, shortest: float = SHORTEST, contrast: float = 2.2e-4) -> None:
        self.box, self.contrast, self.scalar = box, contrast, inertial_scalar(box, seed, shortest)

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        g, slope = self.scalar.value_and_gradient(points)
        across, inverse = _across(points, self.box), (self.width * min(self.box.edges)) ** -2
        envelope = torch.exp(-0.5 * inverse * across.square().sum(-1))
        mixed = torch.tanh(self.intensity * g)
        f, steep = 0.5 * (1 + mixed), 0.5 * self.intensity * (1 - mixed.square())
        gradient = steep[..., None] * slope - (inverse * f)[..., None] * across
        return -self.contrast * envelope * f, (-self.contrast * envelope)[..., None] * gradient


class Fire(Field):
    """A buoyant fire: hot gas within a thin, folded front, with detached pockets,

        n - n_ambient = -A (1 + tanh(h / d)) / 2,      h = R(z) - r + b g.

    g is an `inertial_scalar` with `seed` and `shortest`, A the contrast, and R the radius of the plume, which necks and
    widens.
    """

    front, wrinkling = 0.012, 0.07  # d and b, shares of the shortest edge
    radius, necking = 0.16, 0.04

    def __init__(self, box: Box, seed: int = 0, shortest: float = 4 * SHORTEST, contrast: float = 2.2e-4) -> None:
        self.box, self.contrast, self.scalar = box, contrast, inertial_scalar(box, seed, shortest)

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        edge = min(self.box.edges)
        g, slope = self.scalar.value_and_gradient(points)
        across, z = _across(points, self.box), (points[..., 2] - self.box.centre[2]) / self.box.edges[2]
        r = (across.square().sum(-1) + (0.01 * edge) ** 2).sqrt()  # rounded on the axis
        angle = 2 * math.pi * z
        neck = edge * (self.radius - self.necking * angle.sin())
        h = neck - r + self.wrinkling * edge * g
        gradient = self.wrinkling * edge * slope - across / r[..., None]
        along = -edge * self.necking * angle.cos() * (2 * math.pi / self.box.edges[2])
        gradient = gradient + along[..., None] * gradient.new_tensor([0.0, 0.0, 1.0])
        inside = torch.tanh(h / (self.front * edge))
        steep = 0.5 * (1 - inside.square()) / (self.front * edge)
        return -0.5 * self.contrast * (1 + inside), (-self.contrast * steep)[..., None] * gradient


def _across(points: Points, box: Box) -> Tensor:
    """Displacement from the vertical axis of the box."""
    return (points - points.new_tensor(box.centre)) * points.new_tensor([1.0, 1.0, 0.0])
