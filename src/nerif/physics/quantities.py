"""From index excess to what people were after: n, density, temperature."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.volume import QUANTITIES, Volume, quantities_of
from nerif.physics.gas_optics import density_from_index, gladstone_dale, molar_mass, temperature_from_density

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement

__all__ = [
    "LINEAR", "NOT_UNIFORM", "TEMPERATURE_RANGE", "GasChanges", "GasSettings", "derive", "derive_all", "deviation",
    "masked_lines",
]  # fmt: skip

TEMPERATURE_RANGE = 200.0, 4000.0
"""K; beyond, gases of the table condense or dissociate, and one composition holds no more."""

BOTH_SIGNS, EXTREME = 0.4, 1e-3
"""Ratio of the smaller to the larger of the extreme density differences above and below ambient, from which compression
and expansion are assumed, and the share of the voxels beyond each extreme. Of a hot or cold flow at uniform pressure
the other sign is the error of the field."""

NOT_UNIFORM = (
    "the pressure is not uniform (density is both above and below ambient, as behind compression and expansion waves); "
    "--gas.uniform-pressure yes computes temperature all the same"
)

LINEAR = "n", "density"
"""Quantities that are linear functions of the index excess."""


@dataclass(frozen=True)
class GasSettings:
    """What density and temperature are computed for."""

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
        """Return the settings at the wavelength of a measurement, if it tells one.

        Raises
        ------
        InputError
            If density and temperature cannot be computed of it: before the long work, not after it.
        """
        if "density" not in quantities_of(measurement.quantity):
            return self
        wavelength = measurement.wavelength_nm
        gas = self if wavelength is None else replace(self, wavelength_nm=wavelength)
        density_from_index(0.0, measurement.n_ambient, gladstone_dale(gas.composition, gas.wavelength_nm))
        return gas

    def for_field(self, excess: Volume) -> GasSettings:
        """Return the settings for a flow, with yes or no for whether its pressure is uniform."""
        if self.uniform_pressure != "auto":
            return self
        low, high = np.quantile(excess.values.nan_to_num(0.0).numpy(), [EXTREME, 1 - EXTREME])
        both = min(high, -low) > BOTH_SIGNS * max(high, -low)
        return replace(self, uniform_pressure="no" if both else "yes")

    def quantities_of(self, excess: Volume) -> tuple[str, ...]:
        """Return the quantities that follow from a field: without temperature where the pressure is not uniform."""
        uniform = self.for_field(excess).uniform_pressure == "yes"
        return tuple(q for q in quantities_of(excess.quantity) if uniform or q != "temperature")


@dataclass(frozen=True)
class GasChanges:
    """What density and temperature are computed for, where it is not what the result was."""

    composition: str | None = None
    """Gas or mixture by mole fractions, e.g. "CH4:0.11, air:0.89"; default: that of the result."""
    wavelength_nm: float | None = None
    """Wavelength of the light, nm; default: that of the result."""
    pressure_pa: float | None = None
    """Pressure, Pa; default: that of the result."""
    uniform_pressure: Literal["auto", "yes", "no"] | None = None
    """Whether the pressure is uniform, so that temperature follows from density; default: that of the result."""

    def of(self, settings: Mapping[str, Any]) -> GasSettings:
        """Return the gas that the settings of a run (run.toml) hold, with the changes."""
        kept = settings.get("gas", {})
        changed = {f.name: getattr(self, f.name) for f in fields(self)}
        known = {name: kept[name] for name in changed if name in kept}
        return GasSettings(**known | {name: value for name, value in changed.items() if value is not None})


def derive(excess: Volume, quantity: str, gas: GasSettings) -> Volume:
    """Return n, density (Gladstone-Dale) or temperature (ideal gas) from a volume of index excess.

        rho = (n - 1) / K,      T = p M / (R rho)

    Where the relations break down (n - 1 <= 0, temperature beyond 200 to 4000 K or in a flow whose pressure is not
    uniform) values are NaN; how many, and what was assumed, stands in the notes.

    Parameters
    ----------
    excess : Volume of index excess with n_ambient in its attributes
    quantity : index_excess, n, density or temperature
    gas : composition, wavelength and pressure; written into the attributes

    Raises
    ------
    InputError
        If the quantity is unknown.
    """
    known = quantities_of(excess.quantity)
    if quantity not in known:
        raise InputError(f"expected one of {', '.join(known)}, got '{quantity}'", field="quantity")
    if quantity == excess.quantity:
        return excess
    n_ambient = float(excess.attributes["n_ambient"])
    if quantity == "n":
        return replace(excess, values=excess.values.double() + n_ambient, quantity="n")
    k = gladstone_dale(gas.composition, gas.wavelength_nm)
    mass = molar_mass(gas.composition)
    attributes: dict[str, float | str] = {
        **excess.attributes,
        "gas": gas.composition,
        "wavelength_nm": gas.wavelength_nm,
        "gladstone_dale_m3_kg-1": k,
    }
    density = density_from_index(excess.values.double(), n_ambient, k)
    real = density > 0
    if quantity == "density":
        density = density.masked_fill(~real, math.nan)
        return _quantity(excess, "density", density, attributes, _density_assumption(gas, k), "n - 1 <= 0")
    attributes |= {"pressure_pa": gas.pressure_pa, "molar_mass_kg_mol-1": mass}
    temperature = temperature_from_density(density, gas.pressure_pa, mass)
    low, high = TEMPERATURE_RANGE
    temperature = temperature.masked_fill((temperature < low) | (temperature > high), math.nan)
    where = f"n - 1 <= 0, or temperature beyond {low:g} to {high:g} K"
    if gas.for_field(excess).uniform_pressure == "no":
        temperature, where = torch.full_like(temperature, math.nan), NOT_UNIFORM
    assumption = (
        f"T = p M / (R rho), an ideal gas of M = {mass * 1e3:.4g} g/mol ({gas.composition}) "
        f"at a uniform pressure of {gas.pressure_pa:g} Pa; {_density_assumption(gas, k)}"
    )
    return _quantity(excess, "temperature", temperature, attributes, assumption, where)


def deviation(excess: Volume, std: Tensor, quantity: str, gas: GasSettings) -> Tensor:
    """Return the standard deviation of n, density or temperature by that of the index excess, to first order.

        std(n) = std,      std(rho) = std / K,      std(T) = T std(rho) / rho

    It is NaN where the quantity itself is.

    Parameters
    ----------
    excess : Volume of index excess, or of what is no index
    std : (z, y, x) of its values
    quantity : as `derive` takes it
    gas : composition, wavelength and pressure
    """
    if quantity in (excess.quantity, "n"):
        return std
    derived, density = derive(excess, quantity, gas), derive(excess, "density", gas)
    of_density = std / float(derived.attributes["gladstone_dale_m3_kg-1"])
    return of_density * derived.values.double() / density.values.double()


def derive_all(excess: Volume, gas: GasSettings) -> list[Volume]:
    """Return index_excess, n, density and, at uniform pressure, temperature; a volume of anything else alone."""
    return [derive(excess, quantity, gas) for quantity in gas.quantities_of(excess)]


def masked_lines(volumes: list[Volume]) -> list[str]:
    """Return a line for each quantity with masked voxels: how many, and why."""
    lines = []
    for v in volumes:
        count = int(v.notes.get("masked_voxels", 0))
        if count:
            share = f"{count} of {v.values.numel()} voxels ({count / v.values.numel():.2%})"
            lines.append(f"{v.quantity}: {share} are NaN: {v.notes['masked_where']}")
    return lines


def _density_assumption(gas: GasSettings, k: float) -> str:
    return (
        f"n - 1 = K rho (Gladstone-Dale) with K = {k:.5g} m3/kg of {gas.composition} at {gas.wavelength_nm:g} nm, "
        "one composition throughout"
    )


def _quantity(
    excess: Volume, quantity: str, values: Tensor, attributes: dict[str, float | str], assumption: str, where: str
) -> Volume:
    """A volume whose masked voxels are NaN, counted, and explained."""
    count = int(torch.isnan(values).sum())
    notes: dict[str, float | str] = {"assumption": assumption, "masked_voxels": count, "masked_where": where}
    return Volume(values.float(), excess.grid, quantity, QUANTITIES[quantity][0], attributes, notes)
