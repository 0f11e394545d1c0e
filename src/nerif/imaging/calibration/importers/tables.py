"""Cameras of a plain table: TOML with a table a camera, CSV with a row a camera."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import torch

from nerif.common.conventions import InputError
from nerif.common.files import check_known, read_toml
from nerif.geometry import PERSPECTIVE, projection_named
from nerif.imaging.calibration.cameras_file import (
    FORMAT,
    CalibratedCamera,
    five,
    image_size,
    numbers,
    plane,
    read_cameras,
    upright,
)

__all__ = ["read_csv", "read_tables"]


def read_tables(path: Path) -> list[CalibratedCamera]:
    """Ours, or a table a camera: [cam1] K, R, t, and, if known, the others of `known` (image_size: height, width)."""
    table = read_toml(path)
    if "format" in table or "camera" in table:
        return list(read_cameras(path))
    known = ("K", "R", "t", "distortion", "image_size", "normal", "offset", "projection")
    cameras = []
    for name, own in table.items():
        where = f"{path}: camera '{name}'"
        if not isinstance(own, dict):
            raise InputError(
                f"expected format = '{FORMAT}' or a table [{name}] with K, R and t, got {own!r}", field=path
            )
        check_known(own, known, where)
        for key in ("K", "R", "t"):
            if key not in own:
                raise InputError(f"'{key}' is missing", field=where)
        cameras.append(
            CalibratedCamera(
                name=name,
                intrinsics=upright(own["K"], f"{where}: K"),
                rotation=numbers(own["R"], (3, 3), f"{where}: R"),
                translation=numbers(np.ravel(own["t"]).tolist(), (3,), f"{where}: t"),
                distortion=five(own.get("distortion", []), f"{where}: distortion"),
                image_size=image_size(own["image_size"], f"{where}: image_size") if "image_size" in own else None,
                background=plane(own["normal"], own["offset"], where) if {"normal", "offset"} <= set(own) else None,
                projection=projection_named(own.get("projection", PERSPECTIVE.name), f"{where}: projection"),
            )
        )
    return cameras


NEEDED = ("fx", "fy", "cx", "cy", *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)), "tx", "ty", "tz")
OPTIONAL = ("s", "k1", "k2", "p1", "p2", "k3", "width", "height", "nx", "ny", "nz", "offset", "projection")
COLUMNS = ("name", *NEEDED, *OPTIONAL)


def read_csv(path: Path) -> list[CalibratedCamera]:
    """One row a camera under the names of COLUMNS, separated by comma or semicolon."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise InputError("not a text file", field=path) from None
    lines = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if len(lines) < 2:
        raise InputError(f"expected a line of column names and one line a camera, got {len(lines)} lines", field=path)
    rows = list(csv.DictReader(lines, delimiter=";" if ";" in lines[0] else ",", skipinitialspace=True))
    names = [str(n).strip() for n in rows[0]]
    check_known(names, COLUMNS, str(path), "column")
    for column in NEEDED:
        if column not in names:
            raise InputError(f"column '{column}' is missing", field=path)
    cameras = []
    for i, row in enumerate(rows):
        given = {str(k).strip(): str(v).strip() for k, v in row.items() if v is not None and str(v).strip()}
        name = given.pop("name", f"cam{i + 1}")

        def number(key: str, default: float | None = None, given: dict = given, line: int = i + 2) -> float:
            try:
                value = float(given[key]) if key in given or default is None else default
                if not math.isfinite(value):
                    raise ValueError
                return value
            except (KeyError, ValueError):
                raise InputError(
                    f"line {line}: '{key}': expected a number, got '{given.get(key, '')}'", field=path
                ) from None

        rotation = [[number(f"r{r}{c}") for c in (1, 2, 3)] for r in (1, 2, 3)]
        cameras.append(
            CalibratedCamera(
                name=name,
                intrinsics=torch.tensor(
                    [[number("fx"), number("s", 0.0), number("cx")], [0, number("fy"), number("cy")], [0, 0, 1]],
                    dtype=torch.float64,
                ),
                rotation=torch.tensor(rotation, dtype=torch.float64),
                translation=torch.tensor([number("tx"), number("ty"), number("tz")], dtype=torch.float64),
                distortion=five([number(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3")], f"{path}: {name}"),
                image_size=(int(number("height")), int(number("width"))) if "width" in given else None,
                background=plane([number(k) for k in ("nx", "ny", "nz")], number("offset"), f"{path}: line {i + 2}")
                if "nx" in given and "offset" in given
                else None,
                projection=projection_named(given.get("projection", PERSPECTIVE.name), f"{path}: {name}: projection"),
            )
        )
    return cameras
