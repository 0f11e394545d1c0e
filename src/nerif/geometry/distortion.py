"""Brown's distortion with OpenCV's five coefficients, and its inverse.

    x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y_d = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y,        r^2 = x^2 + y^2
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import Pixels
from nerif.geometry.projection import Array

__all__ = ["POWERS", "distort", "undistort"]

POWERS = (2, 4, 1, 1, 6)
"""Of the unit of (x, y), by which k1, k2, p1, p2, k3 are divided."""


def distort(x: Array, y: Array, coefficients: Iterable[Any]) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Return x_d, y_d and their derivatives d x_d / d x, d x_d / d y = d y_d / d x, d y_d / d y.

    Parameters
    ----------
    x, y : ideal image coordinates
    coefficients : k1, k2, p1, p2, k3
    """
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial / d r2, times 2
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    cross = slope * x * y + 2 * p1 * x + 2 * p2 * y
    xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return xd, yd, (xx, cross, yy)


def undistort(distorted: Pixels, coefficients: Float[Tensor, 5]) -> Pixels | None:
    """Return the ideal coordinates by Newton's method (at most 20 steps); None where they cannot be found."""
    if not (distorted.numel() and bool(coefficients.any())):
        return distorted
    size = max(1.0, float(distorted.abs().amax()))
    x, y = distorted.unbind(-1)
    for _ in range(20):
        xd, yd, (xx, cross, yy) = distort(x, y, coefficients)
        left, below = distorted[..., 0] - xd, distorted[..., 1] - yd
        if float(torch.maximum(left.abs(), below.abs()).amax()) < 1e-14 * size:
            break
        determinant = xx * yy - cross * cross
        x, y = x + (yy * left - cross * below) / determinant, y + (xx * below - cross * left) / determinant
    found = torch.stack([x, y], dim=-1)
    xd, yd, _ = distort(x, y, coefficients)
    return found if float((distorted - torch.stack([xd, yd], dim=-1)).abs().amax()) < 1e-9 * size else None
