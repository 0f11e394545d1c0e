"""A volume: values at voxel centres; and its formats: VTK (.vti for ParaView), NetCDF, NumPy, MATLAB, text, Tecplot."""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.arrays import make_tensors
from nerif.common.axis_order import order_remedy
from nerif.common.conventions import STATISTICS, InputError, ambient_index
from nerif.common.files import atomic, ending
from nerif.common.netcdf import write_dataset
from nerif.data.quantity_names import INDEX_QUANTITIES, QUANTITIES, describe, field_of, name_of
from nerif.data.vti import write_vti
from nerif.geometry import Grid

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = [
    "COMPONENTS", "FORMATS", "REFERENCES", "Volume", "export", "to_dataset", "write_csv", "write_mat", "write_netcdf",
    "write_npz", "write_tecplot",
]  # fmt: skip

COMPONENTS = ("u", "v", "w")
CELL_METHODS = {"mean": "mean", "std": "standard_deviation"}  # of CF
REFERENCES = "Y. He et al., Neural refractive index field, arXiv:2409.14722"


@dataclass(frozen=True, repr=False)
class Volume:
    """One quantity on a voxel grid."""

    values: Float[Tensor, "z y x"]  #: (z, y, x) at voxel centres, in `unit`
    grid: Grid  #: Grid, mm
    quantity: str = "index_excess"  #: name, such as index_excess
    unit: str = "1"  #: of the values
    attributes: dict[str, float | str] = field(default_factory=dict)
    """Numbers and texts of the whole result, such as n_ambient."""
    notes: dict[str, float | str] = field(default_factory=dict)
    """Those of this quantity, such as assumptions and the number of masked voxels."""

    def __post_init__(self) -> None:
        make_tensors(self, torch.float32, "values")
        if tuple(self.values.shape) != self.grid.shape:
            remedy = order_remedy("values", "zyx", self.grid.shape, self.values.shape)
            raise InputError(
                f"expected values of shape {self.grid.shape} (z, y, x), got {tuple(self.values.shape)}{remedy}",
                field=f"volume '{self.quantity}'",
            )

    @classmethod
    def of(cls, values: Float[Tensor, "z y x"], grid: Grid, quantity: str, n_ambient: float) -> Volume:
        """Return a volume with the unit of its quantity and, of an index, the ambient index."""
        attributes: dict[str, float | str] = {"n_ambient": n_ambient} if quantity in INDEX_QUANTITIES else {}
        return cls(values, grid, quantity, describe(quantity)[0], attributes)

    def masked(self, mask: Bool[Tensor, "z y x"], where: str) -> Volume:
        """Return the volume with NaN in a mask; `where` names the place in its notes."""
        notes = {**self.notes, "masked_voxels": int(mask.sum()), "masked_where": where}
        return replace(self, values=self.values.masked_fill(mask, float("nan")), notes=notes)

    @property
    def n_ambient(self) -> float | None:
        """Ambient refractive index; None if unknown."""
        value = self.attributes.get("n_ambient")
        return None if value is None else ambient_index(value, "attribute n_ambient")

    def relative_to(self, n_ambient: float) -> Volume:
        """Return the index excess n - n_ambient of a volume of n, or of the excess over its own ambient index."""
        if self.quantity not in ("index_excess", "n"):
            raise InputError(f"expected index_excess or n, got '{self.quantity}'")
        ambient = 0.0 if self.quantity == "n" else self.n_ambient
        if ambient is None:
            raise InputError("expected the attribute n_ambient beside index_excess, got none; add it, or give n")
        if ambient == n_ambient:
            return self
        values = (self.values.double() + (ambient - n_ambient)).float()
        attributes = {**self.attributes, "n_ambient": n_ambient}
        return replace(self, values=values, quantity="index_excess", attributes=attributes)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Return the values (z, y, x) as an array."""
        return np.array(self.values.cpu().numpy(), dtype=dtype, copy=copy)

    def to_xarray(self) -> xr.DataArray:
        """Return the values with coordinates x, y, z in mm, unit and attributes."""
        dataset = to_dataset([self])
        return dataset[self.quantity].assign_attrs(dataset.attrs)

    def write(self, path: str | os.PathLike[str], force: bool = False) -> None:
        """Write a file in the format of its ending (.vti, .nc, .npz, .mat, .csv, .dat); over another with `force`."""
        export(path, [self], force)

    def plot(self) -> Figure:
        """Return a figure of the three middle slices."""
        from nerif.plotting.notebook import figure_of_slices

        return figure_of_slices(self)

    def __repr__(self) -> str:
        title, values = describe(self.quantity)[1], np.asarray(self)
        finite = values[np.isfinite(values)]
        unit = "" if self.unit == "1" else f" {self.unit}"
        limits = "masked everywhere"
        if finite.size:
            low, high = np.quantile(finite, [0.001, 0.999])  # without single voxels
            limits = f"{low:.4g} to {high:.4g}{unit} (0.1 to 99.9 %)"
        shape, (x, y, z) = " x ".join(map(str, self.grid.shape)), self.grid.box.edges
        return f"<Volume {self.quantity}: {title}, {limits}; {shape} voxels (z, y, x), {x:g} x {y:g} x {z:g} mm>"

    def summary(self) -> list[tuple[str, str]]:
        """Return names and values with units of a short description."""
        from nerif.plotting.drawing import LABELS, plotted_values
        from nerif.plotting.notebook import span

        shape = " × ".join(str(n) for n in self.grid.shape[::-1])
        edges = " × ".join(f"{e:g}" for e in self.grid.box.edges)
        _, unit = LABELS.get(self.quantity, ("", self.unit))
        name = "n − 1" if self.quantity == "n" else self.quantity.replace("_", " ").capitalize()
        rows = [
            (name, span(plotted_values(self), unit)),
            ("Voxels", f"{shape} (x, y, z)"),
            ("Volume", f"{edges} mm (x, y, z)"),
        ]
        return rows + ([] if self.n_ambient is None else [("Ambient index", f"{self.n_ambient:.7g}")])

    def _repr_html_(self) -> str:
        from nerif.plotting.notebook import panel, show_slices

        title = describe(self.quantity)[1].capitalize()
        return panel(title, self.summary(), (show_slices(self), f"{title} in the three middle slices"))


def export(path: str | os.PathLike[str], volumes: list[Volume], force: bool = False) -> None:
    """Write volumes on one grid in the format of the ending of `path`, one of FORMATS; over a file with `force`."""
    if ending(path) not in FORMATS:
        raise InputError(f"expected a name ending in {', '.join(FORMATS)}, got '{Path(path).suffix}'", field=path)
    if not volumes:
        raise InputError("expected at least one volume, got none", field="volumes")
    if Path(path).exists() and not force:
        raise InputError("exists already and was left as it is; give another name, or force=True", field=path)
    FORMATS[ending(path)](path, volumes)


def write_netcdf(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    """Write volumes on one grid to a NetCDF-4 file with CF conventions, coordinates in mm, atomically."""
    dataset = to_dataset(volumes)
    encoding = {str(name): {"zlib": True, "complevel": 1, "shuffle": True} for name in dataset.data_vars}
    write_dataset(path, dataset, encoding)


def to_dataset(volumes: list[Volume]) -> xr.Dataset:
    """Return the variables and attributes of the file of volumes on one grid."""
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
            raise InputError(
                f"expected the grid of '{volumes[0].quantity}', got another", field=f"volume '{v.quantity}'"
            )
        about = {"units": v.unit, "long_name": describe(v.quantity)[1], **_cf(v.quantity, volumes), **v.notes}
        data[v.quantity] = (("z", "y", "x"), v.values.cpu().numpy(), about)
        attributes |= v.attributes
    dataset = xr.Dataset(data, coords=coordinates)
    dataset.attrs = {
        "Conventions": "CF-1.11",
        "title": f"Field of {name_of(field_of(data) or volumes[0].quantity)}",
        "source": f"nerif {__version__}",
        "history": f"{datetime.now(UTC).isoformat(timespec='seconds')} written by nerif {__version__}",
        "references": REFERENCES,
        **attributes,
        # a single voxel centre does not determine the box
        "box_lower_mm": list(grid.box.lower),
        "box_upper_mm": list(grid.box.upper),
    }
    return dataset


def _cf(quantity: str, volumes: list[Volume]) -> dict[str, str]:
    """Return the CF attributes that relate a quantity and its statistics."""
    base, _, statistic = quantity.rpartition("_")
    if statistic in STATISTICS and base in QUANTITIES:
        return {"cell_methods": f"realization: {CELL_METHODS[statistic]}"} if statistic in CELL_METHODS else {}
    statistics = [v.quantity for v in volumes if v.quantity in [f"{quantity}_{name}" for name in STATISTICS]]
    return {"ancillary_variables": " ".join(statistics)} if statistics else {}


def _write_vti(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    arrays = {v.quantity: v.values for v in volumes}
    if all(name in arrays for name in COMPONENTS):
        arrays["velocity"] = torch.stack([arrays.pop(name) for name in COMPONENTS])
    write_vti(path, arrays, volumes[0].grid, _attributes(volumes))


def _attributes(volumes: list[Volume]) -> dict[str, float | str]:
    """Return the attributes of all, then unit and notes of each quantity as density.assumption and the like."""
    attributes: dict[str, float | str] = {}
    for v in volumes:
        attributes |= v.attributes
    for v in volumes:
        attributes |= {f"{v.quantity}.{name}": value for name, value in {"units": v.unit, **v.notes}.items()}
    return attributes


def write_npz(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    """Write arrays [z, y, x] by quantity, x_mm, y_mm, z_mm, and units and attributes as JSON in `about`."""
    arrays: dict[str, Any] = {v.quantity: v.values.cpu().numpy() for v in volumes}
    arrays |= {f"{a}_mm": volumes[0].grid.axis(a).numpy() for a in "xyz"}
    arrays["about"] = np.array(json.dumps(_attributes(volumes)))
    with atomic(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)


def write_mat(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    """Write a MATLAB 5 file: A(i, j, k) of each quantity is at x_mm(i), y_mm(j), z_mm(k); attributes in `about`.

    For plots with rows along y: isosurface(x_mm, y_mm, z_mm, permute(density, [2 1 3]), level).
    """
    from scipy.io import savemat

    data: dict[str, Any] = {v.quantity: v.values.cpu().numpy().transpose(2, 1, 0) for v in volumes}
    data |= {f"{a}_mm": volumes[0].grid.axis(a).numpy()[:, None] for a in "xyz"}
    data["about"] = {re.sub(r"\W", "_", name): value for name, value in _attributes(volumes).items()}
    with atomic(path) as part, part.open("wb") as file:
        savemat(file, data, do_compression=True, long_field_names=True)


def write_csv(path: str | os.PathLike[str], volumes: list[Volume]) -> None:
    """Write one line per voxel: x, y, z in mm, and the quantities."""
    points = volumes[0].grid.points(torch.float64).reshape(-1, 3)
    columns = [points, *(v.values.cpu().double().reshape(-1, 1) for v in volumes)]
    header = ",".join(["x_mm", "y_mm", "z_mm", *(f"{v.quantity} [{v.unit}]" for v in volumes)])
    with atomic(path) as part:
        np.savetxt(part, torch.cat(columns, dim=1).numpy(), delimiter=",", header=header, comments="", fmt="%.9g")


def write_tecplot(path: str | os.PathLike[str], volumes: list[Volume], time: float | None = None) -> None:
    """Write Tecplot text: an ordered zone, x fastest, with X, Y, Z in mm and the quantities, 0 where they are NaN.

    There QUANTITY_valid is 0, elsewhere 1. A quantity without NaN has none, except at an instant `time` (s) of a film,
    whose files all have the same variables.

    Source: vtkTecplotReader of VTK, which ParaView uses. It takes the coordinates by these names, and stops at NaN.
    """
    grid = volumes[0].grid
    columns, names, formats = [grid.points(torch.float64).reshape(-1, 3)], ["X", "Y", "Z"], ["%.9g"] * 3
    for v in volumes:
        valid = torch.isfinite(v.values.cpu()).reshape(-1, 1)
        columns.append(v.values.cpu().double().reshape(-1, 1).where(valid, 0.0))
        names.append(v.quantity)
        formats.append("%.12g" if v.values.dtype == torch.float64 else "%.9g")
        if time is not None or not bool(valid.all()):
            columns.append(valid.double())
            names.append(f"{v.quantity}_valid")
            formats.append("%d")
    nz, ny, nx = grid.shape
    name, instant = ("volume", "") if time is None else (f"t = {time!r} s", f", STRANDID=1, SOLUTIONTIME={time!r}")
    header = [
        "# X, Y, Z in mm; " + "; ".join(f"{v.quantity} in {v.unit}" for v in volumes),
        'TITLE = "nerif"',
        "VARIABLES = " + ", ".join(f'"{name}"' for name in names),
        f'ZONE T="{name}", I={nx}, J={ny}, K={nz}, DATAPACKING=POINT{instant}',
    ]
    with atomic(path) as part:
        rows = torch.cat(columns, dim=1).numpy()
        np.savetxt(part, rows, header="\n".join(header), comments="", fmt=formats, encoding="utf-8")


FORMATS = {
    ".vti": _write_vti, ".nc": write_netcdf, ".npz": write_npz, ".mat": write_mat, ".csv": write_csv,
    ".dat": write_tecplot,
}  # fmt: skip
