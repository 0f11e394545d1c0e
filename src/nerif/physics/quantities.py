"""n, density and temperature from the index excess."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor

from nerif.common.conventions import InputError, percent
from nerif.data.volume import QUANTITIES, Volume, quantities_of
from nerif.physics.gas_optics import density_from_index, gladstone_dale, molar_mass, temperature_from_density

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement

__all__ = ["NOT_UNIFORM", "GasChanges", "GasSettings", "derive", "derive_all", "deviation", "masked_lines"]

TEMPERATURE_RANGE = 200.0, 4000.0
"""K; outside, gases of the table condense or dissociate."""

BOTH_SIGNS, EXTREME = 0.4, 1e-3
"""Ratio of the smaller to the larger extreme of the density differences above and below ambient from which compression
and expansion are assumed (in a flow at uniform pressure the smaller is the error of the field); share of the voxels
beyond each extreme."""

NOT_UNIFORM = (
    "the pressure is not uniform (density is both above and below ambient, as behind compression and expansion waves); "
    "--gas.uniform-pressure yes computes temperature anyway"
)


@dataclass(frozen=True)
class GasSettings:
    """Gas of density and temperature."""

    composition: str = "air"
    """Gas or mixture by mole fractions, e.g. "CH4:0.11, air:0.89"; one composition is assumed throughout."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm."""
    pressure_pa: float = 101325.0
    """Pressure, Pa; assumed uniform."""
    uniform_pressure: Literal["auto", "yes", "no"] = "auto"
    """Whether the pressure is uniform, so that temperature follows from density; auto: yes, unless density is both well
    above and well below ambient, as behind compression and expansion waves."""

    def __post_init__(self) -> None:
        if not 0 < self.pressure_pa < math.inf:
            raise InputError(f"expected a positive pressure in Pa, got {self.pressure_pa}", field="pressure_pa")

    def for_measurement(self, measurement: Measurement) -> GasSettings:
        """Return the settings at the wavelength of a measurement, if it has one, and refuse invalid ones."""
        if "density" not in quantities_of(measurement.quantity):
            return self
        wavelength = measurement.wavelength_nm
        gas = self if wavelength is None else replace(self, wavelength_nm=wavelength)
        density_from_index(0.0, measurement.n_ambient, gladstone_dale(gas.composition, gas.wavelength_nm))
        return gas

    def for_field(self, excess: Volume) -> GasSettings:
        """Return the settings with yes or no for the uniform pressure of a field."""
        if self.uniform_pressure != "auto":
            return self
        low, high = np.quantile(excess.values.nan_to_num(0.0).numpy(), [EXTREME, 1 - EXTREME])
        both = min(high, -low) > BOTH_SIGNS * max(high, -low)
        return replace(self, uniform_pressure="no" if both else "yes")

    def quantities_of(self, excess: Volume) -> tuple[str, ...]:
        """Return the quantities of a field: without temperature if the pressure is not uniform."""
        uniform = self.for_field(excess).uniform_pressure == "yes"
        return tuple(q for q in quantities_of(excess.quantity) if uniform or q != "temperature")


@dataclass(frozen=True)
class GasChanges:
    """Changes to the gas of a result."""

    composition: str | None = None
    """Gas or mixture by mole fractions, e.g. "CH4:0.11, air:0.89"; default: that of the result."""
    wavelength_nm: float | None = None
    """Wavelength of the light, nm; default: that of the result."""
    pressure_pa: float | None = None
    """Pressure, Pa; default: that of the result."""
    uniform_pressure: Literal["auto", "yes", "no"] | None = None
    """Whether the pressure is uniform, so that temperature follows from density; default: that of the result."""

    def of(self, settings: Mapping[str, Any]) -> GasSettings:
        """Return the gas in the settings of a run (run.toml) with the changes."""
        changes = {name: value for name, value in vars(self).items() if value is not None}
        stored = {name: value for name, value in settings.get("gas", {}).items() if name in vars(self)}
        return GasSettings(**stored | changes)


