"""NetCDF files and Zarr stores, opened lazily, with an InputError where they are damaged.

NetCDF-4 is HDF5. The classic formats of version 3 begin with CDF and a number: 1 classic, 2 with 64-bit offsets, which
SciPy reads, and 5 with 64-bit data, which it does not.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nerif.common.conventions import InputError

if TYPE_CHECKING:
    import h5py
    import xarray as xr

CLASSIC, WIDE = (b"CDF\x01", b"CDF\x02"), b"CDF\x05"
"""First bytes of NetCDF-3 files."""
HEAP = b"GCOL\x01\0\0\0"
"""Signature and version of a global heap of HDF5."""

__all__ = ["check_in_one_file", "opened", "reading", "values"]


@contextmanager
def opened(path: str | os.PathLike[str], expected: str) -> Iterator[xr.Dataset]:
    """Open a file as a lazy dataset; an InputError inside the block gets the file name as prefix.

    Parameters
    ----------
    expected : content of the file, such as "a measurement"
    """
    path = Path(path)
    if not path.is_file():
        what = "a folder" if path.is_dir() else "no such file"
        raise InputError(f"{what}; expected {expected}", field=path)
    with reading(f"{path}: not a readable NetCDF file, or truncated"):
        dataset = _dataset(path)
    with dataset:
        try:
            yield dataset
        except InputError as error:
            raise error.inside(path) from None


def _dataset(path: Path) -> xr.Dataset:
    import h5py
    import xarray as xr

    with path.open("rb") as content:
        first = content.read(4)
    if first in CLASSIC:  # read whole: a map of memory could not be closed while arrays refer to it
        return xr.open_dataset(path, engine="scipy", decode_times=False, mmap=False)
    if first == WIDE:
        remedy = f"nccopy -k 4 {path.name} {path.stem}4.nc"
        raise InputError(f"expected NetCDF-4 or classic, got NetCDF-3 with 64-bit data; convert: {remedy}", field=path)
    check_heaps(path)
    with h5py.File(path, "r") as file:
        check_in_one_file(file)
        file.attrs.get("_nc3_strict")  # where this fails, h5netcdf leaves a half-made object that complains later
    return xr.open_dataset(path, engine="h5netcdf", decode_times=False)


def values(variable: xr.DataArray) -> np.ndarray:
    """Read the numbers of a variable."""
    field = f"variable '{variable.name}'"
    with reading(f"{field}: cannot be read; is the file damaged?"):
        numbers = np.asarray(variable.values)
    if numbers.dtype.kind not in "fiub":
        raise InputError(f"expected numbers, got {numbers.dtype}", field=field)
    return numbers


@contextmanager
def reading(message: str) -> Iterator[None]:
    """Raise an InputError with `message` for any error inside; the block holds nothing but calls of a library."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # libraries raise anything on damaged files
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{message} ({reason})") from None


def check_in_one_file(file: h5py.File) -> None:
    """Raise OSError if a part of an HDF5 file, which may come from another person, is in another file."""
    import h5py

    def check(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            names = [name] if item.external or item.is_virtual else []
        else:
            names = [key for key in item if isinstance(item.get(key, getlink=True), h5py.ExternalLink)]
        if names:
            raise OSError(f"'{names[0]}' is in another file; copy it into this one, as by h5repack")

    check("/", file)
    file.visititems(check)


def check_heaps(path: Path) -> None:
    """Raise OSError if a global heap does not end where its header states: the HDF5 library would loop forever.

    A heap is a header of 16 bytes with its size, and objects: index (2 bytes), references (2), 4 free, size (8), data
    up to a multiple of 8 bytes. Object 0 is the free space, whose size counts its own header.

    Source: HDF5 File Format Specification 3.0, III.E.
    """
    if not path.stat().st_size:
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        start = content.find(HEAP)
        while start >= 0:
            if start % 8 == 0:
                _check_heap(content, start)
            start = content.find(HEAP, start + 8)


def _check_heap(content: mmap.mmap, start: int) -> None:
    header = 16
    end = start + int.from_bytes(content[start + 8 : start + header], "little")
    position = start + header
    while position + header <= min(end, len(content)):
        index = int.from_bytes(content[position : position + 2], "little")
        size = int.from_bytes(content[position + 8 : position + header], "little")
        length = header + -(-size // 8) * 8 if index else size
        if length < header or position + length > end:
            raise OSError("a global heap is damaged")
        position += length
