"""Gradients of voxels by their differences at the faces between them."""

from __future__ import annotations

from functools import reduce

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["at_faces", "gradient_square"]


def gradient_square(along: tuple[Tensor, Tensor, Tensor]) -> Float[Tensor, "z y x"]:
    """|grad|^2 at voxel centres: the mean of the squares at the two faces, summed over the axes."""
    means = []
    for axis, difference in enumerate(along):
        square, n = difference.square(), difference.shape[axis] - 1
        means.append(0.5 * (square.narrow(axis, 0, n) + square.narrow(axis, 1, n)))
    return reduce(torch.add, means)


def at_faces(weight: Float[Tensor, "z y x"]) -> tuple[Tensor, Tensor, Tensor]:
    """Weights of the squares at the faces such that sum_voxels weight |grad|^2 = sum_faces weight difference^2."""
    faces = []
    for axis in range(3):
        edge = torch.zeros_like(weight.narrow(axis, 0, 1))
        faces.append(0.5 * (torch.cat([edge, weight], dim=axis) + torch.cat([weight, edge], dim=axis)))
    return faces[0], faces[1], faces[2]
