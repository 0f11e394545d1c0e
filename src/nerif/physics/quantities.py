"""From index excess to what people were after: n, density, temperature."""

from __future__ import annotations

from dataclasses import dataclass, replace

from nerif.conventions import InputError
from nerif.physics.gas_optics import density_from_index, gladstone_dale, molar_mass, temperature_from_density
from nerif.volume import QUANTITIES, Volume

__all__ = ["GasSettings", "derive"]


@dataclass(frozen=True)
class GasSettings:
    """What density and temperature are computed for."""

    composition: str = "air"
    """Gas or mixture by mole fractions, e.g. "CH4:0.11, air:0.89"; one composition is assumed throughout."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm."""
    pressure_pa: float = 101325.0
    """Pressure, Pa; assumed uniform."""

    def __post_init__(self) -> None:
        if not self.pressure_pa > 0:
            raise InputError(f"pressure_pa: expected a positive pressure in Pa, got {self.pressure_pa}")


def derive(excess: Volume, quantity: str, gas: GasSettings) -> Volume:
    """Return n, density (Gladstone-Dale) or temperature (ideal gas) from a volume of index excess.

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
    if quantity not in QUANTITIES:
        raise InputError(f"quantity: expected one of {', '.join(QUANTITIES)}, got '{quantity}'")
    if quantity == "index_excess":
        return excess
    n_ambient = float(excess.attributes["n_ambient"])
    if quantity == "n":
        return replace(excess, values=excess.values.double() + n_ambient, quantity="n")
    k = gladstone_dale(gas.composition, gas.wavelength_nm)
    attributes: dict[str, float | str] = {
        **excess.attributes,
        "gas": gas.composition,
        "wavelength_nm": gas.wavelength_nm,
        "gladstone_dale_m3_kg-1": k,
    }
    density = density_from_index(excess.values.double(), n_ambient, k)
    if quantity == "density":
        return Volume(density.float(), excess.grid, "density", QUANTITIES["density"][0], attributes)
    attributes["pressure_pa"] = gas.pressure_pa
    temperature = temperature_from_density(density, gas.pressure_pa, molar_mass(gas.composition))
    return Volume(temperature.float(), excess.grid, "temperature", QUANTITIES["temperature"][0], attributes)
