"""Fields with one coefficient per voxel: B-splines of degree 1 (trilinear) or 3 (twice differentiable).

    n(x) = sum_ijk c_ijk b(x / hx - i) b(y / hy - j) b(z / hz - k),      x measured from the first voxel centre

Source: Unser, Splines: a perfect fit for signal and image processing, IEEE Signal Process. Mag. 16 (1999).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.arrays import Points, Values, Vectors
from nerif.common.axis_order import order_remedy
from nerif.common.conventions import InputError, parse_faces
from nerif.common.transfer import in_double
from nerif.fields.field import Field
from nerif.geometry import Grid

__all__ = ["DEGREES", "Boundary", "VoxelField", "spline_coefficients", "spline_weights"]

DEGREES = {"linear": 1, "cubic": 3}
MANY_POINTS = 4096  # below, importing the compiler takes longer


class VoxelField(Field):
    """A B-spline over the voxels of a grid; points outside the box have the value at the nearest point of the box.

    Parameters
    ----------
    coefficients : (z + 2 p, y + 2 p, x + 2 p) at the voxel centres, p = (degree + 1) / 2 layers beyond each face
    degree : 1 (coefficients are values) or 3
    """

    def __init__(self, coefficients: Float[Tensor, "zp yp xp"], grid: Grid, degree: int) -> None:
        if degree not in DEGREES.values():
            raise InputError(f"expected one of {', '.join(map(str, DEGREES.values()))}, got {degree}", field="degree")
        self.grid, self.degree, self.layers = grid, degree, (degree + 1) // 2
        shape = tuple(n + 2 * self.layers for n in grid.shape)
        if tuple(coefficients.shape) != shape:
            got = tuple(coefficients.shape)
            raise InputError(f"expected the shape {shape} (z, y, x), got {got}", field="coefficients")
        self.coefficients = coefficients

    @classmethod
    def of(cls, coefficients: Float[Tensor, "z y x"], grid: Grid, degree: int, boundary: Boundary) -> VoxelField:
        """Return the spline of coefficients, which the boundary extends beyond the box."""
        return cls(boundary.extend(coefficients, (degree + 1) // 2), grid, degree)

    @classmethod
    def through(cls, values: Float[Tensor, "z y x"], grid: Grid) -> VoxelField:
        """Return the cubic spline that passes through `values` at the voxel centres, mirrored about the outermost."""
        if tuple(values.shape) != grid.shape:
            remedy = order_remedy("volume", "zyx", grid.shape, values.shape)
            got = tuple(values.shape)
            raise InputError(f"expected the shape {grid.shape} (z, y, x), got {got}{remedy}", field="volume")
        coefficients = in_double(values)
        for axis, n in enumerate(values.shape):
            unit = torch.eye(n, dtype=torch.float64, device=coefficients.device)
            coefficients = _prefilter(coefficients, axis, unit[_mirrored(n, 1)])
            coefficients = coefficients.index_select(axis, _mirrored(n, 2).to(coefficients.device))
        return cls(coefficients.to(values), grid, 3)

    def to(self, device: torch.device | str) -> VoxelField:
        """Return the field with its coefficients on a device."""
        return VoxelField(self.coefficients.to(device), self.grid, self.degree)

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        box, shape = self.grid.box, points.shape
        p = points.reshape(-1, 3)
        if self._compiled_for(p):
            from nerif.fields.spline_kernel import evaluate

            corners = box.lower, box.upper, self.grid.spacing
            value, gradient = evaluate(self.coefficients, self.degree, p, *corners)
            return value.reshape(shape[:-1]), gradient.reshape(shape)
        inside = torch.minimum(torch.maximum(p, p.new_tensor(box.lower)), p.new_tensor(box.upper))
        position = (inside - p.new_tensor(box.lower)) / p.new_tensor(self.grid.spacing) - 0.5
        cell = position.floor()
        weights, slopes = spline_weights(position - cell, self.degree)  # (n, 3, degree + 1): axis x, y, z
        slopes = slopes / p.new_tensor(self.grid.spacing)[:, None] * (inside == p)[..., None]
        _, ny, nx = self.coefficients.shape
        count = self.degree + 1
        # index of the first contributing coefficient
        ix, iy, iz = (cell.long() + self.layers - self.degree // 2).unbind(-1)
        along_x = ix[:, None] + torch.arange(count, device=p.device)
        flat = self.coefficients.to(p).reshape(-1)
        value, gx, gy, gz = (torch.zeros_like(p[:, 0]) for _ in range(4))
        for k in range(count):
            for j in range(count):
                line = flat[(((iz + k) * ny + iy + j) * nx)[:, None] + along_x]  # (n, degree + 1) along x
                along, slope = (line * weights[:, 0]).sum(-1), (line * slopes[:, 0]).sum(-1)
                wy, wz = weights[:, 1, j], weights[:, 2, k]
                value += along * wy * wz
                gx += slope * wy * wz
                gy += along * slopes[:, 1, j] * wz
                gz += along * wy * slopes[:, 2, k]
        return value.reshape(shape[:-1]), torch.stack([gx, gy, gz], dim=-1).reshape(shape)

    def _compiled_for(self, p: Tensor) -> bool:
        """Whether the compiled kernel evaluates points: many of them, on a CPU, without derivatives by them."""
        differentiable = torch.is_grad_enabled() and (p.requires_grad or self.coefficients.requires_grad)
        on_cpu = p.device.type == self.coefficients.device.type == "cpu"
        return on_cpu and len(p) >= MANY_POINTS and not differentiable and p.dtype in (torch.float32, torch.float64)


@dataclass(frozen=True)
class Boundary:
    """Coefficients beyond the faces of the box, which impose the gauge.

    On an ambient face they are mirrored with opposite sign, so that the field is 0 there; on other faces they are
    mirrored, so that its slope is 0.
    """

    ambient_faces: tuple[str, ...] = ()  #: names such as "x-"
    around: bool = False  #: whether the field is periodic along y, as of an angle

    def __post_init__(self) -> None:
        parse_faces(self.ambient_faces)

    def _sign(self, axis: int, side: str) -> float:
        return -1.0 if "zyx"[axis] + side in self.ambient_faces else 1.0

    def extend(
        self, values: Float[Tensor, "z y x"], layers: int, axes: Sequence[int] = (0, 1, 2)
    ) -> Float[Tensor, "zp yp xp"]:
        """Return the values with `layers` more beyond each face across the axes (0, 1, 2: z, y, x)."""
        if min(values.shape[axis] for axis in axes) < layers:
            raise InputError(
                f"expected at least {layers} voxels along each edge, got {tuple(values.shape)}", field="grid"
            )
        for axis in axes:
            first, last = values.narrow(axis, 0, layers), values.narrow(axis, values.shape[axis] - layers, layers)
            if self.around and axis == 1:
                values = torch.cat([last, values, first], dim=axis)
                continue
            before, after = first.flip(axis) * self._sign(axis, "-"), last.flip(axis) * self._sign(axis, "+")
            values = torch.cat([before, values, after], dim=axis)
        return values

    def fold(
        self, extended: Float[Tensor, "zp yp xp"], layers: int, axes: Sequence[int] = (0, 1, 2)
    ) -> Float[Tensor, "z y x"]:
        """Apply the adjoint of `extend`: add values beyond a face to the voxels they mirror."""
        for axis in axes:
            n = extended.shape[axis] - 2 * layers
            before, after = extended.narrow(axis, 0, layers), extended.narrow(axis, n + layers, layers)
            extended = extended.narrow(axis, layers, n).clone()
            if self.around and axis == 1:
                extended.narrow(axis, n - layers, layers).add_(before)
                extended.narrow(axis, 0, layers).add_(after)
                continue
            extended.narrow(axis, 0, layers).add_(before.flip(axis), alpha=self._sign(axis, "-"))
            extended.narrow(axis, n - layers, layers).add_(after.flip(axis), alpha=self._sign(axis, "+"))
        return extended


def spline_weights(t: Tensor, degree: int) -> tuple[Tensor, Tensor]:
    """Return weights of the 2 or 4 nearest neighbours on a new last axis, and their derivatives.

    t is the distance from the neighbour before, in voxels.
    """
    s = 1 - t
    if degree == 1:
        return torch.stack([s, t], dim=-1), torch.stack([-torch.ones_like(t), torch.ones_like(t)], dim=-1)
    weights = torch.stack([s**3, 4 - 6 * t**2 + 3 * t**3, 4 - 6 * s**2 + 3 * s**3, t**3], dim=-1) / 6
    slopes = torch.stack([-(s**2), 3 * t**2 - 4 * t, 4 * s - 3 * s**2, t**2], dim=-1) / 2
    return weights, slopes


def spline_coefficients(
    values: Float[Tensor, "z y x"], degree: int, boundary: Boundary, axes: Sequence[int] = (0, 1, 2)
) -> Float[Tensor, "z y x"]:
    """Return the coefficients within a boundary of the spline along axes with these values at the voxel centres."""
    if degree == 1:
        return values
    coefficients = in_double(values)
    for axis in axes:
        n = values.shape[axis]
        unit = torch.eye(n, dtype=torch.float64, device=coefficients.device)[..., None].movedim(0, axis)
        coefficients = _prefilter(coefficients, axis, boundary.extend(unit, 1, (axis,)).movedim(axis, 0)[..., 0])
    return coefficients.to(values)


def _prefilter(values: Tensor, axis: int, extended: Float[Tensor, "m n"]) -> Tensor:
    """Coefficients c of the spline with (c[i-1] + 4 c[i] + c[i+1]) / 6 = values[i].

    `extended` has a row for each of c[-1] ... c[n], a function of the n inner ones.
    """
    first = values.movedim(axis, 0)
    matrix = (extended[:-2] + 4 * extended[1:-1] + extended[2:]) / 6
    return torch.linalg.solve(matrix, first.reshape(len(first), -1)).reshape(first.shape).movedim(0, axis)


def _mirrored(n: int, layers: int) -> Tensor:
    """Indices 0 ... n - 1 and `layers` more at both ends, mirrored about the end samples."""
    index = torch.arange(-layers, n + layers).abs()
    return torch.where(index < n, index, 2 * (n - 1) - index).clamp(0, n - 1)
