"""Files with a mistake in them: each follows from its kind and its number, and is the same every time.

A mutant is the good file of its kind with one to three mistakes: in the numbers, the structure, the attributes, the
text or the bytes. `make(good, number, folder)` writes it and says what was done.
"""

from __future__ import annotations

import contextlib
import json
import random
import re
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import tomli_w
import xarray as xr

EXTREME = (float("nan"), float("inf"), float("-inf"), 0.0, -1.0, 0.5, 255.0)
EXTREME += (1e-300, 1e-30, 1e-9, 1e9, 1e30, -1e30, 1e300)
FACTORS = (-1.0, 0.0, 1e-6, 1e-3, 0.1, 10.0, 1e3, 1e6, 1e12, 180 / np.pi)
VALUES = (
    "", "air", "x- x+", "nan", "text", [], {}, True, [1, 2], 5, -5, 10**12, -(2**31), "a" * 5000, "é\n",
    "m", "cm", "deg", "pixel", "MM", "days since 2000-01-01", np.array([1.0, 2.0]), np.array([]), b"1.00027",
)  # fmt: skip
TYPES = ("int8", "uint8", "float16", "int64", "bool", "complex128", "U5", "O", "datetime64[ns]", "timedelta64[ns]")
PACKING = ("_FillValue", "scale_factor", "add_offset", "missing_value", "calendar", "masked_voxels")


# -- numbers and structure: any file as nested tables, lists and arrays ---------------------------------------------


def spoil_array(values: np.ndarray, rng: random.Random) -> np.ndarray:
    """One number, a line of them or all set to something extreme or multiplied; or another type, size or order."""
    what = rng.choice(("extreme", "extreme", "extreme", "times", "type", "size", "order"))
    if what == "type":
        return values.astype(rng.choice(TYPES))
    if what == "size":
        return values[rng.choice(([], [0], [0, 0, *range(len(values))], range(len(values))[::-1]))]
    if what == "order":
        return values.T
    where: Any = tuple(rng.randrange(n) for n in values.shape)[: rng.choice((0, 1, 9))]
    new = rng.choice(EXTREME if what == "extreme" else FACTORS)
    spoilt = values if values.dtype.kind == "f" or (what == "extreme" and np.isfinite(new)) else values.astype(float)
    spoilt[where] = spoilt[where] * new if what == "times" else np.float64(new).astype(spoilt.dtype)
    return spoilt


def spoil_tree(tree: Any, rng: random.Random) -> str:
    """Drop, replace, wrap, rename or multiply a leaf or a branch of nested lists and tables, or spoil an array."""
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            places.append((node, key))
            if isinstance(node[key], dict | list):
                walk(node[key])

    walk(tree)
    arrays = [(node, key) for node, key in places if isinstance(node[key], np.ndarray) and node[key].ndim]
    if arrays and rng.random() < 0.4:
        node, key = rng.choice(arrays)
        node[key] = spoil_array(np.array(node[key]), rng)
        return f"array {key}"
    node, key = rng.choice(places)
    what = rng.choice(("drop", "value", "value", "extreme", "extreme", "times", "times", "wrap", "rename", "add"))
    if what == "drop":
        del node[key]
    elif what in ("value", "extreme"):
        node[key] = rng.choice(VALUES if what == "value" else EXTREME)
    elif what == "times" and isinstance(node[key], int | float):
        node[key] = node[key] * rng.choice(FACTORS)
    elif what == "rename" and isinstance(node, dict):
        node[f"{key}x"] = node.pop(key)
    elif what == "add" and isinstance(node[key], dict):
        node[key][rng.choice(PACKING)] = rng.choice(VALUES)
    else:
        node[key] = [node[key]]
    return f"{what} {key}"


def read_netcdf(path: Path) -> Any:
    return xr.load_dataset(path, engine="h5netcdf").to_dict(data="array")


def write_netcdf(path: Path, tree: Any) -> None:
    xr.Dataset.from_dict(tree).to_netcdf(path, engine="h5netcdf")


def read_matlab(path: Path) -> Any:
    content = scipy.io.loadmat(path, simplify_cells=True)
    return {key: value for key, value in content.items() if not key.startswith("__")}


TREES: dict[str, tuple[Callable[[Path], Any], Callable[[Path, Any], object]]] = {
    ".nc": (read_netcdf, write_netcdf),
    ".mat": (read_matlab, scipy.io.savemat),
    ".toml": (lambda path: tomllib.loads(path.read_text()), lambda path, tree: path.write_text(tomli_w.dumps(tree))),
    ".json": (lambda path: json.loads(path.read_text()), lambda path, tree: path.write_text(json.dumps(tree))),
}


def spoil_content(path: Path, rng: random.Random) -> str:
    """Read a file, spoil its tree and write it; what its library does not write is not made."""
    read, write = TREES[path.suffix]
    tree, part = read(path), path.with_name(f"part-{path.name}")
    what = spoil_tree(tree, rng)
    try:
        write(part, tree)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return what


