"""NetCDF files and Zarr stores, opened lazily, with an InputError where they are damaged.

NetCDF-4 is HDF5. The classic formats of version 3 begin with CDF and a number: 1 classic, 2 with 64-bit offsets, which
SciPy reads, and 5 with 64-bit data, which it does not.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerif.common.conventions import InputError, within
from nerif.common.files import atomic, instead_of_file, reading
from nerif.common.hdf5 import open_hdf5
from nerif.common.memory import check_memory

if TYPE_CHECKING:
    import xarray as xr

CLASSIC, WIDE = (b"CDF\x01", b"CDF\x02"), b"CDF\x05"
"""First bytes of NetCDF-3 files."""

__all__ = ["opened", "values", "write_dataset"]


@contextmanager
def opened(path: str | os.PathLike[str], expected: str) -> Iterator[xr.Dataset]:
    """Open a file, `expected` to be "a measurement", say, as a lazy dataset; InputErrors of the block name the file."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{instead_of_file(path)}; expected {expected}", field=path)
    with reading(f"{path}: not a readable NetCDF file, or truncated"):
        dataset = _dataset(path)
    with dataset, within(path):
        yield dataset


def _dataset(path: Path) -> xr.Dataset:
    import xarray as xr

    with path.open("rb") as content:
        first = content.read(4)
    if first in CLASSIC:  # read whole: a map of memory could not be closed while arrays refer to it
        return xr.open_dataset(path, engine="scipy", decode_times=False, mmap=False)
    if first == WIDE:
        remedy = f"nccopy -k 4 {path.name} {path.stem}4.nc"
        raise InputError(f"expected NetCDF-4 or classic, got NetCDF-3 with 64-bit data; convert: {remedy}", field=path)
    with open_hdf5(path) as file:
        for name, item in file.items():
            if getattr(item, "ndim", 0) == 1:  # coordinates, which xarray reads at once
                check_memory(item.size * item.dtype.itemsize, path, f"{path}: variable '{name}'")
        file.attrs.get("_nc3_strict")  # where this fails, h5netcdf leaves a half-made object that complains later
    return xr.open_dataset(path, engine="h5netcdf", decode_times=False, phony_dims="sort")


def write_dataset(path: str | os.PathLike[str], dataset: xr.Dataset, encoding: Mapping[str, Any] | None = None) -> None:
    """Write a NetCDF-4 file atomically.

    It is made in memory: the HDF5 library crashes where it cannot write its last bytes, as on a full disk.
    """
    content = dataset.to_netcdf(engine="h5netcdf", encoding=encoding)
    with atomic(path) as part:
        part.write_bytes(content)


def values(variable: xr.DataArray) -> np.ndarray:
    """Read the numbers of a variable."""
    field = f"variable '{variable.name}'"
    source = variable.encoding.get("source")
    check_memory(variable.nbytes, None if source is None else Path(source), field)
    with reading(f"{field}: cannot be read; is the file damaged?"):
        numbers = np.asarray(variable.values)
    if numbers.dtype.kind not in "fiub":
        raise InputError(f"expected numbers, got {numbers.dtype}", field=field)
    return numbers
