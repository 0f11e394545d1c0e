"""Two gases that mix at a uniform temperature and pressure: mole and mass fraction of the one that flows in, density.

    n - 1 = x r_A + (1 - x) r_B,      r_i = K_i M_i p / (R T),      x = (n - n_ambient) / (r_A - r_B)
    w = x M_A / M,      rho = p M / (R T),      M = x M_A + (1 - x) M_B

The gas around the flow is B alone. One wavelength does not separate composition from temperature.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from nerif.common.conventions import InputError
from nerif.physics.gas_optics import GAS_CONSTANT, ambient_index, molar_mass
from nerif.physics.medium import Medium, check_pressure, check_temperature, check_wavelength

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["MixtureSettings"]

BEYOND = 0.1  # of a mole fraction below 0 or above 1 that noise explains
LIKE = 0.03  # relative difference of n - 1 below which the index does not tell two gases apart
OTHER = 0.2  # relative difference of n_ambient - 1 from that of the gas around


@dataclass(frozen=True)
class MixtureSettings(Medium):
    """Two gases that mix at a uniform temperature and pressure, such as helium into air."""

    names: ClassVar[tuple[str, ...]] = ("mole_fraction", "mass_fraction", "density")
    surface_names: ClassVar[tuple[str, ...]] = ("density",)

    jet: str = "He"
    """Gas that flows in, or a mixture by mole fractions."""
    ambient: str = "air"
    """Gas around the flow, or a mixture by mole fractions."""
    temperature_k: float = 293.15
    """Temperature, K; assumed uniform."""
    pressure_pa: float = 101325.0
    """Pressure, Pa; assumed uniform."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm."""

    def __post_init__(self) -> None:
        check_pressure(self.pressure_pa, "pressure_pa")
        check_temperature(self.temperature_k, "temperature_k")
        check_wavelength(self.wavelength_nm)
        for name in ("jet", "ambient"):
            try:
                molar_mass(getattr(self, name))
            except InputError as error:
                raise error.renamed({"composition": name}) from None
        jet, ambient = self._refractivities
        if abs(jet - ambient) < LIKE * ambient:
            raise InputError(
                f"expected gases of different index, got n - 1 = {jet:.4g} of {self.jet} and {ambient:.4g} of "
                f"{self.ambient}; the index does not separate them",
                field="jet, ambient",
            )

    @property
    def _refractivities(self) -> tuple[float, float]:
        state = (self.temperature_k, self.pressure_pa, self.wavelength_nm)
        return ambient_index(self.jet, *state) - 1, ambient_index(self.ambient, *state) - 1

    def not_around(self, n_ambient: float) -> str:
        _, ambient = self._refractivities
        if abs(n_ambient - 1 - ambient) <= OTHER * ambient:
            return ""
        return (
            f"the ambient index {n_ambient:.10g} is not that of {self.ambient} at {self.temperature_k:g} K and "
            f"{self.pressure_pa:g} Pa ({1 + ambient:.7f}); give --mixture.ambient, temperature and pressure"
        )

    def values(self, excess: Tensor, n_ambient: float, quantity: str) -> tuple[Tensor, str]:
        jet, ambient = self._refractivities
        x = excess / (jet - ambient)
        x = x.masked_fill((x < -BEYOND) | (x > 1 + BEYOND), math.nan)
        where = f"mole fraction beyond {-BEYOND:g} to {1 + BEYOND:g}: another gas or temperature"
        if quantity == "mole_fraction":
            return x, where
        x = x.clamp(max=1.0)  # noise beyond the pure gas would divide by a molar mass near 0
        heavy, light = molar_mass(self.jet), molar_mass(self.ambient)
        mass = x * heavy + (1 - x) * light
        if quantity == "mass_fraction":
            return x * heavy / mass, where
        return self.pressure_pa / (GAS_CONSTANT * self.temperature_k) * mass, where

    def attributes(self, quantity: str) -> dict[str, float | str]:
        return {
            "jet": self.jet, "ambient": self.ambient, "temperature_k": self.temperature_k,
            "pressure_pa": self.pressure_pa, "wavelength_nm": self.wavelength_nm,
        }  # fmt: skip

    def assumption(self, quantity: str) -> str:
        jet, ambient = self._refractivities
        return (
            f"{self.jet} (n - 1 = {jet:.4g}) mixes with {self.ambient} ({ambient:.4g}) at a uniform temperature of "
            f"{self.temperature_k:g} K and {self.pressure_pa:g} Pa, {self.wavelength_nm:g} nm; fractions of {self.jet}"
        )
