"""A Volume: values at voxel centres, and the files it is written to and read from (.nc, .vti)."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.atomic import atomic
from nerif.conventions import LARGEST_INDEX, LARGEST_LENGTH, InputError, ambient_index
from nerif.geometry import Box, Grid
from nerif.netcdf import opened, values

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["QUANTITIES", "Volume", "describe", "read_volume", "read_volumes", "write_netcdf"]

QUANTITIES = {
    "index_excess": ("1", "refractive index minus that of the ambient"),
    "n": ("1", "refractive index"),
    "density": ("kg m-3", "density"),
    "temperature": ("K", "temperature"),
}
"""Unit and long name of what a volume may hold."""

STATISTICS = {"mean": "mean", "std": "standard_deviation"}
"""Endings of what an ensemble adds to a quantity (density_std), and CF's names for them."""

TITLE = "Field of refractive index (background-oriented schlieren)"
REFERENCES = "Y. He et al., Neural refractive index field, arXiv:2409.14722"


def describe(quantity: str) -> tuple[str, str]:
    """Return unit and long name of a quantity such as density, or density_std of an ensemble."""
    base, _, statistic = quantity.rpartition("_")
    if statistic in STATISTICS and base in QUANTITIES:
        unit, name = QUANTITIES[base]
        return unit, f"{STATISTICS[statistic].replace('_', ' ')} of {name} over the ensemble"
    return QUANTITIES.get(quantity, ("1", quantity))


