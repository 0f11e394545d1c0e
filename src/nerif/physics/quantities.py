"""n, density and temperature from the index excess."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from nerif.common.conventions import InputError, percent
from nerif.data.quantity_names import QUANTITIES, quantities_of
from nerif.physics.gas_optics import (
    ambient_index,
    density_from_index,
    gladstone_dale,
    molar_mass,
    parse_mixture,
    temperature_from_density,
)  # fmt: skip

if TYPE_CHECKING:
    from torch import Tensor

    from nerif.data.measurement import Measurement
    from nerif.data.volume import Volume

__all__ = ["NOT_UNIFORM", "GasChanges", "GasSettings", "derive", "derive_all", "deviation", "masked_lines"]

TEMPERATURE_RANGE = 200.0, 4000.0  #: K; outside, gases of the table condense or dissociate
LEAST_PRESSURE, LEAST_WAVELENGTH = 100.0, 100.0  # Pa and nm; smaller ones are in bar and µm
AMBIENT_RANGE = 200.0, 2000.0  # K, of the gas around a flow
HOTTEST = 2300.0  # K, of flames in air; helium in air appears as air of 2400 K
PRODUCTS = "H2O", "CO2"  # a composition without them is not that of a flame
COMMON = 230.0, 1000.0  # K; beyond, a flow in air is a flame, cryogenic, or another gas

BOTH_SIGNS, EXTREME = 0.4, 1e-3
"""Ratio of the smaller to the larger extreme of the density differences above and below ambient from which compression
and expansion are assumed (in a flow at uniform pressure the smaller is the error of the field); share of the voxels
beyond each extreme."""
SOME = 0.1  # the same ratio for a field that is denser than any gas at uniform pressure
FLOW, QUARTER = 0.5, 0.25  # voxels of the flow, relative to the extreme; share of these beyond a temperature

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
        if self.pressure_pa < LEAST_PRESSURE:
            raise InputError(
                f"expected Pa such as 101325, got {self.pressure_pa:g}; 1 bar are 100000 Pa", field="pressure_pa"
            )
        if self.wavelength_nm < LEAST_WAVELENGTH:
            raise InputError(
                f"expected nanometres such as 532, got {self.wavelength_nm:g}; 1 µm are 1000 nm", field="wavelength_nm"
            )

    def for_measurement(self, measurement: Measurement) -> GasSettings:
        """Return the settings at the wavelength of a measurement, if it has one, and refuse invalid ones."""
        if "density" not in quantities_of(measurement.quantity):
            return self
        wavelength = measurement.wavelength_nm
        gas = self if wavelength is None else replace(self, wavelength_nm=wavelength)
        gladstone_dale(gas.composition, gas.wavelength_nm)
        return gas

    def not_around(self, n_ambient: float) -> str:
        """Return why the gas is not the medium around a flow, by the ambient index; empty if it may be."""
        low, high = AMBIENT_RANGE
        thin, dense = (ambient_index(self.composition, t, self.pressure_pa, self.wavelength_nm) for t in (high, low))
        if thin <= n_ambient <= dense:
            return ""
        return (
            f"the ambient index {n_ambient:.10g} is not that of {self.composition} at {self.pressure_pa:g} Pa "
            f"({thin:.7f} to {dense:.7f} for {high:g} to {low:g} K); give --gas.composition and --gas.pressure-pa, or "
            "the n_ambient of the measurement; liquids and plasmas have an index only"
        )

    def absent(self, excess: Volume) -> dict[str, str]:
        """Return the quantities that do not follow from a field of this gas, each with the reason."""
        if "density" not in quantities_of(excess.quantity):
            return {}
        if reason := self.not_around(float(excess.attributes["n_ambient"])):
            return {"density": reason, "temperature": reason}
        if self.uniform_pressure != "auto":
            return {} if self.uniform_pressure == "yes" else {"temperature": NOT_UNIFORM}
        below, above, cold, hot = self._ends(excess)
        (coldest, most), ratio = TEMPERATURE_RANGE, min(above, below) / (max(above, below) or 1.0)
        hottest = most if self._burnt else HOTTEST
        if ratio > BOTH_SIGNS or (ratio > SOME and cold < coldest):
            return {"temperature": NOT_UNIFORM}
        if coldest <= cold and hot <= hottest:
            return {}
        end = f"hotter than {hottest:g} K" if hot > hottest else f"colder than {coldest:g} K"
        return {
            "temperature": f"{QUARTER:.0%} of the flow would be {self.composition} {end} at a uniform pressure: the "
            "pressure varies, or it is another gas, and the density is wrong, too (--gas.composition); "
            "--gas.uniform-pressure yes computes it all the same"
        }

    def remarks(self, excess: Volume) -> list[str]:
        """Return lines on the quantities that do not follow from a field, and on what its temperature implies."""
        absent = self.absent(excess)
        lines = [
            f"{' and '.join(q for q in absent if absent[q] == reason)}: not computed: {reason}"
            for reason in dict.fromkeys(absent.values())
        ]
        if self._burnt or "temperature" not in self.quantities_of(excess):
            return lines
        _, _, *ends = self._ends(excess)
        extreme = [t for t, beyond in zip(ends, (ends[0] < COMMON[0], ends[1] > COMMON[1]), strict=True) if beyond]
        return lines + [
            f"temperature: {QUARTER:.0%} of the flow is beyond {t:.0f} K if it is {self.composition}; density and "
            "temperature are wrong where another gas flows, such as helium or fuel (--gas.composition)"
            for t in extreme
        ]

    @property
    def _burnt(self) -> bool:
        return any(parse_mixture(self.composition).get(product) for product in PRODUCTS)

    def _ends(self, excess: Volume) -> tuple[float, float, float, float]:
        """Return how far the index is below and above ambient, and the temperatures (K) below and above which a quarter
        of the denser and of the lighter flow is."""
        n_ambient = float(excess.attributes["n_ambient"])
        values = np.append(excess.values.double().nan_to_num(0.0).numpy(), 0.0)  # the ambient, for fields of one sign
        low, high = np.quantile(values, [EXTREME, 1 - EXTREME]).clip((-math.inf, 0.0), (0.0, math.inf))
        of_flow = (np.quantile(values[values >= FLOW * high], 1 - QUARTER),
                   np.quantile(values[values <= FLOW * low], QUARTER))  # fmt: skip
        density = density_from_index(np.array(of_flow), n_ambient, gladstone_dale(self.composition, self.wavelength_nm))
        cold, hot = temperature_from_density(density, self.pressure_pa, molar_mass(self.composition))
        return -float(low), float(high), float(cold), math.inf if math.isnan(hot) else float(hot)

    def quantities_of(self, excess: Volume) -> tuple[str, ...]:
        """Return the quantities of a field, without those that are absent."""
        absent = self.absent(excess)
        return tuple(q for q in quantities_of(excess.quantity) if q not in absent)


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

    Values outside the relations (n - 1 <= 0, temperature outside 200 to 4000 K, everything that is absent from a field
    of this gas) are NaN; the notes contain their number, the reason and the assumptions.

    Parameters
    ----------
    excess : volume with n_ambient in its attributes
    quantity : index_excess, n, density or temperature
    """
    from nerif.data.volume import Volume

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
    mass, (low, high) = molar_mass(gas.composition), TEMPERATURE_RANGE
    if quantity == "temperature":
        attributes |= {"pressure_pa": gas.pressure_pa, "molar_mass_kg_mol-1": mass}
        assumption = (
            f"T = p M / (R rho), an ideal gas of M = {mass * 1e3:.4g} g/mol ({gas.composition}) "
            f"at a uniform pressure of {gas.pressure_pa:g} Pa; {assumption}"
        )
    if reason := gas.absent(excess).get(quantity):
        values, where = excess.values.new_full(excess.values.shape, math.nan), reason
    else:
        density = density_from_index(excess.values.double(), n_ambient, k)
        values, where = density.masked_fill(~(density > 0), math.nan), "n - 1 <= 0"
        if quantity == "temperature":
            values = temperature_from_density(density, gas.pressure_pa, mass)
            values = values.masked_fill((values < low) | (values > high), math.nan)
            where += f", or temperature beyond {low:g} to {high:g} K"
    count, earlier = int(values.isnan().sum()), int(excess.notes.get("masked_voxels", 0))
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
    """Return index_excess, n, and density and temperature where they follow; other quantities unchanged."""
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
