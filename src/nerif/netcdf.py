"""NetCDF-4 files and Zarr stores as they are found: opened lazily, and refused in words where they are damaged."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nerif.conventions import InputError

if TYPE_CHECKING:
    import xarray as xr

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
        raise InputError(f"{path}: no such file; expected {expected}")
    with reading(f"{path}: not a readable NetCDF-4 file, or truncated"):
        with h5py.File(path, "r") as file:
            file.attrs.get("_nc3_strict")  # where this fails, h5netcdf leaves a half-made object that complains later
        dataset = xr.open_dataset(path, engine="h5netcdf", decode_times=False)
    with dataset:
        try:
            yield dataset
        except InputError as error:
            raise InputError(f"{path}: {error}") from None


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
        raise InputError(f"variable '{variable.name}': expected numbers, got {read.dtype}")
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
    except InputError:
        raise
    except Exception as error:  # libraries raise whatever the damage leads them to
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{refusal} ({said})") from None
