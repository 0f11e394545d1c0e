"""Records of arrays that have one entry each for many things alike, such as rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar

from torch import Tensor

__all__ = ["Columns"]

C = TypeVar("C", bound="Columns")


class Columns:
    """A record of arrays with one entry a ray, or of such records; None where there is nothing."""

    def each(self: C, change: Callable[..., Tensor], *others: C) -> C:
        """Return the record of what `change` makes of every array and those of the others in its place.

        What is no array, such as a box, is the same in all of them.
        """
        made: dict[str, Any] = {}
        for f in fields(self):  # type: ignore[arg-type]
            first, *more = (getattr(part, f.name) for part in (self, *others))
            if isinstance(first, Columns):
                first = first.each(change, *more)
            elif isinstance(first, Tensor):
                first = change(first, *more)
            else:
                assert all(other == first for other in more), f"{f.name}: expected the same in all records"
            made[f.name] = first
        return type(self)(**made)
