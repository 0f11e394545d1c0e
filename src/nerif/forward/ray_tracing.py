"""Curved rays: the ray equation integrated through the field (paper, App. B).

    dR/dt = T,   dT/dt = D(R) = n grad(n),   dt = ds / n

One Runge-Kutta step of fourth order for this special equation, with A, B, C = D at the start, middle and end:

    A = h D(R),  B = h D(R + h T/2 + h A/8),  C = h D(R + h T + h B/2)
    R <- R + h (T + (A + 2 B)/6),   T <- T + (A + 4 B + C)/6

Source: Sharma, Kumar, Ghatak, Tracing rays through graded-index media: a new method, Appl. Opt. 21 (1982) 984, of
which App. B of the paper gives a four-stage variant (whose weights add up to 7/6, a misprint).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.pauses import pause
from nerif.common.transfer import in_double
from nerif.fields.field import Field
from nerif.forward.path_integral import LENS_RAYS, FieldProjector
from nerif.geometry import Rays

__all__ = ["CurvedRays", "background_points", "trace"]


def trace(
    field: Field, rays: Rays, steps: int = 150, n_ambient: float = 1.0
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Trace rays through the box; return their position (mm) and unit direction at its far side.

    Positions and directions are in double precision, since a deflection is 1e-4 of a direction; the field is evaluated
    in the precision of `rays`. Outside the box the index is ambient, and its faces do not refract.
    """
    step = in_double((rays.far - rays.near) / steps)[:, None] / n_ambient

    def d(position: Tensor) -> tuple[Tensor, Tensor]:
        excess, gradient = field.value_and_gradient(position.to(rays.origin))
        n = n_ambient + in_double(excess)[:, None]
        return n, step * n * in_double(gradient)

    position, heading = in_double(rays.origin + rays.near[:, None] * rays.direction), in_double(rays.direction)
    for i in range(steps):
        pause()
        n, a = d(position)
        if i == 0:
            heading = n * heading
        b = d(position + step * (heading / 2 + a / 8))[1]
        c = d(position + step * (heading + b / 2))[1]
        position = position + step * (heading + (a + 2 * b) / 6)
        heading = heading + (a + 4 * b + c) / 6
    return position, heading / heading.norm(dim=-1, keepdim=True)


def background_points(field: Field, rays: Rays, steps: int = 150, n_ambient: float = 1.0) -> Float[Tensor, "n 3"]:
    """Return the shift (mm) of each ray's background point by refraction, across the undisturbed ray.

    The bent ray continues straight to its point closest to the background point of the straight one; a shift along the
    line of sight is invisible.
    """
    position, heading = trace(field, rays, steps, n_ambient)
    origin, direction, distance = (in_double(x) for x in (rays.origin, rays.direction, rays.ends.distance))
    path = ((position - origin) * direction).sum(-1)
    cosine = (heading * direction).sum(-1)
    reach = (distance - path) / cosine
    return position + reach[:, None] * heading - (origin + distance[:, None] * direction)


@dataclass(frozen=True)
class CurvedRays(FieldProjector):
    """The `traced` model: d = S (X - X0) with X the background point of the bent ray."""

    channels = 2

    steps: int = 150  # of Runge-Kutta through the box
    n_ambient: float = 1.0

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise InputError(f"expected at least one step through the box, got {self.steps}", field="steps")

    def __call__(self, field: Field, rays: Rays) -> Float[Tensor, "n 2"]:
        if rays.lens is not None:
            spread = rays.spread(LENS_RAYS)
            return spread.mean_of(LENS_RAYS, self(field, spread))
        shift = background_points(field, rays, self.steps, self.n_ambient)
        return torch.einsum("nij,nj->ni", in_double(rays.ends.sensitivity), shift).to(rays.origin)
