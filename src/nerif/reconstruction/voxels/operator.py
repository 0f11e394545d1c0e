"""The forward projector of a voxel field and its adjoint, never formed as a matrix."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.fields.voxel_field import DEGREES, Boundary, VoxelField
from nerif.forward.forward_model import ForwardModel
from nerif.geometry import Grid, Rays
from nerif.reconstruction.device import share_threads
from nerif.reconstruction.voxels.levels import FINE_BIN, bins_of
from nerif.reconstruction.voxels.plane_spacing import MAX_STEP, check_step
from nerif.reconstruction.voxels.planes import RayBundle

__all__ = [
    "VoxelOperator", "apply_rows", "lens_rays", "operator_bytes", "operator_norm", "ray_counts", "rays_through",
]  # fmt: skip

# of rays through a lens, per voxel of the cone's radius in the middle of the box; of a pixel
PAIRS_PER_VOXEL, MAX_PAIRS = 2.0, 8


class VoxelOperator:
    """The projections of a B-spline on a voxel grid by a linear forward model; c are the spline's coefficients.

        (A c)_r = sum_m w_rm [A_r f(x_rm) + B_r grad f(x_rm)],    f(x) = sum_ijk c_ijk b_ijk(x)

    Profile w, A and B are the model's (forward/forward_model.py); samples lie where rays cross evenly spaced planes.
    `A(c)` applies the operator, `A.T(y)` its exact adjoint: by Numba on all cores of a CPU, by PyTorch on a GPU. A
    pixel with a lens is the mean over thin rays, the more the wider its cone.

    Parameters
    ----------
    rays : clipped to the box of the grid
    basis : "linear" (coefficients are the values at voxel centres) or "cubic"
    step : largest distance of planes in voxel edges, up to MAX_STEP; None for that
    device, dtype : of c and y

    Source: docs/conventions.md (forward model); Joseph, IEEE Trans. Med. Imaging 1 (1982), for projection by
    interpolation in planes; Lacroute & Levoy, SIGGRAPH (1994), for the resampling along the axis.
    """

    padded_axes: tuple[int, ...] = (0, 1, 2)  # of z, y, x: along them coefficients are extended beyond the box

    def __init__(
        self, rays: Rays, grid: Grid, model: ForwardModel, basis: str = "linear", boundary: Boundary | None = None,
        step: float | None = None, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32,
    ) -> None:  # fmt: skip
        if not model.linear:
            raise InputError(f"expected a linear one, got {type(model).__name__}", field="model")
        if basis not in DEGREES:
            raise InputError(f"expected {' or '.join(DEGREES)}, got '{basis}'", field="basis")
        self.step = MAX_STEP[basis] if step is None else step
        check_step(self.step, basis)
        if not bool(rays.crosses.any()):
            raise InputError("expected rays that cross the box, got none; check box, cameras and masks", field="rays")
        self.grid, self.basis, self.boundary = grid, basis, boundary or Boundary()
        self.degree = DEGREES[basis]
        self.layers = (self.degree + 1) // 2
        if min(grid.shape[axis] for axis in self.padded_axes) < self.layers:
            raise InputError(
                f"expected at least {self.layers} along each edge for basis {basis}, got {grid.shape}", field="voxels"
            )
        self.device, self.dtype = torch.device(device), dtype
        self.compiled = self.device.type == "cpu"  # or False: in PyTorch, to compare with
        self.inner = torch.float64 if self.compiled else dtype
        self.domain_shape = grid.shape
        self.range_shape = (len(rays), len(model.channels))
        self.padded_shape = [n + 2 * self.layers * (axis in self.padded_axes) for axis, n in enumerate(grid.shape)]
        self.shares: Tensor | None = None  # (pixel, ray, 1) weights of rays through a lens
        if rays.lens is not None:
            each = rays_through(rays, min(grid.spacing))
            rays = rays.spread(each)
            self.shares = rays.shares(each).reshape(-1, each, 1).to(self.device, dtype)
        self._place_samples(rays, model)

    def _place_samples(self, rays: Rays, model: ForwardModel) -> None:
        bundles = RayBundle.all_of(rays, self.grid, self.degree, math.ceil(1 / self.step), model)
        self.bundles = [bundle.to(self.device, self.inner, self.dtype) for bundle in bundles]

    @property
    def samples(self) -> int:
        """Number of samples of all rays."""
        return sum(int(bundle.count.sum()) for bundle in self.bundles)

    def for_rays(self, rays: Rays, model: ForwardModel) -> VoxelOperator:
        """Return the operator of other rays on the same grid."""
        settings = self.basis, self.boundary, self.step, self.device, self.dtype
        return VoxelOperator(rays, self.grid, model, *settings)

    def __call__(self, coefficients: Float[Tensor, "z y x"]) -> Float[Tensor, "n c"]:
        """Return the projections of all rays."""
        if tuple(coefficients.shape) != self.domain_shape:
            raise InputError(f"expected {self.domain_shape}, got {tuple(coefficients.shape)}", field="coefficients")
        coefficients = coefficients.to(self.device, self.dtype)
        return self.of_padded(self.boundary.extend(coefficients, self.layers, self.padded_axes))

    def of_padded(self, padded: Float[Tensor, "zp yp xp"]) -> Float[Tensor, "n c"]:
        """Return the projections of coefficients that are already extended beyond the box."""
        rays = self.range_shape[0] if self.shares is None else self.shares.numel()
        result = torch.zeros(rays, self.range_shape[1], dtype=self.dtype, device=self.device)
        self._integrate(padded.to(self.device, self.dtype), result)
        shares = self.shares
        return result if shares is None else (result.reshape(*shares.shape[:2], -1) * shares).sum(dim=1)

    def T(self, projections: Float[Tensor, "n c"]) -> Float[Tensor, "z y x"]:
        """Apply the adjoint."""
        if tuple(projections.shape) != self.range_shape:
            raise InputError(f"expected {self.range_shape}, got {tuple(projections.shape)}", field="projections")
        projections = projections.to(self.device, self.dtype)
        if self.shares is not None:
            projections = (projections[:, None] * self.shares).flatten(0, 1)
        padded = torch.zeros(self.padded_shape, dtype=self.dtype, device=self.device)
        self._spread(projections, padded)
        return self.boundary.fold(padded, self.layers, self.padded_axes)

    def _integrate(self, padded: Float[Tensor, "zp yp xp"], result: Float[Tensor, "m c"]) -> None:
        """Add the projections of thin rays to `result`."""
        kernels = self._kernels()
        for bundle in self.bundles:
            value, slope = bundle.planes.cut(padded, self.inner)
            for matrix, along in ((bundle.gradient, slope), (bundle.value, None)):
                if matrix is not None:
                    integrals = kernels.integrate(self.degree, value, along, bundle.path)
                    result[bundle.index] += apply_rows(matrix, integrals)

    def _spread(self, projections: Float[Tensor, "m c"], padded: Float[Tensor, "zp yp xp"]) -> None:
        """Add the adjoint of thin rays' projections to `padded`."""
        kernels = self._kernels()
        for bundle in self.bundles:
            for matrix in (bundle.gradient, bundle.value):
                if matrix is not None:
                    q = torch.einsum("nij,ni->nj", matrix, projections[bundle.index]).to(self.inner).contiguous()
                    value, *slope = kernels.spread(self.degree, q, bundle.path, bundle.planes.shape(padded.shape))
                    bundle.planes.add_cut_adjoint(value, slope[0] if slope else None, padded)

    def _kernels(self) -> ModuleType:
        if not self.compiled:
            from nerif.reconstruction.voxels import kernels_torch

            return kernels_torch
        from nerif.reconstruction.voxels import kernels_numba

        share_threads()
        return kernels_numba

    def field(self, coefficients: Float[Tensor, "z y x"]) -> VoxelField:
        """Return the field of coefficients."""
        return VoxelField.of(coefficients, self.grid, self.degree, self.boundary)

    @staticmethod
    def memory_bytes(
        rays: int, grid: Grid, basis: str = "linear", dtype: torch.dtype = torch.float32, channels: int = 2,
        step: float | None = None,
    ) -> int:  # fmt: skip
        """Estimate the memory of an operator while it is applied: rays, B, the padded grid and its planes."""
        inner = 8  # bytes of paths and planes on a CPU
        layers, each = (DEGREES[basis] + 1) // 2, math.ceil(1 / (step or MAX_STEP[basis]))
        padded = math.prod(n + 2 * layers for n in grid.shape)
        per_ray = 8 * inner + 3 * channels * dtype.itemsize + 16  # path, B, integers
        return rays * per_ray + padded * (
            2 * dtype.itemsize + each * (4 * inner + 6 * dtype.itemsize)
        )  # value and slope


