"""The linear map from voxels to displacements, never formed as a matrix, and its adjoint."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import InputError
from nerif.fields.grid import DEGREES, Boundary, VoxelField
from nerif.geometry import Grid, Rays

__all__ = ["MODELS", "STEPS", "DeflectionOperator", "operator_norm"]

STEPS = {"linear": 0.5, "cubic": 1.0}
"""Voxels between samples: the gradient of the linear basis jumps from voxel to voxel (benchmarks/README.md)."""
MODELS = ("lever_arm", "paraxial")


class DeflectionOperator:
    """Displacements of rays through a B-spline on a voxel grid, to first order in its coefficients c.

        (A c)_r = sum_m w_rm S_r grad n(x_rm) / n_ambient,    n(x) = sum_ijk c_ijk b_ijk(x)

    w_rm is the lever arm s_b - s at sample m (`lever_arm`) or that of the middle of the ray (`paraxial`), times the
    interval; samples stand at the middles of equal intervals between near and far, no longer than `step` voxels.
    `A(c)` applies it, `A.T(d)` its exact adjoint. On a CPU it runs on all cores (Numba), on CUDA in PyTorch.

    Parameters
    ----------
    rays : Rays clipped to the box of the grid
    grid : Grid
    n_ambient : refractive index the excess is counted from
    model : "lever_arm" or "paraxial"
    basis : "linear" (coefficients are the values at voxel centres) or "cubic"
    boundary : how the coefficients go on beyond the box
    step : longest distance between samples, in edges of a voxel; None for that of STEPS
    device, dtype : where and in which precision c and d are

    Raises
    ------
    InputError
        If no ray crosses the box, one is not clipped to it, or a setting is not one of those named.

    Source: docs/conventions.md (forward model); Joseph, IEEE Trans. Med. Imaging 1 (1982), for projection by
    interpolation.
    """

    def __init__(
        self,
        rays: Rays,
        grid: Grid,
        n_ambient: float = 1.0,
        model: str = "lever_arm",
        basis: str = "linear",
        boundary: Boundary | None = None,
        step: float | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if model not in MODELS:
            raise InputError(f"model: expected {' or '.join(MODELS)}, got '{model}'")
        if basis not in DEGREES:
            raise InputError(f"basis: expected {' or '.join(DEGREES)}, got '{basis}'")
        step = STEPS[basis] if step is None else step
        if not step > 0:
            raise InputError(f"step: expected a length above 0 voxels, got {step}")
        if not bool(rays.crosses.any()):
            raise InputError("rays: expected rays that cross the box, got none; check box, cameras and masks")
        self.grid, self.basis, self.boundary = grid, basis, boundary or Boundary()
        self.degree = DEGREES[basis]
        self.layers = (self.degree + 1) // 2
        self.device, self.dtype = torch.device(device), dtype
        self.domain_shape = grid.shape
        self.range_shape = (len(rays), 2)
        if min(grid.shape) < self.layers:
            raise InputError(
                f"voxels: expected at least {self.layers} along each edge for basis {basis}, got {grid.shape}"
            )
        self._rays = self._prepare(rays, n_ambient, model, step)

    def _prepare(self, rays: Rays, n_ambient: float, model: str, step: float) -> tuple[Tensor, ...]:
        """What the kernels need of each ray: start, stride, lever, matrix, count."""
        rays = rays.to(dtype=torch.float64)  # cameras stand far off: positions lose digits in single precision
        spacing = torch.tensor(self.grid.spacing, dtype=torch.float64, device=rays.near.device)
        lower = torch.tensor(self.grid.box.lower, dtype=torch.float64, device=rays.near.device)
        length = rays.far - rays.near
        count = (length / (step * min(self.grid.spacing))).ceil().clamp_min(1) * rays.crosses
        interval = length / count.clamp_min(1)
        s = rays.near + 0.5 * interval
        start = (rays.origin + s[:, None] * rays.direction - lower) / spacing - 0.5
        start = start + (self.layers - self.degree // 2)  # counted from the first coefficient beyond the box
        stride = rays.direction * interval[:, None] / spacing
        missing = ~rays.crosses[:, None]  # no sample of theirs is taken, but each has to have a place
        start, stride = start.masked_fill(missing, 1.0), stride.masked_fill(missing, 0.0)
        self._check_inside(start, start + (count - 1).clamp_min(0)[:, None] * stride)
        if model == "paraxial":
            lever = torch.stack([rays.ends.distance - 0.5 * (rays.near + rays.far), torch.zeros_like(s)], dim=-1)
        else:
            lever = torch.stack([rays.ends.distance - s, -interval], dim=-1)
        matrix = rays.ends.sensitivity * (interval / n_ambient)[:, None, None] / spacing
        kept = (a.to(self.device, self.dtype).contiguous() for a in (start, stride, lever, matrix))
        return (*kept, count.to(self.device, torch.int32))

    def _check_inside(self, *positions: Tensor) -> None:
        """Refuse samples beyond the coefficients: the kernels would read memory that is not theirs."""
        most = torch.tensor([n + 2 * self.layers - self.degree for n in reversed(self.domain_shape)])
        for p in positions:
            if not bool(((p >= 0) & (p < most.to(p))).all()):
                raise InputError(
                    f"rays: expected rays clipped to the box of the grid, {self.grid.box}, got longer ones"
                )

    def __call__(self, coefficients: Float[Tensor, "z y x"]) -> Float[Tensor, "n 2"]:
        """Return the displacement of every ray, px."""
        if tuple(coefficients.shape) != self.domain_shape:
            raise InputError(f"coefficients: expected {self.domain_shape}, got {tuple(coefficients.shape)}")
        return self.through(self.boundary.extend(coefficients.to(self.device, self.dtype), self.layers))

    def through(self, padded: Float[Tensor, "zp yp xp"]) -> Float[Tensor, "n 2"]:
        """Return the displacement, px, of every ray through coefficients that go on beyond the box already."""
        padded = padded.to(self.device, self.dtype).contiguous()
        displacement = torch.empty(self.range_shape, dtype=self.dtype, device=self.device)
        if self.device.type == "cpu":
            kernels = _numba()
            kernels.forward(self.degree, padded.numpy(), self._arrays(), displacement.numpy())
        else:
            from nerif.reconstruction import kernels_torch

            kernels_torch.forward(self.degree, padded, self._rays, displacement)
        return displacement

    def T(self, displacement: Float[Tensor, "n 2"]) -> Float[Tensor, "z y x"]:
        """Return the adjoint of the operator, applied to displacements."""
        if tuple(displacement.shape) != self.range_shape:
            raise InputError(f"displacement: expected {self.range_shape}, got {tuple(displacement.shape)}")
        shape = tuple(n + 2 * self.layers for n in self.domain_shape)
        padded = torch.zeros(shape, dtype=self.dtype, device=self.device)
        displacement = displacement.to(self.device, self.dtype).contiguous()
        if self.device.type == "cpu":
            kernels = _numba()
            kernels.adjoint(self.degree, displacement.numpy(), self._arrays(), padded.numpy())
        else:
            from nerif.reconstruction import kernels_torch

            kernels_torch.adjoint(self.degree, displacement, self._rays, padded)
        return self.boundary.fold(padded, self.layers)

    def _arrays(self) -> tuple[np.ndarray, ...]:
        return tuple(a.numpy() for a in self._rays)

    def field(self, coefficients: Float[Tensor, "z y x"]) -> VoxelField:
        """Return the field of index excess that coefficients stand for."""
        return VoxelField(self.boundary.extend(coefficients, self.layers), self.grid, self.degree)

    def norm(self, iterations: int = 30) -> float:
        """Return an estimate of the largest singular value, px (per unit of index), from below."""
        start = torch.rand(self.domain_shape, generator=torch.Generator().manual_seed(0), dtype=self.dtype)
        return operator_norm(self, self.T, start.to(self.device), iterations)

    @staticmethod
    def memory_bytes(rays: int, grid: Grid, basis: str = "linear", dtype: torch.dtype = torch.float32) -> int:
        """Return what an operator holds while it is applied: the rays, and the padded grid twice."""
        layers = (DEGREES[basis] + 1) // 2
        padded = 1
        for n in grid.shape:
            padded *= n + 2 * layers
        return rays * (14 * dtype.itemsize + 4) + 2 * padded * dtype.itemsize


def operator_norm(
    forward: Callable[[Tensor], Tensor],
    adjoint: Callable[[Tensor], Tensor],
    start: Tensor,
    iterations: int = 30,
    tolerance: float = 1e-3,
) -> float:
    """Return the largest singular value by the power method on the normal operator, from below.

        x <- A^T A x / |A^T A x|,     |A| = sqrt(|A^T A x|)

    It stops when the estimate grows by less than `tolerance` in an iteration.
    """
    x, estimate = start, 0.0
    for _ in range(iterations):
        x = x / x.norm().clamp_min(torch.finfo(x.dtype).tiny)
        x = adjoint(forward(x))
        last, estimate = estimate, float(x.norm()) ** 0.5
        if estimate <= last * (1 + tolerance):
            break
    return estimate


def _numba() -> ModuleType:
    """The compiled kernels, with as many threads as torch uses."""
    import numba

    from nerif.reconstruction import kernels_numba

    numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))
    return kernels_numba
