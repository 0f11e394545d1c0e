"""Files with a mistake in them: each follows from its kind and its number, and is the same every time.

A mutant is the good file of its kind with one to three mistakes: in the numbers, the structure, the attributes or the
bytes. `make(kind, number, folder)` writes it; `Broken` says what was done.
"""

from __future__ import annotations

import contextlib
import functools
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
    *EXTREME, "", "air", "x- x+", "nan", b"1.00027", True, 5, np.array([1.0, 2.0]), np.array([1.00027]), np.array([]),
    np.array(["x-", "y+"]), -(2**31), "a" * 5000, "line\nline", "é",
)  # fmt: skip
UNITS = ("m", "cm", "deg", "rad", "", "pixel", "MM", "days since 2000-01-01", "seconds", 5, np.array([1.0, 2.0]), b"mm")
TYPES = ("int8", "uint8", "float16", "int64", "bool", "complex128", "U5", "O", "datetime64[ns]", "timedelta64[ns]")


# -- numbers and structure ------------------------------------------------------------------------------------------


def spoil_numbers(data: xr.Dataset, rng: random.Random) -> tuple[xr.Dataset, str]:
    """Set one number, a line of them or all to something extreme, or multiply them."""
    name = rng.choice([*data.data_vars, *data.coords])
    values = np.array(data[name].values)
    if values.dtype.kind in "OUS":
        return data, "nothing"
    where: Any = tuple(rng.randrange(n) for n in values.shape)[: rng.choice((0, 1, 9))]
    with np.errstate(all="ignore"):
        if rng.random() < 0.6:
            new: Any = rng.choice(EXTREME)
            values = values if values.dtype.kind == "f" or np.isfinite(new) else values.astype(np.float64)
            values[where] = np.float64(new).astype(values.dtype)
        else:
            new = rng.choice(FACTORS)
            values = values.astype(np.float64)
            values[where] *= new
    return replaced(data, name, values), f"{name}[{where}] {new}"


def replaced(data: xr.Dataset, name: Any, values: np.ndarray, dims: Any = None) -> xr.Dataset:
    return data.assign({name: (dims or data[name].dims, values, data[name].attrs)})


def drop(data: xr.Dataset, rng: random.Random) -> tuple[xr.Dataset, str]:
    """Leave a variable or coordinate out."""
    name = rng.choice([*data.data_vars, *data.coords])
    return data.drop_vars(name), f"drop {name}"


def transpose(data: xr.Dataset, rng: random.Random) -> tuple[xr.Dataset, str]:
    """Turn the axes of a variable, with their names or under their old names."""
    name = rng.choice([n for n in data.data_vars if data[n].ndim > 1])
    dims = list(data[name].dims)
    rng.shuffle(dims)
    turned = data[name].transpose(*dims)
    if rng.random() < 0.5:
        return data.assign({name: turned}), f"transpose {name} {dims}"
    free = [f"{d}_" for d in data[name].dims]
    keep = data[name].dims if turned.shape == data[name].shape else free
    return replaced(data, name, turned.values, keep), f"transpose the values of {name}"


def rename(data: xr.Dataset, rng: random.Random) -> tuple[xr.Dataset, str]:
    """Give a variable or a dimension another name."""
    name = rng.choice([*data.variables, *data.sizes])
    return data.rename({name: rng.choice(("other", f"{name}s", "X"))}), f"rename {name}"


def resize(data: xr.Dataset, rng: random.Random) -> tuple[xr.Dataset, str]:
    """Leave nothing, one or twice as much along a dimension."""
    name = rng.choice(list(data.sizes))
    index = rng.choice(([], [0], [0, 0, *range(data.sizes[name])], list(range(data.sizes[name]))[::-1]))
    return data.isel({name: index}), f"{name}: {index}"


def units(data: xr.Dataset, rng: random.Random) -> tuple[xr.Dataset, str]:
    """Give a variable another unit."""
    name, unit = rng.choice([*data.data_vars, *data.coords]), rng.choice(UNITS)
    data = data.copy()
    data[name].attrs["units"] = unit
    return data, f"{name} in {unit!r}"


def types(data: xr.Dataset, rng: random.Random) -> tuple[xr.Dataset, str]:
    """Give a variable another type."""
    name, kind = rng.choice([*data.data_vars, *data.coords]), rng.choice(TYPES)
    with contextlib.suppress(ValueError, TypeError), np.errstate(all="ignore"):
        return replaced(data, name, data[name].values.astype(kind)), f"{name} as {kind}"
    return data, "nothing"


