"""From the image plane (x, y) of a camera to its sensor and back: distortion of the lens, then tilt of the sensor.

Distortion, with r^2 = x^2 + y^2:

    x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y_d = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

Tilt (Scheimpflug): the sensor has the axes e_x and e_y, and its point (x_t, y_t) is on the line through (x_d, y_d, 1):

    (x_d, y_d, 1) ~ (0, 0, 1) + x_t e_x + y_t e_y
    e_x = (cos b, sin a sin b, -cos a sin b),     e_y = (0, cos a, sin a),     a = tau_x, b = tau_y

Sources: D. C. Brown, Close-range camera calibration, Photogramm. Eng. 37 (1971); H. Louhichi et al., Self-calibration
of Scheimpflug cameras: an easy protocol, Meas. Sci. Technol. 18 (2007) 2616; conventions of OpenCV.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.arrays import Pixels

__all__ = [
    "POWERS", "UPRIGHT", "Array", "distort", "fold", "from_sensor", "sensor_axes", "tilt", "tilt_slopes", "to_sensor",
    "undistort",
]  # fmt: skip

POWERS = (2, 4, 1, 1, 6)  #: units of k1, k2, p1, p2, k3: inverse powers of that of (x, y)
UPRIGHT = torch.zeros(2, dtype=torch.float64)  #: tilt of a sensor across the optical axis
MAX_IMAGINARY = 1e-6  # part of a real root, over its absolute value
MAX_START, MAX_STEP = 0.9, 0.25  # of Newton's method, over the radius of the fold

Array = TypeVar("Array", Tensor, np.ndarray)


def to_sensor(
    image: Pixels, coefficients: Float[Tensor, 5], angles: Float[Tensor, 2]
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Return x, y on the sensor of the image (X, Y), and the derivatives d x / d X, d x / d Y, d y / d X, d y / d Y.

    NaN beyond the fold of the distortion, and on lines of sight that do not meet the tilted sensor.
    """
    folded = image.norm(dim=-1, keepdim=True) > fold(coefficients)
    valid = image.masked_fill(folded, torch.nan)
    x, y, (xx, cross, yy) = distort(valid[..., 0], valid[..., 1], coefficients)
    if not bool(angles.any()):
        return x, y, (xx, cross, cross, yy)
    x, y, (a, b, c, d) = tilt(x, y, angles)
    behind = a * d - b * c < 0
    slopes = a * xx + b * cross, a * cross + b * yy, c * xx + d * cross, c * cross + d * yy
    return x.masked_fill(behind, torch.nan), y.masked_fill(behind, torch.nan), slopes


def from_sensor(points: Pixels, coefficients: Float[Tensor, 5], angles: Float[Tensor, 2]) -> Pixels:
    """Return the image (x, y) of points of the sensor; NaN if there is none."""
    if bool(angles.any()):
        x, y, depth = (torch.cat([points, torch.ones_like(points[..., :1])], dim=-1) @ sensor_axes(angles).T).unbind(-1)
        points = (torch.stack([x, y], dim=-1) / depth[..., None]).masked_fill(depth[..., None] <= 0, torch.nan)
    return undistort(points, coefficients)


def sensor_axes(angles: Float[Tensor, 2]) -> Float[Tensor, "3 3"]:
    """Return the matrix E with the columns e_x, e_y, e_z: the line of sight of (x_t, y_t) is along E (x_t, y_t, 1)."""
    a, b = angles.tolist()
    return torch.tensor(
        [
            [math.cos(b), 0.0, 0.0],
            [math.sin(a) * math.sin(b), math.cos(a), 0.0],
            [-math.cos(a) * math.sin(b), math.sin(a), 1.0],
        ],
        dtype=torch.float64,
    )


