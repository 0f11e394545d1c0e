"""How rays cross a grid: plane by plane across the axis that they run along most, one sample on each.

A spline on such a plane is a spline of two dimensions, whose coefficients are those of the grid, smoothed along the
axis; the slope along the axis has coefficients of its own. So each sample touches (degree + 1)^2 of them and not
(degree + 1)^3, and the planes of the adjoint can be added to side by side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.fields.grid import spline_weights
from nerif.forward.base import ForwardModel
from nerif.geometry import Grid, Rays

__all__ = ["Bundle", "Planes", "is_even", "tabulated"]

EVEN = 1e-9  # of the largest weight: how far one may be from the line between those at the ends of a ray
PROBES = (0.0, 0.0931, 0.2718, 0.3819, 0.5, 0.6543, 0.8191, 0.9397, 1.0)  # shares of a ray; no profile repeats there
CHUNK = 1 << 15  # rays whose weights are looked at a time, sample by sample
OUTSIDE = 0.25  # voxels: how far a ray clipped in single precision, far from its camera, may reach beyond the box


@dataclass(frozen=True)
class Planes:
    """Planes across one axis of a grid, evenly spaced and each in the middle of its share of the box.

    Parameters
    ----------
    grid : Grid
    degree : of the spline
    axis : 0, 1, 2 for x, y, z
    each : planes in a voxel
    """

    grid: Grid
    degree: int
    axis: int
    each: int

    @property
    def across(self) -> tuple[int, int]:
        """The axes u and v of a plane."""
        u, v = (axis for axis in range(3) if axis != self.axis)
        return u, v

    def shape(self, padded: torch.Size | tuple[int, ...]) -> tuple[int, int, int]:
        """Planes, and coefficients along v and u, of coefficients (z, y, x) that go on beyond the box."""
        u, v = self.across
        return self.each * self.grid.shape[2 - self.axis], padded[2 - v], padded[2 - u]

    def cut(self, padded: Float[Tensor, "z y x"], dtype: torch.dtype) -> tuple[Float[Tensor, "k v u"], ...]:
        """Return the coefficients, on every plane, of the field and of its slope along the axis, per voxel."""
        along = padded.movedim(2 - self.axis, 0)
        n = self.grid.shape[2 - self.axis]
        parts: tuple[list[Tensor], list[Tensor]] = ([], [])
        for weights in self._weights():
            for part, numbers in zip(parts, weights[1:], strict=True):
                part.append(sum(w * along.narrow(0, weights[0] + i, n) for i, w in enumerate(numbers)))  # type: ignore[arg-type]
        shape = self.shape(padded.shape)
        value, slope = (torch.stack(part, dim=1).reshape(shape).to(dtype).contiguous() for part in parts)
        return value, slope

    def mend(
        self, value: Float[Tensor, "k v u"], slope: Float[Tensor, "k v u"] | None, padded: Float[Tensor, "z y x"]
    ) -> None:
        """Add to the padded coefficients what the adjoint of `cut` makes of planes."""
        along, n = padded.movedim(2 - self.axis, 0), self.grid.shape[2 - self.axis]
        for j, (first, values, slopes) in enumerate(self._weights()):
            for i, (a, b) in enumerate(zip(values, slopes, strict=True)):
                here = along.narrow(0, first + i, n)
                here += (a * value[j :: self.each]).to(padded.dtype)
                if slope is not None:
                    here += (b * slope[j :: self.each]).to(padded.dtype)

    def _weights(self) -> list[tuple[int, list[float], list[float]]]:
        """For each plane of a voxel: the first coefficient that counts, and the weights of value and slope."""
        found = []
        for j in range(self.each):
            position = (j + 0.5) / self.each - 0.5
            cell = math.floor(position)
            weights, slopes = spline_weights(torch.tensor(position - cell, dtype=torch.float64), self.degree)
            layers = (self.degree + 1) // 2
            found.append((cell + layers - self.degree // 2, weights.tolist(), slopes.tolist()))
        return found


@dataclass(frozen=True)
class Bundle:
    """Rays that run along the same axis most, sample by sample.

    Sample m of a ray stands on plane first + m, at start + m stride, with the weight profile_0 + m profile_1 of a
    profile (n, 2), or profile_m of one (n, m, 1); the first and the last sample lack the share of the space
    between planes that the ray does not cross.

    Parameters
    ----------
    planes : Planes
    index : (n,) numbers of the rays
    start, stride : (n, 2) along u and v, in voxels, 0 at the first coefficient of a plane
    profile : (n, 2) or (n, m, 1)
    lost : (n, 2) shares that the first and the last sample lack
    first, count : (n,) first plane, and how many
    gradient, value : (n, c, 3), (n, c, 1) what is made of the integrals of the slopes along u, v and the axis, per
        voxel, and of the field; None where the model does not see it
    """

    planes: Planes
    index: Int[Tensor, " n"]
    start: Float[Tensor, "n 2"]
    stride: Float[Tensor, "n 2"]
    profile: Tensor
    lost: Float[Tensor, "n 2"]
    first: Int[Tensor, " n"]
    count: Int[Tensor, " n"]
    gradient: Float[Tensor, "n c 3"] | None
    value: Float[Tensor, "n c 1"] | None

    @property
    def path(self) -> tuple[Tensor, ...]:
        """What the kernels need of the rays."""
        return self.start, self.stride, self.profile, self.lost, self.first, self.count

    @classmethod
    def all_of(cls, rays: Rays, grid: Grid, degree: int, each: int, model: ForwardModel) -> list[Bundle]:
        """Sort rays by the axis that they run along most.

        Raises
        ------
        InputError
            If a ray is not clipped to the box, or the model has weights of other channels than it names.
        """
        crosses = rays.crosses.nonzero()[:, 0]
        spacing = torch.tensor(grid.spacing, dtype=torch.float64, device=rays.near.device)
        axis = (rays.direction[crosses].double() / spacing).abs().argmax(dim=1)
        numbers = [(a, crosses[axis == a]) for a in range(3)]
        return [cls._of(rays[i], i, Planes(grid, degree, a, each), model) for a, i in numbers if len(i)]

    @classmethod
    def _of(cls, rays: Rays, index: Int[Tensor, " n"], planes: Planes, model: ForwardModel) -> Bundle:
        rays = rays.to(dtype=torch.float64)  # cameras stand far off: positions lose digits in single precision
        grid, axis, each = planes.grid, planes.axis, planes.each
        spacing = torch.tensor(grid.spacing, dtype=torch.float64, device=rays.near.device)
        lower = torch.tensor(grid.box.lower, dtype=torch.float64, device=rays.near.device)
        origin, direction = (rays.origin - lower) / spacing, rays.direction / spacing  # in voxels
        ends = origin[:, None] + torch.stack([rays.near, rays.far], dim=1)[..., None] * direction[:, None]
        _check_inside(ends, grid)
        reach = (each * ends[..., axis]).sort(dim=1).values.clamp(0, each * grid.shape[2 - axis])
        first = reach[:, 0].floor().clamp(max=each * grid.shape[2 - axis] - 1)
        last = torch.maximum(reach[:, 1].ceil() - 1, first)
        lost = 1 - torch.stack([torch.minimum(first + 1, reach[:, 1]) - reach[:, 0], reach[:, 1] - last], dim=1)
        lost[:, 1] *= last > first  # a single sample is the first
        # s where the first plane is met, and between one plane and the next
        s = ((first + 0.5) / each - origin[:, axis]) / direction[:, axis]
        apart = 1 / (each * direction[:, axis])
        uv = list(planes.across)
        offset = (planes.degree + 1) // 2 - planes.degree // 2 - 0.5
        start = origin[:, uv] + s[:, None] * direction[:, uv] + offset
        stride = apart[:, None] * direction[:, uv]
        at = torch.stack([s, s + (last - first) * apart], dim=1)
        weights = model.weights(rays, at, apart.abs()[:, None].expand_as(at))
        begin, final = weights.profile.unbind(1)
        profile = torch.stack([begin, (final - begin) / (last - first).clamp_min(1)], dim=1)
        if not is_even(model, rays, s, apart, last - first):
            profile = tabulated(model, rays, s, apart, int((last - first).max()) + 1)
        gradient = None if weights.slope is None else (weights.slope / spacing)[..., [*uv, axis]]
        value = None if weights.value is None else weights.value[..., None]
        for matrix in (gradient, value):
            if matrix is not None and matrix.shape[1] != len(model.channels):
                what = f"expected weights of {len(model.channels)} channels a ray, got {matrix.shape[1]}"
                raise InputError(str(what), field=type(model).__name__)
        count = last - first + 1
        return cls(
            planes, index, start, stride, profile, lost, first.to(torch.int32), count.to(torch.int32), gradient, value
        )

    def to(self, device: torch.device, inner: torch.dtype, dtype: torch.dtype) -> Bundle:
        """Return the same on a device, what the kernels take in one precision and what is made of it in another."""
        path = [a.to(device, inner).contiguous() for a in (self.start, self.stride, self.profile, self.lost)]
        whole = [a.to(device).contiguous() for a in (self.first, self.count)]
        matrices = [None if m is None else m.to(device, dtype).contiguous() for m in (self.gradient, self.value)]
        return Bundle(self.planes, self.index.to(device), *path, *whole, *matrices)


def _check_inside(ends: Float[Tensor, "n 2 3"], grid: Grid) -> None:
    """Refuse rays that go on beyond the box, in voxels from its corner."""
    most = ends.new_tensor([float(n) for n in reversed(grid.shape)])
    if not bool(((ends >= -OUTSIDE) & (ends <= most + OUTSIDE)).all()):
        raise InputError(f"expected rays clipped to the box of the grid, {grid.box}, got longer ones", field="rays")


def is_even(model: ForwardModel, rays: Rays, s: Tensor, apart: Tensor, steps: Tensor) -> bool:
    """Whether the profile of every ray is a line from its first sample to its last, so many steps on."""
    shares = s.new_tensor(PROBES)
    for i in torch.arange(len(rays), device=s.device).split(CHUNK):
        at = s[i, None] + shares * (steps * apart)[i, None]
        profile = model.weights(rays[i], at, apart[i, None].abs().expand_as(at)).profile
        line = profile[:, :1] + shares * (profile[:, -1:] - profile[:, :1])
        if bool(((profile - line).abs() > EVEN * profile.abs().amax()).any()):
            return False
    return True


def tabulated(model: ForwardModel, rays: Rays, s: Tensor, apart: Tensor, most: int) -> Float[Tensor, "n m 1"]:
    """The profile of a model at every sample of every ray."""
    m = torch.arange(most, dtype=s.dtype, device=s.device)
    parts = []
    for i in torch.arange(len(rays), device=s.device).split(CHUNK):
        at = s[i, None] + m * apart[i, None]
        parts.append(model.weights(rays[i], at, apart[i, None].abs().expand_as(at)).profile)
    return torch.cat(parts)[..., None]
