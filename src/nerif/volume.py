"""A Volume: values at voxel centres, and the files it is written to and read from (.nc, .vti)."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import InputError
from nerif.geometry import Box, Grid

__all__ = ["Volume", "read_volume", "write_netcdf"]

QUANTITIES = {
    "index_excess": ("1", "refractive index minus that of the ambient"),
    "n": ("1", "refractive index"),
    "density": ("kg m-3", "density"),
    "temperature": ("K", "temperature"),
}
"""Unit and long name of what a volume may hold."""


@dataclass(frozen=True)
class Volume:
    """One quantity on a voxel grid.

    Parameters
    ----------
    values : (z, y, x) at voxel centres, in `unit`
    grid : Grid, mm
    quantity : what it is, e.g. "index_excess"
    unit : of the values
    attributes : numbers and texts that belong to it, such as n_ambient
    """

    values: Float[Tensor, "z y x"]
    grid: Grid
    quantity: str = "index_excess"
    unit: str = "1"
    attributes: dict[str, float | str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if tuple(self.values.shape) != self.grid.shape:
            raise InputError(
                f"volume '{self.quantity}': expected values of shape {self.grid.shape} (z, y, x), "
                f"got {tuple(self.values.shape)}"
            )


def write_netcdf(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    """Write volumes on one grid to a NetCDF-4 file with coordinates x, y, z in mm, atomically."""
    import xarray as xr

    grid = volumes[0].grid
    coordinates = {a: (a, grid.axis(a).numpy(), {"units": "mm", "axis": a.upper()}) for a in "zyx"}
    data = {}
    for v in volumes:
        if v.grid != grid:
            raise InputError(f"volume '{v.quantity}': expected the grid of '{volumes[0].quantity}', got another")
        long_name = QUANTITIES.get(v.quantity, (v.unit, v.quantity))[1]
        data[v.quantity] = (("z", "y", "x"), v.values.cpu().numpy(), {"units": v.unit, "long_name": long_name})
    dataset = xr.Dataset(data, coords=coordinates)
    dataset.attrs = {"Conventions": "CF-1.8", **volumes[0].attributes}
    # the box cannot be told from one voxel centre alone
    dataset.attrs["box_lower_mm"], dataset.attrs["box_upper_mm"] = list(grid.box.lower), list(grid.box.upper)
    temporary = Path(f"{os.fspath(path)}.part")
    dataset.to_netcdf(temporary, engine="h5netcdf", encoding={k: {"zlib": True, "complevel": 4} for k in data})
    os.replace(temporary, path)


def read_volume(path: str | os.PathLike[str], quantity: str | None = None) -> Volume:
    """Read one quantity of a .nc or .vti file as a Volume.

    Without `quantity`, index_excess is taken, or n with the file's n_ambient, or the only variable there is.

    Raises
    ------
    InputError
        If the file is missing, of another kind, or lacks the quantity.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a volume (.nc or .vti)")
    if path.suffix == ".nc":
        arrays, grid, attributes = _read_netcdf(path)
    elif path.suffix == ".vti":
        from nerif.vti import read_vti

        arrays, grid, attributes = read_vti(path)
    else:
        raise InputError(f"{path}: expected a volume in .nc or .vti, got '{path.suffix or path.name}'")
    return _choose(path, arrays, grid, attributes, quantity)


def _choose(
    path: Path,
    arrays: dict[str, Tensor],
    grid: Grid,
    attributes: dict[str, float | str],
    quantity: str | None,
) -> Volume:
    if quantity is None:
        known = [q for q in ("index_excess", "n") if q in arrays]
        quantity = known[0] if known else next(iter(arrays)) if len(arrays) == 1 else None
    if quantity is None or quantity not in arrays:
        raise InputError(
            f"{path}: expected a variable '{quantity or 'index_excess'}', got {', '.join(arrays) or 'none on z, y, x'}"
        )
    values = arrays[quantity]
    if not bool(torch.isfinite(values).all()):
        raise InputError(f"{path}: variable '{quantity}' holds NaN or infinite values; fill them first")
    if quantity == "n":
        n_ambient = float(attributes.get("n_ambient", 1.0))
        return Volume((values.double() - n_ambient).float(), grid, "index_excess", "1", attributes)
    return Volume(values.float(), grid, quantity, QUANTITIES.get(quantity, ("1",))[0], attributes)


def _read_netcdf(path: Path) -> tuple[dict[str, Tensor], Grid, dict[str, float | str]]:
    import numpy as np
    import xarray as xr

    try:
        dataset = xr.load_dataset(path, engine="h5netcdf")
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: not a readable NetCDF-4 file, or truncated ({error})") from None
    for axis in "zyx":
        if axis not in dataset.coords:
            raise InputError(f"{path}: expected a volume with coordinates z, y, x in mm, got {list(dataset.coords)}")
    lower, upper = [], []
    for axis in "xyz":
        centres = dataset[axis].values.astype(np.float64)
        given = dataset.attrs.get("box_lower_mm"), dataset.attrs.get("box_upper_mm")
        if given[0] is not None and given[1] is not None:
            lower.append(float(given[0]["xyz".index(axis)]))
            upper.append(float(given[1]["xyz".index(axis)]))
            continue
        steps = np.diff(centres)
        if len(steps) == 0 or not np.allclose(steps, steps.mean(), rtol=1e-3) or steps.mean() <= 0:
            raise InputError(f"{path}: expected equally spaced, rising voxel centres along {axis} (mm)")
        lower.append(float(centres[0] - steps.mean() / 2))
        upper.append(float(centres[-1] + steps.mean() / 2))
    shape = (dataset.sizes["z"], dataset.sizes["y"], dataset.sizes["x"])
    grid = Grid(Box((lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2])), shape)
    arrays = {
        str(name): torch.from_numpy(np.ascontiguousarray(v.transpose("z", "y", "x").values))
        for name, v in dataset.data_vars.items()
        if set(v.dims) == {"z", "y", "x"}
    }
    attributes: dict[str, float | str] = {
        str(k): v if isinstance(v, str) else float(v)
        for k, v in dataset.attrs.items()
        if isinstance(v, str | int | float | np.number)
    }
    return arrays, grid, attributes
