"""Brown's distortion with OpenCV's five coefficients, and its inverse.

    x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y_d = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y,        r^2 = x^2 + y^2
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import Pixels
from nerif.geometry.projection import Array

__all__ = ["POWERS", "distort", "fold", "undistort"]

POWERS = (2, 4, 1, 1, 6)
"""Of the unit of (x, y), by which k1, k2, p1, p2, k3 are divided."""
REAL = 1e-6  # imaginary part over absolute value, below which a root is real
START, STEP = 0.9, 0.25  # of the radius of the fold: how far out Newton's method starts, and its longest step


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


def fold(coefficients: Float[Tensor, 5]) -> float:
    """Return the radius r up to which no two points (x, y) are distorted to the same; infinite where there is no end.

    Beyond, the image that a polynomial makes folds back. The derivatives are a symmetric matrix, and as long as that is
    positive definite points stay apart. Its lowest eigenvalue is at least

        1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6 - 6 (p1^2 + p2^2)^(1/2) r
    """
    k1, k2, p1, p2, k3 = coefficients.tolist()
    roots = np.roots([7 * k3, 0.0, 5 * k2, 0.0, 3 * k1, -6 * math.hypot(p1, p2), 1.0])
    real = roots.real[(roots.real > 0) & (np.abs(roots.imag) < REAL * np.abs(roots))]
    return float(real.min(initial=math.inf))


def undistort(distorted: Pixels, coefficients: Float[Tensor, 5]) -> Pixels:
    """Return the ideal coordinates by Newton's method (at most 20 steps); NaN where there are none before the fold."""
    if not (distorted.numel() and bool(coefficients.any())):
        return distorted
    end = fold(coefficients)
    size = max(1.0, float(distorted.abs().amax()))
    x, y = _within(distorted[..., 0], distorted[..., 1], START * end)
    for _ in range(20):
        xd, yd, (xx, cross, yy) = distort(x, y, coefficients)
        left, below = distorted[..., 0] - xd, distorted[..., 1] - yd
        if float(torch.maximum(left.abs(), below.abs()).amax()) < 1e-14 * size:
            break
        determinant = xx * yy - cross * cross
        step = (yy * left - cross * below) / determinant, (xx * below - cross * left) / determinant
        aside, down = _within(step[0], step[1], STEP * end)
        x, y = _within(x + aside, y + down, end)
    xd, yd, _ = distort(x, y, coefficients)
    error = (distorted - torch.stack([xd, yd], dim=-1)).abs().amax(dim=-1, keepdim=True)
    return torch.where(error < 1e-9 * size, torch.stack([x, y], dim=-1), torch.nan)


def _within(x: Tensor, y: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """The vector (x, y), no longer than that."""
    share = (radius / torch.hypot(x, y)).clamp(max=1)
    return x * share, y * share
