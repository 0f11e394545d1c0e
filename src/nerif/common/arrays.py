"""Aliases of arrays with their shapes, as used in annotations."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

__all__ = ["Mask", "Matrix3", "Pixels", "Points", "Values", "Vectors"]

Points = Float[Tensor, "*batch 3"]  # mm, world frame
Vectors = Float[Tensor, "*batch 3"]  # direction (1) or gradient (1/mm)
Values = Float[Tensor, "*batch"]  # index excess n - n_ambient (1)
Pixels = Float[Tensor, "*batch 2"]  # px, (column u, row v), (0, 0) the centre of the top-left pixel
Matrix3 = Float[Tensor, "3 3"]
Mask = Bool[Tensor, "*batch"]
