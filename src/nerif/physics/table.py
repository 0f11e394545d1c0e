"""A liquid or any medium whose index was tabulated: columns of one quantity, n, and optionally the wavelength."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import InputError
from nerif.common.text_tables import read_numbers
from nerif.physics.medium import check_wavelength
from nerif.physics.tabulated import Tabulated
from nerif.physics.water import ZERO_CELSIUS

__all__ = ["TableSettings"]

MEASURED = ("temperature", "mole_fraction", "mass_fraction", "salinity", "density")
LIGHT = ("wavelength", "wavelength_nm")
CELSIUS = ("c", "degc", "celsius", "degreesc")
OTHER = 0.15  # relative difference of n_ambient - 1 from that of the table
UNITS = {
    "temperature": ("k", *CELSIUS), "salinity": ("g/kg", "gkg-1"), "density": ("kg/m3", "kgm-3"),
    "mole_fraction": ("1", "-", "mol/mol"), "mass_fraction": ("1", "-", "kg/kg"),
}  # fmt: skip
"""Units without capitals, blanks and circumflexes."""
COLD = 200.0  # K: a table without a unit that begins below is in another


@dataclass(frozen=True)
class TableSettings(Tabulated):
    """A medium by a table of its index."""

    names: ClassVar[tuple[str, ...]] = MEASURED

    file: Path | None = None
    """Text file with a line of names and a row a point: temperature (K, or [C]), mass_fraction, mole_fraction, salinity
    or density; n; optionally wavelength (nm), between which n is interpolated."""
    ambient: float = 0.0
    """Value of the quantity around the flow, in the unit of the table."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm."""

    def __post_init__(self) -> None:
        check_wavelength(self.wavelength_nm)
        if self.file is None:
            return
        q, n = self.curve("")
        if not (np.diff(n) > 0).all() and not (np.diff(n) < 0).all():
            raise InputError(
                "expected n to rise or fall all the way with the quantity, got both; shorten it", field=self.file
            )
        if not q.min() <= self.ambient_value("") <= q.max():
            low, high = (end - self._zero for end in (q.min(), q.max()))
            raise InputError(
                f"expected a value of the table ({low:g} to {high:g}), got {self.ambient:g}", field="ambient"
            )

    @property
    def _content(self) -> tuple[str, bool, Float[np.ndarray, "n 3"]]:
        if self.file is None:
            raise InputError("expected a file for --medium table, got none; give --table.file", field="file")
        return _read(self.file)

    @property
    def _zero(self) -> float:
        """Value of the quantity at the zero of the table's unit."""
        return ZERO_CELSIUS if self._content[1] else 0.0

    def available(self, quantity: str) -> tuple[str, ...]:
        name = self._content[0]
        return tuple(q for q in super().available(quantity) if q not in MEASURED or q == name)

    def curve(self, quantity: str) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        _, _, rows = self._content
        if np.isnan(rows[:, 2]).all():
            return rows[:, 0], rows[:, 1]
        lights = np.unique(rows[:, 2])
        if not lights[0] <= self.wavelength_nm <= lights[-1]:
            raise InputError(
                f"expected {lights[0]:g} to {lights[-1]:g} nm as in {self.file}, got {self.wavelength_nm:g}",
                field="wavelength_nm",
            )
        q = np.unique(rows[:, 0])
        columns = [np.interp(q, *rows[rows[:, 2] == light, :2].T) for light in lights]
        return q, np.array([np.interp(self.wavelength_nm, lights, n) for n in np.stack(columns, axis=1)])

    def ambient_value(self, quantity: str) -> float:
        return self.ambient + self._zero

    def not_around(self, n_ambient: float) -> str:
        expected = float(np.interp(self.ambient_value(""), *self.curve("")))
        if abs(n_ambient - expected) <= OTHER * abs(expected - 1):
            return ""
        return (
            f"the ambient index {n_ambient:.10g} is not that of {self.file} ({expected:.6f}); give the n_ambient of "
            "the measurement"
        )

    def attributes(self, quantity: str) -> dict[str, float | str]:
        return {"medium": str(self.file), "wavelength_nm": self.wavelength_nm, "ambient": self.ambient}

    def assumption(self, quantity: str) -> str:
        return f"{quantity} by the index of {self.file} at {self.wavelength_nm:g} nm"


@lru_cache(maxsize=8)
def _read(path: Path) -> tuple[str, bool, Float[np.ndarray, "n 3"]]:
    """Return quantity, whether it is in degrees Celsius, and rows of it (K), n and wavelength, by rising quantity."""
    table = read_numbers(path, least=2)
    names = [name.lower().replace(" ", "_") for name in table.names]
    name = next((n for n in names if n in MEASURED), None)
    if name is None or "n" not in names:
        raise InputError(
            f"expected columns n and one of {', '.join(MEASURED)}, got {', '.join(names) or 'no names'}", field=path
        )
    unit = re.sub(r"[\s^]", "", table.units[names.index(name)].lower().replace("°", "deg").replace("³", "3"))
    if unit and unit not in UNITS[name]:
        raise InputError(f"expected {name} in {' or '.join(UNITS[name])}, got '{unit}'", field=path)
    celsius = name == "temperature" and unit in CELSIUS
    if name == "temperature" and not unit and float(np.nanmin(table.values[:, names.index(name)])) < COLD:
        raise InputError("expected a unit, temperature [C] or temperature [K], got none", field=path)
    q, n = table.values[:, names.index(name)], table.values[:, names.index("n")]
    light = next((table.values[:, names.index(key)] for key in LIGHT if key in names), np.full(len(q), np.nan))
    rows = np.stack([q + ZERO_CELSIUS * celsius, n, light], axis=-1)
    if len(rows) < 2 or not np.isfinite(rows[:, :2]).all():
        raise InputError("expected at least two rows of finite numbers", field=path)
    return name, celsius, rows[np.argsort(rows[:, 0], kind="stable")]
