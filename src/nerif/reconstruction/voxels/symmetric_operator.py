"""The forward projector of a symmetric field, a spline of (r, h), and its adjoint."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.fields.symmetric import SymmetricVoxels
from nerif.fields.voxel_field import DEGREES, Boundary, VoxelField
from nerif.forward.forward_model import ForwardModel
from nerif.geometry import Grid, Rays
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction.device import share_threads
from nerif.reconstruction.voxels.operator import VoxelOperator, apply_rows
from nerif.reconstruction.voxels.planes import profiles

__all__ = ["SymmetricOperator", "project_spline"]

SAMPLES_PER_VOXEL = 2


@dataclass(frozen=True)
class Curves:
    """Rays in (r, h) as kernels_symmetric.py takes them, and the matrices applied to their integrals."""

    index: Tensor
    path: tuple[Tensor, ...]
    plane: Tensor
    matrices: list[Tensor]


class SymmetricOperator(VoxelOperator):
    """The projections of a symmetric field by a linear forward model; c are coefficients (h, k, r) of its splines.

        (A c)_p = sum_m w_pm [A_p f(x_pm) + B_p grad f(x_pm)],    f(x) = sum_k D_k(x) sum_ij c_jki b_i(r) b_j(h)

    Samples are evenly spaced along each ray, at least two in a voxel. It runs on the CPU. The grid is that of
    (r, k, h); other parameters are those of VoxelOperator.
    """

    padded_axes = (0, 2)

    def __init__(
        self, symmetry: Symmetry, rays: Rays, grid: Grid, model: ForwardModel, basis: str = "cubic",
        boundary: Boundary | None = None, step: float | None = None, dtype: torch.dtype = torch.float32,
    ) -> None:  # fmt: skip
        self.symmetry = symmetry
        super().__init__(rays, grid, model, basis, boundary, step, "cpu", dtype)

    def for_rays(self, rays: Rays, model: ForwardModel) -> SymmetricOperator:
        settings = self.basis, self.boundary, self.step, self.dtype
        return SymmetricOperator(self.symmetry, rays, self.grid, model, *settings)

    @property
    def samples(self) -> int:
        return int(self.curves.path[3].sum())

    def _place_samples(self, rays: Rays, model: ForwardModel) -> None:
        index = rays.crosses.nonzero()[:, 0]
        rays = rays[index].to("cpu", torch.float64)
        hx, _, hz = self.grid.spacing
        length = rays.far - rays.near
        count = (length * SAMPLES_PER_VOXEL / (self.step * min(hx, hz))).ceil().clamp(min=1)
        apart = length / count
        first = rays.near + 0.5 * apart
        weights, profile = profiles(model, rays, first, apart, count - 1)
        symmetry, frame = self.symmetry, self.symmetry.matrix
        start = symmetry.local(rays.origin + first[:, None] * rays.direction)
        stride = rays.direction @ frame.T * apart[:, None]
        path = tuple(a.contiguous() for a in (start, stride, profile, count.to(torch.int32)))
        box, (nz, _, nx) = self.grid.box, self.grid.shape
        rounding = symmetry.rounding if symmetry.axial else -1.0
        numbers = [box.lower[0], box.lower[2], hx, hz, nx, nz, rounding, self.layers]
        matrices = [] if weights.slope is None else [(weights.slope @ frame.T).to(self.dtype)]
        matrices += [] if weights.value is None else [weights.value[..., None].to(self.dtype)]
        self.curves = Curves(index.cpu(), path, torch.tensor(numbers, dtype=torch.float64), matrices)

    def _integrate(self, padded: Float[Tensor, "zp k xp"], result: Float[Tensor, "m c"]) -> None:
        kernels, curves, values = self._kernels(), self.curves, padded.double().contiguous()
        for matrix in curves.matrices:
            integrals = kernels.integrate(self.degree, values, curves.path, curves.plane, matrix.shape[2] == 3)
            result[curves.index] += apply_rows(matrix, integrals)

    def _spread(self, projections: Float[Tensor, "m c"], padded: Float[Tensor, "zp k xp"]) -> None:
        kernels, curves = self._kernels(), self.curves
        for matrix in curves.matrices:
            q = torch.einsum("nij,ni->nj", matrix, projections[curves.index]).double().contiguous()
            groups = kernels.spread(self.degree, q, curves.path, curves.plane, padded.shape)
            padded += torch.from_numpy(groups.numpy().sum(axis=0)).to(padded)  # NumPy's order of summation

    def _kernels(self) -> ModuleType:
        from nerif.reconstruction.voxels import kernels_symmetric

        share_threads()
        return kernels_symmetric

    def matrix(self) -> Float[Tensor, "n c m"]:
        """Return the operator as a matrix (ray, channel, coefficient), for small grids."""
        kernels, curves, channels = self._kernels(), self.curves, self.range_shape[1]
        rays = self.range_shape[0] if self.shares is None else self.shares.numel()
        rows = torch.zeros(rays, channels, math.prod(self.domain_shape), dtype=self.dtype)
        for matrix in curves.matrices:
            for c in range(channels):
                q = matrix[:, c].double().contiguous()
                each = kernels.spread(self.degree, q, curves.path, curves.plane, self.padded_shape, len(curves.index))
                for i, padded in zip(curves.index.tolist(), each, strict=True):
                    rows[i, c] += self.boundary.fold(padded, self.layers, self.padded_axes).flatten().to(self.dtype)
        if self.shares is None:
            return rows
        return (rows.reshape(*self.shares.shape[:2], channels, -1) * self.shares[..., None]).sum(dim=1)


def project_spline(
    field: VoxelField | SymmetricVoxels, rays: Rays, model: ForwardModel, step: float | None = None,
    device: torch.device | str = "cpu",
) -> Float[Tensor, "n c"]:  # fmt: skip
    """Return the projections of a spline along rays that are clipped to the box."""
    degree = field.degree if isinstance(field, VoxelField) else field.parts[0].degree
    basis = next(name for name, d in DEGREES.items() if d == degree)
    if isinstance(field, VoxelField):
        return VoxelOperator(rays, field.grid, model, basis, step=step, device=device).of_padded(field.coefficients)
    return SymmetricOperator(field.symmetry, rays, field.grid, model, basis, step=step).of_padded(field.padded)
