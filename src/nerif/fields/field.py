"""Interface of a field: phantom, network or voxels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor

from nerif.common.arrays import Points, Values, Vectors
from nerif.common.conventions import InputError
from nerif.common.pauses import pause
from nerif.geometry import Grid

__all__ = ["Field", "in_chunks"]


class Field(ABC):
    """A scalar field of index excess n - n_ambient over space."""

    @abstractmethod
    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        """Return the index excess (1) and its gradient (1/mm) at points (mm)."""

    def value(self, points: Points) -> Values:
        """Return the index excess (1) at points (mm)."""
        return self.value_and_gradient(points)[0]

    def __call__(self, points: Points | ArrayLike) -> Values:
        """Return the index excess (1) at points (mm), a tensor, an array or lists."""
        if isinstance(points, Tensor):
            return self.value(points)
        with torch.no_grad():
            return self.value(_tensor(points))

    def gradient(self, points: Points | ArrayLike) -> Vectors:
        """Return the gradient of the index (1/mm) at points (mm), a tensor, an array or lists."""
        if isinstance(points, Tensor):
            return self.value_and_gradient(points)[1]
        return self.value_and_gradient(_tensor(points))[1].detach()

    def to(self, device: torch.device | str) -> Field:
        """Return the field on a device; itself if its parameters follow the points."""
        return self

    @torch.no_grad()
    def sample(self, grid: Grid, device: torch.device | str = "cpu") -> Float[Tensor, "z y x"]:
        """Return the index excess at the voxel centres of a grid."""
        field, points = self.to(device), grid.points().reshape(-1, 3)
        values = [field(p.to(device)).cpu().to(torch.float32) for p in in_chunks(points)]
        return torch.cat(values).reshape(grid.shape)


def _tensor(points: ArrayLike) -> Points:
    array = np.asarray(points, dtype=np.float32)
    if array.shape[-1:] != (3,):
        raise InputError(f"expected x, y, z in mm along the last axis, got shape {array.shape}", field="points")
    return torch.from_numpy(array)


def in_chunks(points: Tensor, size: int = 1 << 13) -> Iterator[Tensor]:
    """Split along the first axis into chunks that fit the cache; pause before each."""
    for part in torch.split(points, size):
        pause()
        yield part
