"""Cameras fitted to a table of points: camera (or view, name), X, Y, Z in the world, u, v in its image, one a line."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.text_tables import UNIT
from nerif.data.cameras_file import CalibratedCamera
from nerif.imaging.calibration.calibration_settings import ImportSettings
from nerif.imaging.calibration.importers.dlt import pixel_axes
from nerif.imaging.calibration.importers.matlab import WORLD_UNITS
from nerif.imaging.calibration.importers.point_fit import PointFit, fit_camera
from nerif.imaging.calibration.importers.sheet import Sheet

__all__ = ["is_point_list", "read_point_list"]

NAMES, WORLD, IMAGE = ("camera", "view", "name"), ("x", "y", "z"), ("u", "v")
PIXELS = ("", "px", "pixel", "pixels")
OUTLIER, MIN_OUTLIER = 5, 0.1  # times the typical error; px


def is_point_list(sheet: Sheet) -> bool:
    """Return whether the first row names the columns of a list of points."""
    columns = _columns(sheet.rows[0]) if sheet.rows else []
    return {*WORLD, *IMAGE} <= {*columns} and bool({*NAMES} & {*columns})


def read_point_list(
    sheet: Sheet, settings: ImportSettings, say: Callable[[str], None]
) -> tuple[list[CalibratedCamera], float]:
    """Return a camera for each name, and the unit of length in mm; report residuals and outliers."""
    columns = _columns(sheet.rows[0])
    unit, key = _unit(sheet, columns), next(name for name in NAMES if name in columns)
    numbered: dict[str, list[tuple[int, list[float]]]] = {}
    for line, cells in sheet.table(columns, (*WORLD, *IMAGE)):
        numbers = [_number(sheet, line, name, cells.get(name, "")) for name in (*WORLD, *IMAGE)]
        if key not in cells:
            raise InputError(f"line {line}: '{key}' is empty", field=sheet.path)
        if all(map(math.isfinite, numbers)):
            numbered.setdefault(cells[key], []).append((line, numbers))
    axes, cameras = pixel_axes(settings, sheet.path), []
    for name, rows in numbered.items():
        values = np.array([numbers for _, numbers in rows])
        pixels = values[:, 3:] @ axes[:2, :2].T + axes[:2, 2]
        fit = fit_camera(values[:, :3], pixels, f"{sheet.path}: camera '{name}'", name, settings.image_size)
        say(f"{sheet.path.name}: {name}: {fit.words}")
        _report_outliers(fit, [line for line, _ in rows], sheet.path.name, say)
        cameras.append(fit.camera)
    return cameras, unit


def _report_outliers(fit: PointFit, lines: Sequence[int], file: str, say: Callable[[str], None]) -> None:
    for line, error in zip(lines, fit.errors, strict=True):
        if error > max(OUTLIER * fit.typical, MIN_OUTLIER):
            say(
                f"note: {file}, line {line}: {error:.2g} px from its projection by {fit.camera.name}, more than "
                f"{OUTLIER} times the rms of the other points; correct or remove it"
            )


def _columns(head: Sequence[str]) -> list[str]:
    return [UNIT.sub("", name).strip().lower() for name in head]


def _unit(sheet: Sheet, columns: Sequence[str]) -> float:
    """Unit of X, Y, Z in brackets behind their names, mm; 1 without any."""
    units = {
        name: match[1].strip().lower() if (match := UNIT.search(head)) else ""
        for name, head in zip(columns, sheet.rows[0], strict=True)
    }
    of_world, of_image = {units[name] for name in WORLD}, {units[name] for name in IMAGE}
    if len(of_world) > 1 or not of_world <= {"", *WORLD_UNITS} or not of_image <= {*PIXELS}:
        got = ", ".join(f"{name} [{units[name]}]" for name in (*WORLD, *IMAGE))
        raise InputError(
            f"expected one unit of X, Y, Z ({', '.join(WORLD_UNITS)}) and u, v in px, got {got}", field=sheet.path
        )
    return WORLD_UNITS.get(of_world.pop(), 1.0)


def _number(sheet: Sheet, line: int, name: str, cell: str) -> float:
    """Return a number; NaN of u and v for a point that is not in the image."""
    if name in IMAGE and cell.lower() in ("", "nan"):
        return math.nan
    try:
        number = float(cell)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"line {line}: '{name}': expected a number, got '{cell}'", field=sheet.path)
    return number
