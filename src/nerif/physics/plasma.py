"""A plasma: electron density from the index, which electrons lower below that of the gas around.

    n^2 = n_ambient^2 - n_e / n_c,      n_c = eps0 m_e (2 pi c / wavelength)^2 / e^2

The heavy particles are taken to be those of the ambient; two wavelengths separate both (two_wavelengths.py).

Source: Hutchinson, Principles of Plasma Diagnostics, section 4.1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from nerif.physics.medium import Medium, check_wavelength

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["PlasmaSettings", "critical_density"]

VACUUM_PERMITTIVITY, ELECTRON_MASS = 8.8541878188e-12, 9.1093837139e-31  # F/m, kg: CODATA 2022
CHARGE, LIGHT_SPEED = 1.602176634e-19, 299792458.0  # C, m/s


def critical_density(wavelength_nm: float) -> float:
    """Return the electron density above which light does not propagate, m^-3."""
    frequency = 2 * math.pi * LIGHT_SPEED / (wavelength_nm * 1e-9)
    return VACUUM_PERMITTIVITY * ELECTRON_MASS * frequency**2 / CHARGE**2


@dataclass(frozen=True)
class PlasmaSettings(Medium):
    """A plasma in a gas of constant density."""

    names: ClassVar[tuple[str, ...]] = ("electron_density",)

    wavelength_nm: float = 532.0
    """Wavelength of the light, nm."""
    composition: str = "air"
    """Gas of the heavy particles, which two wavelengths separate from the electrons."""

    def __post_init__(self) -> None:
        check_wavelength(self.wavelength_nm)

    def values(self, excess: Tensor, n_ambient: float, quantity: str) -> tuple[Tensor, str]:
        return -critical_density(self.wavelength_nm) * excess * (2 * n_ambient + excess), "never"

    def attributes(self, quantity: str) -> dict[str, float | str]:
        return {"medium": "plasma", "wavelength_nm": self.wavelength_nm}

    def assumption(self, quantity: str) -> str:
        return f"electrons alone change the index, at {self.wavelength_nm:g} nm (cold plasma without a magnetic field)"
