"""Cubic splines at points that depend on the unknowns, with derivatives by coefficients and by points, on the CPU.

    f_c(x) = sum_ijk c_cijk b(x / hx - i) b(y / hy - j) b(z / hz - k)

Source: Unser, Splines: a perfect fit for signal and image processing, IEEE Signal Process. Mag. 16 (1999).
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.fields.spline_kernel import evaluate
from nerif.fields.voxel_field import VoxelField
from nerif.flow.kernels import CHANNELS, LAYERS, interpolate, spread

__all__ = ["fixed_splines", "periodic_spline"]


def periodic_spline(coefficients: Float[Tensor, "c z y x"], points: Float[Tensor, "n 3"]) -> Float[Tensor, "c n"]:
    """Return the values of splines on a periodic grid, differentiable by coefficients and points.

    Parameters
    ----------
    coefficients : at the nodes, of four channels at most
    points : x, y, z in nodes from the first one
    """
    return _Periodic.apply(coefficients, points)


def fixed_splines(fields: Sequence[VoxelField], points: Sequence[Float[Tensor, "n 3"]]) -> tuple[Tensor, ...]:
    """Return the values of fields, each at its own points (mm), differentiable by the points only."""
    return _Fixed.apply(fields, *points)


class _Periodic(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, points: Tensor) -> Tensor:
        channels, p = len(coefficients), points.detach().contiguous()
        c = _around(coefficients.detach())
        ctx.save_for_backward(c, p)
        ctx.channels = channels
        values = torch.empty(len(p), CHANNELS)
        interpolate(c.numpy(), p.numpy(), values.numpy())
        return values.T[:channels]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        c, p = ctx.saved_tensors
        gradient = torch.zeros(len(p), CHANNELS)
        gradient[:, : ctx.channels] = gradients[0].T
        by_coefficients = torch.zeros(torch.get_num_threads(), *c.shape)
        by_points = torch.empty_like(p)
        spread(c.numpy(), p.numpy(), gradient.numpy(), by_coefficients.numpy(), by_points.numpy())
        return _folded(by_coefficients.sum(dim=0))[: ctx.channels], by_points


def _around(values: Float[Tensor, "c z y x"]) -> Float[Tensor, "zl yl xl 4"]:
    """Put channels last, with zeros for lacking ones, and repeat the first layers of each axis at its end."""
    nz, ny, nx = values.shape[1:]
    result = torch.zeros(nz + LAYERS, ny + LAYERS, nx + LAYERS, CHANNELS)
    result[:nz, :ny, :nx, : len(values)] = values.permute(1, 2, 3, 0)
    for axis, n in ((2, nx), (1, ny), (0, nz)):
        for layer in range(LAYERS):
            result.select(axis, n + layer).copy_(result.select(axis, layer % n))
    return result


def _folded(values: Float[Tensor, "zl yl xl 4"]) -> Float[Tensor, "4 z y x"]:
    """Apply the adjoint of `_around`."""
    for axis in range(3):
        n = values.shape[axis] - LAYERS
        inner = values.narrow(axis, 0, n)
        for layer in range(LAYERS):
            inner.select(axis, layer % n).add_(values.select(axis, n + layer))
        values = inner
    return values.permute(3, 0, 1, 2).contiguous()


class _Fixed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, fields: Sequence[VoxelField], *points: Tensor) -> tuple[Tensor, ...]:
        def at(field: VoxelField, places: Tensor) -> tuple[Tensor, Tensor]:
            box = field.grid.box
            corners = box.lower, box.upper, field.grid.spacing
            return evaluate(field.coefficients, field.degree, places.detach(), *corners)

        with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # the kernel has one thread
            values, slopes = zip(*pool.map(at, fields, points), strict=True)
        ctx.slopes = slopes
        return values

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return None, *(g[:, None] * slope for g, slope in zip(gradients, ctx.slopes, strict=True))
