"""Vectors in text: of PIVlab, OpenPIV, DaVis, Insight and Dynamic Studio, and tables with named columns."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.text_tables import TextTable, read_numbers
from nerif.data.kinds import vector_program
from nerif.imaging.vectors.program import (
    DANTEC,
    DAVIS,
    INSIGHT,
    OPENPIV,
    PIVLAB,
    TABLE,
    Program,
    ProgramVectors,
    length_unit,
)  # fmt: skip
from nerif.imaging.vectors.vector_settings import LENGTHS, RATES, VectorSettings

__all__ = ["MISSING", "read_text_vectors", "role"]

NAMES = {
    "x": ("x",), "y": ("y",),
    "u": ("u", "vx", "velocityu", "ux", "dx"), "v": ("v", "vy", "velocityv", "uy", "dy"),
    "w": ("w", "vz", "velocityw"),
    "sigma": ("uncertainty", "uncertaintyv", "sigma", "standarddeviation"),
    "sigma_u": ("sigmau", "uncertaintyvx", "uncertaintyu"), "sigma_v": ("sigmav", "uncertaintyvy"),
}  # fmt: skip
"""Names of the columns, without blanks and capitals."""
MISSING: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "flags": lambda f: f != 0, "flag": lambda f: f != 0, "mask": lambda f: f != 0, "isnan": lambda f: f != 0,
    "isnan?": lambda f: f != 0, "status": lambda f: f != 0, "vectortype": lambda f: f != 1,
    "typevector": lambda f: f != 1, "isvalid": lambda f: f <= 0, "valid": lambda f: f <= 0, "chc": lambda f: f <= 0,
}  # fmt: skip
"""Which values of a column of flags mean that there is no vector."""
PROGRAMS = {program.name: program for program in (DANTEC, DAVIS, INSIGHT, OPENPIV, PIVLAB)}
DAVIS_TEXT = re.compile(r"#\w+ [\d.]+ ([23])D-vector (\d+) (\d+) (\d+) (.*)")
INSIGHT_ENTRY = r'{}="([-+.\dEe]+)"'


def role(name: str) -> str:
    """Return x, y, u, v, w, sigma, or a name of MISSING for the name of a column; "" for any other."""
    plain = re.sub(r"[\s_]", "", name).lower()
    return next((key for key, names in NAMES.items() if plain in names), plain if plain in MISSING else "")


def read_text_vectors(path: Path, settings: VectorSettings) -> ProgramVectors:
    """Read the vectors of one view and one instant."""
    table = _with_units(read_numbers(path))
    head = "\n".join(table.head)
    program = PROGRAMS.get(vector_program(head))
    if program is DAVIS and (match := DAVIS_TEXT.search(head)):
        return _davis(table, match, path)
    if program is None:
        program = TABLE if table.names else OPENPIV
    columns = _columns(table, settings, path)
    x, y, u, v = (table.values[:, columns[name]] for name in "xyuv")
    if program is PIVLAB and np.any(np.diff(x[y == y[0]]) < 0):
        raise InputError("expected x to the right, got x to the left; set the axis in PIVlab's calibration", field=path)
    units = {"x": "", "u": ""}
    for name, stated in (("x", settings.position_unit), ("u", settings.vector_unit)):
        text = table.units[columns[name]] if table.units else ""
        units[name] = length_unit(text)
        if text and not units[name] and not stated:
            option = "--position-unit" if name == "x" else "--vector-unit"
            raise InputError(
                f"expected px, {', '.join((*LENGTHS, *RATES))}, got the unit '{text}' of {name}; give {option}",
                field=path,
            )
    missing = np.zeros(len(x), dtype=bool)
    for i, name in enumerate(table.names):
        if (test := MISSING.get(role(name))) is not None and not settings.columns:
            missing |= test(table.values[:, i])
    if settings.columns[4:]:
        missing |= _flagged(settings.columns[4], table.values[:, columns["flag"]])
    elif not table.names:
        missing |= _flags_without_name(table.values)
    up, mirrored = _y_up(program, x, y)
    scale = time_step = 0.0
    origin = None
    if program is INSIGHT:
        entries = {
            n: re.search(INSIGHT_ENTRY.format(n), head) for n in ("MicrometersPerPixelX", "MicrosecondsPerDeltaT")
        }
        um, us = (float(m[1]) if m else 0.0 for m in entries.values())
        scale, time_step = um / 1e3, us / 1e6
        origin = (-program.first_pixel, -program.first_pixel) if y.max() <= 0 else None  # y = 0 at the upper edge
    elif program is PIVLAB and (factors := re.search(r"px -> m\): ([\d.eE+-]+).*m/s\): ([\d.eE+-]+)", head)):
        xy, uv = map(float, factors.groups())
        if xy != 1:
            scale, time_step = 1e3 * xy, xy / abs(uv) if uv else 0.0
    sigma = _sigma(table, columns)
    return ProgramVectors(
        program, x, y, u, v, ~missing, units["x"] or "px", units["u"] or "px", up, mirrored, scale, time_step, origin,
        sigma,
    )  # fmt: skip


def _with_units(table: TextTable) -> TextTable:
    """Return the table with units that are the last word of a name, such as "X mm", as units."""
    words = [name.rpartition(" ") for name in table.names]
    alone = [bool(word) and bool(length_unit(last)) for word, _, last in words]
    names = tuple(word if yes else name for name, (word, *_), yes in zip(table.names, words, alone, strict=True))
    units = tuple(
        unit or (last if yes else "") for unit, (*_, last), yes in zip(table.units, words, alone, strict=True)
    )
    return replace(table, names=names, units=units)


def _flagged(name: str, values: np.ndarray) -> np.ndarray:
    return MISSING.get(role(name), lambda f: f != 0)(values)


def _columns(table: TextTable, settings: VectorSettings, path: Path) -> dict[str, int]:
    """Return the columns of x, y, u, v and others by their names; of several the one in px, then in lengths."""
    if settings.columns:
        wanted = dict(zip(("x", "y", "u", "v", "flag"), settings.columns, strict=False))
        if not 4 <= len(settings.columns) <= 5:
            raise InputError(f"expected four or five names, got {' '.join(settings.columns)}", field="columns")
        lower = [name.lower() for name in table.names]
        for name in wanted.values():
            if name.lower() not in lower:
                raise InputError(f"no column '{name}'; it has {', '.join(table.names) or 'no names'}", field=path)
        return {key: lower.index(name.lower()) for key, name in wanted.items()}
    if not table.names:
        return {name: i for i, name in enumerate("xyuv")}

    def rank(i: int) -> int:
        unit = length_unit(table.units[i])
        return 0 if unit == "px" else 1 if unit in LENGTHS else 2 if unit in RATES else 3

    indices: dict[str, int] = {}
    for i in sorted(range(len(table.names)), key=lambda i: (rank(i), i)):
        if key := role(table.names[i]):
            indices.setdefault(key, i)
    if lacking := [name for name in "xyuv" if name not in indices]:
        raise InputError(
            f"expected columns x, y, u, v, got {', '.join(table.names)} without {', '.join(lacking)}; name those of "
            "x, y, u, v with --columns",
            field=path,
        )
    if "w" in indices and np.any(table.values[:, indices["w"]]):
        raise InputError(
            "expected two components of one camera, got three; export the vectors of each camera", field=path
        )
    return indices


def _flags_without_name(values: np.ndarray) -> np.ndarray:
    """Return where a column behind the fourth that holds nothing but 0, 1 and 2 is not 0."""
    flags = [c for c in values[:, 4:].T if np.isin(c[np.isfinite(c)], (0, 1, 2)).all()]
    return np.any([c != 0 for c in flags], axis=0) if flags else np.zeros(len(values), dtype=bool)


def _y_up(program: Program, x: np.ndarray, y: np.ndarray) -> tuple[bool, bool]:
    """Return whether y points up, and whether it is mirrored on the grid instead of the image."""
    if program in (INSIGHT, DANTEC):
        return True, False
    steps = np.diff(y[x == x[0]])  # along the first column, in the order of the file
    falling = bool(len(steps)) and bool(steps[0] < 0)
    if program is OPENPIV:
        return falling, True
    return falling and program in (PIVLAB, DAVIS), False


def _sigma(table: TextTable, columns: dict[str, int]) -> np.ndarray | None:
    keys = ("sigma_u", "sigma_v") if {"sigma_u", "sigma_v"} <= columns.keys() else ("sigma", "sigma")
    return None if keys[0] not in columns else np.stack([table.values[:, columns[key]] for key in keys], axis=-1)


def _davis(table: TextTable, match: re.Match[str], path: Path) -> ProgramVectors:
    """Vectors of DaVis's own text: the head names the spacing in px, from which the length of a pixel follows."""
    kind, spacing, rows, columns = (int(n) for n in match.groups()[:4])
    if kind != 2 or table.values.shape[1] != 4:
        raise InputError(
            "expected two components of one camera, got three; export the vectors of each camera", field=path
        )
    if len(table.values) != rows * columns:
        raise InputError(f"expected {rows} x {columns} vectors, as its head says, got {len(table.values)}", field=path)
    quoted = re.findall(r'"([^"]*)"', match[5])
    units = [length_unit(unit) or "px" for unit in quoted[1::2]]
    x, y, u, v = table.values.T
    step = abs(x[1] - x[0]) if columns > 1 else abs(y[columns] - y[0])
    scale = LENGTHS[units[0]] * step / spacing if units[0] != "px" else 0.0
    j, i = np.arange(len(x)) % columns, np.arange(len(x)) // columns
    up = bool(rows > 1 and y[columns] < y[0])
    if x[-1] < x[0]:
        raise InputError("expected x to the right, got x to the left; export with the axis to the right", field=path)
    position = [(index + 0.5) * spacing for index in (j, i)]  # the first window begins at the edge of the image
    return ProgramVectors(
        DAVIS, position[0], position[1], u, -v if up else v, ~((u == 0) & (v == 0)), "px",
        units[2] if len(units) > 2 else "px", False, scale=scale,
    )  # fmt: skip
