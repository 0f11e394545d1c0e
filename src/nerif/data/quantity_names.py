"""Quantities of volumes: names, units, and which follow from which."""

from __future__ import annotations

from collections.abc import Iterable

from nerif.common.conventions import STATISTICS

__all__ = [
    "FLOW_QUANTITIES", "INDEX", "INDEX_QUANTITIES", "QUANTITIES", "describe", "field_of", "name_of", "quantities_of",
]  # fmt: skip

QUANTITIES = {
    "index_excess": ("1", "refractive index minus that of the ambient"),
    "n": ("1", "refractive index"),
    "density": ("kg m-3", "density"),
    "temperature": ("K", "temperature"),
    "mole_fraction": ("1", "mole fraction"),
    "mass_fraction": ("1", "mass fraction"),
    "static_pressure": ("Pa", "static pressure"),
    "mach": ("1", "Mach number"),
    "pressure_coefficient": ("1", "pressure coefficient"),
    "salinity": ("g kg-1", "salinity"),
    "electron_density": ("m-3", "electron density"),
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
INDEX_QUANTITIES = (INDEX, *(name for name in QUANTITIES if name not in (INDEX, "extinction", "emission")))


def quantities_of(quantity: str) -> tuple[str, ...]:
    """Return the quantities that follow from a reconstructed field in some medium."""
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
