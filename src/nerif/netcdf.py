"""NetCDF-4 files that others wrote: opened lazily, and refused in words where they are damaged."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from nerif.conventions import InputError

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["opened", "reason"]


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
    try:
        h5py.File(path, "r").close()  # h5netcdf leaves a half-made object behind where this fails
        dataset = xr.open_dataset(path, engine="h5netcdf", decode_times=False)
    except Exception as error:  # the libraries raise whatever the damage leads them to
        raise InputError(f"{path}: not a readable NetCDF-4 file, or truncated ({reason(error)})") from None
    with dataset:
        try:
            yield dataset
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        except (OSError, RuntimeError) as error:
            raise InputError(f"{path}: not a readable NetCDF-4 file, or truncated ({reason(error)})") from None


def reason(error: Exception) -> str:
    """Return the first line of what a library says, or at least the kind of its error."""
    return str(error).splitlines()[0] if str(error) else type(error).__name__
