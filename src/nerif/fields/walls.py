"""A network with the surfaces of bodies: the field may differ on the two sides of a thin plate.

Among the inputs of its first layer is the direction from the nearest surface, which fades with the distance d:

    v = (1 - (d / L)^2)^2 grad d,   d < L,      0 beyond

v is continuous around edges and jumps across a plate, and so may the field (docs/decisions/059).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.fields.network import UNBOUNDED, Network, encode_pullback
from nerif.fields.network_shape import NetworkShape
from nerif.geometry.body import Body, from_surface

__all__ = ["WallNetwork"]

REACH = 0.2  # L, of half the longest edge of the box


class WallNetwork(Network):
    """A network with the direction from the nearest surface of bodies in its coordinates, beside the encoding."""

    beside: ClassVar[int] = 3
    compilable: ClassVar[bool] = False

    def __init__(self, shape: NetworkShape, bodies: Sequence[Body], bounds: tuple[float, float] = UNBOUNDED) -> None:
        super().__init__(shape, bounds)
        self.bodies = tuple(bodies)
        self._last: tuple[Tensor, Tensor, Tensor] | None = None

    def encode(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, "n e"]:
        return torch.cat([super().encode(p), self._directions(p)[0]], dim=1)

    def pull_back(self, p: Tensor, encoded: Tensor, cotangent: Tensor) -> Float[Tensor, "n 3"]:
        slope = encode_pullback(encoded[:, : -self.beside], cotangent[:, : -self.beside], self.waves)
        return slope + (cotangent[:, -self.beside :, None] * self._directions(p)[1]).sum(dim=1)

    def _directions(self, p: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
        """The faded directions at points, and their derivatives; kept, since a step needs them twice."""
        last = self._last
        if last is None or last[0] is not p:
            self._last = last = (p, *from_surface(self.bodies, p, REACH))
        return last[1], last[2]