def resize(path: Path, rng: random.Random) -> str:
    """Leave nothing, one or twice as much along a dimension of all variables, or turn all axes with their names."""
    data = xr.load_dataset(path, engine="h5netcdf")
    name = rng.choice(list(data.sizes))
    index = rng.choice(([], [0], [0, 0, *range(data.sizes[name])], list(range(data.sizes[name]))[::-1]))
    changed = data.transpose() if rng.random() < 0.3 else data.isel({name: index})
    changed.to_netcdf(path, engine="h5netcdf")
    return f"{name}: {index}"


def spoil_store(path: Path, rng: random.Random) -> str:
    """Spoil numbers, the metadata or a chunk of a Zarr store, or lose it."""
    import zarr

    if rng.random() < 0.5:
        array: Any = zarr.open(rng.choice(sorted(p.parent for p in path.glob("*/zarr.json"))), mode="r+")
        array[...] = spoil_array(np.array(array[...]), rng)
        return f"numbers of {array.name}"
    files = sorted(p for p in path.rglob("*") if p.is_file())
    file = rng.choice([p for p in files if p.name == "zarr.json"] if rng.random() < 0.6 else files)
    if rng.random() < 0.1:
        file.unlink()
        return f"{file.relative_to(path)} lost"
    spoil = spoil_content if file.name == "zarr.json" and rng.random() < 0.8 else spoil_bytes
    return f"{file.relative_to(path)}: {spoil(file, rng)}"


# -- bytes and text -------------------------------------------------------------------------------------------------


def spoil_head(path: Path, rng: random.Random) -> str:
    """Set one of the first bytes, where headers are."""
    content = bytearray(path.read_bytes())
    at = rng.randrange(min(200, len(content)))
    content[at] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
    path.write_bytes(content)
    return f"byte {at} is {content[at]}"


def spoil_bytes(path: Path, rng: random.Random) -> str:
    """Flip, cut, blank, double or add bytes."""
    content = bytearray(path.read_bytes())
    what = rng.choice(("flip", "flip", "flip", "cut", "blank", "double", "add"))
    at = rng.randrange(len(content) or 1)
    if what == "flip":
        for _ in range(rng.choice((1, 3, 10, 100)) if content else 0):
            content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    elif what == "cut":
        del content[at:]
    elif what == "blank":
        content[at : at + 64] = bytes(len(content[at : at + 64]))
    elif what == "double":
        content[at:at] = content[at : at + 100]
    else:
        content += bytes(rng.randrange(256) for _ in range(50))
    path.write_bytes(bytes(content))
    return f"{what} bytes at {at}"


NUMBER = re.compile(rb"-?\d+\.?\d*(?:e[+-]?\d+)?")
WORDS = (b"nan", b"inf", b"-1", b"0", b"1e300", b"1e-300", b"99999999999", b"true", b'"text"')
WORDS += (b"[]", b"{}", b"", b"null", b"[1, 2]")


def spoil_text(path: Path, rng: random.Random) -> str:
    """Put something else in the place of one number, or drop or double a line."""
    content = path.read_bytes()
    matches = list(NUMBER.finditer(content[:20000]))
    if matches and rng.random() < 0.7:
        hit, word = rng.choice(matches), rng.choice(WORDS)
        path.write_bytes(content[: hit.start()] + word + content[hit.end() :])
        return f"{hit.group().decode()} at {hit.start()} became {word.decode()!r}"
    lines = content.splitlines(keepends=True)
    at = rng.randrange(len(lines) or 1)
    lines[at : at + 1] = rng.choice(([], lines[at : at + 1] * 2))
    path.write_bytes(b"".join(lines))
    return f"line {at} dropped or doubled"


# -- mutants --------------------------------------------------------------------------------------------------------

SPOILERS: dict[str, tuple[Callable[[Path, random.Random], str], ...]] = {
    ".nc": (spoil_content, spoil_content, resize, spoil_bytes), ".mat": (spoil_content, spoil_content, spoil_bytes),
    **dict.fromkeys((".toml", ".json"), (spoil_content, spoil_content, spoil_text, spoil_bytes)),
    **dict.fromkeys((".vti", ".csv", ".yml", ".cihx"), (spoil_text, spoil_text, spoil_head, spoil_bytes)),
    ".zarr": (spoil_store,),
}  # fmt: skip
"""Kinds of mistakes by the ending of the file; of images, in the head or anywhere."""


def make(good: Path, number: int, folder: Path) -> tuple[Path, str]:
    """Write mutant `number` of a good file, and the file beside it that it needs; return where, and what is wrong."""
    rng = random.Random(f"{good.name} {number}")
    path, beside = folder / f"{good.stem}-{number}{good.suffix}", good.with_suffix(".mraw")
    (shutil.copytree if good.is_dir() else shutil.copy)(good, path)
    if beside.is_file():
        shutil.copy(beside, path.with_suffix(".mraw"))
    done, spoilers = [], SPOILERS.get(good.suffix, (spoil_head, spoil_bytes))
    for spoil in sorted(rng.choices(spoilers, k=rng.choice((1, 1, 2, 3))), key=spoilers.index):  # the content first
        with contextlib.suppress(Exception), np.errstate(all="ignore"):
            done.append(spoil(path, rng))
    return path, ", ".join(done)