def tilt(x: Array, y: Array, angles: Iterable[Any]) -> tuple[Array, Array, tuple[Array, Array, Array, Array]]:
    """Return x_t, y_t of (x_d, y_d), and their derivatives d x_t / d x_d, d x_t / d y_d, d y_t / d x_d, d y_t / d y_d.

    x_t = x_d / (w cos b),     y_t = (y_d / cos a - x_d tan a tan b) / w,     w = 1 + x_d tan b / cos a - y_d tan a
    """
    a, b = map(float, angles)
    across, down, shear = math.tan(b) / math.cos(a), -math.tan(a), -math.tan(a) * math.tan(b)
    w = 1 + across * x + down * y
    xt, yt = x / (w * math.cos(b)), (y / math.cos(a) + shear * x) / w
    xx, xy = (1 / math.cos(b) - across * xt) / w, -down * xt / w
    yx, yy = (shear - across * yt) / w, (1 / math.cos(a) - down * yt) / w
    return xt, yt, (xx, xy, yx, yy)


def tilt_slopes(x: Array, y: Array, angles: Iterable[Any]) -> tuple[Array, Array, Array, Array]:
    """Return the derivatives d x_t / d a, d x_t / d b, d y_t / d a, d y_t / d b of `tilt` at (x_d, y_d)."""
    a, b = map(float, angles)
    xt, yt, _ = tilt(x, y, (a, b))
    ta, tb, ca, cb = math.tan(a), math.tan(b), math.cos(a), math.cos(b)
    w = 1 + tb / ca * x - ta * y
    by_a, by_b = (ta * tb / ca * x - y / ca**2) / w, x / (ca * cb**2) / w  # of w, over w
    return (
        -xt * by_a,
        xt * (tb - by_b),
        (ta / ca * y - tb / ca**2 * x) / w - yt * by_a,
        -ta / cb**2 * x / w - yt * by_b,
    )


def distort(x: Array, y: Array, coefficients: Iterable[Any]) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Return x_d, y_d and their derivatives d x_d / d x, d x_d / d y = d y_d / d x, d y_d / d y."""
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
    """Return the radius below which the distortion is invertible; infinity without a limit.

    Beyond it the polynomial folds the image back. It is invertible as long as the matrix of derivatives, which is
    symmetric, is positive definite. Its lowest eigenvalue is at least

        1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6 - 6 (p1^2 + p2^2)^(1/2) r
    """
    k1, k2, p1, p2, k3 = coefficients.tolist()
    roots = np.roots([7 * k3, 0.0, 5 * k2, 0.0, 3 * k1, -6 * math.hypot(p1, p2), 1.0])
    real = roots.real[(roots.real > 0) & (np.abs(roots.imag) < MAX_IMAGINARY * np.abs(roots))]
    return float(real.min(initial=math.inf))


def undistort(distorted: Pixels, coefficients: Float[Tensor, 5]) -> Pixels:
    """Return the coordinates before distortion by Newton's method, at most 20 steps; NaN if there are none."""
    if not (distorted.numel() and bool(coefficients.any())):
        return distorted
    end = fold(coefficients)
    size = max(1.0, float(distorted.abs().amax()))
    x, y = _within(distorted[..., 0], distorted[..., 1], MAX_START * end)
    for _ in range(20):
        xd, yd, (xx, cross, yy) = distort(x, y, coefficients)
        dx, dy = distorted[..., 0] - xd, distorted[..., 1] - yd
        if float(torch.maximum(dx.abs(), dy.abs()).amax()) < 1e-14 * size:
            break
        determinant = xx * yy - cross * cross
        step = (yy * dx - cross * dy) / determinant, (xx * dy - cross * dx) / determinant
        dx, dy = _within(step[0], step[1], MAX_STEP * end)
        x, y = _within(x + dx, y + dy, end)
    xd, yd, _ = distort(x, y, coefficients)
    error = (distorted - torch.stack([xd, yd], dim=-1)).abs().amax(dim=-1, keepdim=True)
    return torch.where(error < 1e-9 * size, torch.stack([x, y], dim=-1), torch.nan)


def _within(x: Tensor, y: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """The vector (x, y), shortened to at most this length."""
    share = (radius / torch.hypot(x, y)).clamp(max=1)
    return x * share, y * share