def rays_through(rays: Rays, length: float) -> int:
    """Return how many rays through the lens of a pixel average a field that varies over a length (mm); 1 if thin."""
    if rays.lens is None:
        return 1
    rays = rays[rays.crosses]
    assert rays.lens is not None
    if not len(rays):
        return 2
    middle = 0.5 * (rays.near + rays.far)
    spread = float(rays.half_width(middle).max())
    return 2 * min(MAX_PAIRS, max(1, math.ceil(PAIRS_PER_VOXEL * spread / length)))


def apply_rows(matrix: Float[Tensor, "n c q"], integrals: Float[Tensor, "n q"]) -> Float[Tensor, "n c"]:
    """Return each ray's matrix times its integrals."""
    return torch.einsum("nij,nj->ni", matrix, integrals.to(matrix.dtype))


def operator_norm(
    forward: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor], start: Tensor, iterations: int = 30,
    tolerance: float = 1e-3,
) -> float:  # fmt: skip
    """Estimate the largest singular value from below, until it grows by less than `tolerance` per iteration.

    Power method on the normal operator: x <- A^T A x / |A^T A x|,     |A| = sqrt(|A^T A x|)
    """
    x, estimate = start, 0.0
    for _ in range(iterations):
        x = x / x.norm().clamp_min(torch.finfo(x.dtype).tiny)
        x = adjoint(forward(x))
        last, estimate = estimate, float(x.norm()) ** 0.5
        if estimate <= last * (1 + tolerance):
            break
    return estimate


