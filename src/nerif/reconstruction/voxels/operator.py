"""The linear map from voxels to what rays see of them, never formed as a matrix, and its adjoint."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.fields.grid import DEGREES, Boundary, VoxelField
from nerif.forward.base import ForwardModel
from nerif.geometry import Grid, Rays
from nerif.reconstruction.device import share_threads
from nerif.reconstruction.voxels.planes import Bundle

__all__ = ["STEPS", "VoxelOperator", "check_step", "made_of", "operator_norm", "rays_through"]

STEPS = {"linear": 0.5, "cubic": 1.0}
"""Voxels between planes, at most: the gradient of the linear basis jumps from voxel to voxel (docs/decisions/011)."""

PAIRS, MOST_PAIRS = 2.0, 8
"""Of rays through a lens, for each voxel that the cone's radius is wide in the middle of the box, and at most."""


class VoxelOperator:
    """What rays see of a B-spline on a voxel grid by a linear forward model; c are the spline's coefficients.

        (A c)_r = sum_m w_rm [A_r f(x_rm) + B_r grad f(x_rm)],    f(x) = sum_ijk c_ijk b_ijk(x)

    Profile w, A and B are the model's (forward/base.py); samples stand where rays cross evenly spaced planes
    (planes.py). `A(c)` applies the operator, `A.T(y)` its exact adjoint. On a CPU it runs on all cores (Numba), on CUDA
    in PyTorch. What a ray with a lens sees is the mean over thin rays through it, the more the wider they spread.

    Parameters
    ----------
    rays : Rays clipped to the box of the grid
    grid : Grid
    model : linear ForwardModel
    basis : "linear" (coefficients are the values at voxel centres) or "cubic"
    boundary : how the coefficients go on beyond the box
    step : longest distance between planes, in edges of a voxel, at most that of STEPS; None for that
    device, dtype : where and in which precision c and y are

    Raises
    ------
    InputError
        If no ray crosses the box, one is not clipped to it, the model is not linear, or a setting is not one of those
        named.

    Source: docs/conventions.md (forward model); Joseph, IEEE Trans. Med. Imaging 1 (1982), for projection by
    interpolation in planes; Lacroute & Levoy, SIGGRAPH (1994), for the resampling along the axis.
    """

    padded_axes: tuple[int, ...] = (0, 1, 2)
    """Of z, y, x, across which coefficients go on beyond the box."""

    def __init__(
        self,
        rays: Rays,
        grid: Grid,
        model: ForwardModel,
        basis: str = "linear",
        boundary: Boundary | None = None,
        step: float | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if not model.linear:
            raise InputError(f"expected a linear one, got {type(model).__name__}", field="model")
        if basis not in DEGREES:
            raise InputError(f"expected {' or '.join(DEGREES)}, got '{basis}'", field="basis")
        step = STEPS[basis] if step is None else step
        check_step(step, basis)
        if not bool(rays.crosses.any()):
            raise InputError("expected rays that cross the box, got none; check box, cameras and masks", field="rays")
        self.grid, self.basis, self.boundary = grid, basis, boundary or Boundary()
        self.degree = DEGREES[basis]
        self.layers = (self.degree + 1) // 2
        self.device, self.dtype = torch.device(device), dtype
        self.compiled = self.device.type == "cpu"  # or False: in plain PyTorch, to compare with
        self.inner = torch.float64 if self.compiled else dtype
        self.domain_shape = grid.shape
        self.range_shape = (len(rays), len(model.channels))
        self.shares: Tensor | None = None  # of rays through a lens, in what a pixel sees
        if rays.lens is not None:
            each = rays_through(rays, min(grid.spacing))
            rays = rays.spread(each)
            self.shares = rays.shares(each).reshape(-1, each, 1).to(self.device, dtype)
        if min(grid.shape[axis] for axis in self.padded_axes) < self.layers:
            raise InputError(
                f"expected at least {self.layers} along each edge for basis {basis}, got {grid.shape}", field="voxels"
            )
        self.step = step
        self._follow(rays, model)

    def _follow(self, rays: Rays, model: ForwardModel) -> None:
        """Find where rays are sampled."""
        bundles = Bundle.all_of(rays, self.grid, self.degree, math.ceil(1 / self.step), model)
        self.bundles = [bundle.to(self.device, self.inner, self.dtype) for bundle in bundles]

    @property
    def samples(self) -> int:
        """How many samples all rays have."""
        return sum(int(bundle.count.sum()) for bundle in self.bundles)

    def for_rays(self, rays: Rays, model: ForwardModel) -> VoxelOperator:
        """Return the operator of other rays on the same grid."""
        return VoxelOperator(
            rays, self.grid, model, self.basis, self.boundary, self.step, self.device, self.dtype
        )  # fmt: skip

    def __call__(self, coefficients: Float[Tensor, "z y x"]) -> Float[Tensor, "n c"]:
        """Return what every ray sees."""
        if tuple(coefficients.shape) != self.domain_shape:
            raise InputError(f"expected {self.domain_shape}, got {tuple(coefficients.shape)}", field="coefficients")
        return self.through(
            self.boundary.extend(coefficients.to(self.device, self.dtype), self.layers, self.padded_axes)
        )

    def through(self, padded: Float[Tensor, "zp yp xp"]) -> Float[Tensor, "n c"]:
        """Return what every ray sees of coefficients that go on beyond the box already."""
        padded = padded.to(self.device, self.dtype)
        seen = self._of_rays(None)
        self._integrate(padded, seen)
        return seen if self.shares is None else (seen.reshape(*self.shares.shape[:2], -1) * self.shares).sum(dim=1)

    def T(self, seen: Float[Tensor, "n c"]) -> Float[Tensor, "z y x"]:
        """Return the adjoint of the operator, applied to what rays see."""
        if tuple(seen.shape) != self.range_shape:
            raise InputError(f"expected {self.range_shape}, got {tuple(seen.shape)}", field="seen")
        shape = [n + 2 * self.layers * (axis in self.padded_axes) for axis, n in enumerate(self.domain_shape)]
        padded = torch.zeros(shape, dtype=self.dtype, device=self.device)
        self._spread(self._of_rays(seen.to(self.device, self.dtype)), padded)
        return self.boundary.fold(padded, self.layers, self.padded_axes)

    def _integrate(self, padded: Float[Tensor, "zp yp xp"], seen: Float[Tensor, "m c"]) -> None:
        """Set what thin rays see."""
        integrate, _ = self._kernels()
        for bundle in self.bundles:
            value, slope = bundle.planes.cut(padded, self.inner)
            own = torch.zeros_like(seen[: len(bundle.index)])
            if bundle.gradient is not None:
                own += made_of(bundle.gradient, integrate(self.degree, value, slope, bundle.path))
            if bundle.value is not None:
                own += made_of(bundle.value, integrate(self.degree, value, None, bundle.path))
            seen[bundle.index] = own

    def _spread(self, seen: Float[Tensor, "m c"], padded: Float[Tensor, "zp yp xp"]) -> None:
        """Add what the adjoint makes of what thin rays see."""
        _, spread = self._kernels()
        for bundle in self.bundles:
            for matrix in (bundle.gradient, bundle.value):
                if matrix is not None:
                    q = torch.einsum("nij,ni->nj", matrix, seen[bundle.index]).to(self.inner).contiguous()
                    value, *slope = spread(self.degree, q, bundle.path, bundle.planes.shape(padded.shape))
                    bundle.planes.mend(value, slope[0] if slope else None, padded)

    def _of_rays(self, seen: Float[Tensor, "n c"] | None) -> Float[Tensor, "m c"]:
        """Of what pixels see the part of each of their rays; 0 where nothing is given."""
        pixels, channels = self.range_shape
        if seen is None:
            rays = pixels if self.shares is None else self.shares.numel()
            return torch.zeros(rays, channels, dtype=self.dtype, device=self.device)
        return seen if self.shares is None else (seen[:, None] * self.shares).flatten(0, 1)

    def _kernels(self) -> tuple[Callable[..., Tensor], Callable[..., list[Tensor]]]:
        """The kernels to run."""
        if self.compiled:
            return _compiled_integrate, _compiled_spread
        from nerif.reconstruction.voxels import kernels_torch

        return kernels_torch.integrate, kernels_torch.spread

    def field(self, coefficients: Float[Tensor, "z y x"]) -> VoxelField:
        """Return the field that coefficients stand for."""
        return VoxelField.of(coefficients, self.grid, self.degree, self.boundary)

    def norm(self, iterations: int = 30) -> float:
        """Return an estimate of the largest singular value, from below."""
        start = torch.rand(self.domain_shape, generator=torch.Generator().manual_seed(0), dtype=self.dtype)
        return operator_norm(self, self.T, start.to(self.device), iterations)

    @staticmethod
    def memory_bytes(
        rays: int, grid: Grid, basis: str = "linear", dtype: torch.dtype = torch.float32, channels: int = 2,
        step: float | None = None,
    ) -> int:  # fmt: skip
        """Return what an operator holds while it is applied: rays, B in so many channels, the padded grid and planes.

        Paths and planes count in double precision, as on a CPU; planes are those of value and slope, cut and mended,
        and what they are made of.
        """
        inner = 8
        layers, each = (DEGREES[basis] + 1) // 2, math.ceil(1 / (step or STEPS[basis]))
        padded = math.prod(n + 2 * layers for n in grid.shape)
        held = 8 * inner + 3 * channels * dtype.itemsize + 16  # numbers of a path, B, whole numbers
        return rays * held + padded * (2 * dtype.itemsize + each * (4 * inner + 6 * dtype.itemsize))


def rays_through(rays: Rays, length: float) -> int:
    """Return how many rays through the lens of a pixel tell what it sees of a field that changes over a length, mm."""
    if rays.lens is None:
        return 1
    rays = rays[rays.crosses]
    assert rays.lens is not None
    if not len(rays):
        return 2
    middle = 0.5 * (rays.near + rays.far)
    spread = float(rays.half_width(middle).max())
    return 2 * min(MOST_PAIRS, max(1, math.ceil(PAIRS * spread / length)))


def check_step(step: float, basis: str) -> None:
    """Refuse a distance of planes that no operator has."""
    if not 0 < step <= STEPS[basis]:
        raise InputError(
            f"expected above 0 and at most {STEPS[basis]:g} voxels (basis {basis}), got {step}", field="step"
        )


def made_of(matrix: Float[Tensor, "n c q"], integrals: Float[Tensor, "n q"]) -> Float[Tensor, "n c"]:
    """What the matrices make of integrals."""
    return torch.einsum("nij,nj->ni", matrix, integrals.to(matrix.dtype))


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


def _compiled_integrate(degree: int, value: Tensor, slope: Tensor | None, path: Sequence[Tensor]) -> Tensor:
    arrays = [a.numpy() for a in path]
    found = _compiled().integrate(degree, value.numpy(), None if slope is None else slope.numpy(), arrays)
    return torch.from_numpy(found)


def _compiled_spread(degree: int, seen: Tensor, path: Sequence[Tensor], shape: Sequence[int]) -> list[Tensor]:
    planes = _compiled().spread(degree, seen.numpy(), [a.numpy() for a in path], shape)
    return [torch.from_numpy(plane) for plane in planes]


def _compiled() -> ModuleType:
    """The compiled kernels, with as many threads as torch uses."""
    from nerif.reconstruction.voxels import kernels_numba

    share_threads()
    return kernels_numba
