"""Cameras of a plain table: TOML with one table per camera, CSV with one row per camera."""

from __future__ import annotations

import csv
import math
from pathlib import Path

from nerif.common.conventions import InputError
from nerif.common.files import check_known, read_toml
from nerif.geometry import PERSPECTIVE
from nerif.imaging.calibration.cameras_file import FORMAT, CalibratedCamera, read_cameras

__all__ = ["read_csv", "read_tables"]

KEYS = ("K", "R", "t", "distortion", "image_size", "normal", "offset", "projection", "tilt")
REQUIRED = ("fx", "fy", "cx", "cy", *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)), "tx", "ty", "tz")
DISTORTION, TILT = ("k1", "k2", "p1", "p2", "k3"), ("tau_x", "tau_y")
TEXTS = ("name", "projection")
COLUMNS = (*TEXTS, *REQUIRED, "s", *DISTORTION, *TILT, "width", "height", "nx", "ny", "nz", "offset")


def read_tables(path: Path) -> list[CalibratedCamera]:
    """Read a calibration file, or plain tables: [cam1] with K, R, t and, optionally, the others of KEYS."""
    tables = read_toml(path)
    if "format" in tables or "camera" in tables:
        return list(read_cameras(path))
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


def read_csv(path: Path) -> list[CalibratedCamera]:
    """Read one camera per row, from the columns COLUMNS, separated by comma or semicolon."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise InputError("not a text file", field=path) from None
    lines = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if len(lines) < 2:
        raise InputError(f"expected a line of column names and one line a camera, got {len(lines)} lines", field=path)
    rows = list(csv.DictReader(lines, delimiter=";" if ";" in lines[0] else ",", skipinitialspace=True))
    columns = [str(name).strip() for name in rows[0]]
    check_known(columns, COLUMNS, str(path), "column")
    for column in REQUIRED:
        if column not in columns:
            raise InputError(f"column '{column}' is missing", field=path)
    return [_row(row, i, path) for i, row in enumerate(rows, start=1)]


def _row(row: dict, number: int, path: Path) -> CalibratedCamera:
    cells = {str(k).strip(): str(v).strip() for k, v in row.items() if v is not None and str(v).strip()}
    x: dict[str, float] = dict.fromkeys(("s", *DISTORTION, *TILT), 0.0)
    for key in (*REQUIRED, *(cells.keys() - {*REQUIRED, *TEXTS})):
        try:
            x[key] = float(cells.get(key, ""))
        except ValueError:
            text = cells.get(key, "")
            raise InputError(f"line {number + 1}: '{key}': expected a number, got '{text}'", field=path) from None
    normal, size = ([x.get(k, math.nan) for k in keys] for keys in (("nx", "ny", "nz"), ("height", "width")))
    return CalibratedCamera.from_values(
        f"{path}: line {number + 1}",
        cells.get("name", f"cam{number}"),
        [[x["fx"], x["s"], x["cx"]], [0, x["fy"], x["cy"]], [0, 0, 1]],
        [[x[f"r{i}{j}"] for j in (1, 2, 3)] for i in (1, 2, 3)],
        [x["tx"], x["ty"], x["tz"]],
        [x[k] for k in DISTORTION],
        size if "width" in x else None,
        (normal, x["offset"]) if "nx" in x and "offset" in x else None,
        cells.get("projection", PERSPECTIVE.name),
        tilt=[x[k] for k in TILT],
    )
