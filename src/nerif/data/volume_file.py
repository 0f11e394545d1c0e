"""Volumes read from NetCDF and VTK images."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from nerif.common.conventions import LARGEST_INDEX, LARGEST_LENGTH, InputError, within
from nerif.common.files import ending, instead_of_file
from nerif.common.netcdf import opened, values
from nerif.data.kinds import VOLUME, reading_as
from nerif.data.quantity_names import QUANTITIES, describe, field_of
from nerif.data.volume import Volume
from nerif.data.vti import read_vti
from nerif.geometry import Box, Grid

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["read_volume", "read_volumes"]

Content = tuple[dict[str, Tensor], Grid, dict[str, float | str]]  # arrays, grid, attributes


def read_volume(path: str | os.PathLike[str], quantity: str | None = None, gaps: bool = False) -> Volume:
    """Read one quantity of a .nc or .vti file.

    By default index_excess, else n, another reconstructed field, or the only variable. n becomes the index excess where
    the file has n_ambient, else it stays n in double precision. With `gaps` an index may be NaN, as within a body.
    """
    arrays, grid, attributes = _read(Path(path))
    if quantity is None:
        only = next(iter(arrays)) if len(arrays) == 1 else field_of(q for q in arrays if q in QUANTITIES)
        quantity = next((q for q in ("index_excess", "n") if q in arrays), only)
    if quantity is None or quantity not in arrays:
        raise InputError(f"expected a variable '{quantity or 'index_excess'}', got {', '.join(arrays)}", field=path)
    volume = _volume(quantity, arrays[quantity], grid, attributes)
    index = quantity in ("index_excess", "n")
    allowed = gaps or (not index and "masked_voxels" in volume.notes)
    finite = torch.isfinite(volume.values)
    if not bool(finite.all()) and (not allowed or (index and not bool(finite.any()))):
        raise InputError(f"variable '{quantity}': expected finite values, got NaN or infinity; fill them", field=path)
    if index and not bool((volume.values[finite].abs() <= LARGEST_INDEX).all()):
        raise InputError(
            f"variable '{quantity}': expected refractive indices, got values beyond {LARGEST_INDEX}", field=path
        )
    with within(path):
        n_ambient = volume.n_ambient
    if quantity == "n" and n_ambient is not None:
        return Volume((volume.values - n_ambient).float(), grid, "index_excess", "1", volume.attributes)
    return volume


def read_volumes(path: str | os.PathLike[str]) -> dict[str, Volume]:
    """Read every quantity of a .nc or .vti file, masked voxels as NaN."""
    arrays, grid, attributes = _read(Path(path))
    return {quantity: _volume(quantity, values, grid, attributes) for quantity, values in arrays.items()}


def _read(path: Path) -> Content:
    """Return the content of a file; attributes of one quantity under density.assumption and the like."""
    with reading_as(path, VOLUME):
        content = _read_as_ending(path)
        if not content[0]:
            raise InputError("expected a variable 'index_excess', got none on z, y, x", field=path)
        return content


def _read_as_ending(path: Path) -> Content:
    if not path.is_file():
        raise InputError(f"{instead_of_file(path)}; expected a volume (.nc or .vti)", field=path)
    if ending(path) == ".nc":
        with opened(path, "a volume (.nc or .vti)") as dataset:
            return _content(dataset)
    if ending(path) == ".vti":
        return read_vti(path)
    raise InputError(f"expected a volume in .nc or .vti, got '{path.suffix or path.name}'", field=path)


def _volume(quantity: str, values: Tensor, grid: Grid, attributes: Mapping[str, float | str]) -> Volume:
    prefix = f"{quantity}."
    notes = {k.removeprefix(prefix): v for k, v in attributes.items() if k.startswith(prefix) and k != f"{prefix}units"}
    shared = {k: v for k, v in attributes.items() if "." not in k}
    values = values.double() if quantity == "n" else values.float()
    return Volume(values, grid, quantity, describe(quantity)[0], shared, notes)


def _content(dataset: xr.Dataset) -> Content:
    for axis in "zyx":
        if axis not in dataset.coords:
            raise InputError(f"expected a volume with coordinates z, y, x in mm, got {list(dataset.coords)}")
    lower, upper = zip(*(_ends(dataset, axis) for axis in "xyz"), strict=True)
    grid = Grid(Box(lower, upper), (dataset.sizes["z"], dataset.sizes["y"], dataset.sizes["x"]))
    arrays: dict[str, Tensor] = {}
    every: dict[str, Any] = {str(k): v for k, v in dataset.attrs.items()}
    for key, variable in dataset.data_vars.items():
        every |= {f"{key}.{k}": v for k, v in variable.attrs.items()}
        name, unit = str(key), variable.attrs.get("units")
        if set(variable.dims) == {"z", "y", "x"}:
            expected = describe(name)[0]
            if name in QUANTITIES and unit is not None and not (isinstance(unit, str) and unit == expected):
                raise InputError(f"expected units '{expected}', got '{unit}'", field=f"variable '{name}'")
            numbers = values(variable.transpose("z", "y", "x"))
            kind = np.float32 if numbers.dtype.itemsize <= 4 else np.float64
            arrays[name] = torch.from_numpy(np.ascontiguousarray(numbers.astype(kind)))
    attributes: dict[str, float | str] = {
        k: v if isinstance(v, str) else float(v)
        for k, v in every.items()
        if isinstance(v, str | int | float | np.number)
    }
    return arrays, grid, attributes


def _ends(dataset: xr.Dataset, axis: str) -> tuple[float, float]:
    """Return the limits of the box along an axis, mm: from the attributes if consistent, else from voxel centres."""
    unit, field = dataset[axis].attrs.get("units", "mm"), f"coordinate '{axis}'"
    if not (isinstance(unit, str) and unit == "mm"):
        raise InputError(f"expected units 'mm', got '{unit}'", field=field)
    centres = values(dataset[axis]).astype(np.float64)
    if not (np.abs(centres) <= LARGEST_LENGTH).all():
        raise InputError(f"expected voxel centres in mm, got {centres.tolist()[:4]} ...", field=field)
    corners = [np.asarray(dataset.attrs.get(name)) for name in ("box_lower_mm", "box_upper_mm")]
    if len(centres) and all(c.shape == (3,) and c.dtype.kind in "fiu" for c in corners):
        lower, upper = (float(c["xyz".index(axis)]) for c in corners)
        edge = (upper - lower) / len(centres)
        # a part of a volume has the attributes of the whole, but not its coordinates
        if np.allclose(centres, lower + (np.arange(len(centres)) + 0.5) * edge, rtol=0, atol=1e-3 * abs(edge)):
            return lower, upper
    steps = np.diff(centres)
    if len(steps) == 0 or not steps.mean() > 0 or not np.allclose(steps, steps.mean(), rtol=1e-3):
        raise InputError("expected equally spaced, increasing voxel centres, mm", field=field)
    return float(centres[0] - steps.mean() / 2), float(centres[-1] + steps.mean() / 2)
