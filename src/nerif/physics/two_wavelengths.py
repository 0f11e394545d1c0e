"""Two unknowns of a flow from its index at two wavelengths: gas and electrons, or the densities of two gases.

    n_i - n_ambient,i = sum_k c_ik q_k,      q = C^-1 (n - n_ambient),      var(q) = (C^-1)^2 var(n)

    gas and electrons    q = density less that of the ambient, electron density;    c = K(wavelength), -1 / (2 n_c)
    two gases            q = density of the one, change of the other's;      c = K_A, K_B

Temperature and mole fraction of two gases at a uniform pressure, T = p / (R sum_k rho_k / M_k), follow from the latter.
The dispersion of gases differs by little over the visible: the deviations show by how much noise grows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.quantity_names import INDEX, describe
from nerif.data.volume import Volume
from nerif.physics.gas_optics import GAS_CONSTANT, Composition, density_from_temperature, gladstone_dale, molar_mass
from nerif.physics.medium import Medium, check_pressure, check_temperature, check_wavelength
from nerif.physics.mixture import MixtureSettings
from nerif.physics.plasma import PlasmaSettings, critical_density

__all__ = ["gas_and_electrons", "separate", "two_gases"]

SAME = 1e-6  # of a determinant, relative to its terms: wavelengths that say the same


def separate(
    fields: Sequence[Volume], wavelengths_nm: Sequence[float], medium: Medium, stds: Sequence[Tensor] | None = None
) -> list[Volume]:  # fmt: skip
    """Return the two unknowns of a plasma (`gas_and_electrons`) or a mixture (`two_gases`)."""
    if isinstance(medium, PlasmaSettings):
        return gas_and_electrons(fields, wavelengths_nm, medium.composition, stds)
    if isinstance(medium, MixtureSettings):
        m = medium
        return two_gases(fields, wavelengths_nm, m.jet, m.ambient, m.temperature_k, m.pressure_pa, stds)
    raise InputError("expected plasma or mixture for two wavelengths, of which others have one unknown", field="medium")


def gas_and_electrons(
    fields: Sequence[Volume], wavelengths_nm: Sequence[float], composition: Composition = "air",
    stds: Sequence[Tensor] | None = None,
) -> list[Volume]:  # fmt: skip
    """Return density (kg/m^3) and electron density (m^-3), and their deviations if stated.

    Parameters
    ----------
    fields : two volumes of index excess on one grid
    wavelengths_nm : of the light of each
    stds : (z, y, x) standard deviations of both
    """
    lights = _checked(fields, wavelengths_nm)
    matrix = np.array([[gladstone_dale(composition, w), -1 / (2 * critical_density(w))] for w in lights])
    (change, electrons), deviations = _solved(matrix, fields, stds)
    around = (float(fields[0].attributes["n_ambient"]) - 1) / matrix[0, 0]
    about: dict[str, float | str] = {"gas": str(composition)}
    return _volumes(fields[0], ("density", "electron_density"), (change + around, electrons), deviations, about)


def two_gases(
    fields: Sequence[Volume], wavelengths_nm: Sequence[float], jet: Composition, ambient: Composition,
    temperature_k: float = 293.15, pressure_pa: float = 101325.0, stds: Sequence[Tensor] | None = None,
) -> list[Volume]:  # fmt: skip
    """Return temperature (K) and mole fraction of the jet, and their deviations to first order if stated.

    Parameters
    ----------
    fields, wavelengths_nm, stds : as in `gas_and_electrons`
    jet, ambient : gas that flows in, and gas around the flow
    temperature_k : of the gas around
    pressure_pa : uniform
    """
    check_temperature(temperature_k, "temperature_k")
    check_pressure(pressure_pa, "pressure_pa")
    lights = _checked(fields, wavelengths_nm)
    matrix = np.array([[gladstone_dale(gas, w) for gas in (jet, ambient)] for w in lights])
    (first, change), deviations = _solved(matrix, fields, stds)
    around = density_from_temperature(temperature_k, pressure_pa, molar_mass(ambient))
    moles = [first / molar_mass(jet), (change + around) / molar_mass(ambient)]
    total = moles[0] + moles[1]
    total = total.masked_fill(~(total > 0), math.nan)
    values = (pressure_pa / (GAS_CONSTANT * total), moles[0] / total)
    results = None
    if deviations is not None:
        of_moles = torch.linalg.inv(torch.from_numpy(matrix)) / torch.tensor([[molar_mass(jet)], [molar_mass(ambient)]])
        slopes = (
            [-values[0] / total, -values[0] / total],  # dT / d moles
            [moles[1] / total.square(), -moles[0] / total.square()],
        )
        assert stds is not None
        results = tuple(
            torch.stack([
                ((s[0] * of_moles[0, i] + s[1] * of_moles[1, i]) * stds[i].double()).square() for i in (0, 1)
            ]).sum(dim=0).sqrt()
            for s in slopes
        )  # fmt: skip
    about: dict[str, float | str] = {
        "jet": str(jet), "ambient": str(ambient), "ambient_temperature_k": temperature_k, "pressure_pa": pressure_pa,
    }  # fmt: skip
    return _volumes(fields[0], ("temperature", "mole_fraction"), values, results, about)


def _checked(fields: Sequence[Volume], wavelengths_nm: Sequence[float]) -> tuple[float, ...]:
    if len(fields) != 2 or len(wavelengths_nm) != 2:
        raise InputError(
            f"expected two of each, got {len(fields)} and {len(wavelengths_nm)}", field="fields, wavelengths_nm"
        )
    for field in fields:
        if field.quantity != INDEX:
            raise InputError(f"expected {INDEX}, got {field.quantity}", field="fields")
        if field.grid != fields[0].grid:
            raise InputError("expected both on one grid; sample the results with the same Grid", field="fields")
    for wavelength in wavelengths_nm:
        check_wavelength(wavelength, "wavelengths_nm")
    return tuple(wavelengths_nm)


def _solved(
    matrix: Float[np.ndarray, "2 2"], fields: Sequence[Volume], stds: Sequence[Tensor] | None
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor] | None]:
    """Return both unknowns, and their standard deviations for independent errors."""
    terms = abs(matrix[0, 0] * matrix[1, 1]) + abs(matrix[0, 1] * matrix[1, 0])
    if abs(np.linalg.det(matrix)) < SAME * terms:
        raise InputError("expected wavelengths that separate both, got the same relation twice", field="wavelengths_nm")
    inverse = np.linalg.inv(matrix)
    x = [field.values.double() for field in fields]
    first, second = (row[0] * x[0] + row[1] * x[1] for row in inverse)
    if stds is None:
        return (first, second), None
    squares = [std.double().square() for std in stds]
    a, b = ((row[0] ** 2 * squares[0] + row[1] ** 2 * squares[1]).sqrt() for row in inverse)
    return (first, second), (a, b)


def _volumes(
    like: Volume, names: tuple[str, str], values: Sequence[Tensor], deviations: Sequence[Tensor] | None,
    about: dict[str, float | str],
) -> list[Volume]:  # fmt: skip
    whole = [*names, *(f"{name}_std" for name in names if deviations)]
    return [
        Volume(v.float(), like.grid, name, describe(name)[0], about)
        for name, v in zip(whole, (*values, *(deviations or ())), strict=True)
    ]
