"""Cameras of the direct linear transformation: 11 coefficients L of each, by DLTdv, DLTcal, easyWand or Argus.

    u = (L1 X + L2 Y + L3 Z + L4) / w,     v = (L5 X + L6 Y + L7 Z + L8) / w,     w = L9 X + L10 Y + L11 Z + 1

    [L1 L2 L3 L4; L5 L6 L7 L8; L9 L10 L11 1] ~ K [R | t]

A file has a row a coefficient and a column a camera. Neither the unit of length nor the axes of the pixels are in it:
DLTdv counts from 1 and, before version 8, upwards from the lower edge, as do Argus and many files of easyWand. The
origin of the world (w = 1) is taken to be in front of the cameras.

Sources: Abdel-Aziz & Karara, Direct linear transformation from comparator coordinates into object space coordinates,
1971; T. L. Hedrick, DLTdv: dlt_inverse.m, DLTcameraPosition.m.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera
from nerif.imaging.calibration.calibration_settings import ImportSettings
from nerif.imaging.calibration.importers.names import UNNAMED
from nerif.imaging.calibration.importers.sheet import Sheet

__all__ = ["MIRRORED", "are_numbers", "is_dlt", "pixel_axes", "read_dlt"]

COEFFICIENTS = 11
MIN_SCALE = 1e-8  # of the rows of K: below it, rays are parallel
MIRRORED = (
    "axes of pixels and world are mirror images; give --rows-upward if rows are counted from the lower edge, and no "
    "--rows-upward if from the upper one, or reverse one axis of the world to make it right-handed"
)


def are_numbers(cells: Sequence[str]) -> bool:
    """Return whether all cells are numbers, with a decimal point or comma."""
    try:
        return bool([float(cell.replace(",", ".")) for cell in cells if cell])
    except ValueError:
        return False


def is_dlt(sheet: Sheet) -> bool:
    """Return whether a sheet has 11 rows of numbers, or rows of 11 numbers, below a row of names or none."""
    body = sheet.rows if sheet.rows and are_numbers(sheet.rows[0]) else sheet.rows[1:]
    eleven = len(body) == COEFFICIENTS or len(sheet.rows) == len(body) > 0 == len(body[0]) - COEFFICIENTS
    return eleven and all(are_numbers(row) for row in body)


def read_dlt(sheet: Sheet, settings: ImportSettings) -> list[CalibratedCamera]:
    """Read the cameras, with the names in the first row if there are any."""
    named = not are_numbers(sheet.rows[0])
    cells = [[cell for cell in row if cell] for row in sheet.rows[named:]]
    if len({len(row) for row in cells}) != 1 or COEFFICIENTS not in (len(cells), len(cells[0])):
        got = f"{len(cells)} x {' or '.join(str(n) for n in sorted({len(row) for row in cells}))}"
        raise InputError(
            f"expected column names, or DLT coefficients in {COEFFICIENTS} rows and a column a camera, got {got}",
            field=sheet.path,
        )
    if settings.first_pixel is None:
        raise InputError(
            "expected the coordinate of the first pixel's centre, which is not in a file of DLT coefficients; give "
            "nerif calibrate --first-pixel 1 (DLTdv, easyWand: MATLAB), 0 or 0.5",
            field=sheet.path,
        )
    numbers = sheet.decimal_points([cell for row in cells for cell in row])
    values = np.array(numbers, dtype=np.float64).reshape(len(cells), -1)
    if len(cells) != COEFFICIENTS:
        values = values.T
    axes, names = pixel_axes(settings, sheet.path), [cell for cell in sheet.rows[0] if cell] if named else []
    if len(names) != values.shape[1]:
        names = [f"{UNNAMED}{i + 1}" for i in range(values.shape[1])]
    return [_camera(f"{sheet.path}: {name}", name, axes, values[:, i]) for i, name in enumerate(names)]


def pixel_axes(settings: ImportSettings, place: object) -> Float[np.ndarray, "3 3"]:
    """Return the matrix from (u, v, 1) of a file to pixels: the first one centred on (0, 0), v down."""
    first = settings.first_pixel or 0.0
    if not settings.rows_upward:
        return np.array([[1, 0, -first], [0, 1, -first], [0, 0, 1]])
    if settings.image_size is None:
        raise InputError("expected the size of the images to count rows from above; give --image-size", field=place)
    return np.array([[1, 0, -first], [0, -1, settings.image_size[0] - 1 + first], [0, 0, 1]])


def _camera(where: str, name: str, axes: np.ndarray, coefficients: Float[np.ndarray, 11]) -> CalibratedCamera:
    from scipy.linalg import rq

    if not np.isfinite(coefficients).all():
        raise InputError(f"expected finite coefficients, got {coefficients.tolist()}", field=where)
    matrix = axes @ np.append(coefficients, 1.0).reshape(3, 4)
    k, rotation = rq(matrix[:, :3])
    signs = np.where(np.diag(k) < 0, -1.0, 1.0)
    k, rotation = k * signs, signs[:, None] * rotation
    if not np.diag(k).min() > MIN_SCALE * np.abs(k).max():
        raise InputError(f"expected a perspective camera, got DLT coefficients {coefficients.tolist()}", field=where)
    if np.linalg.det(rotation) < 0:
        raise InputError(MIRRORED, field=where)
    translation = np.linalg.solve(k, matrix[:, 3])
    return CalibratedCamera.from_values(where, name, k / k[2, 2], rotation, translation)