def attributes(data: xr.Dataset, rng: random.Random) -> tuple[xr.Dataset, str]:
    """Drop an attribute of the file or of a variable, or set it to something else."""
    data = data.copy()
    owner: Any = data if rng.random() < 0.7 else data[rng.choice(list(data.data_vars))]
    packing = ("_FillValue", "scale_factor", "add_offset", "missing_value", "calendar", "masked_voxels")
    name = rng.choice([*owner.attrs, *owner.attrs, *packing])
    if rng.random() < 0.3 and name in owner.attrs:
        del owner.attrs[name]
        return data, f"drop attribute {name}"
    owner.attrs[name] = rng.choice(VALUES)
    return data, f"attribute {name} = {owner.attrs[name]!r}"[:100]


def names(data: xr.Dataset, rng: random.Random) -> tuple[xr.Dataset, str]:
    """Give the views other names: equal, empty, numbers, bytes."""
    coordinate = "view" if "view" in data.coords else rng.choice(list(data.coords))
    n = data.sizes.get(coordinate, 0)
    lines = [f"{i}\n/" for i in range(n)]
    other: list[Any] = rng.choice((["a"] * n, [""] * n, list(range(n)), [np.nan] * n, [b"a", b"b", b"c"] * n, lines))
    return data.assign_coords({coordinate: (coordinate, np.array(other[:n]))}), f"{coordinate} named {other[:3]}"


STRUCTURE: tuple[Callable[[xr.Dataset, random.Random], tuple[xr.Dataset, str]], ...] = (
    spoil_numbers, spoil_numbers, spoil_numbers, drop, transpose, rename, resize, units, types, attributes, attributes,
    names,
)  # fmt: skip


def write_netcdf(data: xr.Dataset, path: Path, rng: random.Random) -> str:
    """Write the file with mistakes of structure; those that the libraries do not write are not made."""
    changed, done = data, []
    for _ in range(rng.choice((1, 1, 2, 3))):
        with contextlib.suppress(Exception):
            changed, what = rng.choice(STRUCTURE)(changed, rng)
            done.append(what)
    try:
        changed.to_netcdf(path, engine="h5netcdf")
    except Exception:
        path.unlink(missing_ok=True)
        data.to_netcdf(path, engine="h5netcdf")
        return "nothing"
    return ", ".join(done)


# -- bytes and text -------------------------------------------------------------------------------------------------


def spoil_bytes(path: Path, rng: random.Random) -> str:
    """Flip, cut, blank, double or add bytes."""
    content = bytearray(path.read_bytes())
    what = rng.choice(("flip", "flip", "flip", "cut", "blank", "double", "add", "head"))
    at = rng.randrange(len(content) or 1)
    if what == "flip":
        for _ in range(rng.choice((1, 3, 10, 100))):
            if content:
                content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    elif what == "cut":
        del content[at:]
    elif what == "blank":
        content[at : at + 64] = bytes(len(content[at : at + 64]))
    elif what == "double":
        content[at:at] = content[at : at + 100]
    elif what == "add":
        content += bytes(rng.randrange(256) for _ in range(50))
    else:
        place = rng.randrange(min(len(content), 2000) or 1)
        content[place : place + 1] = bytes([rng.randrange(256)])
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


def spoil_tree(tree: Any, rng: random.Random) -> str:
    """Drop, replace, wrap or multiply one leaf or branch of nested lists and tables, or one number of an array."""
    places: list[tuple[Any, Any]] = []
    numbers: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            places.append((node, key))
            if isinstance(node[key], dict | list):
                walk(node[key])
            elif isinstance(node[key], np.ndarray) and node[key].size:
                numbers.append((node[key].reshape(-1), rng.randrange(node[key].size)))

    walk(tree)
    if numbers and rng.random() < 0.4:
        array, at = rng.choice(numbers)
        array[at] = rng.choice(EXTREME)
        return f"number {at} of an array"
    node, key = rng.choice(places)
    what = rng.choice(("drop", "value", "value", "value", "times", "wrap", "rename"))
    if what == "drop":
        del node[key]
    elif what == "value":
        node[key] = rng.choice((*EXTREME, "", "text", [], {}, True, [1, 2], -5, 10**12, "é\n"))
    elif what == "times" and isinstance(node[key], int | float):
        node[key] = node[key] * rng.choice(FACTORS)
    elif what == "rename" and isinstance(node, dict):
        node[f"{key}x"] = node.pop(key)
    else:
        node[key] = [node[key]]
    return f"{what} {key}"