def derive(excess: Volume, quantity: str, gas: GasSettings) -> Volume:
    """Return n, density (Gladstone-Dale) or temperature (ideal gas) from a volume of index excess.

        rho = (n - 1) / K,      T = p M / (R rho)

    Values outside the relations (n - 1 <= 0, temperature outside 200 to 4000 K or at non-uniform pressure) are NaN; the
    notes contain their number and the assumptions.

    Parameters
    ----------
    excess : volume with n_ambient in its attributes
    quantity : index_excess, n, density or temperature
    """
    quantities = quantities_of(excess.quantity)
    if quantity not in quantities:
        raise InputError(f"expected one of {', '.join(quantities)}, got '{quantity}'", field="quantity")
    if quantity == excess.quantity:
        return excess
    n_ambient = float(excess.attributes["n_ambient"])
    if quantity == "n":
        return replace(excess, values=excess.values.double() + n_ambient, quantity="n")
    k = gladstone_dale(gas.composition, gas.wavelength_nm)
    attributes = excess.attributes | {
        "gas": gas.composition, "wavelength_nm": gas.wavelength_nm, "gladstone_dale_m3_kg-1": k,
    }  # fmt: skip
    assumption = (
        f"n - 1 = K rho (Gladstone-Dale) with K = {k:.5g} m3/kg of {gas.composition} at {gas.wavelength_nm:g} nm, "
        "one composition throughout"
    )
    density = density_from_index(excess.values.double(), n_ambient, k)
    if quantity == "density":
        values, where = density.masked_fill(~(density > 0), math.nan), "n - 1 <= 0"
    else:
        mass, (low, high) = molar_mass(gas.composition), TEMPERATURE_RANGE
        attributes |= {"pressure_pa": gas.pressure_pa, "molar_mass_kg_mol-1": mass}
        assumption = (
            f"T = p M / (R rho), an ideal gas of M = {mass * 1e3:.4g} g/mol ({gas.composition}) "
            f"at a uniform pressure of {gas.pressure_pa:g} Pa; {assumption}"
        )
        values = temperature_from_density(density, gas.pressure_pa, mass)
        values = values.masked_fill((values < low) | (values > high), math.nan)
        where = f"n - 1 <= 0, or temperature beyond {low:g} to {high:g} K"
        if gas.for_field(excess).uniform_pressure == "no":
            values, where = torch.full_like(values, math.nan), NOT_UNIFORM
    count, earlier = int(torch.isnan(values).sum()), int(excess.notes.get("masked_voxels", 0))
    if earlier:
        where = f"{excess.notes['masked_where']}, or {where}" if count > earlier else str(excess.notes["masked_where"])
    notes: dict[str, float | str] = {"assumption": assumption, "masked_voxels": count, "masked_where": where}
    return Volume(values.float(), excess.grid, quantity, QUANTITIES[quantity][0], attributes, notes)


def deviation(excess: Volume, std: Tensor, quantity: str, gas: GasSettings) -> Tensor:
    """Return the standard deviation of n, density or temperature to first order; NaN where the quantity is.

        std(n) = std,      std(rho) = std / K,      std(T) = T std(rho) / rho

    Parameters
    ----------
    std : (z, y, x) standard deviation of the values of `excess`
    """
    if quantity in (excess.quantity, "n"):
        return std
    derived, density = derive(excess, quantity, gas), derive(excess, "density", gas)
    of_density = std / float(derived.attributes["gladstone_dale_m3_kg-1"])
    return of_density * derived.values.double() / density.values.double()


def derive_all(excess: Volume, gas: GasSettings) -> list[Volume]:
    """Return index_excess, n, density and, at uniform pressure, temperature; other quantities unchanged."""
    return [derive(excess, quantity, gas) for quantity in gas.quantities_of(excess)]


def masked_lines(volumes: list[Volume]) -> list[str]:
    """Return a line with number and reason for each quantity with masked voxels."""
    lines = []
    for v in volumes:
        count = int(v.notes.get("masked_voxels", 0))
        if count:
            share = f"{count} of {v.values.numel()} voxels ({percent(count / v.values.numel(), 2)})"
            lines.append(f"{v.quantity}: {share} are NaN: {v.notes['masked_where']}")
    return lines
