"""The linear map from a spline of (r, h) to what rays see of its symmetric field, and the adjoint."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.fields.grid import DEGREES, Boundary, VoxelField
from nerif.fields.symmetric import SymmetricVoxels
from nerif.forward.base import ForwardModel
from nerif.geometry import Grid, Rays
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction.device import share_threads
from nerif.reconstruction.voxels.operator import VoxelOperator, made_of
from nerif.reconstruction.voxels.planes import is_even, tabulated

__all__ = ["SymmetricOperator", "seen_of"]

SAMPLES = 2  # in a voxel, at least


@dataclass(frozen=True)
class Curves:
    """Rays as they run through (r, h), and what is made of their integrals; for the kernels."""

    index: Tensor
    path: tuple[np.ndarray, ...]
    plane: np.ndarray
    gradient: Float[Tensor, "n c 3"] | None
    value: Float[Tensor, "n c 1"] | None


class SymmetricOperator(VoxelOperator):
    """What rays see of a field with a symmetry by a linear forward model; c are coefficients (h, k, r) of its splines.

        (A c)_p = sum_m w_pm [A_p f(x_pm) + B_p grad f(x_pm)],    f(x) = sum_k D_k(x) sum_ij c_jki b_i(r) b_j(h)

    Samples are evenly spaced along each ray, two or more in a voxel. It runs on the CPU.

    Parameters
    ----------
    symmetry : Symmetry, mm
    rays, grid, model, basis, boundary, step, dtype : as of a VoxelOperator; the grid is of (r, k, h)
    """

    padded_axes = (0, 2)

    def __init__(
        self, symmetry: Symmetry, rays: Rays, grid: Grid, model: ForwardModel, basis: str = "cubic",
        boundary: Boundary | None = None, step: float | None = None, dtype: torch.dtype = torch.float32,
    ) -> None:  # fmt: skip
        self.symmetry = symmetry
        super().__init__(rays, grid, model, basis, boundary, step, "cpu", dtype)

    def for_rays(self, rays: Rays, model: ForwardModel) -> SymmetricOperator:
        return SymmetricOperator(
            self.symmetry, rays, self.grid, model, self.basis, self.boundary, self.step, self.dtype
        )

    @property
    def samples(self) -> int:
        return int(self.curves.path[3].sum())

    def _follow(self, rays: Rays, model: ForwardModel) -> None:
        index = rays.crosses.nonzero()[:, 0]
        rays = rays[index].to("cpu", torch.float64)
        hx, _, hz = self.grid.spacing
        length = rays.far - rays.near
        count = (length * SAMPLES / (self.step * min(hx, hz))).ceil().clamp(min=1)
        apart = length / count
        first = rays.near + 0.5 * apart
        at = torch.stack([first, first + (count - 1) * apart], dim=1)
        weights = model.weights(rays, at, apart[:, None].expand_as(at))
        begin, final = weights.profile.unbind(1)
        profile = torch.stack([begin, (final - begin) / (count - 1).clamp(min=1)], dim=1)
        if not is_even(model, rays, first, apart, count - 1):
            profile = tabulated(model, rays, first, apart, int(count.max()))
        symmetry, frame = self.symmetry, self.symmetry.matrix
        start = symmetry.local(rays.origin + first[:, None] * rays.direction)
        stride = rays.direction @ frame.T * apart[:, None]
        path = tuple(a.contiguous().numpy() for a in (start, stride, profile, count.to(torch.int32)))
        box, (nz, _, nx) = self.grid.box, self.grid.shape
        rounding = symmetry.rounding if symmetry.axial else -1.0
        plane = np.array([box.lower[0], box.lower[2], hx, hz, nx, nz, rounding, self.layers])
        gradient = None if weights.slope is None else (weights.slope @ frame.T).to(self.dtype)
        value = None if weights.value is None else weights.value[..., None].to(self.dtype)
        self.curves = Curves(index.cpu(), path, plane, gradient, value)

    def _integrate(self, padded: Float[Tensor, "zp k xp"], seen: Float[Tensor, "m c"]) -> None:
        from nerif.reconstruction.voxels import kernels_symmetric

        share_threads()
        curves, array = self.curves, padded.double().contiguous().numpy()
        for matrix in (curves.gradient, curves.value):
            if matrix is not None:
                found = kernels_symmetric.integrate(self.degree, array, curves.path, curves.plane, matrix.shape[2] == 3)
                seen[curves.index] += made_of(matrix, torch.from_numpy(found))

    def _spread(self, seen: Float[Tensor, "m c"], padded: Float[Tensor, "zp k xp"]) -> None:
        from nerif.reconstruction.voxels import kernels_symmetric

        share_threads()
        curves = self.curves
        for matrix in (curves.gradient, curves.value):
            if matrix is not None:
                q = torch.einsum("nij,ni->nj", matrix, seen[curves.index]).double().contiguous().numpy()
                found = kernels_symmetric.spread(self.degree, q, curves.path, curves.plane, padded.shape)
                padded += torch.from_numpy(found.sum(axis=0)).to(padded)

    def matrix(self) -> Float[Tensor, "n c m"]:
        """Return the operator as numbers, (ray, channel, coefficient), of grids that are small."""
        from nerif.reconstruction.voxels import kernels_symmetric

        share_threads()
        curves, rays, channels = self.curves, len(self.curves.index), self.range_shape[1]
        shape = [n + 2 * self.layers * (axis in self.padded_axes) for axis, n in enumerate(self.domain_shape)]
        whole = self._of_rays(None).shape[0]
        rows = torch.zeros(whole, channels, math.prod(self.domain_shape), dtype=self.dtype)
        for matrix in (curves.gradient, curves.value):
            for c in range(channels if matrix is not None else 0):
                assert matrix is not None
                q = matrix[:, c].double().contiguous().numpy()
                found = kernels_symmetric.spread(self.degree, q, curves.path, curves.plane, shape, rays)
                for i, own in zip(curves.index.tolist(), torch.from_numpy(found), strict=True):
                    rows[i, c] += self.boundary.fold(own, self.layers, self.padded_axes).flatten().to(self.dtype)
        if self.shares is None:
            return rows
        return (rows.reshape(*self.shares.shape[:2], channels, -1) * self.shares[..., None]).sum(dim=1)


def seen_of(
    field: VoxelField | SymmetricVoxels, rays: Rays, model: ForwardModel, step: float | None = None,
    device: torch.device | str = "cpu",
) -> Float[Tensor, "n c"]:  # fmt: skip
    """Return what rays that are clipped to the box see of splines, by the operator that goes with them."""
    degree = field.degree if isinstance(field, VoxelField) else field.parts[0].degree
    basis = next(name for name, d in DEGREES.items() if d == degree)
    if isinstance(field, VoxelField):
        return VoxelOperator(rays, field.grid, model, basis, step=step, device=device).through(field.coefficients)
    return SymmetricOperator(field.symmetry, rays, field.grid, model, basis, step=step).through(field.padded)