def spoil_toml(path: Path, rng: random.Random) -> str:
    tree = tomllib.loads(path.read_text())
    what = spoil_tree(tree, rng)
    path.write_text(tomli_w.dumps(tree))
    return what


def spoil_json(path: Path, rng: random.Random) -> str:
    tree = json.loads(path.read_text())
    what = spoil_tree(tree, rng)
    path.write_text(json.dumps(tree))
    return what


def spoil_store(path: Path, rng: random.Random) -> str:
    """Spoil numbers, the metadata or a chunk of a Zarr store, or lose it."""
    if rng.random() < 0.5:
        return spoil_array(path, rng)
    files = sorted(p for p in path.rglob("*") if p.is_file())
    metadata = [p for p in files if p.name == "zarr.json"]
    file = rng.choice(metadata if rng.random() < 0.6 else files)
    what = "lost"
    if rng.random() < 0.1:
        file.unlink()
    elif file.name == "zarr.json" and rng.random() < 0.8:
        what = spoil_json(file, rng)
    else:
        what = spoil_bytes(file, rng)
    return f"{file.relative_to(path)}: {what}"


def spoil_array(path: Path, rng: random.Random) -> str:
    """Set numbers of an array of a Zarr store to something extreme."""
    import zarr

    array: Any = zarr.open(rng.choice(sorted(p.parent for p in path.glob("*/zarr.json"))), mode="r+")
    values = np.array(array[...])
    where: Any = tuple(rng.randrange(n) for n in values.shape)[: rng.choice((0, 1, 9))]
    with np.errstate(all="ignore"):
        values[where] = np.float64(rng.choice(EXTREME)).astype(values.dtype)
    array[...] = values
    return f"{array.name}[{where}] = {values[where]}"[:80]


# -- kinds ----------------------------------------------------------------------------------------------------------


@functools.cache
def loaded(good: Path) -> xr.Dataset:
    return xr.load_dataset(good, engine="h5netcdf")


def netcdf(good: Path, path: Path, rng: random.Random) -> str:
    if rng.random() < 0.4:
        shutil.copy(good, path)
        return spoil_bytes(path, rng)
    return write_netcdf(loaded(good).copy(deep=True), path, rng)


def text(good: Path, path: Path, rng: random.Random) -> str:
    shutil.copy(good, path)
    spoil: list[Callable[[Path, random.Random], str]] = [spoil_text, spoil_text, spoil_bytes]
    spoil += {".toml": [spoil_toml] * 4, ".json": [spoil_json] * 4}.get(path.suffix, [])
    return rng.choice(spoil)(path, rng)


def store(good: Path, path: Path, rng: random.Random) -> str:
    shutil.copytree(good, path)
    done = []
    for _ in range(rng.choice((1, 1, 2))):
        with contextlib.suppress(Exception):
            done.append(spoil_store(path, rng))
    return ", ".join(done)


def matlab(good: Path, path: Path, rng: random.Random) -> str:
    shutil.copy(good, path)
    if rng.random() < 0.3:
        return spoil_bytes(path, rng)
    content = scipy.io.loadmat(good, simplify_cells=True)
    tree = {k: v for k, v in content.items() if not k.startswith("__")}
    if rng.random() < 0.5:  # one of the three alone
        tree = tree.pop(rng.choice(list(tree)))
    what = spoil_tree(tree, rng)
    with contextlib.suppress(Exception):  # what SciPy does not write is not made
        scipy.io.savemat(path, tree)
    return what


MAKERS: dict[str, Callable[[Path, Path, random.Random], str]] = {
    ".nc": netcdf, ".vti": text, ".toml": text, ".csv": text, ".json": text, ".yml": text, ".mat": matlab,
    ".zarr": store,
}  # fmt: skip


def make(good: Path, number: int, folder: Path) -> tuple[Path, str]:
    """Write mutant `number` of a good file into a folder; return where, and what is wrong with it."""
    rng = random.Random(f"{good.name} {number}")
    path = folder / f"{good.stem}-{number}{good.suffix}"
    return path, MAKERS[good.suffix](good, path, rng)
