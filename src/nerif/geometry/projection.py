"""The two projections: where a point of the camera's frame is in the image plane, and the line that is seen there.

    perspective    (x, y) = (X/Z, Y/Z)    lines through the optical centre; K holds focal lengths, px
    telecentric    (x, y) = (X, Y)        lines parallel to the optical axis; K holds px per mm

Distortion and K act on (x, y) alike: pixel = K distorted(x, y, 1).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import LARGEST_LENGTH, InputError, Pixels, Points, Values

__all__ = [
    "PERSPECTIVE", "PROJECTIONS", "TELECENTRIC", "Perspective", "Projection", "Telecentric", "projection_named",
]  # fmt: skip

Array = TypeVar("Array", Tensor, np.ndarray)


class Projection(ABC):
    """From the camera's frame (mm) to its image plane, before distortion and K, and back."""

    name: ClassVar[str]
    """In files and settings."""
    begin: ClassVar[float]
    """Path length before which there is no ray, mm."""
    shows_depth: ClassVar[bool]
    """Whether a picture changes with the depth of what it shows."""
    scale: ClassVar[str]
    """What fx and fy of K are called."""
    unit: ClassVar[str]
    """Of fx and fy."""
    least_scale: ClassVar[float]
    """Of fx and fy."""

    @abstractmethod
    def image(self, local: Array) -> Array:
        """Return (x, y) (..., 2) of points (..., 3)."""

    @abstractmethod
    def slope(self, along_x: Array, along_y: Array, image: Array, local: Array) -> tuple[Array, Array, Array]:
        """Return d g / d (X, Y, Z) of what has d g / d (x, y) = (along_x, along_y), at points and their (x, y)."""

    @abstractmethod
    def lines(self, image: Pixels) -> tuple[Float[Tensor, "*#batch 3"], Points]:
        """Return where the lines seen at (x, y) start, mm (one place if it is the same), and their directions.

        The directions are of any length, and lead away from the camera.
        """

    @abstractmethod
    def sight(self, local: Points) -> Points:
        """Return the unit directions in which points are seen, away from the camera."""

    @abstractmethod
    def distance(self, local: Points) -> Values:
        """Return how far the camera is from points, mm."""

    @abstractmethod
    def magnification(self, local: Points) -> Values:
        """Return how far (x, y) moves as a point moves by 1 mm across the optical axis."""


@dataclass(frozen=True)
class Perspective(Projection):
    """All lines go through the optical centre."""

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
    """All lines are parallel to the optical axis, and start where they cross Z = 0."""

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
        start = torch.cat([image, torch.zeros_like(image[..., :1])], dim=-1)
        return start, self.sight(start)

    def sight(self, local: Points) -> Points:
        axis: Float[Tensor, 3] = local.new_tensor([0.0, 0.0, 1.0])
        return axis.expand_as(local)

    def distance(self, local: Points) -> Values:
        return torch.full_like(local[..., 0], math.inf)

    def magnification(self, local: Points) -> Values:
        return torch.ones_like(local[..., 0])


PERSPECTIVE, TELECENTRIC = Perspective(), Telecentric()
PROJECTIONS: dict[str, Projection] = {kind.name: kind for kind in (PERSPECTIVE, TELECENTRIC)}
"""Every projection by its name."""


def projection_named(name: object, what: str = "projection") -> Projection:
    """Return a projection by its name.

    Raises
    ------
    InputError
        If there is none of that name.
    """
    if not isinstance(name, str) or name not in PROJECTIONS:
        raise InputError(f"{what}: expected one of {', '.join(PROJECTIONS)}, got {name!r}")
    return PROJECTIONS[name]
