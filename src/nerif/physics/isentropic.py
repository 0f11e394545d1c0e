"""A gas that flows without loss from a reservoir of total pressure and temperature, as in a wind tunnel.

    rho = (n - 1) / K,      T = T0 (rho / rho0)^(g - 1),      p = p0 (rho / rho0)^g,      rho0 = p0 M / (R T0)
    Ma^2 = 2 / (g - 1) (T0 / T - 1),      cp = (p - p1) / (g p1 Ma1^2 / 2)

Index 1 is the ambient, the stream. A shock keeps T0 and loses total pressure, by the Mach number across it,
Ma_n = Ma1 sin(angle):

    p02 / p01 = [(g + 1) Ma_n^2 / ((g - 1) Ma_n^2 + 2)]^(g / (g - 1)) [(g + 1) / (2 g Ma_n^2 - (g - 1))]^(1 / (g - 1))

Source: Anderson, Modern Compressible Flow, sections 3.4 to 3.6 and 4.3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

from annotated_types import Ge, Gt, Le, Lt

from nerif.common.conventions import InputError
from nerif.common.settings import NonNegative
from nerif.physics.gas_optics import GAS_CONSTANT, gladstone_dale, molar_mass
from nerif.physics.medium import Medium, check_pressure, check_temperature, check_wavelength
from nerif.physics.shock import shock_angle

if TYPE_CHECKING:
    from torch import Tensor

    from nerif.data.volume import Volume

__all__ = ["IsentropicSettings"]

COMPRESSED = 1.05  # density over that of the stream, from which a shock may have lost total pressure
ABOVE_TOTAL = 0.02  # of the total density that noise explains
UNLIKE = 0.2  # relative difference of the density by n_ambient from that of the stream
COLDEST = 30.0  # K, below which air condenses even in the short time of a nozzle
PASSED = 0.5  # of the jump of density at the shock, from which on gas has passed it


@dataclass(frozen=True)
class IsentropicSettings(Medium):
    """A gas from a reservoir: pressure, temperature and Mach number from its density."""

    names: ClassVar[tuple[str, ...]] = (
        "density", "static_pressure", "temperature", "mach", "pressure_coefficient",
    )  # fmt: skip
    surface_names: ClassVar[tuple[str, ...]] = ("density", "static_pressure", "pressure_coefficient")

    total_pressure_pa: float = 101325.0
    """Pressure of the reservoir, Pa."""
    total_temperature_k: float = 293.15
    """Temperature of the reservoir, K."""
    mach: NonNegative = 0.0
    """Mach number of the ambient, the stream around the model; 0: from the ambient index."""
    shock_angle: Annotated[float, Ge(0), Le(90)] = 0.0
    """Angle between shock and stream, degrees, as the field shows it (a line of the run has it): behind the shock its
    loss of total pressure is accounted for; 0: behind compressions only the density is given."""
    stream: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Direction of the stream, by which the angle of a shock in the field is measured."""
    composition: str = "air"
    """Gas or mixture by mole fractions."""
    gamma: Annotated[float, Gt(1), Lt(2)] = 1.4
    """Ratio of specific heats."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm."""

    def __post_init__(self) -> None:
        check_pressure(self.total_pressure_pa, "total_pressure_pa")
        check_temperature(self.total_temperature_k, "total_temperature_k")
        check_wavelength(self.wavelength_nm)
        if not any(self.stream):
            raise InputError("expected a direction, got 0 0 0", field="stream")
        if self.shock_angle and self.mach and self._normal(self.mach) <= 1:
            least = math.degrees(math.asin(1 / self.mach)) if self.mach > 1 else 90
            raise InputError(
                f"expected more than the Mach angle, {least:.1f} degrees at Mach {self.mach:g}, got "
                f"{self.shock_angle:g}",
                field="shock_angle",
            )

    @property
    def _constant(self) -> float:
        return gladstone_dale(self.composition, self.wavelength_nm)

    @property
    def total_density(self) -> float:
        """Density of the reservoir, kg/m^3."""
        return self.total_pressure_pa * molar_mass(self.composition) / (GAS_CONSTANT * self.total_temperature_k)

    def _normal(self, mach: float) -> float:
        return mach * math.sin(math.radians(self.shock_angle))

    def stream_density(self, n_ambient: float) -> float:
        """Return the density of the stream, kg/m^3, by its Mach number or the ambient index."""
        if not self.mach:
            return (n_ambient - 1) / self._constant
        return float(self.total_density * (1 + (self.gamma - 1) / 2 * self.mach**2) ** (-1 / (self.gamma - 1)))

    def stream_mach(self, n_ambient: float) -> float:
        """Return the Mach number of the stream."""
        if self.mach:
            return self.mach
        ratio = self.total_density / self.stream_density(n_ambient)
        return math.sqrt(max(0.0, 2 / (self.gamma - 1) * (ratio ** (self.gamma - 1) - 1)))

    def not_around(self, n_ambient: float) -> str:
        if not self.stream_density(n_ambient) > 0:
            return f"the ambient index {n_ambient:.10g} is that of no gas; give --isentropic.mach"
        if self.stream_density(n_ambient) <= (1 + ABOVE_TOTAL) * self.total_density:
            return ""
        return (
            f"the ambient index {n_ambient:.10g} is that of a density of {self.stream_density(n_ambient):.4g} kg/m3, "
            f"above that of the reservoir, {self.total_density:.4g} ({self.total_pressure_pa:g} Pa, "
            f"{self.total_temperature_k:g} K); give its total pressure, or --isentropic.mach"
        )

    def remarks(self, excess: Volume) -> list[str]:
        lines, n_ambient = super().remarks(excess), float(excess.attributes["n_ambient"])
        if self.not_around(n_ambient):
            return lines
        mach = self.stream_mach(n_ambient)
        stream = self.stream_density(n_ambient)
        lines.append(f"stream: Mach {mach:.3g}, density {stream:.4g} kg/m3")
        of_index = (n_ambient - 1) / self._constant
        if abs(of_index - stream) > UNLIKE * stream:
            lines.append(
                f"stream: n_ambient of the measurement is that of {of_index:.4g} kg/m3; is the Mach number right, or "
                "is n_ambient that of the laboratory?"
            )
        stated = self.shock_angle and self._normal(mach) > 1
        if stated:
            jump, loss = self._shock(self._normal(mach))
            lines.append(
                f"shock of {self.shock_angle:g} degrees: density rises {jump:.3g} times, total pressure falls to "
                f"{loss:.1%}; compare the former with the field"
            )
        if mach > 1 and self._is_compressed(excess) and (angle := shock_angle(excess, self.stream)):
            text = "" if stated else "; --isentropic.shock-angle accounts for its loss of total pressure"
            lines.append(f"shock in the field: {angle[0]:.1f} degrees (+- {angle[1]:.1f}) to the stream{text}")
        return lines

    def values(self, excess: Tensor, n_ambient: float, quantity: str) -> tuple[Tensor, str]:
        stream, total, g = self.stream_density(n_ambient), self.total_density, self.gamma
        density = stream + excess / self._constant
        where = "density <= 0"
        density = density.masked_fill(~(density > 0), math.nan)
        if quantity == "density":
            return density, where
        mach = self.stream_mach(n_ambient)
        local = density.new_full(density.shape, total)
        if self.shock_angle and self._normal(mach) > 1:
            jump, loss = self._shock(self._normal(mach))
            local = local.masked_fill(density > stream * (1 + PASSED * (jump - 1)), total * loss)
        else:
            density = density.masked_fill(density > COMPRESSED * stream, math.nan)
            where += ", behind compressions, where a shock may have lost total pressure (--isentropic.shock-angle)"
        ratio = density / local
        ratio = ratio.masked_fill(ratio > 1 + ABOVE_TOTAL, math.nan).clamp(max=1.0)
        cold = ratio < (COLDEST / self.total_temperature_k) ** (1 / (g - 1))
        ratio = ratio.masked_fill(cold, math.nan)
        where += f", above the total density, or colder than {COLDEST:g} K"
        if quantity == "temperature":
            return self.total_temperature_k * ratio ** (g - 1), where
        if quantity == "mach":
            return (2 / (g - 1) * (ratio ** (1 - g) - 1)).clamp(min=0).sqrt(), where
        pressure = self.total_pressure_pa * (local / total) * ratio**g
        if quantity == "static_pressure":
            return pressure, where
        if not mach:
            return density.new_full(density.shape, math.nan), "the stream is at rest"
        ambient = self.total_pressure_pa * (stream / total) ** g
        return (pressure - ambient) / (g / 2 * ambient * mach**2), where

    def _is_compressed(self, excess: Volume) -> bool:
        rise = (COMPRESSED - 1) * self._constant * self.stream_density(float(excess.attributes["n_ambient"]))
        return bool((excess.values > rise).any())

    def _shock(self, normal: float) -> tuple[float, float]:
        """Return the ratios of density and of total pressure across a shock of this normal Mach number."""
        g, square = self.gamma, normal**2
        jump = (g + 1) * square / ((g - 1) * square + 2)
        return jump, jump ** (g / (g - 1)) * ((g + 1) / (2 * g * square - (g - 1))) ** (1 / (g - 1))

    def attributes(self, quantity: str) -> dict[str, float | str]:
        about: dict[str, float | str] = {
            "gas": self.composition, "wavelength_nm": self.wavelength_nm, "gladstone_dale_m3_kg-1": self._constant,
        }  # fmt: skip
        if quantity != "density":
            about |= {
                "total_pressure_pa": self.total_pressure_pa, "total_temperature_k": self.total_temperature_k,
                "gamma": self.gamma, "shock_angle_deg": self.shock_angle,
            }  # fmt: skip
        return about

    def assumption(self, quantity: str) -> str:
        text = f"n - 1 = K rho with K = {self._constant:.5g} m3/kg of {self.composition} at {self.wavelength_nm:g} nm"
        if quantity == "density":
            return text
        return (
            f"isentropic flow (gamma {self.gamma:g}) from a reservoir of {self.total_pressure_pa:g} Pa and "
            f"{self.total_temperature_k:g} K; {text}"
        )
