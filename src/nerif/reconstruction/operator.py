"""The linear map from voxels to what rays see of them, never formed as a matrix, and its adjoint."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import InputError
from nerif.fields.grid import DEGREES, Boundary, VoxelField
from nerif.geometry import Grid, Rays
from nerif.techniques.base import ForwardModel

__all__ = ["STEPS", "VoxelOperator", "operator_norm"]

STEPS = {"linear": 0.5, "cubic": 1.0}
"""Voxels between samples: the gradient of the linear basis jumps from voxel to voxel (benchmarks/README.md)."""

EVEN = 1e-9  # of the largest weight: how far one may be from the line between those at the ends of a ray
PROBES = (0.0, 0.0931, 0.2718, 0.3819, 0.5, 0.6543, 0.8191, 0.9397, 1.0)  # shares of a ray; no profile repeats there
CHUNK = 1 << 15  # rays whose weights are looked at a time, sample by sample


class VoxelOperator:
    """What rays see of a B-spline on a voxel grid by a linear forward model; c are the spline's coefficients.

        (A c)_r = sum_m w_rm [A_r f(x_rm) + B_r grad f(x_rm)],    f(x) = sum_ijk c_ijk b_ijk(x)

    Profile w, A and B are the model's (techniques/base.py); samples stand at the middles of equal intervals between
    near and far, no longer than `step` voxels. The kernels take the profile of a ray as first value and increment; one
    that does not grow evenly is kept sample by sample. `A(c)` applies the operator, `A.T(y)` its exact adjoint. On a
    CPU it runs on all cores (Numba), on CUDA in PyTorch.

    Parameters
    ----------
    rays : Rays clipped to the box of the grid
    grid : Grid
    model : linear ForwardModel
    basis : "linear" (coefficients are the values at voxel centres) or "cubic"
    boundary : how the coefficients go on beyond the box
    step : longest distance between samples, in edges of a voxel; None for that of STEPS
    device, dtype : where and in which precision c and y are

    Raises
    ------
    InputError
        If no ray crosses the box, one is not clipped to it, the model is not linear, or a setting is not one of those
        named.

    Source: docs/conventions.md (forward model); Joseph, IEEE Trans. Med. Imaging 1 (1982), for projection by
    interpolation.
    """

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
            raise InputError(f"model: expected a linear one, got {type(model).__name__}")
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
        self.range_shape = (len(rays), len(model.channels))
        if min(grid.shape) < self.layers:
            raise InputError(
                f"voxels: expected at least {self.layers} along each edge for basis {basis}, got {grid.shape}"
            )
        self.step = step
        self.path, self.matrices = self._prepare(rays, model, step)

    def for_rays(self, rays: Rays, model: ForwardModel) -> VoxelOperator:
        """Return the operator of other rays on the same grid."""
        return VoxelOperator(
            rays, self.grid, model, self.basis, self.boundary, self.step, self.device, self.dtype
        )  # fmt: skip

    def _prepare(self, rays: Rays, model: ForwardModel, step: float) -> tuple[tuple[Tensor, ...], list[Tensor]]:
        """What the kernels need: start, stride, profile and count of each ray; its A and B, in voxels."""
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
        last = (count - 1).clamp_min(0)
        ends = s[:, None] + torch.stack([0 * last, last * interval], dim=1)
        weights = model.weights(rays, ends, interval[:, None].expand_as(ends))
        first, final = weights.profile.unbind(1)
        profile = torch.stack([first, (final - first) / last.clamp_min(1)], dim=1)
        if not _even(model, rays, s, interval, last * interval):
            profile = _tabulated(model, rays, s, interval, int(count.max()))
        kept = [a.to(self.device, self.dtype).contiguous() for a in (start, stride, profile)]
        matrices = [] if weights.slope is None else [weights.slope / spacing]
        matrices += [] if weights.value is None else [weights.value[..., None]]
        for matrix in matrices:  # by which the kernels walk through memory
            if matrix.shape[1] != self.range_shape[1]:
                what = f"expected weights of {self.range_shape[1]} channels a ray, got {matrix.shape[1]}"
                raise InputError(f"{type(model).__name__}: {what}")
        path = (*kept, count.to(self.device, torch.int32))
        return path, [a.to(self.device, self.dtype).contiguous() for a in matrices]

    def _check_inside(self, *positions: Tensor) -> None:
        """Refuse samples beyond the coefficients: the kernels would read memory that is not theirs."""
        most = torch.tensor([n + 2 * self.layers - self.degree for n in reversed(self.domain_shape)])
        for p in positions:
            if not bool(((p >= 0) & (p < most.to(p))).all()):
                raise InputError(
                    f"rays: expected rays clipped to the box of the grid, {self.grid.box}, got longer ones"
                )

    def __call__(self, coefficients: Float[Tensor, "z y x"]) -> Float[Tensor, "n c"]:
        """Return what every ray sees."""
        if tuple(coefficients.shape) != self.domain_shape:
            raise InputError(f"coefficients: expected {self.domain_shape}, got {tuple(coefficients.shape)}")
        return self.through(self.boundary.extend(coefficients.to(self.device, self.dtype), self.layers))

    def through(self, padded: Float[Tensor, "zp yp xp"]) -> Float[Tensor, "n c"]:
        """Return what every ray sees of coefficients that go on beyond the box already."""
        padded = padded.to(self.device, self.dtype).contiguous()
        seen = torch.zeros(self.range_shape, dtype=self.dtype, device=self.device)
        kernels, convert = self._kernels()
        for matrix in self.matrices:
            path = [convert(a) for a in self.path]
            kernels.forward(self.degree, convert(padded), path, convert(matrix), convert(seen))
        return seen

    def T(self, seen: Float[Tensor, "n c"]) -> Float[Tensor, "z y x"]:
        """Return the adjoint of the operator, applied to what rays see."""
        if tuple(seen.shape) != self.range_shape:
            raise InputError(f"seen: expected {self.range_shape}, got {tuple(seen.shape)}")
        shape = tuple(n + 2 * self.layers for n in self.domain_shape)
        padded = torch.zeros(shape, dtype=self.dtype, device=self.device)
        seen = seen.to(self.device, self.dtype).contiguous()
        kernels, convert = self._kernels()
        for matrix in self.matrices:
            path = [convert(a) for a in self.path]
            kernels.adjoint(self.degree, convert(seen), path, convert(matrix), convert(padded))
        return self.boundary.fold(padded, self.layers)

    def _kernels(self) -> tuple[Any, Callable[[Tensor], Any]]:
        """The kernels of the device, and how they take arrays."""
        if self.device.type == "cpu":
            return _numba(), Tensor.numpy
        from nerif.reconstruction import kernels_torch

        return kernels_torch, lambda a: a

    def field(self, coefficients: Float[Tensor, "z y x"]) -> VoxelField:
        """Return the field that coefficients stand for."""
        return VoxelField.of(coefficients, self.grid, self.degree, self.boundary)

    def norm(self, iterations: int = 30) -> float:
        """Return an estimate of the largest singular value, from below."""
        start = torch.rand(self.domain_shape, generator=torch.Generator().manual_seed(0), dtype=self.dtype)
        return operator_norm(self, self.T, start.to(self.device), iterations)

    @staticmethod
    def memory_bytes(
        rays: int, grid: Grid, basis: str = "linear", dtype: torch.dtype = torch.float32, channels: int = 2
    ) -> int:
        """Return what an operator holds while it is applied: rays, B in so many channels, and the padded grid twice."""
        layers = (DEGREES[basis] + 1) // 2
        padded = 1
        for n in grid.shape:
            padded *= n + 2 * layers
        return rays * ((8 + 3 * channels) * dtype.itemsize + 4) + 2 * padded * dtype.itemsize


def _even(model: ForwardModel, rays: Rays, s: Tensor, interval: Tensor, length: Tensor) -> bool:
    """Whether the profile of every ray is a line from its first sample to its last, a length (mm) apart."""
    shares = s.new_tensor(PROBES)
    for i in torch.arange(len(rays), device=s.device).split(CHUNK):
        at = s[i, None] + shares * length[i, None]
        profile = model.weights(rays[i], at, interval[i, None].expand_as(at)).profile
        line = profile[:, :1] + shares * (profile[:, -1:] - profile[:, :1])
        if bool(((profile - line).abs() > EVEN * profile.abs().amax()).any()):
            return False
    return True


def _tabulated(model: ForwardModel, rays: Rays, s: Tensor, interval: Tensor, most: int) -> Float[Tensor, "n m 1"]:
    """The profile of a model at every sample of every ray."""
    m = torch.arange(most, dtype=s.dtype, device=s.device)
    parts = []
    for i in torch.arange(len(rays), device=s.device).split(CHUNK):
        at = s[i, None] + m * interval[i, None]
        parts.append(model.weights(rays[i], at, interval[i, None].expand_as(at)).profile)
    return torch.cat(parts)[..., None]


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
