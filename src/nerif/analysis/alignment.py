"""Error of a field after its best rigid motion onto the truth: a motion of rig and field together is undetectable."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.arrays import Points, Values, Vectors
from nerif.data.volume import Volume
from nerif.fields.field import Field, in_chunks
from nerif.geometry.pose import rotation_matrix

__all__ = ["MovedField", "aligned"]

MAX_POINTS, MAX_ITERATIONS = 60_000, 12
TOLERANCE = 1e-5  # mm, at the edge of the grid for the rotation


class MovedField(Field):
    """A field in rigid motion: g(x) = f(exp([w]x) x + c).

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

    def to(self, device: torch.device | str) -> MovedField:
        return MovedField(self.field.to(device), self.turn, self.shift)


@torch.no_grad()
def aligned(field: Field, truth: Volume) -> MovedField:
    """Return the field in the rigid motion closest to a truth of its quantity, by Gauss-Newton iteration.

    min_(w, c)  sum |f(exp([w]x) x + c) - truth|^2
    """
    points = truth.grid.points().reshape(-1, 3)
    sample = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:MAX_POINTS]
    sample = sample[truth.values.flatten()[sample].isfinite()]  # not within a body
    points, target = points[sample], truth.values.flatten()[sample].double()
    reach = float(points.norm(dim=1).max())
    result = MovedField(field, torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    for _ in range(MAX_ITERATIONS):
        parts = [result.value_and_gradient(chunk) for chunk in in_chunks(points)]
        value, gradient = (torch.cat(part).double() for part in zip(*parts, strict=True))
        rotation = rotation_matrix(result.turn)
        position, gradient = points.double() @ rotation.T, gradient @ rotation.T
        jacobian = torch.cat([torch.linalg.cross(position, gradient) * (1 / reach), gradient], dim=1)
        step = torch.linalg.lstsq(jacobian, (target - value)[:, None]).solution[:, 0]
        result = MovedField(field, result.turn + step[:3] / reach, result.shift + step[3:])
        if float(step.abs().max()) < TOLERANCE:
            break
    return result
