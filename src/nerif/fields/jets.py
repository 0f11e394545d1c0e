"""Axisymmetric phantoms: functions of z and r^2, smooth on the axis, which is the vertical centre line of the box.

gaussian-jet    jet that spreads from a virtual origin
plume           hot gas above a candle, with a thin edge
underexpanded   supersonic jet with shock cells
"""

from __future__ import annotations

import math
from abc import abstractmethod

import torch
from torch import Tensor

from nerif.common.arrays import Points, Values, Vectors
from nerif.fields.field import Field
from nerif.geometry import Box

__all__ = ["AXISYMMETRIC", "Axisymmetric", "GaussianJet", "Plume", "UnderexpandedJet"]


class Axisymmetric(Field):
    """A field around the axis of a box (mm), n - n_ambient = f(r^2, h), scaled by a contrast A.

    Lengths are in units of a, half the shorter horizontal edge; the height h is 0 at the bottom of the box, 1 at the
    top.
    """

    contrast: float

    def __init__(self, box: Box, contrast: float | None = None) -> None:
        self.box, self.unit = box, min(box.edges[:2]) / 2
        self.contrast = self.contrast if contrast is None else contrast

    @abstractmethod
    def profile(self, r2: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return f (1), df/d(r^2) and df/dh."""

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        p = points - points.new_tensor(self.box.centre)
        across = p[..., :2] / self.unit
        value, outward, upward = self.profile(across.square().sum(-1), p[..., 2] / self.box.edges[2] + 0.5)
        slope = (2 / self.unit) * outward[..., None] * across
        return value, torch.cat([slope, upward[..., None] / self.box.edges[2]], dim=-1)


class GaussianJet(Axisymmetric):
    """A round jet that spreads from a virtual origin, n - n_ambient = A (w_0 / w) exp(-r^2 / (2 w^2)).

    The width w = w_0 + k h grows and the value on the axis falls as 1 / w, as for a scalar in a self-similar jet. A is
    the index excess on the axis at the bottom, by default of helium into air.

    Source: Pope, Turbulent Flows (2000), section 5.1, for the self-similar round jet.
    """

    contrast = -2.2e-4
    width, spreading = 0.08, 0.16  # w_0 and k

    def profile(self, r2: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        w = self.width + self.spreading * h
        scaled = r2 / w.square()
        value = self.contrast * self.width / w * torch.exp(-0.5 * scaled)
        return value, -0.5 * value / w.square(), self.spreading * value * (scaled - 1) / w


class Plume(Axisymmetric):
    """Hot gas above a candle with a thin edge, n - n_ambient = -A exp(-c h) (1 + tanh s) / 2.

        s = (R^2 - r^2) / (2 R d),      R = R_0 exp(g h + b sin(3 pi h))

    s is (R - r) / d at the edge. The plume is narrow at the wick, widens, necks and widens again, and cools upward.
    A = 2.2e-4 of 2.7e-4 is a density ratio of 5.5.
    """

    contrast = 2.2e-4

    radius, widening, necking = 0.13, 1.17, 0.4  # R_0, g, b
    edge, cooling = 0.024, 0.35  # d, c

    def profile(self, r2: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        angle = 3 * math.pi * h
        radius = self.radius * torch.exp(self.widening * h + self.necking * angle.sin())
        growth = radius * (self.widening + 3 * math.pi * self.necking * angle.cos())
        inside, by_r2, by_radius, _ = _within(r2, radius, torch.full_like(radius, self.edge))
        strength = -self.contrast * torch.exp(-self.cooling * h)
        return strength * inside, strength * by_r2, strength * (by_radius * growth - self.cooling * inside)


class UnderexpandedJet(Axisymmetric):
    """A supersonic jet with shock cells, n - n_ambient = A [m + exp(-h / h_d) (S(p + q) + S(p - q)) / 2] J(r, h).

        S(p) = arctan(k sin p / (1 - k cos p)) / arcsin(k),      p = 2 pi N h - pi / 2,      q = pi r / R_0
        J = (1 + tanh s) / 2,      s = (R^2 - r^2) / (2 R d)
        R = R_0 + g h + b exp(-h / h_d) sin^2(p / 2),      d = d_0 + d_1 h

    S is a rounded saw tooth between -1 and 1: each cell expands slowly and is compressed in a thin front. The fronts
    are cones that cross on the axis once in each of the N cells and reach the boundary J half a cell later. The
    boundary bulges with the cells, and its shear layer d thickens. A is the index excess of the first cells; densities
    are 0.5 to 1.7 times that of the ambient air.

    Source: Pack, Q. J. Mech. Appl. Math. 3 (1950) 173, for cells that are periodic along the axis.
    """

    contrast = 1.6e-4
    cells, decay, mean, sharpness = 3.5, 0.8, 0.2, 0.9  # N, h_d, m, k
    radius, growth, bulge = 0.28, 0.07, 0.05  # R_0, g, b
    layer, thickening = 0.02, 0.06  # d_0, d_1

    def profile(self, r2: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        wave = 2 * math.pi * self.cells
        phase, fading = wave * h - 0.5 * math.pi, torch.exp(-h / self.decay)
        r = (r2 + 1e-6).sqrt()  # rounded: the sum of both saw teeth is even in r
        q = (math.pi / self.radius) * r
        ahead, behind = self._saw_tooth(phase + q), self._saw_tooth(phase - q)
        pattern = 0.5 * fading * (ahead[0] + behind[0])
        pattern_by_r2 = 0.25 * fading * (ahead[1] - behind[1]) * (math.pi / self.radius) / r
        pattern_by_h = 0.5 * fading * (ahead[1] + behind[1]) * wave - pattern / self.decay

        swell = self.bulge * fading
        radius = self.radius + self.growth * h + swell * (0.5 * phase).sin().square()
        swelling = swell * (0.5 * wave * phase.sin() - (0.5 * phase).sin().square() / self.decay)
        inside, by_r2, by_radius, by_edge = _within(r2, radius, self.layer + self.thickening * h)
        by_h = by_radius * (self.growth + swelling) + by_edge * self.thickening
        level = self.mean + pattern
        return (
            self.contrast * level * inside,
            self.contrast * (level * by_r2 + pattern_by_r2 * inside),
            self.contrast * (level * by_h + pattern_by_h * inside),
        )

    def _saw_tooth(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """S and its derivative."""
        k, sine, cosine = self.sharpness, phase.sin(), phase.cos()
        scale = 1 / math.asin(k)
        slope = (k * cosine - k * k) / (1 - 2 * k * cosine + k * k)
        return scale * torch.atan2(k * sine, 1 - k * cosine), scale * slope


def _within(r2: Tensor, radius: Tensor, edge: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(1 + tanh s) / 2 with s = (R^2 - r^2) / (2 R d), and its derivatives by r^2, R and d."""
    s = (radius.square() - r2) / (2 * radius * edge)
    inside = torch.tanh(s)
    steep = 0.5 * (1 - inside.square())
    by_radius = steep * (radius.square() + r2) / (2 * radius.square() * edge)
    return 0.5 * (1 + inside), -steep / (2 * radius * edge), by_radius, -steep * s / edge


AXISYMMETRIC: dict[str, type[Axisymmetric]] = {
    "gaussian-jet": GaussianJet, "plume": Plume, "underexpanded": UnderexpandedJet,
}  # fmt: skip
"""The phantoms by name."""
