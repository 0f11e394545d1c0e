"""The lens of a camera: a pixel gathers the rays from all of its disc that meet in one point in focus.

    L = O + r (x e_1 + y e_2),  |(x, y)| <= 1        a point of the disc about the camera's centre O, of radius r
    X_f = O + s_f t                                  in focus on the pixel's own ray, O + s t
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import LARGEST_LENGTH, InputError
from nerif.geometry.columns import Columns
from nerif.geometry.grid import Box

__all__ = ["Lens", "LensDiscs", "disc_points"]

SEED = 20  # of points that have to be the same every time
MANY = 8  # points, from which on they stand on two rings
RINGS = (0.5,), (0.5 - 0.5 / math.sqrt(3), 0.5 + 0.5 / math.sqrt(3))  # squares of their radii


@dataclass(frozen=True)
class Lens:
    """A thin lens of finite aperture.

    Parameters
    ----------
    diameter : of the entrance pupil (focal length / f-number) or, of a telecentric lens, of the cone of rays to a point
        in focus where it passes z_cam = 0; mm; 0 for a thin ray a pixel
    focus : depth of the plane in focus along the optical axis, mm, below 0 only of a telecentric lens; None for the
        background's
    points : number of points on the disc, where pictures are rendered and measurements simulated

    Raises
    ------
    InputError
        If one of them cannot be.
    """

    diameter: float = 0.0
    focus: float | None = None
    points: int = 19

    def __post_init__(self) -> None:
        if not 0 <= self.diameter <= LARGEST_LENGTH:
            raise InputError(f"aperture_diameter: expected a lens of 0 mm or more, got {self.diameter}")
        if self.focus is not None and not 0 < abs(self.focus) <= LARGEST_LENGTH:
            raise InputError(f"focus_distance: expected a lens in focus elsewhere than at 0 mm, got {self.focus}")
        if self.points < 1:
            raise InputError(f"points: expected at least one point on the lens, got {self.points}")

    def offsets(self) -> Float[Tensor, "n 2"]:
        """Return points spread evenly over the disc (sunflower spiral), in shares of its radius; one for a thin ray."""
        if self.diameter == 0:
            return torch.zeros(1, 2, dtype=torch.float64)
        i = torch.arange(self.points, dtype=torch.float64)
        radius, angle = torch.sqrt((i + 0.5) / self.points), i * math.pi * (3 - math.sqrt(5))
        return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)], dim=-1)


@dataclass(frozen=True)
class LensDiscs(Columns):
    """The disc of the lens that each ray passes in the middle.

    Parameters
    ----------
    axis : (n, 3) unit vector of the optical axis, which the disc stands across
    normal : (n, 3) unit vector of the background's normal; the axis where there is none
    radius : (n,) mm
    focus : (n,) path length from the ray's origin to the point in focus, mm
    box : what rays through other points of the disc are clipped to, or None
    """

    axis: Float[Tensor, "n 3"]
    normal: Float[Tensor, "n 3"]
    radius: Float[Tensor, " n"]
    focus: Float[Tensor, " n"]
    box: Box | None = None

    def points(self, disc: Float[Tensor, "n k 2"]) -> Float[Tensor, "n k 3"]:
        """Return how far from its middle points of the disc are (mm), given in shares of its radius."""
        # across the axis, by the coordinate that the axis has least of
        least = torch.nn.functional.one_hot(self.axis.abs().argmin(dim=-1), 3).to(self.axis)
        first = torch.nn.functional.normalize(torch.linalg.cross(self.axis, least), dim=-1)
        second = torch.linalg.cross(self.axis, first)
        x, y = (self.radius[:, None] * disc.to(self.axis).unbind(-1)[i] for i in (0, 1))
        return x[..., None] * first[:, None] + y[..., None] * second[:, None]


def disc_points(rays: int, count: int, generator: torch.Generator | None = None) -> Float[Tensor, "n k 2"]:
    """Return points of the unit disc for each ray whose mean is that over the disc, turned at random.

    They stand evenly on one ring, or from MANY on two: the mean of a polynomial is exact up to degree 3 in the radius,
    or 7, and up to the number of points on a ring, less one, in the angle.

    Parameters
    ----------
    count : even, or 1 for the middle
    generator : turns them; None for the same points every time

    Source: Gauss-Legendre quadrature in the square of the radius; Stroud, Approximate Calculation of Multiple Integrals
    (1971), S2.
    """
    if count == 1:
        return torch.zeros(rays, 1, 2)
    assert count % 2 == 0, "so many points stand on rings"
    rings = RINGS[count >= MANY]
    on_ring = count // len(rings)
    turn = torch.rand(rays, 1, 1, generator=generator or torch.Generator().manual_seed(SEED))
    share = torch.arange(on_ring) / on_ring + torch.arange(len(rings))[:, None] / (len(rings) * on_ring)
    angle = 2 * math.pi * (turn + share)
    radius = torch.tensor(rings).sqrt()[:, None]
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)], dim=-1).flatten(1, 2)
