"""Interface of a field: phantom, network or voxels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.arrays import Points, Values, Vectors
from nerif.common.pauses import pause
from nerif.geometry import Grid

__all__ = ["Field", "in_chunks"]


class Field(ABC):
    """A scalar field of index excess n - n_ambient over space."""

    @abstractmethod
    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        """Return the index excess (1) and its gradient (1/mm) at points (mm)."""

    def __call__(self, points: Points) -> Values:
        """Return the index excess (1) at points (mm)."""
        return self.value_and_gradient(points)[0]

    def gradient(self, points: Points) -> Vectors:
        """Return the gradient of the index (1/mm) at points (mm)."""
        return self.value_and_gradient(points)[1]

    def to(self, device: torch.device | str) -> Field:
        """Return the field on a device; itself if its parameters follow the points."""
        return self

    @torch.no_grad()
    def sample(self, grid: Grid, device: torch.device | str = "cpu") -> Float[Tensor, "z y x"]:
        """Return the index excess at the voxel centres of a grid."""
        field, points = self.to(device), grid.points().reshape(-1, 3)
        values = [field(p.to(device)).cpu().to(torch.float32) for p in in_chunks(points)]
        return torch.cat(values).reshape(grid.shape)


def in_chunks(points: Tensor, size: int = 1 << 13) -> Iterator[Tensor]:
    """Split along the first axis into chunks that fit the cache; pause before each."""
    for part in torch.split(points, size):
        pause()
        yield part
