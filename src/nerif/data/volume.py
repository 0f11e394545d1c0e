"""A Volume: values at voxel centres."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import STATISTICS, InputError, ambient_index
from nerif.geometry import Grid

__all__ = ["INDEX", "QUANTITIES", "Volume", "describe", "field_of", "name_of", "quantities_of"]

QUANTITIES = {
    "index_excess": ("1", "refractive index minus that of the ambient"),
    "n": ("1", "refractive index"),
    "density": ("kg m-3", "density"),
    "temperature": ("K", "temperature"),
    "extinction": ("mm-1", "extinction coefficient"),
    "emission": ("mm-1", "radiance per length"),
}
"""Unit and long name of what a volume may hold."""

INDEX = "index_excess"
OF_AN_INDEX = (INDEX, "n", "density", "temperature")


def quantities_of(quantity: str) -> tuple[str, ...]:
    """Return what can be given of a reconstructed field: of an index excess all that follows from it, else itself."""
    return OF_AN_INDEX if quantity == INDEX else (quantity,)


def field_of(quantities: Iterable[str]) -> str | None:
    """Return which of the quantities of one result is the reconstructed field: none of what follows from an index."""
    known = [q for q in quantities if q.rpartition("_")[2] not in STATISTICS and q not in OF_AN_INDEX[1:]]
    return INDEX if INDEX in known else next(iter(known), None)


def name_of(quantity: str) -> str:
    """Return what a field of a quantity is called: an excess is one of refractive index."""
    return describe("n" if quantity == INDEX else quantity)[1]


def describe(quantity: str) -> tuple[str, str]:
    """Return unit and long name of a quantity such as density, or density_std."""
    base, _, statistic = quantity.rpartition("_")
    if statistic in STATISTICS and base in QUANTITIES:
        unit, name = QUANTITIES[base]
        return "1" if statistic == "certainty" else unit, f"{STATISTICS[statistic]} of {name}"
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
                f"expected values of shape {self.grid.shape} (z, y, x), got {tuple(self.values.shape)}",
                field=f"volume '{self.quantity}'",
            )

    @classmethod
    def of(cls, values: Float[Tensor, "z y x"], grid: Grid, quantity: str, n_ambient: float) -> Volume:
        """Return a reconstructed field, or what follows from it, with its unit and, of an index, the ambient."""
        attributes: dict[str, float | str] = {"n_ambient": n_ambient} if quantity in OF_AN_INDEX else {}
        return cls(values, grid, quantity, describe(quantity)[0], attributes)

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
        from nerif.plotting.drawing import LABELS, shown
        from nerif.plotting.notebook import span

        shape = " × ".join(str(n) for n in self.grid.shape[::-1])
        edges = " × ".join(f"{e:g}" for e in self.grid.box.edges)
        _, unit = LABELS.get(self.quantity, ("", self.unit))
        name = "n − 1" if self.quantity == "n" else self.quantity.replace("_", " ").capitalize()
        rows = [(name, span(shown(self), unit)), ("Voxels", f"{shape} (x, y, z)"), ("Volume", f"{edges} mm (x, y, z)")]
        if self.n_ambient is not None:
            rows.append(("Ambient index", f"{self.n_ambient:.7g}"))
        return rows

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the three middle slices, and the summary."""
        from nerif.plotting.notebook import panel, show_slices

        title = describe(self.quantity)[1].capitalize()
        return panel(title, self.summary(), (show_slices(self), f"{title} in the three middle slices"))