def operator_bytes(measurement: Measurement, grid: Grid, basis: str, precision: str, step: float | None) -> int:
    """Return the memory of the operators of all techniques."""
    dtype, per_pixel = getattr(torch, precision), lens_rays(measurement, grid)
    return sum(
        VoxelOperator.memory_bytes(per_pixel * rays, grid, basis, dtype, channels, step)
        for rays, channels in ray_counts(measurement, grid)
    )


def ray_counts(measurement: Measurement, grid: Grid) -> list[tuple[int, int]]:
    """Return the numbers of rays, of bins where pixels are averaged, and of channels of each technique."""
    pixels, counts = bins_of(measurement, grid, FINE_BIN) ** 2, []
    for o in measurement.observations:
        rays = int(measurement.usable_for(o).sum()) // (1 if o.technique.derived else pixels)
        counts.append((rays + 1, len(o.technique.channels)))
    return counts


def lens_rays(measurement: Measurement, grid: Grid) -> int:
    """Return the largest number of rays per pixel, from a lattice of pixels of each image."""
    most = 1
    for camera in measurement.cameras:
        lattice = [torch.linspace(0, n - 1, min(n, 9), dtype=camera.intrinsics.dtype) for n in camera.image_size[::-1]]
        rays = camera.rays(torch.cartesian_prod(*lattice).reshape(-1, 2)).clip(measurement.box)
        most = max(most, rays_through(rays, min(grid.spacing)))
    return most
