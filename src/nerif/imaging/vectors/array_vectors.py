"""Vectors in arrays: exports and sessions of PIVlab (.mat), arrays of MATLAB, NumPy and NetCDF."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.files import ending, reading
from nerif.common.netcdf import opened
from nerif.common.npz import open_npz
from nerif.imaging.vectors.program import PIVLAB, TABLE, ProgramVectors, length_unit
from nerif.imaging.vectors.text_vectors import MISSING, role
from nerif.imaging.vectors.vector_settings import VectorSettings

__all__ = ["read_array_vectors"]

STAGES = ("smoothed", "filtered", "original")
"""Stages of PIVlab's vectors, the last first."""
SESSION = {"smoothed": (9, 10), "filtered": (6, 7), "original": (2, 3)}
TYPES = {"filtered": 8, "original": 4}
"""Rows of PIVlab's resultslist, from 0: u, v, and the type of each vector; x and y are 0 and 1."""
MIN_ROWS = 5


def read_array_vectors(path: Path, settings: VectorSettings) -> list[ProgramVectors]:
    """Return the vectors of a file, one entry for each view or instant."""
    content = _content(path)
    if "pivlab_data" in content:
        content = dict(content["pivlab_data"])
    if "resultslist" in content:
        return [*_session(content, path)]
    if "u_original" in content:
        return [*_export(content, path)]
    return [*_plain(content, settings, path)]


def _content(path: Path) -> dict[str, Any]:
    if ending(path) == ".npz":
        with reading("not a readable file of NumPy", path), open_npz(path) as (archive, shapes):
            return {name: archive[name] for name in shapes}
    if ending(path) == ".nc":
        with opened(path, "vectors") as dataset:
            units = {f"{name} unit": str(v.attrs.get("units", "")) for name, v in dataset.variables.items()}
            return {str(name): v.to_numpy() for name, v in dataset.variables.items()} | units
    import pymatreader

    with reading("not a readable MATLAB file", path), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        content = pymatreader.read_mat(str(path))
    return {name: value for name, value in content.items() if not name.startswith(("__", "#"))}


def _frames(value: Any) -> list[np.ndarray]:
    """Return the matrices of a cell over frames, or of a single frame."""
    if isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
        return [np.atleast_2d(np.asarray(v, dtype=np.float64)) if np.size(v) else np.empty((0, 0)) for v in value]
    return [np.asarray(value, dtype=np.float64)] if np.size(value) else []


def _export(content: Mapping[str, Any], path: Path) -> Iterator[ProgramVectors]:
    """Yield the frames of "Export MAT file": matrices with the first row at the top of the image."""
    first, _, second = (
        str(content.get("units", "px respectively px")).replace("[", "").replace("]", "").partition("respectively")
    )
    position, vector = (length_unit(text) or "px" for text in (first, second))
    calxy, calu = (abs(float(np.ravel(content.get(name, 1.0))[0])) for name in ("calxy", "calu"))
    if position == "px" and calxy != 1:
        position, vector = "m", "m/s"
    x, y = _frames(content["x"]), _frames(content["y"])
    for i in range(len(x)):
        stage = next(s for s in STAGES if f"u_{s}" in content and _part(content, f"u_{s}", i).size)
        u, v = (_part(content, f"{name}_{stage}", i) for name in "uv")
        types = [_part(content, f"typevector_{s}", i) for s in STAGES[1:]]
        types = [t for t in types if t.size]
        valid = np.isfinite(u) & ((types[0] == 1) if types else True)
        up = y[i].shape[0] > 1 and bool(y[i][1, 0] < y[i][0, 0])
        if x[i].shape[1] > 1 and x[i][0, 1] < x[i][0, 0]:
            raise InputError(
                "expected x to the right, got x to the left; set the axis in PIVlab's calibration", field=path
            )
        yield ProgramVectors.of_maps(
            PIVLAB, (x[i], y[i], u, v, valid), position_unit=position, vector_unit=vector, y_up=up,
            scale=1e3 * calxy if position != "px" else 0.0, time_step=calxy / calu if vector.endswith("/s") else 0.0,
        )  # fmt: skip


