"""Axis names and units (prose: docs/conventions.md).

Lengths are millimetres, image quantities pixels, angles radians, times seconds. Volumes are indexed [z, y, x].
"""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import SupportsFloat

__all__ = [
    "AMBIENT_INDEX", "COMPONENTS", "DEFAULT_AMBIENT_FACES", "FACES", "LARGEST_INDEX", "LARGEST_LENGTH", "STATISTICS",
    "InputError", "ambient_index", "check_name", "parse_faces", "percent", "printable", "unit_shown", "whole",
    "with_unit", "within",
]  # fmt: skip

COMPONENTS = ("u", "v")
"""Displacement components: u along columns, v along rows, both in px."""

FACES = ("x-", "x+", "y-", "y+", "z-", "z+")
"""Faces of the box, by outward normal."""

DEFAULT_AMBIENT_FACES = ("x-", "x+", "y-", "y+")
"""Faces with the ambient index by default: the side faces (the gauge)."""

AMBIENT_INDEX = 1.00027
"""Default refractive index: air at 20 °C and one atmosphere."""

STATISTICS = {"std": "standard deviation", "p05": "5th percentile", "p95": "95th percentile", "certainty": "certainty"}
"""Suffixes of bootstrap statistics of a quantity (density_std), and their names."""

LARGEST_INDEX = 4.0
"""Upper limit of the refractive index of gases, liquids and glasses."""

CONTROL = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Unicode categories of control, format and line characters."""

LARGEST_LENGTH = 1e7
"""Ten kilometres in mm: a longer length is taken for an error of unit."""


class InputError(ValueError):
    """Invalid input.

    Parameters
    ----------
    message : the expected and the actual value, and the remedy
    field : name of the parameter, variable or file; precedes the message
    """

    def __init__(self, message: str, *, field: object = "") -> None:
        self.field, self.message = str(field), message
        super().__init__(f"{self.field}: {message}" if self.field else message)

    def inside(self, place: object) -> InputError:
        """Return the error with the file or view in which it occurred as prefix and the field unchanged."""
        error = InputError(f"{place}: {self}")
        error.field = self.field
        return error

    def renamed(self, names: Mapping[str, str]) -> InputError:
        """Return the error with other names of its fields, such as those of options, where all of them have one."""
        fields = self.field.split(", ")
        if not str(self).startswith(f"{self.field}: ") or not all(field in names for field in fields):
            return self
        return InputError(self.message, field=", ".join(names[field] for field in fields))


@contextmanager
def within(place: object) -> Iterator[None]:
    """Prefix an InputError of the block with the file or view in which it occurs."""
    try:
        yield
    except InputError as error:
        raise error.inside(place) from None


def ambient_index(value: object, name: str = "n_ambient") -> float:
    """Return the refractive index around the flow, a number between 0.9 and 4, as a float."""
    if not isinstance(value, SupportsFloat) or not 0.9 < float(value) < LARGEST_INDEX:
        raise InputError(f"expected a refractive index such as 1.00027, got {value}", field=name)
    return float(value)


def printable(text: str) -> str:
    """Return a text whose control characters, but for line breaks and tabs, are escapes: a terminal obeys them."""
    return "".join(c if c in "\n\t" or unicodedata.category(c) not in CONTROL else ascii(c)[1:-1] for c in text)


def check_name(name: str, of: str) -> None:
    """Refuse the name of a view, say, with control characters: they would reach terminals, reports, names of files."""
    if any(unicodedata.category(c) in CONTROL for c in name):
        raise InputError(f"expected a name without control characters, got {name!a}", field=of)


def whole(value: object, name: str) -> int:
    """Return a whole number of a file as an int."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = math.nan
    if not number.is_integer():
        raise InputError(f"expected a whole number, got {value}", field=name)
    return int(number)


def percent(share: float, digits: int = 1) -> str:
    """Return a fraction in per cent; a small one as under 0.1 %, not 0."""
    least = 10.0 ** -(digits + 2)
    return f"under {least:.{digits}%}" if 0 < share < least / 2 else f"{share:.{digits}%}"


def unit_shown(unit: str) -> str:
    """Return the unit as printed, a noun in the plural; empty for the unit 1."""
    return {"1": "", "grey value": "grey values"}.get(unit, unit)


def with_unit(value: object, unit: str) -> str:
    """Return a number, or a text that ends with one, followed by its unit."""
    return f"{value} {unit_shown(unit)}".rstrip()


def parse_faces(text: str | tuple[str, ...] | list[str], name: str = "ambient_faces") -> tuple[str, ...]:
    """Return the faces named in a text such as ``"x- x+ y- y+"``."""
    words = tuple(text.replace(",", " ").split()) if isinstance(text, str) else tuple(text)
    for word in words:
        if word not in FACES:
            raise InputError(f"expected faces out of '{' '.join(FACES)}', got '{word}'", field=name)
    return words
