"""Water: temperature of fresh water, or salinity at a uniform temperature.

    (n^2 - 1) / (n^2 + 2) / r = a0 + a1 r + a2 t + a3 l^2 t + a4 / l^2 + a5 / (l^2 - u^2) + a6 / (l^2 - i^2) + a7 r^2
    r = rho / 1000 kg/m^3,      t = T / 273.15 K,      l = wavelength / 589 nm                    fresh water
    n = n0 + (n1 + n2 T + n3 T^2) S + n4 T^2 + (n5 + n6 S + n7 T) / l + n8 / l^2 + n9 / l^3    seawater, C and nm

with the density of fresh water at one atmosphere. n falls with temperature from 0 degrees C on; Gladstone-Dale does not
hold.

Sources: Harvey, Gallagher & Levelt Sengers 1998, J. Phys. Chem. Ref. Data 27, 761 (IAPWS R9-97), 0 to 99 degrees C, 200
to 1100 nm; Kell 1975, J. Chem. Eng. Data 20, 97; Quan & Fry 1995, Appl. Opt. 34, 3477, 0 to 30 degrees C, 0 to 35 g/kg,
400 to 700 nm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.physics.medium import check_wavelength
from nerif.physics.tabulated import Tabulated

__all__ = ["ZERO_CELSIUS", "WaterSettings", "fresh_water_index", "seawater_index", "water_density"]

ZERO_CELSIUS = 273.15  # K
FRESH, SALT = (0.2, 99.0), (0.0, 30.0)  # degrees C of the formulas; n has a maximum near 0
SALINITIES = (0.0, 40.0)  # g/kg
LIGHT = {"temperature": (200.0, 1100.0), "salinity": (400.0, 700.0)}  # nm
POINTS = 2001
OTHER = 5e-3  # difference of the ambient index from that of the formula

A = (
    0.244257733,
    9.74634476e-3,
    -3.73234996e-3,
    2.68678472e-4,
    1.58920570e-3,
    2.45934259e-3,
    0.900704920,
    -1.66626219e-2,
)
ULTRAVIOLET, INFRARED = 0.2292020, 5.432937
N = (1.31405, 1.779e-4, -1.05e-6, 1.6e-8, -2.02e-6, 15.868, 0.01155, -0.00423, -4382.0, 1.1455e6)


def water_density(celsius: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the density of fresh water at one atmosphere, kg/m^3 (Kell 1975)."""
    t = celsius
    terms = (999.83952, 16.945176, -7.9870401e-3, -46.170461e-6, 105.56302e-9, -280.54253e-12)
    return sum(a * t**k for k, a in enumerate(terms)) / (1 + 16.879850e-3 * t)


def fresh_water_index(celsius: Float[np.ndarray, " n"], wavelength_nm: float) -> Float[np.ndarray, " n"]:
    """Return the index of fresh water at one atmosphere against vacuum (IAPWS)."""
    r, t, square = water_density(celsius) / 1000, (celsius + ZERO_CELSIUS) / ZERO_CELSIUS, (wavelength_nm / 589) ** 2
    right = A[0] + A[1] * r + A[2] * t + A[3] * square * t + A[4] / square + A[7] * r**2
    right = r * (right + A[5] / (square - ULTRAVIOLET**2) + A[6] / (square - INFRARED**2))
    return np.sqrt((1 + 2 * right) / (1 - right))


def seawater_index(
    celsius: float, salinity: Float[np.ndarray, " n"], wavelength_nm: float
) -> Float[np.ndarray, " n"]:  # fmt: skip
    """Return the index of seawater at one atmosphere by its salinity, g/kg (Quan & Fry)."""
    t, light = celsius, wavelength_nm
    of_salt = N[1] + N[2] * t + N[3] * t**2 + N[6] / light
    of_light = (N[5] + N[7] * t) / light + N[8] / light**2 + N[9] / light**3
    return N[0] + of_salt * salinity + N[4] * t**2 + of_light


@dataclass(frozen=True)
class WaterSettings(Tabulated):
    """Water: temperature, or salinity at a uniform temperature."""

    names: ClassVar[tuple[str, ...]] = ("temperature", "salinity")

    varies: Literal["temperature", "salinity"] = "temperature"
    """What the index shows; the other is uniform."""
    ambient_c: float = 20.0
    """Temperature of the water around the flow, degrees Celsius."""
    ambient_salinity: float = 0.0
    """Salinity of the water around the flow, g/kg."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm."""

    def __post_init__(self) -> None:
        check_wavelength(self.wavelength_nm)
        low, high = FRESH if self.varies == "temperature" else SALT
        if not low <= self.ambient_c <= high:
            raise InputError(
                f"expected {low:g} to {high:g} degrees C for {self.varies}, got {self.ambient_c:g}", field="ambient_c"
            )
        least, most = LIGHT[self.varies]
        if not least <= self.wavelength_nm <= most:
            raise InputError(f"expected {least:g} to {most:g} nm, got {self.wavelength_nm:g}", field="wavelength_nm")
        low, high = SALINITIES if self.varies == "salinity" else (0.0, 0.0)
        if not low <= self.ambient_salinity <= high:
            raise InputError(
                f"expected {low:g} to {high:g} g/kg where {self.varies} varies, got {self.ambient_salinity:g}",
                field="ambient_salinity",
            )

    def available(self, quantity: str) -> tuple[str, ...]:
        other = "salinity" if self.varies == "temperature" else "temperature"
        return tuple(q for q in super().available(quantity) if q != other)

    def not_around(self, n_ambient: float) -> str:
        q, n = self.curve(self.varies)
        expected = float(np.interp(self.ambient_value(self.varies), q, n))
        if abs(n_ambient - expected) <= OTHER:
            return ""
        return (
            f"the ambient index {n_ambient:.10g} is not that of water at {self.ambient_c:g} degrees C "
            f"({expected:.6f}); give the n_ambient of the measurement, or another --medium"
        )

    def curve(self, quantity: str) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        if quantity == "salinity":
            salinity = np.linspace(*SALINITIES, POINTS)
            return salinity, seawater_index(self.ambient_c, salinity, self.wavelength_nm)
        celsius = np.linspace(*FRESH, POINTS)
        return celsius + ZERO_CELSIUS, fresh_water_index(celsius, self.wavelength_nm)

    def ambient_value(self, quantity: str) -> float:
        return self.ambient_salinity if quantity == "salinity" else self.ambient_c + ZERO_CELSIUS

    def attributes(self, quantity: str) -> dict[str, float | str]:
        return {
            "medium": "water", "wavelength_nm": self.wavelength_nm, "ambient_c": self.ambient_c,
            "ambient_salinity": self.ambient_salinity,
        }  # fmt: skip

    def assumption(self, quantity: str) -> str:
        if quantity == "salinity":
            return f"seawater at uniform {self.ambient_c:g} degrees C and {self.wavelength_nm:g} nm (Quan & Fry 1995)"
        return f"fresh water at one atmosphere and {self.wavelength_nm:g} nm (IAPWS R9-97; density by Kell 1975)"
