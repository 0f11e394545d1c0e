"""Cubic splines at points that depend on the unknowns, with derivatives by coefficients and by points, on the CPU.

    f_c(x) = sum_ijk c_cijk b(x / hx - i) b(y / hy - j) b(z / hz - k)

Source: Unser, Splines: a perfect fit for signal and image processing, IEEE Signal Process. Mag. 16 (1999).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.fields.grid import VoxelField
from nerif.fields.spline_kernel import CUBIC, evaluate
from nerif.reconstruction.velocity.kernels import LAYERS, interpolate, spread

__all__ = ["fixed_spline", "periodic_spline"]


def periodic_spline(coefficients: Float[Tensor, "c z y x"], points: Float[Tensor, "n 3"]) -> Float[Tensor, "c n"]:
    """Return the values of splines on a periodic grid, differentiable by coefficients and points.

    Parameters
    ----------
    coefficients : at the nodes
    points : x, y, z in nodes from the first one
    """
    return _Periodic.apply(coefficients, points)


def fixed_spline(field: VoxelField, points: Float[Tensor, "n 3"]) -> Float[Tensor, n]:
    """Return the values of a field at points (mm), differentiable by the points only."""
    return _Fixed.apply(points, field)


class _Periodic(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, points: Tensor) -> Tensor:
        c, p = _around(coefficients.detach()), points.detach().contiguous()
        ctx.save_for_backward(c, p)
        values = np.empty((len(c), len(p)), dtype=np.float32)
        interpolate(c.numpy(), p.numpy(), values, CUBIC)
        return torch.from_numpy(values)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        c, p = ctx.saved_tensors
        by_coefficients = np.zeros(c.shape, dtype=np.float32)
        by_points = np.empty((len(c), *p.shape), dtype=np.float32)  # one for each thread
        spread(c.numpy(), p.numpy(), gradients[0].contiguous().numpy(), by_coefficients, by_points, CUBIC)
        return _folded(torch.from_numpy(by_coefficients)), torch.from_numpy(by_points).sum(dim=0)


def _around(values: Tensor) -> Tensor:
    """Repeat the first layers of each axis at its end."""
    for axis in (1, 2, 3):
        values = torch.cat([values, values.narrow(axis, 0, LAYERS)], dim=axis)
    return values.contiguous()


def _folded(values: Tensor) -> Tensor:
    """Apply the adjoint of `_around`."""
    for axis in (1, 2, 3):
        n = values.shape[axis] - LAYERS
        inner = values.narrow(axis, 0, n).clone()
        inner.narrow(axis, 0, LAYERS).add_(values.narrow(axis, n, LAYERS))
        values = inner
    return values


class _Fixed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, field: VoxelField) -> Tensor:
        box = field.grid.box
        corners = box.lower, box.upper, field.grid.spacing
        values, ctx.slope = evaluate(field.coefficients, field.degree, points.detach(), *corners)
        return values

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0][:, None] * ctx.slope, None
