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
        """Return the record of what `change` makes of every array and those of the others in its place."""
        made: dict[str, Any] = {}
        for f in fields(self):  # type: ignore[arg-type]
            first, *more = (getattr(part, f.name) for part in (self, *others))
            if isinstance(first, Columns):
                first = first.each(change, *more)
            made[f.name] = change(first, *more) if isinstance(first, Tensor) else first
        return type(self)(**made)
