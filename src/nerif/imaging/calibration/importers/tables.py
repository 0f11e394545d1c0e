"""Cameras of a plain table: TOML with one table per camera, CSV with one row per camera or in another form."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from nerif.common.conventions import InputError
from nerif.common.files import check_known, ending, read_toml
from nerif.data.cameras_file import FORMAT, CalibratedCamera, check_model, numbers, read_cameras
from nerif.geometry import PERSPECTIVE
from nerif.imaging.calibration.calibration_settings import ImportSettings
from nerif.imaging.calibration.importers.dlt import are_numbers, is_dlt, read_dlt
from nerif.imaging.calibration.importers.names import UNNAMED
from nerif.imaging.calibration.importers.point_lists import is_point_list, read_point_list
from nerif.imaging.calibration.importers.sheet import read_sheet

__all__ = ["holds_points", "read_csv", "read_tables"]

KEYS = ("K", "R", "t", "distortion", "image_size", "normal", "offset", "projection", "tilt")
REQUIRED = ("fx", "fy", "cx", "cy", *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)), "tx", "ty", "tz")
DISTORTION, TILT = ("k1", "k2", "p1", "p2", "k3"), ("tau_x", "tau_y")
ANIPOSE = {"name", "matrix", "distortions", "rotation", "translation"}
TEXTS = ("name", "projection")
COLUMNS = (*TEXTS, *REQUIRED, "s", *DISTORTION, *TILT, "width", "height", "nx", "ny", "nz", "offset")


def read_tables(path: Path) -> list[CalibratedCamera]:
    """Read a calibration file, or plain tables: [cam1] with K, R, t and, optionally, the others of KEYS."""
    tables = read_toml(path)
    if "format" in tables or "camera" in tables:
        return list(read_cameras(path))
    if any(isinstance(table, dict) and table.keys() >= ANIPOSE for table in tables.values()):
        return [_anipose(path, key, table) for key, table in tables.items() if key != "metadata"]
    cameras = []
    for name, table in tables.items():
        where = f"{path}: camera '{name}'"
        if not isinstance(table, dict):
            raise InputError(f"expected format = '{FORMAT}' or a table [{name}], got {table!r}", field=path)
        check_known(table, KEYS, where)
        for key in ("K", "R", "t"):
            if key not in table:
                raise InputError(f"'{key}' is missing", field=where)
        cameras.append(
            CalibratedCamera.from_values(
                where, name, table["K"], table["R"], table["t"], table.get("distortion"), table.get("image_size"),
                (table["normal"], table["offset"]) if {"normal", "offset"} <= set(table) else None,
                table.get("projection", PERSPECTIVE.name), tilt=table.get("tilt"),
            )
        )  # fmt: skip
    return cameras


def _anipose(path: Path, key: str, table: Any) -> CalibratedCamera:
    """Read a camera of anipose: OpenCV's, with a rotation vector, and width before height."""
    import cv2

    where = f"{path}: camera '{key}'"
    if not isinstance(table, dict) or not table.keys() >= ANIPOSE:
        raise InputError(f"expected {', '.join(sorted(ANIPOSE))} as anipose writes them, got {table!r}", field=where)
    if table.get("fisheye"):
        check_model("fisheye", where)
    rotation = cv2.Rodrigues(numbers(table["rotation"], (3,), f"{where}: rotation").numpy())[0]
    size = table.get("size")
    return CalibratedCamera.from_values(
        where, str(table["name"]), table["matrix"], rotation, table["translation"], table["distortions"],
        size[::-1] if isinstance(size, list) else size,
    )  # fmt: skip


def read_csv(
    path: Path, settings: ImportSettings, say: Callable[[str], None]
) -> tuple[list[CalibratedCamera], float]:  # fmt: skip
    """Read cameras and their unit of length in mm, from a row each, from points, or from DLT coefficients.

    Cells are separated by tabs, semicolons or commas. Names of columns may have capital letters. Numbers have a decimal
    point, or all of them a decimal comma.
    """
    sheet = read_sheet(path)
    if is_point_list(sheet):
        return read_point_list(sheet, settings, say)
    columns = [name.lower() for name in sheet.rows[0]] if sheet.rows else []
    if sheet.rows and (are_numbers(columns) or (is_dlt(sheet) and not {*COLUMNS} & {*columns})):
        return read_dlt(sheet, settings), 1.0
    if len(sheet.rows) < 2:
        raise InputError(
            f"expected a line of column names and one line a camera, got {len(sheet.rows)} lines", field=path
        )
    check_known(filter(None, columns), COLUMNS, str(path), "column")
    for column in REQUIRED:
        if column not in columns:
            raise InputError(f"column '{column}' is missing", field=path)
    tables = sheet.table(columns, {*COLUMNS} - {*TEXTS})
    return [_row(cells, i, f"{path}: line {line}") for i, (line, cells) in enumerate(tables, 1)], 1.0


def holds_points(path: Path) -> bool:
    """Return whether a file holds points of cameras or DLT coefficients, which resemble vectors."""
    if ending(path) != ".csv" or not path.is_file():
        return False
    with suppress(InputError):
        sheet = read_sheet(path)
        return is_point_list(sheet) or is_dlt(sheet)
    return False


def _row(cells: dict[str, str], number: int, where: str) -> CalibratedCamera:
    x: dict[str, float] = dict.fromkeys(("s", *DISTORTION, *TILT), 0.0)
    for key in (*REQUIRED, *(cells.keys() - {*REQUIRED, *TEXTS})):
        try:
            x[key] = float(cells.get(key, ""))
        except ValueError:
            text = cells.get(key, "")
            raise InputError(f"expected a number, got '{text}'", field=f"{where}: '{key}'") from None
    normal, size = ([x.get(k, math.nan) for k in keys] for keys in (("nx", "ny", "nz"), ("height", "width")))
    return CalibratedCamera.from_values(
        where,
        cells.get("name", f"{UNNAMED}{number}"),
        [[x["fx"], x["s"], x["cx"]], [0, x["fy"], x["cy"]], [0, 0, 1]],
        [[x[f"r{i}{j}"] for j in (1, 2, 3)] for i in (1, 2, 3)],
        [x["tx"], x["ty"], x["tz"]],
        [x[k] for k in DISTORTION],
        size if "width" in x else None,
        (normal, x["offset"]) if "nx" in x and "offset" in x else None,
        cells.get("projection", PERSPECTIVE.name),
        tilt=[x[k] for k in TILT],
    )