def _part(content: Mapping[str, Any], name: str, i: int) -> np.ndarray:
    frames = _frames(content.get(name, []))
    return frames[i] if i < len(frames) else np.empty((0, 0))


def _session(content: Mapping[str, Any], path: Path) -> Iterator[ProgramVectors]:
    """Yield the frames of a session: raw pixels in the axes of the image, whatever its calibration."""
    count = 0
    for parts in _by_frame(content["resultslist"]):
        stage = next((s for s in STAGES if SESSION[s][1] < len(parts) and parts[SESSION[s][0]].size), None)
        if stage is None:
            continue
        u, v = (parts[k] for k in SESSION[stage])
        types = next((parts[TYPES[s]] for s in STAGES[1:] if TYPES[s] < len(parts) and parts[TYPES[s]].size), None)
        valid = np.isfinite(u) & (True if types is None else types == 1)
        count += 1
        yield ProgramVectors.of_maps(PIVLAB, (parts[0], parts[1], u, v, valid))
    if not count:
        raise InputError("a session of PIVlab without vectors; analyse its images first", field=path)


def _by_frame(results: Any) -> list[list[np.ndarray]]:
    """Return resultslist as lists (frame, row): MATLAB's version 5 has lists (row, frame), version 7.3 one of all."""
    if isinstance(results[0], list):
        return [[np.asarray(v) for v in frame] for frame in zip(*results, strict=True)]
    parts = [np.asarray(v) for v in results]
    again = (k for k in range(MIN_ROWS, len(parts)) if np.array_equal(parts[k], parts[0]))  # x of the next frame
    rows = next(again, len(parts))
    return [parts[i : i + rows] for i in range(0, len(parts), rows)]


def _plain(content: Mapping[str, Any], settings: VectorSettings, path: Path) -> Iterator[ProgramVectors]:
    """Yield the maps of arrays u, v (..., row, column) over the axes before rows."""
    if settings.columns:
        wanted = dict(zip(("x", "y", "u", "v", "flag"), settings.columns, strict=False))
    else:
        wanted = {key: name for name in reversed([*content]) if (key := role(name)) in ("x", "y", "u", "v", "sigma")}
        if flag := next((name for name in content if role(name) in MISSING), None):
            wanted["flag"] = flag
    if lacking := [key for key in "xyuv" if wanted.get(key) not in content]:
        raise InputError(
            f"expected arrays x, y, u, v, got {', '.join(n for n in content if not n.endswith(' unit'))} without "
            f"{', '.join(lacking)}; name those of x, y, u, v with --columns",
            field=path,
        )
    arrays = {key: np.asarray(content[name], dtype=np.float64) for key, name in wanted.items()}
    u, v = arrays["u"], arrays["v"]
    if u.ndim < 2 or u.shape != v.shape:
        raise InputError(f"expected u and v of one shape (..., row, column), got {u.shape} and {v.shape}", field=path)
    x, y = arrays["x"], arrays["y"]
    x, y = (x[None, :], y[:, None]) if x.ndim == y.ndim == 1 else (x, y)
    x, y = np.broadcast_to(x, u.shape), np.broadcast_to(y, u.shape)
    bad = MISSING.get(role(wanted.get("flag", "")), lambda f: f != 0)(arrays["flag"]) if "flag" in arrays else False
    valid = np.isfinite(u) & np.isfinite(v) & ~np.broadcast_to(bad, u.shape)
    sigma = np.broadcast_to(arrays["sigma"], u.shape) if "sigma" in arrays else None
    units = [length_unit(str(content.get(f"{wanted[key]} unit", ""))) or "px" for key in "xu"]
    for index in np.ndindex(u.shape[:-2]):
        s = None if sigma is None else np.stack([sigma[index].ravel()] * 2, axis=-1)
        maps = [a[index] for a in (x, y, u, v, valid)]
        yield ProgramVectors.of_maps(TABLE, maps, position_unit=units[0], vector_unit=units[1], sigma=s)
