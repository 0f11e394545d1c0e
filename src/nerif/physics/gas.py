"""A gas of one composition: density by Gladstone-Dale, temperature by the ideal gas law at a uniform pressure.

rho = (n - 1) / K,      T = p M / (R rho)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from nerif.data.quantity_names import INDEX
from nerif.physics.gas_optics import (
    ambient_index,
    density_from_index,
    gladstone_dale,
    molar_mass,
    parse_mixture,
    temperature_from_density,
)  # fmt: skip
from nerif.physics.medium import Medium, check_pressure, check_wavelength

if TYPE_CHECKING:
    from torch import Tensor

    from nerif.data.measurement import Measurement
    from nerif.data.volume import Volume

__all__ = ["NOT_UNIFORM", "TEMPERATURE_RANGE", "GasSettings"]

TEMPERATURE_RANGE = 200.0, 4000.0  #: K; outside, gases of the table condense or dissociate
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
class GasSettings(Medium):
    """Gas of density and temperature."""

    names: ClassVar[tuple[str, ...]] = ("density", "temperature")
    surface_names: ClassVar[tuple[str, ...]] = ("density",)
    optional: ClassVar[tuple[str, ...]] = ("temperature",)

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
        check_pressure(self.pressure_pa, "pressure_pa")
        check_wavelength(self.wavelength_nm)

    def for_measurement(self, measurement: Measurement) -> GasSettings:
        """Return the settings at the wavelength of a measurement, if it has one, and refuse invalid ones."""
        gas = super().for_measurement(measurement)
        if measurement.quantity == INDEX:
            gladstone_dale(gas.composition, gas.wavelength_nm)
        return gas

    def values(self, excess: Tensor, n_ambient: float, quantity: str) -> tuple[Tensor, str]:
        density = density_from_index(excess, n_ambient, self._constant)
        values, where = density.masked_fill(~(density > 0), math.nan), "n - 1 <= 0"
        if quantity == "density":
            return values, where
        low, high = TEMPERATURE_RANGE
        values = temperature_from_density(density, self.pressure_pa, molar_mass(self.composition))
        values = values.masked_fill((values < low) | (values > high), math.nan)
        return values, f"{where}, or temperature beyond {low:g} to {high:g} K"

    def slope(self, excess: Tensor, n_ambient: float, quantity: str) -> Tensor:
        """Return d rho / dn = 1 / K, or dT / dn = -T / (K rho)."""
        if quantity == "density":
            return excess.new_full(excess.shape, 1 / self._constant)
        temperature = self.values(excess, n_ambient, "temperature")[0]
        return -temperature / self._constant / density_from_index(excess, n_ambient, self._constant)

    @property
    def _constant(self) -> float:
        return gladstone_dale(self.composition, self.wavelength_nm)

    def attributes(self, quantity: str) -> dict[str, float | str]:
        about: dict[str, float | str] = {
            "gas": self.composition, "wavelength_nm": self.wavelength_nm, "gladstone_dale_m3_kg-1": self._constant,
        }  # fmt: skip
        if quantity == "temperature":
            about |= {"pressure_pa": self.pressure_pa, "molar_mass_kg_mol-1": molar_mass(self.composition)}
        return about

    def assumption(self, quantity: str) -> str:
        text = (
            f"n - 1 = K rho (Gladstone-Dale) with K = {self._constant:.5g} m3/kg of {self.composition} at "
            f"{self.wavelength_nm:g} nm, one composition throughout"
        )
        if quantity == "density":
            return text
        return (
            f"T = p M / (R rho), an ideal gas of M = {molar_mass(self.composition) * 1e3:.4g} g/mol "
            f"({self.composition}) at a uniform pressure of {self.pressure_pa:g} Pa; {text}"
        )

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
        if excess.quantity != INDEX:
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
        lines = super().remarks(excess)
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
        density = density_from_index(np.array(of_flow), n_ambient, self._constant)
        cold, hot = temperature_from_density(density, self.pressure_pa, molar_mass(self.composition))
        return -float(low), float(high), float(cold), math.inf if math.isnan(hot) else float(hot)
