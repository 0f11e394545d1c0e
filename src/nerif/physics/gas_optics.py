"""Gas optics: density from the refractive index by Gladstone-Dale, temperature from density by the ideal gas law.

    n - 1 = K rho,      K = sum_i w_i K_i,      K_i = (n_i - 1) R T_i / (p_i M_i)      at each gas's reference state

One K for a field whose composition varies (fuel, products, co-flow) is an approximation; the temperature of the
products has its error.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from nerif.common.conventions import InputError

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "GASES", "GAS_CONSTANT", "Composition", "Gas", "ambient_index", "density_from_index", "density_from_temperature",
    "gladstone_dale", "molar_mass", "parse_mixture", "temperature_from_density",
]  # fmt: skip

GAS_CONSTANT = 8.314462618  # J/(mol K), CODATA 2018

Composition = str | Mapping[str, float]
"""A gas of `GASES`, or mole fractions as a mapping or a text such as ``"CH4:0.112, O2:0.888"``."""

Quantity = TypeVar("Quantity", float, np.ndarray, "Tensor")

_ATM = 101325.0  # Pa
_FRACTION_TOLERANCE = 1.0001e-3  # for three thirds written as 0.333, and rounding


def _sellmeier(constant: float, *terms: tuple[float, float]) -> Callable[[float], float]:
    """n - 1 = constant + sum_i a_i / (b_i - s^2), with s = 1 / wavelength in 1/um."""
    return lambda wavelength_um: constant + sum(a / (b - wavelength_um**-2) for a, b in terms)


def _power_series(*coefficients: float) -> Callable[[float], float]:
    """n - 1 = sum_i c_i s^(2 i), with s = 1 / wavelength in 1/um."""
    return lambda wavelength_um: sum(c * wavelength_um ** (-2 * i) for i, c in enumerate(coefficients))


@dataclass(frozen=True)
class Gas:
    """A gas and its dispersion formula."""

    name: str
    molar_mass: float  #: kg/mol
    temperature: float  #: K, of the reference state of the formula
    pressure: float  #: Pa, of the same
    refractivity: Callable[[float], float]  #: n - 1 at the reference state by the vacuum wavelength in um
    wavelength_range: tuple[float, float]  #: nm, in which the formula was fitted
    source: str  #: of the formula


GASES: Mapping[str, Gas] = {
    "air": Gas(
        "dry air, 450 ppm CO2", 28.9641e-3, 288.15, _ATM,
        _sellmeier(0.0, (5792105e-8, 238.0185), (167917e-8, 57.362)), (230.0, 1690.0),
        "Ciddor 1996, Appl. Opt. 35, 1566"),
    "N2": Gas(
        "nitrogen", 28.0134e-3, 288.15, _ATM,
        _sellmeier(6.497378e-5, (3.0738649e-2, 144.0)), (467.9, 2058.7),
        "Peck & Khanna 1966, J. Opt. Soc. Am. 56, 1059"),
    "O2": Gas(
        "oxygen", 31.9988e-3, 293.15, _ATM,
        _sellmeier(1.181494e-4, (9.708931e-3, 75.4)), (400.0, 1800.0),
        "Zhang, Lu & Wang 2008, Appl. Opt. 47, 3143, corrected by Kren 2011, Appl. Opt. 50, 6484"),
    "CH4": Gas(
        "methane", 16.0425e-3, 273.15, _ATM,
        _power_series(4.2607e-4, 6.1396687e-6), (529.0, 658.5),
        "Loria 1909, Ann. Phys. 334, 605"),
    "CO2": Gas(
        "carbon dioxide", 44.0095e-3, 273.15, _ATM,
        _sellmeier(0.0, (6.99100e-2, 166.175), (1.44720e-3, 79.609), (6.42941e-5, 56.3064), (5.21306e-5, 46.0196),
                   (1.46847e-6, 0.0584738)), (180.7, 1694.5),
        "Bideau-Mehu, Guern, Abjean & Johannin-Gilles 1973, Opt. Commun. 9, 432"),
    "H2O": Gas(
        "water vapour", 18.0153e-3, 293.15, 1333.0,
        _power_series(*(1.022e-8 * c for c in (295.235, 2.6422, -0.032380, 0.004028))), (300.0, 1690.0),
        "Ciddor 1996, Appl. Opt. 35, 1566"),
    "Ar": Gas(
        "argon", 39.948e-3, 273.15, _ATM,
        _sellmeier(6.7867e-5, (3.0182943e-2, 144.0)), (467.9, 2058.7),
        "Peck & Fisher 1964, J. Opt. Soc. Am. 54, 1362"),
    "He": Gas(
        "helium", 4.002602e-3, 273.15, _ATM,
        _sellmeier(0.0, (0.01470091, 423.98)), (480.1, 2058.6),
        "Mansfield & Peck 1969, J. Opt. Soc. Am. 59, 199"),
}  # fmt: skip
"""Gases with the formulas of refractiveindex.info, with which tests compare them."""


def _species(name: str) -> str:
    if name in GASES:
        return name
    spellings = {key.lower(): key for key in GASES} | {gas.name.split(",")[0]: key for key, gas in GASES.items()}
    near = difflib.get_close_matches(name.lower(), spellings, n=1)
    hint = f"; did you mean '{spellings[near[0]]}'?" if near else "; give its mixture, or compute K from its own data"
    raise InputError(f"expected gases out of '{' '.join(GASES)}', got '{name}'{hint}", field="composition")


def _positive(name: str, value: float, unit: str, remedy: str) -> float:
    """The value as a Python float, which does not change the dtype of arrays."""
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"expected a positive number in {unit}, got {value:g}; {remedy}", field=name)
    return float(value)


def parse_mixture(composition: Composition) -> dict[str, float]:
    """Return the mole fractions of a composition, normalised to the sum 1; the given sum must be 1 within 1e-3."""
    pairs: Iterable[tuple[str, str | float]]
    if not isinstance(composition, str):
        pairs = composition.items()
    elif ":" in composition:
        pairs = [(part.partition(":")[0], part.partition(":")[2]) for part in composition.split(",")]
    else:
        pairs = [(composition, 1.0)]
    fractions: dict[str, float] = {}
    for name, number in pairs:
        species = _species(name.strip())
        if species in fractions:
            raise InputError(f"expected each gas once, got '{species}' twice; add its fractions", field="composition")
        try:
            fractions[species] = float(number)
        except (TypeError, ValueError):
            fractions[species] = math.nan
        if not fractions[species] >= 0:
            raise InputError(
                f"expected a mole fraction >= 0 for {species}, got '{number}'; write it as in 'CH4:0.112, O2:0.888'",
                field="composition",
            )
    total = sum(fractions.values())
    if not abs(total - 1) <= _FRACTION_TOLERANCE:
        remedy = f"the sum {total:g}; divide each by {total:g}" if total > 0 else "none above 0; name at least one gas"
        raise InputError(f"expected mole fractions with the sum 1, got {remedy}", field="composition")
    return {species: fraction / total for species, fraction in fractions.items()}


def molar_mass(composition: Composition) -> float:
    """Return the molar mass M = sum_i x_i M_i, kg/mol."""
    return sum(fraction * GASES[species].molar_mass for species, fraction in parse_mixture(composition).items())


def gladstone_dale(composition: Composition, wavelength_nm: float) -> float:
    """Return the Gladstone-Dale constant K = sum_i w_i K_i (m^3/kg), w_i the mass fractions x_i M_i / M.

    The reference density is that of the ideal gas; for CO2, the least ideal gas here, the real density at 0 degrees C
    is 0.7 % higher.

    Parameters
    ----------
    wavelength_nm : in vacuum

    Source: paper, Eq. (2); formulas and reference states in `GASES`.
    """
    mass, weighted = 0.0, 0.0
    for species, fraction in parse_mixture(composition).items():
        gas = GASES[species]
        low, high = gas.wavelength_range
        if not low <= wavelength_nm <= high:
            raise InputError(
                f"expected {low:g} to {high:g} nm for {species} ({gas.source}), got {wavelength_nm:g}; "
                "give nanometres, or the nearest end of the range (K changes by a few per cent over the visible)",
                field="wavelength_nm",
            )
        density = gas.pressure * gas.molar_mass / (GAS_CONSTANT * gas.temperature)
        constant = gas.refractivity(wavelength_nm / 1000) / density
        mass += fraction * gas.molar_mass
        weighted += fraction * gas.molar_mass * constant
    return weighted / mass


def density_from_index(index_excess: Quantity, n_ambient: float, K: float) -> Quantity:
    """Return the density rho = ((n_ambient - 1) + (n - n_ambient)) / K, kg/m^3.

    n itself is never formed: one float32 step near 1.00027 is already 0.04 % of n - 1.

    Parameters
    ----------
    index_excess : (...) n - n_ambient (1); float, array or tensor, whose type and dtype the result has
    K : Gladstone-Dale constant, m^3/kg
    """
    if not (math.isfinite(n_ambient) and n_ambient >= 1):
        raise InputError(
            f"expected a refractive index of at least 1, got {n_ambient:g}; "
            "give n itself, not n - 1 (ambient_index computes it)",
            field="n_ambient",
        )
    return (index_excess + (float(n_ambient) - 1.0)) / _positive("K", K, "m^3/kg", "see gladstone_dale")


def temperature_from_density(density: Quantity, pressure_pa: float, molar_mass: float) -> Quantity:
    """Return the temperature T = p M / (R rho) of an ideal gas, K; NaN where noise has made the density 0 or less.

    Parameters
    ----------
    density : (...) kg/m^3; float, array or tensor, whose type and dtype the result has
    pressure_pa : absolute pressure
    molar_mass : kg/mol
    """
    pressure = _positive("pressure_pa", pressure_pa, "Pa", "give the absolute pressure, 101325 for one atmosphere")
    mass = _positive("molar_mass", molar_mass, "kg/mol", "see molar_mass")
    scale = pressure * mass / GAS_CONSTANT
    if isinstance(density, float | int | np.generic):
        return scale / density if density > 0 else math.nan
    if isinstance(density, np.ndarray):
        return scale / np.where(density > 0, density, math.nan)
    return scale / density.where(density > 0, math.nan)


def density_from_temperature(temperature: Quantity, pressure_pa: float, molar_mass: float) -> Quantity:
    """Return the density rho = p M / (R T) (kg/m^3); the inverse of `temperature_from_density` has the same form."""
    return temperature_from_density(temperature, pressure_pa, molar_mass)


def ambient_index(composition: Composition, temperature_k: float, pressure_pa: float, wavelength_nm: float) -> float:
    """Return the refractive index n = 1 + K p M / (R T) of a gas at rest.

    Parameters
    ----------
    pressure_pa : absolute pressure
    wavelength_nm : in vacuum
    """
    temperature = _positive("temperature_k", temperature_k, "K", "add 273.15 to degrees Celsius")
    density = density_from_temperature(temperature, pressure_pa, molar_mass(composition))
    return 1.0 + gladstone_dale(composition, wavelength_nm) * density
