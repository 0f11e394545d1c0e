"""Cameras of OpenPTV: cam1.tif.ori and cam1.tif.addpar of each camera, parameters/ptv.par of all; lengths in mm.

.ori       x0 y0 z0, omega phi kappa (rad), D (3, 3) = Rx(omega) Ry(phi) Rz(kappa), xh yh, cc, glass (3)
.addpar    k1 k2 k3 p1 p2 scx she
ptv.par    cameras, two names of each, three switches, columns, rows, pixel (2), interlaced, n1 n2 n3, glass thickness

The camera looks along -z, with y up. From the middle of the sensor, D^T (X - x0) = (a, b, -c) is imaged at

    (x, y) = (xh, yh) + cc (a, b) / c,     x += x (k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 x^2) + 2 p2 x y,
    column = (scx x - sin(she) y) / pixel + columns / 2,     row = rows / 2 - cos(she) y / pixel

and y in the same way; pixel centres are at 0.5. The distortion is about the middle of the sensor, OpenCV's about the
principal point, so that its coefficients are fitted; a difference is refused.

Source: OpenPTV, liboptv: calibration.c, imgcoord.c, trafo.c, parameters.c, segmentation.c.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.common.files import ending
from nerif.data.cameras_file import CalibratedCamera

__all__ = ["ORI", "read_openptv"]

ORI = ".ori"
MOST = 0.05  # px, by which OpenCV's distortion may differ
PLACES = ("../parameters/ptv.par", "parameters/ptv.par", "ptv.par", "../ptv.par")
"""Paths of the parameters of the sensor, from the folder of the cameras."""

Points = Float[np.ndarray, "n 2"]


def read_openptv(path: Path) -> list[CalibratedCamera]:
    """Read one camera, or all of a folder, named by their images."""
    folder = path if path.is_dir() else path.parent
    files = sorted(p for p in folder.iterdir() if ending(p) == ORI) if path.is_dir() else [path]
    size, pixel = _sensor(folder)
    return [_camera(file, size, pixel) for file in files]


def _sensor(folder: Path) -> tuple[tuple[int, int], tuple[float, float]]:
    """Rows and columns, and width and height of a pixel, mm."""
    path = next((folder / place for place in PLACES if (folder / place).is_file()), None)
    if path is None:
        raise InputError(
            "expected the parameters of the sensor in parameters/ptv.par beside the folder of the cameras, got none",
            field=folder,
        )
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    try:
        columns, rows, width, height, interlaced, *n = (float(line) for line in lines[1 + 2 * int(lines[0]) + 3 :][:8])
    except (ValueError, IndexError):
        raise InputError("expected the parameters of OpenPTV, a number a line", field=path) from None
    if interlaced or len({*n}) != 1 or min(columns, rows, width, height) <= 0:
        raise InputError(
            f"expected whole frames and one medium, got interlaced = {interlaced:g}, n = {', '.join(map(str, n))}; "
            "calibrate without water and windows, with all n = 1",
            field=path,
        )
    return (int(rows), int(columns)), (width, height)


def _numbers(path: Path, count: int) -> list[float]:
    words = path.read_text(encoding="utf-8", errors="replace").split()
    try:
        numbers = [float(word) for word in words[:count]]
    except ValueError:
        numbers = []
    if len(numbers) < count:
        raise InputError(f"expected {count} numbers of OpenPTV, got {len(words)} words", field=path)
    return numbers


def _camera(path: Path, size: tuple[int, int], pixel: tuple[float, float]) -> CalibratedCamera:
    import cv2
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    ori = np.array(_numbers(path, 18))
    added = path.with_suffix(".addpar")
    k1, k2, k3, p1, p2, scx, she = _numbers(added, 7) if added.is_file() else [0, 0, 0, 0, 0, 1, 0]
    (xh, yh, cc), (rows, columns) = ori[15:18], size
    turn = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("XYZ", ori[3:6]).as_matrix().T
    affine = np.array([[scx, np.sin(she)], [0, np.cos(she)]]) / np.array(pixel)[:, None]  # px per mm, y down
    middle = np.array([columns, rows]) / 2 - 0.5

    def project(xy: Points) -> Points:
        """Pixels of directions (x, y, 1)."""
        x, y = (cc * xy + (xh, -yh)).T
        r2 = x**2 + y**2
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = x * radial + p1 * (r2 + 2 * x**2) - 2 * p2 * x * y
        v = y * radial - p2 * (r2 + 2 * y**2) + 2 * p1 * x * y
        return np.stack([u, v], axis=-1) @ affine.T + middle

    def opencv(parameters: np.ndarray, xy: Points) -> Points:
        k, (fx, s, fy, cx, cy) = parameters[5:] / scales, parameters[:5]
        rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        distorted = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), k)[0][:, 0]
        return distorted @ np.array([[fx, 0], [s, fy]]) + (cx, cy)

    reach = np.array([columns * pixel[0], rows * pixel[1]]) / 2
    grid = np.stack(np.meshgrid(*(np.linspace(-1, 1, 15),) * 2), axis=-1).reshape(-1, 2)
    at = (grid * reach - (xh, -yh)) / cc
    scales = np.abs(at).max() ** np.array([2, 4, 1, 1, 6])  # so that all coefficients are of one order
    (fx, s), (_, fy) = cc * affine
    cx, cy = middle + affine @ (xh, -yh)
    start = [fx, s, fy, cx, cy, *(scales * (k1 * cc**2, k2 * cc**4, -p2 * cc, p1 * cc, k3 * cc**6))]
    weights, exact = np.array([fx] * 5 + [1.0] * 5), project(at)
    fit = least_squares(
        lambda p: (opencv(p, at) - exact).ravel(), start, x_scale=weights, xtol=1e-14, ftol=1e-14, max_nfev=30
    )
    error = float(np.abs(fit.fun).max())
    if not error <= MOST:
        raise InputError(
            f"expected a distortion that OpenCV's covers within {MOST} px, got {error:.2g} px; undistort the images, "
            "or calibrate again with xh = yh = 0",
            field=path,
        )
    fx, s, fy, cx, cy = fit.x[:5]
    name = Path(path.stem).stem if "." in path.stem else path.stem
    k = [[fx, s, cx], [0, fy, cy], [0, 0, 1]]
    return CalibratedCamera.from_values(str(path), name, k, turn, -turn @ ori[:3], fit.x[5:] / scales, size)