@dataclass(frozen=True)
class Volume:
    """One quantity on a voxel grid.

    Parameters
    ----------
    values : (z, y, x) at voxel centres, in `unit`
    grid : Grid, mm
    quantity : what it is, e.g. "index_excess"
    unit : of the values
    attributes : numbers and texts that belong to the whole field, such as n_ambient
    notes : those that belong to this quantity, such as what was assumed for it and how many voxels are masked
    """

    values: Float[Tensor, "z y x"]
    grid: Grid
    quantity: str = "index_excess"
    unit: str = "1"
    attributes: dict[str, float | str] = field(default_factory=dict)
    notes: dict[str, float | str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if tuple(self.values.shape) != self.grid.shape:
            raise InputError(
                f"volume '{self.quantity}': expected values of shape {self.grid.shape} (z, y, x), "
                f"got {tuple(self.values.shape)}"
            )

    @property
    def n_ambient(self) -> float | None:
        """Refractive index around the flow, from which an excess is counted; None where nobody said."""
        value = self.attributes.get("n_ambient")
        return None if value is None else ambient_index(value, "attribute n_ambient")

    def relative_to(self, n_ambient: float) -> Volume:
        """Return the index excess over `n_ambient`: n - n_ambient, with n = excess + n_ambient of the volume itself.

        Raises
        ------
        InputError
            If it holds another quantity, or an excess and nobody said over which ambient.
        """
        if self.quantity not in ("index_excess", "n"):
            raise InputError(f"expected index_excess or n, got '{self.quantity}'")
        own = 0.0 if self.quantity == "n" else self.n_ambient
        if own is None:
            raise InputError(
                "expected the attribute n_ambient, from which its index_excess is counted, got none; add it, or give n"
            )
        if own == n_ambient:
            return self
        values = (self.values.double() + (own - n_ambient)).float()
        return replace(
            self, values=values, quantity="index_excess", attributes={**self.attributes, "n_ambient": n_ambient}
        )

    def summary(self) -> list[tuple[str, str]]:
        """Return what it holds as names and values with units."""
        from nerif.drawing import shown
        from nerif.notebook import span

        shape = " × ".join(str(n) for n in self.grid.shape[::-1])
        edges = " × ".join(f"{e:g}" for e in self.grid.box.edges)
        unit = "" if self.unit == "1" else f" {self.unit}"
        name = "n − 1" if self.quantity == "n" else self.quantity.replace("_", " ").capitalize()
        rows = [(name, span(shown(self), unit)), ("Voxels", f"{shape} (x, y, z)"), ("Volume", f"{edges} mm (x, y, z)")]
        if self.n_ambient is not None:
            rows.append(("Ambient index", f"{self.n_ambient:.7g}"))
        return rows

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the three middle slices, and the summary."""
        from nerif.notebook import panel, show_slices

        title = describe(self.quantity)[1].capitalize()
        return panel(title, self.summary(), show_slices(self), f"{title} in the three middle slices")


def write_netcdf(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    """Write volumes on one grid to a NetCDF-4 file by the CF conventions, coordinates in mm, atomically."""
    from datetime import UTC, datetime

    import xarray as xr

    from nerif import __version__

    grid = volumes[0].grid
    coordinates = {
        a: (a, grid.axis(a).numpy(), {"units": "mm", "axis": a.upper(), "long_name": f"{a} of the voxel centre"})
        for a in "zyx"
    }
    data: dict[str, tuple] = {}
    attributes: dict[str, float | str] = {}
    for v in volumes:
        if v.grid != grid:
            raise InputError(f"volume '{v.quantity}': expected the grid of '{volumes[0].quantity}', got another")
        about = {"units": v.unit, "long_name": describe(v.quantity)[1], **_cf(v.quantity, volumes), **v.notes}
        data[v.quantity] = (("z", "y", "x"), v.values.cpu().numpy(), about)
        attributes |= v.attributes
    dataset = xr.Dataset(data, coords=coordinates)
    written = f"{datetime.now(UTC).isoformat(timespec='seconds')} written by nerif {__version__}"
    dataset.attrs = {"Conventions": "CF-1.11", "title": TITLE, "source": f"nerif {__version__}", "history": written}
    dataset.attrs |= {"references": REFERENCES, **attributes}
    # the box cannot be told from one voxel centre alone
    dataset.attrs["box_lower_mm"], dataset.attrs["box_upper_mm"] = list(grid.box.lower), list(grid.box.upper)
    with atomic(path) as part:
        dataset.to_netcdf(part, engine="h5netcdf", encoding={k: {"zlib": True, "complevel": 4} for k in data})


def _cf(quantity: str, volumes: list[Volume]) -> dict[str, str]:
    """How CF says that one variable is the spread of another."""
    base, _, statistic = quantity.rpartition("_")
    if statistic in STATISTICS and base in QUANTITIES:
        return {"cell_methods": f"realization: {STATISTICS[statistic]}"}
    beside = [v.quantity for v in volumes if v.quantity in (f"{quantity}_mean", f"{quantity}_std")]
    return {"ancillary_variables": " ".join(beside)} if beside else {}


def read_volume(path: str | os.PathLike[str], quantity: str | None = None) -> Volume:
    """Read one quantity of a .nc or .vti file as a Volume.

    Without `quantity`, index_excess is taken, or n, or the only variable there is. n becomes the index excess where the
    file says its n_ambient, and stays n, in double precision, where it does not.

    Raises
    ------
    InputError
        If the file is missing, of another kind, or lacks the quantity.
    """
    arrays, grid, attributes = _read(Path(path))
    if quantity is None:
        known = [q for q in ("index_excess", "n") if q in arrays]
        quantity = known[0] if known else next(iter(arrays)) if len(arrays) == 1 else None
    if quantity is None or quantity not in arrays:
        raise InputError(
            f"{path}: expected a variable '{quantity or 'index_excess'}', got {', '.join(arrays) or 'none on z, y, x'}"
        )
    volume = _volume(quantity, arrays[quantity], grid, attributes)
    index = quantity in ("index_excess", "n")
    if (index or "masked_voxels" not in volume.notes) and not bool(torch.isfinite(volume.values).all()):
        raise InputError(f"{path}: variable '{quantity}' holds NaN or infinite values; fill them first")
    if index and not bool((volume.values.abs() <= LARGEST_INDEX).all()):
        raise InputError(f"{path}: variable '{quantity}': expected refractive indices, got some beyond {LARGEST_INDEX}")
    try:
        n_ambient = volume.n_ambient
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if quantity == "n" and n_ambient is not None:
        return Volume((volume.values - n_ambient).float(), grid, "index_excess", "1", volume.attributes)
    return volume


def read_volumes(path: str | os.PathLike[str]) -> dict[str, Volume]:
    """Read every quantity of a .nc or .vti file, masked voxels as NaN.

    Raises
    ------
    InputError
        If the file is missing or of another kind.
    """
    arrays, grid, attributes = _read(Path(path))
    return {quantity: _volume(quantity, values, grid, attributes) for quantity, values in arrays.items()}


def _read(path: Path) -> tuple[dict[str, Tensor], Grid, dict[str, float | str]]:
    """Arrays by name, and attributes: those of one quantity as density.assumption and the like."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a volume (.nc or .vti)")
    if path.suffix == ".nc":
        return _read_netcdf(path)
    if path.suffix == ".vti":
        from nerif.vti import read_vti

        return read_vti(path)
    raise InputError(f"{path}: expected a volume in .nc or .vti, got '{path.suffix or path.name}'")


