"""A field given by voxel values, interpolated by cubic B-splines: twice differentiable, exact gradient."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import InputError, Points, Values, Vectors
from nerif.fields.base import Field
from nerif.geometry import Grid

__all__ = ["VoxelField"]


class VoxelField(Field):
    """Interpolates voxel-centre values by a cubic B-spline that passes through each of them.

    n(x) = sum_ijk c_ijk beta(x/hx - i) beta(y/hy - j) beta(z/hz - k)

    Half a voxel beyond the outermost centres the field is continued by mirroring; further out it is that of the
    nearest point of the box.

    Parameters
    ----------
    values : (z, y, x) index excess at the voxel centres
    grid : Grid

    Source: Unser, Splines: a perfect fit for signal and image processing, IEEE Signal Process. Mag. 16 (1999).
    """

    def __init__(self, values: Float[Tensor, "z y x"], grid: Grid) -> None:
        if tuple(values.shape) != grid.shape:
            raise InputError(f"volume: expected values of shape {grid.shape} (z, y, x), got {tuple(values.shape)}")
        self.grid = grid
        coefficients = values.to(torch.float64)
        for axis in range(3):
            coefficients = _prefilter(coefficients, axis)
        self.coefficients = coefficients.to(values.dtype)

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        box, shape = self.grid.box, points.shape
        p = points.reshape(-1, 3)
        inside = torch.minimum(torch.maximum(p, p.new_tensor(box.lower)), p.new_tensor(box.upper))
        position = (inside - p.new_tensor(box.lower)) / p.new_tensor(self.grid.spacing) - 0.5
        cell = position.floor()
        weights, slopes = _cubic_weights(position - cell)  # (n, 3, 4): axis x, y, z; the four neighbours
        slopes = slopes / p.new_tensor(self.grid.spacing)[:, None] * (inside == p)[..., None]
        nz, ny, nx = self.grid.shape
        neighbour = cell.long()[..., None] + torch.arange(-1, 3, device=p.device)
        ix, iy, iz = (_mirror(neighbour[:, a], n) for a, n in ((0, nx), (1, ny), (2, nz)))
        flat = self.coefficients.to(p).reshape(-1)
        value, gx, gy, gz = (torch.zeros_like(p[:, 0]) for _ in range(4))
        for k in range(4):
            for j in range(4):
                line = flat[((iz[:, k] * ny + iy[:, j]) * nx)[:, None] + ix]  # (n, 4) along x
                along, slope = (line * weights[:, 0]).sum(-1), (line * slopes[:, 0]).sum(-1)
                wy, wz = weights[:, 1, j], weights[:, 2, k]
                value += along * wy * wz
                gx += slope * wy * wz
                gy += along * slopes[:, 1, j] * wz
                gz += along * wy * slopes[:, 2, k]
        return value.reshape(shape[:-1]), torch.stack([gx, gy, gz], dim=-1).reshape(shape)


def _prefilter(values: Tensor, axis: int) -> Tensor:
    """Coefficients c of the spline with (c[i-1] + 4 c[i] + c[i+1]) / 6 = values[i], mirrored at the ends."""
    n = values.shape[axis]
    if n == 1:
        return values
    matrix = torch.zeros(n, n, dtype=values.dtype, device=values.device)
    matrix.diagonal().fill_(4 / 6)
    matrix.diagonal(1).fill_(1 / 6)
    matrix.diagonal(-1).fill_(1 / 6)
    matrix[0, 1] = matrix[-1, -2] = 2 / 6
    moved = values.movedim(axis, 0)
    return torch.linalg.solve(matrix, moved.reshape(n, -1)).reshape(moved.shape).movedim(0, axis)


def _cubic_weights(t: Tensor) -> tuple[Tensor, Tensor]:
    """Weights of the four neighbours of a point a fraction t beyond the second, and their slopes in t."""
    s = 1 - t
    weights = torch.stack([s**3, 4 - 6 * t**2 + 3 * t**3, 4 - 6 * s**2 + 3 * s**3, t**3], dim=-1) / 6
    slopes = torch.stack([-(s**2), 3 * t**2 - 4 * t, 4 * s - 3 * s**2, t**2], dim=-1) / 2
    return weights, slopes


def _mirror(index: Tensor, n: int) -> Tensor:
    """Fold indices just beyond the ends back about the end samples."""
    if n == 1:
        return torch.zeros_like(index)
    return torch.where(index.abs() < n, index.abs(), 2 * (n - 1) - index.abs()).clamp(0, n - 1)
