"""Cameras of a plain table: TOML with one table per camera, CSV with one row per camera."""

from __future__ import annotations

import codecs
import csv
import math
import re
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

from nerif.common.conventions import InputError
from nerif.common.files import check_known, read_toml
from nerif.data.cameras_file import FORMAT, CalibratedCamera, check_model, numbers, read_cameras
from nerif.geometry import PERSPECTIVE
from nerif.imaging.calibration.importers.names import UNNAMED

__all__ = ["read_csv", "read_tables"]

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


def read_csv(path: Path) -> list[CalibratedCamera]:
    """Read one camera per row, from the columns COLUMNS, separated by tabs, semicolons or commas.

    Names of columns may have capital letters. Numbers have a decimal point, or all of them a decimal comma.
    """
    lines = [line for line in _text(path).splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if lines and (match := re.fullmatch(r"sep=(.)\s*", lines[0], re.IGNORECASE)):  # Excel's own first line
        lines = lines[1:]
    if len(lines) < 2:
        raise InputError(f"expected a line of column names and one line a camera, got {len(lines)} lines", field=path)
    separator = match[1] if match else next((c for c in "\t;" if c in lines[0]), ",")
    head, *rows = (
        [cell.strip() for cell in row] for row in csv.reader(lines, delimiter=separator, skipinitialspace=True)
    )
    columns = [name.lower() for name in head]
    check_known(filter(None, columns), COLUMNS, str(path), "column")
    for column in REQUIRED:
        if column not in columns:
            raise InputError(f"column '{column}' is missing", field=path)
    if twice := [name for name, count in Counter(filter(None, columns)).items() if count > 1]:
        raise InputError(f"expected each column once, got '{twice[0]}' twice", field=path)
    tables: list[dict[str, str]] = []
    for number, row in enumerate(rows, start=2):
        if any(row[len(columns) :]):
            raise InputError(
                f"line {number}: expected {len(columns)} columns, got {len(row)}; separate them by semicolons if the "
                "numbers have decimal commas",
                field=path,
            )
        tables.append({name: cell for name, cell in zip(columns, row, strict=False) if cell})
    number_cells = [cell for table in tables for name, cell in table.items() if name not in TEXTS]
    commas = any("," in cell for cell in number_cells)
    if commas and (separator == "," or any("." in cell for cell in number_cells)):
        raise InputError(
            "expected numbers with decimal points, such as 1500.5, or with decimal commas in a table separated by "
            "semicolons or tabs, got commas and points, or commas in quotes; remove separators of thousands",
            field=path,
        )
    if commas:
        tables = [{k: v if k in TEXTS else v.replace(",", ".") for k, v in table.items()} for table in tables]
    return [_row(cells, i, path) for i, cells in enumerate(filter(None, tables), start=1)]


def _text(path: Path) -> str:
    """Return the text of a file in UTF-8, in UTF-16 with its mark (Excel's Unicode text) or in Windows-1252."""
    content = path.read_bytes()
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encodings = ["utf-16"]
    else:
        encodings = [] if b"\0" in content else ["utf-8-sig", "cp1252"]
    for encoding in encodings:
        with suppress(UnicodeDecodeError):
            return content.decode(encoding)
    raise InputError("not a text file in UTF-8 or UTF-16", field=path)


def _row(cells: dict[str, str], number: int, path: Path) -> CalibratedCamera:
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
