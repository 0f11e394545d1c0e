"""NetCDF-4 files and Zarr stores as they are found: opened lazily, and refused in words where they are damaged."""

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
    import xarray as xr

HEAP = b"GCOL\x01\0\0\0"
"""Signature and version of a global heap of HDF5."""

__all__ = ["opened", "reading", "values"]


@contextmanager
def opened(path: str | os.PathLike[str], expected: str) -> Iterator[xr.Dataset]:
    """Give a file as a dataset of which nothing is read yet; what is refused while it is open is told with its name.

    Parameters
    ----------
    expected : what the file should be, such as "a measurement"

    Raises
    ------
    InputError
        If it is missing, no NetCDF-4, or damaged.
    """
    import h5py
    import xarray as xr

    path = Path(path)
    if not path.is_file():
        raise InputError(f"no such file; expected {expected}", field=path)
    with reading(f"{path}: not a readable NetCDF-4 file, or truncated"):
        check_heaps(path)
        with h5py.File(path, "r") as file:
            file.attrs.get("_nc3_strict")  # where this fails, h5netcdf leaves a half-made object that complains later
        dataset = xr.open_dataset(path, engine="h5netcdf", decode_times=False)
    with dataset:
        try:
            yield dataset
        except InputError as error:
            raise error.inside(path) from None


def values(variable: xr.DataArray) -> np.ndarray:
    """Read the numbers of a variable.

    Raises
    ------
    InputError
        If they are no numbers, or the file is damaged there.
    """
    with reading(f"variable '{variable.name}': cannot be read; is the file damaged?"):
        read = np.asarray(variable.values)
    if read.dtype.kind not in "fiub":
        raise InputError(f"expected numbers, got {read.dtype}", field=f"variable '{variable.name}'")
    return read


@contextmanager
def reading(refusal: str) -> Iterator[None]:
    """Refuse what a library cannot read: calls of it stand inside, and no others, since any error is taken for damage.

    Raises
    ------
    InputError
        With the refusal, and the first line of what the library says.
    """
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # libraries raise whatever the damage leads them to
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{refusal} ({said})") from None


def check_heaps(path: Path) -> None:
    """Refuse a file whose global heaps do not add up: the HDF5 library would walk along them for ever.

    A heap is a header of 16 bytes with its size, and objects: index (2 bytes), references (2), 4 free, size (8), data
    up to a multiple of 8 bytes. Object 0 is the free space, whose size counts its own header.

    Raises
    ------
    OSError
        If one does not end where its header says.

    Source: HDF5 File Format Specification 3.0, III.E.
    """
    with path.open("rb") as file:
        if not path.stat().st_size:
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            at = content.find(HEAP)
            while at >= 0:
                if at % 8 == 0:
                    _check_heap(content, at)
                at = content.find(HEAP, at + 8)


def _check_heap(content: mmap.mmap, at: int) -> None:
    header = 16
    end = at + int.from_bytes(content[at + 8 : at + header], "little")
    place = at + header
    while place + header <= min(end, len(content)):
        index = int.from_bytes(content[place : place + 2], "little")
        size = int.from_bytes(content[place + 8 : place + header], "little")
        length = header + -(-size // 8) * 8 if index else size
        if length < header or place + length > end:
            raise OSError("a global heap is damaged")
        place += length
