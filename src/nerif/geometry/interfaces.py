"""Plane interfaces between a camera and the flow, such as windows and tanks: exact refraction of rays, its inverse.

With indices n_1, n_2 before and behind a plane of unit normal N (N . t > 0), r = n_1 / n_2, c = N . t, Snell's law is

    t' = r t + (g - r c) N,    g = (1 - r^2 (1 - c^2))^(1/2)    imaginary at total reflection
    X  = O + l t,              l = (offset - N . O) / c

A ray depends on the image (x, y) of its pixel, and so do its derivatives, of which the planes make

    dt' = r dt + (r^2 c / g - r) (N . dt) N,    dX = dO + l dt - t N . (dO + l dt) / c

For a point X = O + s t of the ray behind the last plane, A = dO + s dt across t (two vectors in space) is invertible
there: d(x, y) / dX = A^+. This gives the sensitivity, and the steps of Newton's method for the ray through a point.
Where a motion m of the camera moves the ray through its image by dX / dm, d(x, y) / dm = -A^+ dX / dm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.arrays import Pixels, Points, Values, Vectors, make_tensors
from nerif.common.conventions import LARGEST_LENGTH, InputError

__all__ = ["MAX_INTERFACES", "Interface", "Line", "image_of"]

MAX_INTERFACES = 3
INDICES = (1.0, 4.0)  # of the medium behind an interface
NEWTON_STEPS, CONVERGED, ACCEPTED = 30, 1e-14, 1e-10  # steps, over the size of (x, y)


@dataclass(frozen=True)
class Interface:
    """The plane normal . x = offset (mm, world frame), behind which, as the camera sees it, the index is another."""

    normal: Float[Tensor, 3]  #: unit vector of either sign
    offset: float  #: mm
    index: float  #: refractive index behind the plane, relative to that around the camera

    def __post_init__(self) -> None:
        make_tensors(self, torch.float64, "normal")
        length = float(self.normal.norm())
        if not abs(length - 1) < 1e-3:
            raise InputError(f"expected a unit vector, got length {length:g}", field="interface normal")
        if not abs(self.offset) <= LARGEST_LENGTH:
            raise InputError(f"expected up to {LARGEST_LENGTH:g} mm, got {self.offset}", field="interface offset")
        if not INDICES[0] <= self.index <= INDICES[1]:
            low, high = INDICES
            raise InputError(f"expected {low:g} to {high:g}, got {self.index}", field="interface index")
        object.__setattr__(self, "normal", self.normal.double() / length)
        object.__setattr__(self, "offset", self.offset / length)


@dataclass(frozen=True)
class Line:
    """Lines of sight in one medium, and their derivatives by the image (x, y), and optionally by motions."""

    origin: Points  #: mm
    direction: Vectors  #: unit vector
    origin_slope: Float[Tensor, "*batch p 3"]  #: d origin / d (x, y, motions)
    direction_slope: Float[Tensor, "*batch p 3"]  #: d direction / d (x, y, motions)

    @classmethod
    def of(
        cls, origin: Points, heading: Vectors, origin_slope: Float[Tensor, "*#batch p 3"],
        heading_slope: Float[Tensor, "*#batch p 3"],
    ) -> Line:  # fmt: skip
        """Return lines along headings of any length."""
        length = heading.norm(dim=-1, keepdim=True)
        direction = heading / length
        slope = _across(heading_slope.expand(*heading.shape[:-1], -1, 3), direction) / length[..., None]
        return cls(origin, direction, origin_slope.expand_as(slope), slope)

    def behind(self, interfaces: Sequence[Interface], forward: bool) -> Line:
        """Return the lines behind all interfaces, with origins on the last; NaN if they cannot get there.

        Parameters
        ----------
        forward : whether the lines begin at their origins, and not at infinity
        """
        line, index = self, 1.0
        for interface in interfaces:
            line = line._refracted(interface, index / interface.index, forward)
            index, forward = interface.index, True
        return line

    def _refracted(self, interface: Interface, ratio: float, forward: bool) -> Line:
        t, normal = self.direction, interface.normal.to(self.direction)
        normal = torch.where(t @ normal < 0, -1.0, 1.0)[..., None].to(t) * normal
        cosine = (t * normal).sum(-1, keepdim=True)
        plane = interface.offset * (normal @ interface.normal.to(t))[..., None]
        length = (plane - (self.origin * normal).sum(-1, keepdim=True)) / cosine
        blocked = (length < -1e-9) if forward else torch.zeros_like(length, dtype=torch.bool)
        moved = self.origin_slope + length[..., None] * self.direction_slope
        moved = moved - (moved @ normal[..., None]) / cosine[..., None] * t[..., None, :]
        g = (1 - ratio**2 * (1 - cosine**2)).sqrt()  # NaN at total reflection
        turned = self.direction_slope @ normal[..., None]
        turned = (ratio**2 * cosine / g - ratio)[..., None] * turned * normal[..., None, :]
        direction = (ratio * t + (g - ratio * cosine) * normal).masked_fill(blocked, torch.nan)
        return Line(self.origin + length * t, direction, moved, ratio * self.direction_slope + turned)

    @property
    def begin(self) -> Values:
        """Path length (mm) of the apparent optical centre, where lines of neighbouring pixels are closest; at most 0.

        0 for parallel lines, which have none.
        """
        slope = self.direction_slope[..., :2, :]
        square = slope.square().sum((-1, -2))
        centre = -(_across(self.origin_slope[..., :2, :], self.direction) * slope).sum((-1, -2)) / square
        return torch.where(square > 0, centre, 0.0)

    def image_slope(self, points: Points) -> Float[Tensor, "*batch 2 3"]:
        """Return d (x, y) / d X (1/mm) at points of the lines; 0 along the line."""
        s = ((points - self.origin) * self.direction).sum(-1)[..., None, None]
        a = _across((self.origin_slope + s * self.direction_slope)[..., :2, :], self.direction)
        x, y = a.unbind(-2)
        xx, xy, yy = ((i * j).sum(-1, keepdim=True) for i, j in ((x, x), (x, y), (y, y)))
        return torch.stack([yy * x - xy * y, xx * y - xy * x], dim=-2) / (xx * yy - xy * xy)[..., None]

    def motion_slope(self, points: Points) -> Float[Tensor, "*batch 2 m"]:
        """Return d (x, y) / d motion at points of the lines."""
        s = ((points - self.origin) * self.direction).sum(-1)[..., None, None]
        moved = (self.origin_slope + s * self.direction_slope)[..., 2:, :]
        return -self.image_slope(points) @ moved.transpose(-1, -2)


def image_of(points: Points, line_of: Callable[[Pixels], Line], start: Pixels) -> Pixels:
    """Return the image (x, y) whose line passes through a point (mm), by Newton's method; NaN if there is none.

    Parameters
    ----------
    line_of : line behind the interfaces of an image (x, y)
    start : first guess
    """
    image, error, size = start, torch.full_like(start, torch.inf), 1.0
    for _ in range(NEWTON_STEPS):
        line = line_of(image)
        step = (line.image_slope(points) @ (points - line.origin)[..., None])[..., 0]
        image, error = image + step, step.abs()
        size = max(1.0, float(image.nan_to_num().abs().amax())) if image.numel() else 1.0
        if not image.numel() or float(error.nan_to_num().amax()) < CONVERGED * size:
            break
    return torch.where((error < ACCEPTED * size).all(-1, keepdim=True), image, math.nan)


def _across(vectors: Float[Tensor, "*batch p 3"], direction: Vectors) -> Float[Tensor, "*batch p 3"]:
    """The parts of vectors across a unit direction."""
    t = direction[..., None, :]
    return vectors - (vectors * t).sum(-1, keepdim=True) * t