def _volume(quantity: str, values: Tensor, grid: Grid, attributes: dict[str, float | str]) -> Volume:
    own = f"{quantity}."
    notes = {k.removeprefix(own): v for k, v in attributes.items() if k.startswith(own) and k != f"{own}units"}
    shared = {k: v for k, v in attributes.items() if "." not in k}
    values = values.double() if quantity == "n" else values.float()
    return Volume(values, grid, quantity, describe(quantity)[0], shared, notes)


def _read_netcdf(path: Path) -> tuple[dict[str, Tensor], Grid, dict[str, float | str]]:
    with opened(path, "a volume (.nc or .vti)") as dataset:
        return _contents(dataset)


def _contents(dataset: xr.Dataset) -> tuple[dict[str, Tensor], Grid, dict[str, float | str]]:
    for axis in "zyx":
        if axis not in dataset.coords:
            raise InputError(f"expected a volume with coordinates z, y, x in mm, got {list(dataset.coords)}")
    ends = [_ends(dataset, axis) for axis in "xyz"]
    lower, upper = zip(*ends, strict=True)
    grid = Grid(Box(lower, upper), (dataset.sizes["z"], dataset.sizes["y"], dataset.sizes["x"]))
    arrays = {}
    for key, variable in dataset.data_vars.items():
        name, unit = str(key), variable.attrs.get("units")
        if set(variable.dims) == {"z", "y", "x"}:
            expected = describe(name)[0]
            if name in QUANTITIES and unit is not None and not (isinstance(unit, str) and unit == expected):
                raise InputError(f"variable '{name}': expected units '{expected}', got '{unit}'")
            numbers = values(variable.transpose("z", "y", "x"))
            kind = np.float32 if numbers.dtype.itemsize <= 4 else np.float64
            arrays[name] = torch.from_numpy(np.ascontiguousarray(numbers.astype(kind)))
    found = dict(dataset.attrs)
    for key, variable in dataset.data_vars.items():
        found |= {f"{key}.{k}": v for k, v in variable.attrs.items()}
    attributes: dict[str, float | str] = {
        str(k): v if isinstance(v, str) else float(v)
        for k, v in found.items()
        if isinstance(v, str | int | float | np.number)
    }
    return arrays, grid, attributes


def _ends(dataset: xr.Dataset, axis: str) -> tuple[float, float]:
    """Where the box begins and ends along an axis, mm, by the attributes where they fit, else by the voxel centres."""
    unit = dataset[axis].attrs.get("units", "mm")
    if not (isinstance(unit, str) and unit == "mm"):
        raise InputError(f"coordinate '{axis}': expected units 'mm', got '{unit}'")
    centres = values(dataset[axis]).astype(np.float64)
    if not (np.abs(centres) <= LARGEST_LENGTH).all():
        raise InputError(f"coordinate '{axis}': expected voxel centres in mm, got {centres.tolist()[:4]} ...")
    corners = [np.asarray(dataset.attrs.get(name)) for name in ("box_lower_mm", "box_upper_mm")]
    if len(centres) and all(c.shape == (3,) and c.dtype.kind in "fiu" for c in corners):
        lower, upper = (float(c["xyz".index(axis)]) for c in corners)
        edge = (upper - lower) / len(centres)
        # a part cut out of the volume has the whole's attributes, but not its coordinates
        if np.allclose(centres, lower + (np.arange(len(centres)) + 0.5) * edge, rtol=0, atol=1e-3 * abs(edge)):
            return lower, upper
    steps = np.diff(centres)
    if len(steps) == 0 or not steps.mean() > 0 or not np.allclose(steps, steps.mean(), rtol=1e-3):
        raise InputError(f"expected equally spaced, rising voxel centres along {axis} (mm)")
    return float(centres[0] - steps.mean() / 2), float(centres[-1] + steps.mean() / 2)
