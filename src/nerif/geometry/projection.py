"""Projections of cameras: perspective and telecentric.

perspective    (x, y) = (X/Z, Y/Z)    rays through the optical centre; K holds focal lengths, px
telecentric    (x, y) = (X, Y)        rays parallel to the optical axis; K holds px per mm
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from nerif.common.conventions import LARGEST_LENGTH, InputError

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from nerif.common.arrays import Pixels, Points, Values
    from nerif.geometry.distortion import Array

__all__ = [
    "MAX_TILT", "PERSPECTIVE", "PROJECTIONS", "TELECENTRIC", "Perspective", "Projection", "Telecentric",
    "projection_named",
]  # fmt: skip

MAX_TILT = 45.0
"""Largest tilt of a sensor behind a projection, degrees."""


class Projection(ABC):
    """From the camera's frame (mm) to its image plane (x, y), before distortion and K, and back."""

    name: ClassVar[str]
    """In files and settings."""
    begin: ClassVar[float]
    """Path length at which rays begin, mm."""
    shows_depth: ClassVar[bool]
    """Whether the image of a point depends on its depth."""
    scale: ClassVar[str]
    """Name of fx and fy of K."""
    unit: ClassVar[str]
    """Unit of fx and fy."""
    least_scale: ClassVar[float]
    """Lower limit of fx and fy."""

    @abstractmethod
    def image(self, local: Array) -> Array:
        """Return (x, y) (..., 2) of points (..., 3)."""

    @abstractmethod
    def slope(self, along_x: Array, along_y: Array, image: Array, local: Array) -> tuple[Array, Array, Array]:
        """Return dg/d(X, Y, Z) of a function with dg/d(x, y) = (along_x, along_y), at points and their (x, y)."""

    @abstractmethod
    def lines(self, image: Pixels) -> tuple[Float[Tensor, "*#batch 3"], Points]:
        """Return the origins, mm, and directions, of any length, of the lines of sight at (x, y)."""

    @abstractmethod
    def sight(self, local: Points) -> Points:
        """Return the unit directions of the lines of sight through points, away from the camera."""

    @abstractmethod
    def distance(self, local: Points) -> Values:
        """Return the distances of points from the camera, mm; infinity if lines of sight are parallel."""

    @abstractmethod
    def magnification(self, local: Points) -> Values:
        """Return the shift of (x, y) per mm that a point moves across the optical axis."""


@dataclass(frozen=True)
class Perspective(Projection):
    """Lines of sight pass through the optical centre."""

    name = "perspective"
    begin = 0.0
    shows_depth = True
    scale = "focal length"
    unit = "px"
    least_scale = 1.0

    def image(self, local: Array) -> Array:
        return local[..., :2] / local[..., 2:]

    def slope(self, along_x: Array, along_y: Array, image: Array, local: Array) -> tuple[Array, Array, Array]:
        depth = local[..., 2]
        along_z = -(along_x * image[..., 0] + along_y * image[..., 1])
        return along_x / depth, along_y / depth, along_z / depth

    def lines(self, image: Pixels) -> tuple[Float[Tensor, "*#batch 3"], Points]:
        import torch

        direction = torch.cat([image, torch.ones_like(image[..., :1])], dim=-1)
        return direction.new_zeros(3), direction

    def sight(self, local: Points) -> Points:
        return local / local.norm(dim=-1, keepdim=True)

    def distance(self, local: Points) -> Values:
        return local.norm(dim=-1)

    def magnification(self, local: Points) -> Values:
        return 1 / local[..., 2]


@dataclass(frozen=True)
class Telecentric(Projection):
    """Lines of sight are parallel to the optical axis, with origins on Z = 0."""

    name = "telecentric"
    begin = -math.inf
    shows_depth = False
    scale = "scale"
    unit = "px/mm"
    least_scale = 1 / LARGEST_LENGTH

    def image(self, local: Array) -> Array:
        return local[..., :2]

    def slope(self, along_x: Array, along_y: Array, image: Array, local: Array) -> tuple[Array, Array, Array]:
        return along_x, along_y, 0 * along_x

    def lines(self, image: Pixels) -> tuple[Float[Tensor, "*#batch 3"], Points]:
        import torch

        start = torch.cat([image, torch.zeros_like(image[..., :1])], dim=-1)
        return start, self.sight(start)

    def sight(self, local: Points) -> Points:
        axis: Float[Tensor, 3] = local.new_tensor([0.0, 0.0, 1.0])
        return axis.expand_as(local)

    def distance(self, local: Points) -> Values:
        return local.new_full(local.shape[:-1], math.inf)

    def magnification(self, local: Points) -> Values:
        return local.new_ones(local.shape[:-1])


PERSPECTIVE, TELECENTRIC = Perspective(), Telecentric()
PROJECTIONS: dict[str, Projection] = {kind.name: kind for kind in (PERSPECTIVE, TELECENTRIC)}


def projection_named(name: object, field: str = "projection") -> Projection:
    """Return the projection of a name."""
    if not isinstance(name, str) or name not in PROJECTIONS:
        raise InputError(f"expected one of {', '.join(PROJECTIONS)}, got {name!r}", field=field)
    return PROJECTIONS[name]
