"""Samples of rays on a grid: one where a ray crosses each plane across the axis that it follows most closely.

A spline restricted to such a plane is a two-dimensional spline: its coefficients are those of the grid smoothed along
the axis, and the slope along the axis has its own. A sample then has (degree + 1)^2 neighbours instead of
(degree + 1)^3, and the planes of the adjoint can be summed in parallel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.transfer import double_device
from nerif.fields.voxel_field import spline_weights
from nerif.forward.forward_model import ForwardModel, Weights
from nerif.geometry import Grid, Rays

__all__ = ["Planes", "RayBundle", "profiles"]

EVEN = 1e-9  # of the largest weight: tolerated deviation from the line between the ends of a ray
PROBES = (0.0, 0.0931, 0.2718, 0.3819, 0.5, 0.6543, 0.8191, 0.9397, 1.0)  # along a ray; irregular, against aliasing
CHUNK_RAYS = 1 << 15  # whose weights are computed at a time
OUTSIDE = 0.25  # voxels by which rays clipped in single precision, far from their camera, may extend beyond the box


@dataclass(frozen=True)
class Planes:
    """Evenly spaced planes across one axis of a grid, each in the middle of its share of the box."""

    grid: Grid
    degree: int  # of the spline
    axis: int  # 0, 1, 2 for x, y, z
    each: int  # planes in a voxel

    @property
    def across(self) -> tuple[int, int]:
        """The axes u and v of a plane."""
        u, v = (axis for axis in range(3) if axis != self.axis)
        return u, v

    def shape(self, padded: torch.Size | tuple[int, ...]) -> tuple[int, int, int]:
        """Number of planes, and coefficients along v and u, for padded coefficients of a shape (z, y, x)."""
        u, v = self.across
        return self.each * self.grid.shape[2 - self.axis], padded[2 - v], padded[2 - u]

    def cut(self, padded: Float[Tensor, "z y x"], dtype: torch.dtype) -> tuple[Float[Tensor, "k v u"], ...]:
        """Return the coefficients, on every plane, of the field and of its slope along the axis, per voxel."""
        along = padded.movedim(2 - self.axis, 0)
        n = self.grid.shape[2 - self.axis]
        parts: tuple[list[Tensor], list[Tensor]] = ([], [])
        for first, *both in self._weights():
            for part, weights in zip(parts, both, strict=True):
                part.append(sum(w * along.narrow(0, first + i, n) for i, w in enumerate(weights)))  # type: ignore[arg-type]
        shape = self.shape(padded.shape)
        value, slope = (torch.stack(part, dim=1).reshape(shape).to(dtype).contiguous() for part in parts)
        return value, slope

    def add_cut_adjoint(
        self, value: Float[Tensor, "k v u"], slope: Float[Tensor, "k v u"] | None, padded: Float[Tensor, "z y x"]
    ) -> None:
        """Add the adjoint of `cut` to the padded coefficients."""
        along, n = padded.movedim(2 - self.axis, 0), self.grid.shape[2 - self.axis]
        for j, (first, values, slopes) in enumerate(self._weights()):
            for i, (a, b) in enumerate(zip(values, slopes, strict=True)):
                layer = along.narrow(0, first + i, n)
                layer += (a * value[j :: self.each]).to(padded.dtype)
                if slope is not None:
                    layer += (b * slope[j :: self.each]).to(padded.dtype)

    def _weights(self) -> list[tuple[int, list[float], list[float]]]:
        """For each plane of a voxel: the first neighbour, and the weights of value and slope."""
        planes = []
        for j in range(self.each):
            position = (j + 0.5) / self.each - 0.5
            cell = math.floor(position)
            weights, slopes = spline_weights(torch.tensor(position - cell, dtype=torch.float64), self.degree)
            layers = (self.degree + 1) // 2
            planes.append((cell + layers - self.degree // 2, weights.tolist(), slopes.tolist()))
        return planes


@dataclass(frozen=True)
class RayBundle:
    """Rays that follow the same axis most closely, with their samples.

    Sample m of a ray is on plane first + m, at start + m stride, with weight profile_0 + m profile_1 or profile_m; the
    first and the last sample lack the share of the space between planes that the ray does not cross.
    """

    planes: Planes
    index: Int[Tensor, " n"]  # numbers of the rays
    start: Float[Tensor, "n 2"]  # along u and v, in voxels, 0 at the first coefficient of a plane
    stride: Float[Tensor, "n 2"]
    profile: Tensor  # (n, 2) or (n, m, 1)
    lost: Float[Tensor, "n 2"]  # shares that the first and the last sample lack
    first: Int[Tensor, " n"]  # plane
    count: Int[Tensor, " n"]  # of planes
    # applied to the integrals of the slopes along u, v and the axis, per voxel; None if the model depends on f alone
    gradient: Float[Tensor, "n c 3"] | None
    value: Float[Tensor, "n c 1"] | None  # applied to the integral of f, or None

    @property
    def path(self) -> tuple[Tensor, ...]:
        """The arguments of the kernels."""
        return self.start, self.stride, self.profile, self.lost, self.first, self.count

    @classmethod
    def all_of(cls, rays: Rays, grid: Grid, degree: int, each: int, model: ForwardModel) -> list[RayBundle]:
        """Sort rays, clipped to the box, by the axis that they follow most closely."""
        rays = rays.to(double_device(rays.near.device))
        crosses = rays.crosses.nonzero()[:, 0]
        spacing = torch.tensor(grid.spacing, dtype=torch.float64, device=rays.near.device)
        axis = (rays.direction[crosses].double() / spacing).abs().argmax(dim=1)
        numbers = [(a, crosses[axis == a]) for a in range(3)]
        return [cls._of(rays[i], i, Planes(grid, degree, a, each), model) for a, i in numbers if len(i)]

    @classmethod
    def _of(cls, rays: Rays, index: Int[Tensor, " n"], planes: Planes, model: ForwardModel) -> RayBundle:
        rays = rays.to(dtype=torch.float64)  # cameras are far away: positions lose digits in single precision
        grid, axis, each = planes.grid, planes.axis, planes.each
        spacing, lower = rays.near.new_tensor(grid.spacing), rays.near.new_tensor(grid.box.lower)
        origin, direction = (rays.origin - lower) / spacing, rays.direction / spacing  # in voxels
        ends = origin[:, None] + torch.stack([rays.near, rays.far], dim=1)[..., None] * direction[:, None]
        upper = ends.new_tensor([float(n) for n in reversed(grid.shape)])
        if not bool(((ends >= -OUTSIDE) & (ends <= upper + OUTSIDE)).all()):
            raise InputError(f"expected rays clipped to the box of the grid, {grid.box}, got longer ones", field="rays")
        reach = (each * ends[..., axis]).sort(dim=1).values.clamp(0, each * grid.shape[2 - axis])
        first = reach[:, 0].floor().clamp(max=each * grid.shape[2 - axis] - 1)
        last = torch.maximum(reach[:, 1].ceil() - 1, first)
        lost = 1 - torch.stack([torch.minimum(first + 1, reach[:, 1]) - reach[:, 0], reach[:, 1] - last], dim=1)
        lost[:, 1] *= last > first  # a single sample is the first
        # path length at the first plane, and between planes
        s = ((first + 0.5) / each - origin[:, axis]) / direction[:, axis]
        apart = 1 / (each * direction[:, axis])
        uv = list(planes.across)
        offset = (planes.degree + 1) // 2 - planes.degree // 2 - 0.5
        start = origin[:, uv] + s[:, None] * direction[:, uv] + offset
        stride = apart[:, None] * direction[:, uv]
        weights, profile = profiles(model, rays, s, apart, last - first)
        gradient = None if weights.slope is None else (weights.slope / spacing)[..., [*uv, axis]]
        value = None if weights.value is None else weights.value[..., None]
        for matrix in (gradient, value):
            if matrix is not None and matrix.shape[1] != len(model.channels):
                raise InputError(
                    f"expected weights of {len(model.channels)} channels a ray, got {matrix.shape[1]}",
                    field=type(model).__name__,
                )
        numbers = first.to(torch.int32), (last - first + 1).to(torch.int32)
        return cls(planes, index, start, stride, profile, lost, *numbers, gradient, value)

    def to(self, device: torch.device, inner: torch.dtype, dtype: torch.dtype) -> RayBundle:
        """Return the bundle on a device: paths in the kernels' precision, matrices in that of the projections."""
        path = [a.to(device, inner).contiguous() for a in (self.start, self.stride, self.profile, self.lost)]
        whole = [a.to(device).contiguous() for a in (self.first, self.count)]
        matrices = [None if m is None else m.to(device, dtype).contiguous() for m in (self.gradient, self.value)]
        return RayBundle(self.planes, self.index.to(device), *path, *whole, *matrices)


