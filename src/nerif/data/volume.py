"""A Volume: values at voxel centres."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.arrays import make_tensors
from nerif.common.axis_order import order_remedy
from nerif.common.conventions import STATISTICS, InputError, ambient_index
from nerif.geometry import Grid

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = ["FLOW_QUANTITIES", "INDEX", "QUANTITIES", "Volume", "describe", "field_of", "name_of", "quantities_of"]

QUANTITIES = {
    "index_excess": ("1", "refractive index minus that of the ambient"),
    "n": ("1", "refractive index"),
    "density": ("kg m-3", "density"),
    "temperature": ("K", "temperature"),
    "extinction": ("mm-1", "extinction coefficient"),
    "emission": ("mm-1", "radiance per length"),
}
"""Unit and long name of the quantities of volumes."""

FLOW_QUANTITIES = {
    "u": ("m s-1", "velocity along x"),
    "v": ("m s-1", "velocity along y"),
    "w": ("m s-1", "velocity along z"),
    "speed": ("m s-1", "speed"),
    "vorticity": ("s-1", "magnitude of the vorticity"),
    "pressure": ("Pa", "pressure relative to its mean"),
    "transport_residual": ("s-1", "change of density / reference density that the velocity does not explain"),
    "momentum_residual": ("m s-2", "acceleration that the equation of momentum does not explain"),
}
"""Unit and long name of the quantities of a flow."""

INDEX = "index_excess"
INDEX_QUANTITIES = (INDEX, "n", "density", "temperature")


def quantities_of(quantity: str) -> tuple[str, ...]:
    """Return the quantities that follow from a reconstructed field."""
    return INDEX_QUANTITIES if quantity == INDEX else (quantity,)


def field_of(quantities: Iterable[str]) -> str | None:
    """Return which of the quantities of a result is the reconstructed field."""
    fields = [q for q in quantities if q.rpartition("_")[2] not in STATISTICS and q not in INDEX_QUANTITIES[1:]]
    return INDEX if INDEX in fields else next(iter(fields), None)


def name_of(quantity: str) -> str:
    """Return the name of the reconstructed field, such as refractive index."""
    return describe("n" if quantity == INDEX else quantity)[1]


def describe(quantity: str) -> tuple[str, str]:
    """Return unit and long name of a quantity such as density, or density_std."""
    base, _, statistic = quantity.rpartition("_")
    names = QUANTITIES | FLOW_QUANTITIES
    if statistic in STATISTICS and base in names:
        unit, name = names[base]
        return "1" if statistic == "certainty" else unit, f"{STATISTICS[statistic]} of {name}"
    return names.get(quantity, ("1", quantity))


@dataclass(frozen=True, repr=False)
class Volume:
    """One quantity on a voxel grid.

    Parameters
    ----------
    values : (z, y, x) at voxel centres, in `unit`
    grid : Grid, mm
    quantity : name, such as index_excess
    unit : of the values
    attributes : numbers and texts of the whole result, such as n_ambient
    notes : those of this quantity, such as assumptions and the number of masked voxels
    """

    values: Float[Tensor, "z y x"]
    grid: Grid
    quantity: str = "index_excess"
    unit: str = "1"
    attributes: dict[str, float | str] = field(default_factory=dict)
    notes: dict[str, float | str] = field(default_factory=dict)

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
        from nerif.data.volume_file import to_dataset

        dataset = to_dataset([self])
        return dataset[self.quantity].assign_attrs(dataset.attrs)

    def write(self, path: str | os.PathLike[str], force: bool = False) -> None:
        """Write a file in the format of its ending (.vti, .nc, .npz, .mat, .csv); over another with `force`."""
        from nerif.data.exports import export

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
