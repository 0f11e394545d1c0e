"""A medium: what its refractive index says, beside n itself, such as density or temperature."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self

from nerif.common.conventions import InputError, percent
from nerif.data.quantity_names import INDEX, QUANTITIES

if TYPE_CHECKING:
    from torch import Tensor

    from nerif.data.measurement import Measurement
    from nerif.data.volume import Volume

__all__ = ["Medium", "derive", "derive_all", "deviation", "masked_lines"]

LEAST_PRESSURE, LEAST_WAVELENGTH = 100.0, 100.0  # Pa and nm; smaller ones are in bar and µm
LEAST_TEMPERATURE = 60.0  # K of a gas around a flow; lower ones are degrees Celsius
STEP = 1e-4  # of the largest index excess, for derivatives
LEAST_STEP = 1e-9  # index


@dataclass(frozen=True)
class Medium(ABC):
    """Relations between the refractive index and other quantities of one medium."""

    names: ClassVar[tuple[str, ...]]
    """Quantities that may follow, beside index_excess and n."""
    surface_names: ClassVar[tuple[str, ...]] = ()
    """Those of them that are written on the surface of bodies."""
    optional: ClassVar[tuple[str, ...]] = ()
    """Those of them that an export has only on request."""

    @abstractmethod
    def values(self, excess: Tensor, n_ambient: float, quantity: str) -> tuple[Tensor, str]:
        """Return a quantity, NaN outside of its relation, and where that is, in words.

        Parameters
        ----------
        excess : (...) n - n_ambient
        """

    @abstractmethod
    def assumption(self, quantity: str) -> str:
        """The relation and what it assumes, in one line."""

    def attributes(self, quantity: str) -> dict[str, float | str]:
        """Return what a file says of the relation of a quantity."""
        return {}

    def not_around(self, n_ambient: float) -> str:
        """Return why this is not the medium around a flow, by the ambient index; empty if it may be."""
        return ""

    def absent(self, excess: Volume) -> dict[str, str]:
        """Return the quantities that do not follow from a field in this medium, each with the reason."""
        if excess.quantity != INDEX:
            return {}
        reason = self.not_around(float(excess.attributes["n_ambient"]))
        return dict.fromkeys((q for q in self.available(INDEX) if q in self.names), reason) if reason else {}

    def remarks(self, excess: Volume) -> list[str]:
        """Return lines on the quantities that do not follow from a field."""
        absent = self.absent(excess)
        return [
            f"{' and '.join(q for q in absent if absent[q] == reason)}: not computed: {reason}"
            for reason in dict.fromkeys(absent.values())
        ]

    def assumed(self, quantities: Sequence[str]) -> list[str]:
        """Return a line on each relation that gives some quantities, with what it assumes."""
        texts = {q: self.assumption(q) for q in quantities if q in self.names}
        distinct = dict.fromkeys(texts.values())
        whole = [text for text in distinct if not any(text in other for other in distinct if other != text)]
        return [f"{', '.join(q for q, part in texts.items() if part in text)}: {text}" for text in whole]

    def slope(self, excess: Tensor, n_ambient: float, quantity: str) -> Tensor:
        """Return the derivative of a quantity by the index, by central differences."""
        step = max(LEAST_STEP, STEP * float(excess.nan_to_num().abs().max()))
        above, below = (self.values(excess + sign * step, n_ambient, quantity)[0] for sign in (1, -1))
        return (above - below) / (2 * step)

    def for_measurement(self, measurement: Measurement) -> Self:
        """Return the medium at the wavelength of a measurement, if it has one."""
        wavelength = measurement.wavelength_nm
        if wavelength is None or measurement.quantity != INDEX or not hasattr(self, "wavelength_nm"):
            return self
        changes: dict[str, Any] = {"wavelength_nm": wavelength}
        return replace(self, **changes)

    def available(self, quantity: str) -> tuple[str, ...]:
        """Return the quantities that may follow from a field."""
        return (INDEX, "n", *self.names) if quantity == INDEX else (quantity,)

    def quantities_of(self, excess: Volume) -> tuple[str, ...]:
        """Return the quantities of a field, without those that are absent."""
        absent = self.absent(excess)
        return tuple(q for q in self.available(excess.quantity) if q not in absent)


def check_pressure(value: float, name: str) -> None:
    """Refuse what is no absolute pressure in Pa."""
    if not 0 < value < math.inf:
        raise InputError(f"expected a positive pressure in Pa, got {value}", field=name)
    if value < LEAST_PRESSURE:
        raise InputError(f"expected Pa such as 101325, got {value:g}; 1 bar are 100000 Pa", field=name)


def check_wavelength(value: float, name: str = "wavelength_nm") -> None:
    """Refuse a wavelength in micrometres."""
    if value < LEAST_WAVELENGTH:
        raise InputError(f"expected nanometres such as 532, got {value:g}; 1 µm are 1000 nm", field=name)


def check_temperature(value: float, name: str) -> None:
    """Refuse a temperature in degrees Celsius."""
    if not LEAST_TEMPERATURE <= value < math.inf:
        least = f"{LEAST_TEMPERATURE:g}"
        raise InputError(f"expected K, from {least} on, got {value:g}; add 273.15 to degrees Celsius", field=name)


def derive(excess: Volume, quantity: str, medium: Medium) -> Volume:
    """Return n, or a quantity of the medium, from a volume of index excess.

    Values outside of the relation, and everything that is absent from a field of this medium, are NaN; the notes
    contain their number, the reason and the assumptions.

    Parameters
    ----------
    excess : volume with n_ambient in its attributes
    quantity : index_excess, n, or one of the medium's
    """
    from nerif.data.volume import Volume

    available = medium.available(excess.quantity)
    if quantity not in available:
        raise InputError(f"expected one of {', '.join(available)}, got '{quantity}'", field="quantity")
    if quantity == excess.quantity:
        return excess
    n_ambient = float(excess.attributes["n_ambient"])
    if quantity == "n":
        return replace(excess, values=excess.values.double() + n_ambient, quantity="n")
    if reason := medium.absent(excess).get(quantity):
        values, where = excess.values.new_full(excess.values.shape, math.nan), reason
    else:
        values, where = medium.values(excess.values.double(), n_ambient, quantity)
    count, earlier = int(values.isnan().sum()), int(excess.notes.get("masked_voxels", 0))
    if earlier:
        where = f"{excess.notes['masked_where']}, or {where}" if count > earlier else str(excess.notes["masked_where"])
    notes: dict[str, float | str] = {
        "assumption": medium.assumption(quantity), "masked_voxels": count, "masked_where": where,
    }  # fmt: skip
    attributes = excess.attributes | medium.attributes(quantity)
    return Volume(values.float(), excess.grid, quantity, QUANTITIES[quantity][0], attributes, notes)


def deviation(excess: Volume, std: Tensor, quantity: str, medium: Medium) -> Tensor:
    """Return the standard deviation of a quantity to first order, |dq/dn| std; NaN where the quantity is.

    Parameters
    ----------
    std : (z, y, x) standard deviation of the values of `excess`
    """
    if quantity in (excess.quantity, "n"):
        return std
    slope = medium.slope(excess.values.double(), float(excess.attributes["n_ambient"]), quantity)
    return (std * slope.abs()).masked_fill(derive(excess, quantity, medium).values.isnan(), math.nan)


def derive_all(excess: Volume, medium: Medium) -> list[Volume]:
    """Return index_excess, n, and the quantities of the medium where they follow; other quantities unchanged."""
    return [derive(excess, quantity, medium) for quantity in medium.quantities_of(excess)]


def masked_lines(volumes: Sequence[Volume]) -> list[str]:
    """Return a line with number and reason for quantities with masked voxels."""
    names: dict[str, list[str]] = {}
    for v in volumes:
        if count := int(v.notes.get("masked_voxels", 0)):
            share = f"{count} of {v.values.numel()} voxels ({percent(count / v.values.numel(), 2)})"
            names.setdefault(f"{share} are NaN: {v.notes['masked_where']}", []).append(v.quantity)
    return [f"{', '.join(quantities)}: {line}" for line, quantities in names.items()]
