"""The rigid motion that no camera sees: of all cameras with the field. Errors before it and after it."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import Points, Values, Vectors
from nerif.data.volume import Volume
from nerif.fields.base import Field, in_chunks
from nerif.geometry.pose import rotation_matrix

__all__ = ["Moved", "aligned"]

POINTS, ROUNDS = 60_000, 12
SETTLED = 1e-5  # mm, and as much at the edge of the grid


class Moved(Field):
    """Another field, moved: g(x) = f(exp([w]x) x + c).

    Parameters
    ----------
    field : f
    turn : (3,) w, rad
    shift : (3,) c, mm
    """

    def __init__(self, field: Field, turn: Float[Tensor, 3], shift: Float[Tensor, 3]) -> None:
        self.field, self.turn, self.shift = field, turn, shift

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        rotation = rotation_matrix(self.turn.double()).to(points)
        value, gradient = self.field.value_and_gradient(points @ rotation.T + self.shift.to(points))
        return value, gradient @ rotation

    def to(self, device: torch.device | str) -> Moved:
        return Moved(self.field.to(device), self.turn, self.shift)


@torch.no_grad()
def aligned(field: Field, truth: Volume) -> Moved:
    """Return a field moved rigidly to where it is closest to a truth on the truth's grid (Gauss and Newton).

        min_(w, c)  sum |f(exp([w]x) x + c) - truth|^2

    Parameters
    ----------
    field : of the truth's quantity
    """
    points = truth.grid.points().reshape(-1, 3)
    some = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:POINTS]
    points, wanted = points[some], truth.values.flatten()[some].double()
    reach = float(points.norm(dim=1).max())
    found = Moved(field, torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    for _ in range(ROUNDS):
        seen = [found.value_and_gradient(some) for some in in_chunks(points)]
        value, slope = (torch.cat(parts).double() for parts in zip(*seen, strict=True))
        rotation = rotation_matrix(found.turn)
        place, slope = points.double() @ rotation.T, slope @ rotation.T  # where f is asked, but for the shift
        jacobian = torch.cat([torch.linalg.cross(place, slope) * (1 / reach), slope], dim=1)
        step = torch.linalg.lstsq(jacobian, (wanted - value)[:, None]).solution[:, 0]
        found = Moved(field, found.turn + step[:3] / reach, found.shift + step[3:])
        if float(step.abs().max()) < SETTLED:
            break
    return found
