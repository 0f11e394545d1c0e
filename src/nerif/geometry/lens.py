"""The ray bundle of a pixel: rays from the lens aperture that meet in the plane in focus, over a window of pixels.

L = O + r (x e_1 + y e_2),  |(x, y)| <= 1        a point of the aperture about the camera's centre O, radius r
X_f = O + s_f t                                  in focus on the pixel's own ray, O + s t
p' = p + w (a, b),  |a|, |b| <= 1                a pixel of the window about p, w half its edge
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Annotated, Any, TypeVar

import torch
from annotated_types import Ge, Le
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import LARGEST_LENGTH, InputError
from nerif.common.settings import Count, check_settings
from nerif.geometry.grid import Box

__all__ = ["Columns", "Lens", "LensDiscs", "spread_points"]

C = TypeVar("C", bound="Columns")


class Columns:
    """A record of arrays with one entry per ray, or of such records; None for an absent one."""

    def each(self: C, change: Callable[..., Tensor], *others: C) -> C:
        """Return the record of change(array, the arrays of `others` in its place) for all arrays.

        Other fields, such as a box, have to be the same in all records.
        """
        columns: dict[str, Any] = {}
        for f in fields(self):  # type: ignore[arg-type]
            first, *more = (getattr(part, f.name) for part in (self, *others))
            if isinstance(first, Columns):
                first = first.each(change, *more)
            elif isinstance(first, Tensor):
                first = change(first, *more)
            else:
                assert all(other == first for other in more), f"{f.name}: expected the same in all records"
            columns[f.name] = first
        return type(self)(**columns)


CHEBYSHEV = (-0.7946544723, -0.1875924741, 0.1875924741, 0.7946544723)  # equal-weight quadrature on -1 to 1
SHUFFLE = 3  # stride through the points of the window, so that neighbours on the disc are not neighbours in it
MAX_WINDOW = 1000  # px
SEED = 20  # of points that are the same in each call
TWO_RINGS = 8  # number of points from which they are placed on two rings
RINGS = (0.5,), (0.5 - 0.5 / math.sqrt(3), 0.5 + 0.5 / math.sqrt(3))  # squares of their radii
PLASTIC = 1.324717957244746  # root of x^3 = x + 1, which gives the most even lattice in a square


@dataclass(frozen=True)
class Lens:
    """Aperture and window of a pixel: a thin lens, and the square of pixels over which a displacement is the mean."""

    diameter: float = 0.0
    """Diameter, mm, of the entrance pupil (focal length / f-number) or, of a telecentric lens, of the cone of rays to a
    point in focus at z_cam = 0; 0 for thin rays."""
    focus: float | None = None
    """Depth of the plane in focus along the optical axis, mm, negative only for a telecentric lens; None: the
    background."""
    points: Count = 19  #: number of points on the disc for rendered images and simulated measurements
    window: Annotated[float, Ge(0), Le(MAX_WINDOW)] = 0.0  #: edge of the square, px; 0 for a displacement at the pixel

    def __post_init__(self) -> None:
        check_settings(self)
        if not 0 <= self.diameter <= LARGEST_LENGTH:
            raise InputError(f"expected 0 mm or more, got {self.diameter}", field="aperture_diameter")
        if self.focus is not None and not 0 < abs(self.focus) <= LARGEST_LENGTH:
            raise InputError(f"expected a distance other than 0 mm, got {self.focus}", field="focus_distance")

    @property
    def wide(self) -> bool:
        """Whether a pixel has more than one thin ray."""
        return self.diameter > 0 or self.window > 0

    def offsets(self) -> Float[Tensor, "n 4"]:
        """Return points of disc (sunflower spiral) and window, over radius and half edge; one for a thin ray."""
        if not self.wide:
            return torch.zeros(1, 4, dtype=torch.float64)
        i = torch.arange(self.points, dtype=torch.float64)
        radius, angle = torch.sqrt((i + 0.5) / self.points), i * math.pi * (3 - math.sqrt(5))
        disc = torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)], dim=-1)
        return torch.cat([disc, _square(torch.full((1, 1, 2), 0.5), self.points)[0].double()], dim=-1)


@dataclass(frozen=True)
class LensDiscs(Columns):
    """The disc of the lens about each ray, and the window about its pixel."""

    axis: Float[Tensor, "n 3"]  #: unit vector of the optical axis, normal to the disc
    normal: Float[Tensor, "n 3"]  #: unit normal of the background; the axis without one
    radius: Float[Tensor, " n"]  #: mm
    focus: Float[Tensor, " n"]  #: path length from the ray's origin to the point in focus, mm
    window: Float[Tensor, " n"]  #: half the edge of the window, px
    parallel: Bool[Tensor, " n"]  #: whether rays of other pixels are parallel to this one, or have the same origin
    box: Box | None = None  #: to which rays through other points of the disc are clipped, or None

    def shifts(
        self, square: Float[Tensor, "n k 2"], sensitivity: Float[Tensor, "n 2 3"], direction: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n k 3"]:
        """Return the shifts on the background (mm) of the ends of other pixels of the window.

            X' = X - S^+ p + t (n . S^+ p) / (n . t),      S^+ = S^T (S S^T)^-1

        Parameters
        ----------
        square : pixels of the window, over half its edge
        sensitivity : S, px/mm
        direction : t of the rays
        """
        p = self.window[:, None, None] * square.to(direction)
        # written out, since a matrix product may be of reduced precision
        square_of = (sensitivity[:, :, None] * sensitivity[:, None]).sum(-1)
        inverse = torch.linalg.solve(square_of, sensitivity)
        across = -(p[..., None] * inverse[:, None]).sum(-2)
        off = (across * self.normal[:, None]).sum(-1) / (direction * self.normal).sum(-1, keepdim=True)
        return across - off[..., None] * direction[:, None]

    def points(self, disc: Float[Tensor, "n k 2"]) -> Float[Tensor, "n k 3"]:
        """Return points of the disc, given over its radius, relative to its centre, mm."""
        # across the axis, from the coordinate axis furthest from it
        other = torch.nn.functional.one_hot(self.axis.abs().argmin(dim=-1), 3).to(self.axis)
        first = torch.nn.functional.normalize(torch.linalg.cross(self.axis, other), dim=-1)
        second = torch.linalg.cross(self.axis, first)
        x, y = (self.radius[:, None] * disc.to(self.axis).unbind(-1)[i] for i in (0, 1))
        return x[..., None] * first[:, None] + y[..., None] * second[:, None]


def spread_points(rays: int, count: int, generator: torch.Generator | None = None) -> Float[Tensor, "n k 4"]:
    """Return points of the unit disc and of the square [-1, 1]^2 for each ray, evenly over both.

    Parameters
    ----------
    count : even, or 1 for the middle
    generator : of a random rotation and shift; None: the same points in each call
    """
    if count == 1:
        return torch.zeros(rays, 1, 4)
    generator = generator or torch.Generator().manual_seed(SEED)
    disc = _disc(rays, count, generator)
    return torch.cat([disc, _square(torch.rand(rays, 1, 2, generator=generator), count)], dim=-1)


def _disc(rays: int, count: int, generator: torch.Generator) -> Float[Tensor, "n k 2"]:
    """Points of the unit disc whose mean approximates that over the disc, rotated at random for each ray.

    They are evenly spaced on one ring, or on two from TWO_RINGS points on: exact for polynomials up to degree 3 or 7 in
    the radius, and up to the number of points on a ring, less one, in the angle.

    Source: Gauss-Legendre quadrature in the square of the radius; Stroud, Approximate Calculation of Multiple Integrals
    (1971), S2.
    """
    assert count % 2 == 0, "expected an even number of points"
    rings = RINGS[count >= TWO_RINGS]
    on_ring = count // len(rings)
    turn = torch.rand(rays, 1, 1, generator=generator)
    share = torch.arange(on_ring) / on_ring + torch.arange(len(rings))[:, None] / (len(rings) * on_ring)
    angle = 2 * math.pi * (turn + share)
    radius = torch.tensor(rings).sqrt()[:, None]
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)], dim=-1).flatten(1, 2)


def _square(start: Float[Tensor, "n 1 2"], count: int) -> Float[Tensor, "n k 2"]:
    """Points of the square [-1, 1]^2, for a mean over it.

    16 are 4 x 4, exact up to degree 5; others a lattice from `start`, folded by the tent function.

    Source: Chebyshev's quadrature; Hickernell, Obtaining O(N^-2+eps) convergence for lattice quadrature rules (2002).
    """
    if count == len(CHEBYSHEV) ** 2:
        row = torch.tensor(CHEBYSHEV)
        order = torch.arange(count) * SHUFFLE % count
        return torch.cartesian_prod(row, row)[order].expand(len(start), -1, -1)
    i = torch.arange(count)[:, None]
    lattice = (start + i * torch.tensor([1 / PLASTIC, 1 / PLASTIC**2])) % 1
    return 1 - 2 * (2 * lattice - 1).abs()