def profiles(model: ForwardModel, rays: Rays, s: Tensor, apart: Tensor, steps: Tensor) -> tuple[Weights, Tensor]:
    """Return the weights of the end samples, and the profile of each ray.

    The profile is (n, 2), first value and increment, where it is linear along every ray, else (n, m, 1). The first
    sample is at path length s, the others `apart` (mm; negative where samples run against the ray), `steps` in all.
    """
    ends = torch.stack([s, s + steps * apart], dim=1)
    weights = model.weights(rays, ends, apart.abs()[:, None].expand_as(ends))
    begin, final = weights.profile.unbind(1)
    if _is_linear(model, rays, s, apart, steps):
        return weights, torch.stack([begin, (final - begin) / steps.clamp(min=1)], dim=1)
    m = torch.arange(int(steps.max()) + 1, dtype=s.dtype, device=s.device)
    parts = []
    for i in torch.arange(len(rays), device=s.device).split(CHUNK_RAYS):
        at = s[i, None] + m * apart[i, None]
        parts.append(model.weights(rays[i], at, apart[i, None].abs().expand_as(at)).profile)
    return weights, torch.cat(parts)[..., None]


def _is_linear(model: ForwardModel, rays: Rays, s: Tensor, apart: Tensor, steps: Tensor) -> bool:
    """Whether the profile is linear along every ray."""
    shares = s.new_tensor(PROBES)
    for i in torch.arange(len(rays), device=s.device).split(CHUNK_RAYS):
        at = s[i, None] + shares * (steps * apart)[i, None]
        profile = model.weights(rays[i], at, apart[i, None].abs().expand_as(at)).profile
        line = profile[:, :1] + shares * (profile[:, -1:] - profile[:, :1])
        if bool(((profile - line).abs() > EVEN * profile.abs().amax()).any()):
            return False
    return True
