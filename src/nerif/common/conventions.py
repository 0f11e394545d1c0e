"""Axis names, units and array aliases: the one place where each is written down (prose in docs/conventions.md).

Lengths are millimetres, image quantities pixels, angles radians, times seconds. Volumes are indexed [z, y, x].
"""

from __future__ import annotations

from typing import SupportsFloat

from jaxtyping import Bool, Float, Int
from torch import Tensor

__all__ = [
    "AMBIENT_INDEX",
    "COMPONENTS",
    "DEFAULT_AMBIENT_FACES",
    "FACES",
    "LARGEST_INDEX",
    "LARGEST_LENGTH",
    "STATISTICS",
    "InputError",
    "Mask",
    "Matrix3",
    "Pixels",
    "Points",
    "Values",
    "Vectors",
    "VoxelIndex",
    "ambient_index",
    "parse_faces",
    "unit_shown",
    "with_unit",
]

COMPONENTS = ("u", "v")
"""Displacement components: u along columns, v along rows, both in px."""

FACES = ("x-", "x+", "y-", "y+", "z-", "z+")
"""Faces of the box, by outward normal."""

DEFAULT_AMBIENT_FACES = ("x-", "x+", "y-", "y+")
"""Where the index is taken as ambient when nothing else is said: the side faces (the gauge)."""

AMBIENT_INDEX = 1.00027
"""Of air at 20 °C and one atmosphere, where nothing else is said."""

STATISTICS = {
    "std": "standard deviation",
    "p05": "5th percentile",
    "p95": "95th percentile",
    "certainty": "certainty",
}
"""Endings of what repetitions of a reconstruction tell of a quantity (density_std), in words."""

LARGEST_INDEX = 4.0
"""Of gases, liquids and glasses."""

LARGEST_LENGTH = 1e7
"""Beyond ten kilometres (mm) a length is taken for a mistake of its unit."""

Points = Float[Tensor, "*batch 3"]  # mm, world frame
Vectors = Float[Tensor, "*batch 3"]  # direction (1) or gradient (1/mm)
Values = Float[Tensor, "*batch"]  # index excess n - n_ambient (1)
Pixels = Float[Tensor, "*batch 2"]  # px, (column u, row v), (0, 0) the centre of the top-left pixel
Matrix3 = Float[Tensor, "3 3"]
Mask = Bool[Tensor, "*batch"]
VoxelIndex = Int[Tensor, "*batch 3"]


class InputError(ValueError):
    """Invalid input: the message names the field, what was expected, what came, and the remedy.

    Parameters
    ----------
    message : what was expected, what came, the remedy
    field : name of the parameter, variable or file at fault, which the message then begins with
    """

    def __init__(self, message: str, *, field: object = "") -> None:
        self.field = str(field)
        super().__init__(f"{self.field}: {message}" if self.field else message)

    def inside(self, place: object) -> InputError:
        """Return the error with the file or view in which it occurred before its message; the field stays."""
        error = InputError(f"{place}: {self}")
        error.field = self.field
        return error


def ambient_index(value: object, name: str = "n_ambient") -> float:
    """Return the refractive index around the flow as a number.

    Raises
    ------
    InputError
        If it is not a number between 0.9 and 4, as of gases, liquids and glasses.
    """
    if not isinstance(value, SupportsFloat) or not 0.9 < float(value) < LARGEST_INDEX:
        raise InputError(f"expected a refractive index such as 1.00027, got {value}", field=name)
    return float(value)


def unit_shown(unit: str) -> str:
    """Return a unit as people see it: nothing for that of a pure number, 1."""
    return "" if unit == "1" else unit


def with_unit(value: object, unit: str) -> str:
    """Return a number, or a text that ends with one, with its unit behind it."""
    return f"{value} {unit_shown(unit)}".rstrip()


def parse_faces(text: str | tuple[str, ...] | list[str], name: str = "ambient_faces") -> tuple[str, ...]:
    """Return the faces named in a text such as ``"x- x+ y- y+"``.

    Raises
    ------
    InputError
        If a word is not one of ``x- x+ y- y+ z- z+``.
    """
    words = tuple(text.replace(",", " ").split()) if isinstance(text, str) else tuple(text)
    for word in words:
        if word not in FACES:
            raise InputError(f"expected faces out of '{' '.join(FACES)}', got '{word}'", field=name)
    return words
