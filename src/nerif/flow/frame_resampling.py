"""Linear maps along the axes of volumes: Gaussian averages on a coarser grid, splines on a finer one."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.fields.voxel_field import spline_weights
from nerif.geometry import Grid

__all__ = [
    "along_axes", "averages", "interpolations", "laplacian", "periodic_averages", "periodic_splines", "smooth",
    "squared_slope",
]  # fmt: skip

WIDTH = 0.6  # standard deviation of an average, coarse voxels
NARROWEST = 1.2  # the least, fine voxels: finer waves of a density are below the resolution of a film


def along_axes(values: Float[Tensor, "*c z y x"], matrices: Sequence[Tensor]) -> Float[Tensor, "*c z2 y2 x2"]:
    """Apply a matrix to each of the axes z, y, x."""
    for axis, matrix in enumerate(matrices):
        values = torch.movedim(torch.movedim(values, axis - 3, -1) @ matrix.T, -1, axis - 3)
    return values


def averages(fine: Grid, coarse: Grid) -> list[Tensor]:
    """Return the matrices of Gaussian averages about coarse voxels."""
    pairs = zip(fine.shape, coarse.shape, strict=True)
    return [_gaussian(n, m, max(NARROWEST, WIDTH * n / m)) for n, m in pairs]


def interpolations(coarse: Grid, fine: Grid, shape: Sequence[int], first: Sequence[int]) -> list[Tensor]:
    """Return the matrices that evaluate periodic splines at the voxel centres of a finer grid in the same box.

    Parameters
    ----------
    shape : of the coefficients
    first : voxels of them before the box
    """
    matrices = []
    for n, m, count, before in zip(fine.shape, coarse.shape, shape, first, strict=True):
        matrices.append(periodic_splines((torch.arange(float(n)) + 0.5) * m / n - 0.5 + before, count))
    return matrices


def periodic_splines(positions: Float[Tensor, n], count: int) -> Float[Tensor, "n count"]:
    """Return the matrix that evaluates a periodic spline of `count` coefficients at positions in voxels."""
    cell = positions.floor()
    weights, _ = spline_weights(positions - cell, 3)
    matrix = torch.zeros(len(positions), count)
    for k in range(4):
        matrix[torch.arange(len(positions)), (cell.long() - 1 + k) % count] += weights[:, k]
    return matrix


def periodic_averages(positions: Float[Tensor, n], count: int, deviation: float) -> Float[Tensor, "n count"]:
    """Return the matrix of Gaussian averages of periodic values about positions in voxels."""
    distance = (torch.arange(float(count)) - positions[:, None] + count / 2) % count - count / 2
    weights = torch.exp(-0.5 * (distance / deviation) ** 2)
    return weights / weights.sum(dim=1, keepdim=True)


def smooth(values: Float[Tensor, "*c z y x"], widths: Sequence[float]) -> Float[Tensor, "*c z y x"]:
    """Return Gaussian averages of standard deviations in voxels along z, y, x."""
    return along_axes(values, [_gaussian(n, n, width) for n, width in zip(values.shape[-3:], widths, strict=True)])


def _gaussian(n: int, m: int, deviation: float) -> Float[Tensor, "m n"]:
    """Weights of n voxels about the centres of m, of a standard deviation in the former."""
    centre = (torch.arange(float(m)) + 0.5) * n / m - 0.5
    weights = torch.exp(-0.5 * ((torch.arange(float(n)) - centre[:, None]) / deviation) ** 2)
    return weights / weights.sum(dim=1, keepdim=True)


def squared_slope(values: Float[Tensor, "t z y x"], spacing: Sequence[float]) -> Float[Tensor, "t z y x"]:
    """Return the square of the gradient's length by central differences of a spacing along z, y, x."""
    axes = [axis for axis in (1, 2, 3) if values.shape[axis] > 1]
    return torch.stack(torch.gradient(values, spacing=[spacing[a - 1] for a in axes], dim=axes)).square().sum(dim=0)


def laplacian(values: Float[Tensor, "*c z y x"], spacing: Sequence[float]) -> Float[Tensor, "*c z y x"]:
    """Return the Laplacian by central differences of sixth order (spacing along z, y, x), constant beyond the faces."""
    stencil = (-490 / 180, 270 / 180, -27 / 180, 2 / 180)
    result = torch.zeros_like(values)
    for axis, h in enumerate(spacing):
        n = values.shape[axis - 3]
        for distance, weight in enumerate(stencil):
            for step in {distance, -distance}:
                index = (torch.arange(n) + step).clamp(0, n - 1)
                result += weight / h**2 * values.index_select(values.ndim + axis - 3, index)
    return result
