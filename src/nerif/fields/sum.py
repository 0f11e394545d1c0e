"""The sum of several fields, such as a network and the splines of the detail that it leaves."""

from __future__ import annotations

import torch

from nerif.common.arrays import Points, Values, Vectors
from nerif.fields.field import Field

__all__ = ["SumField"]


class SumField(Field):
    """The sum of fields in the same box."""

    def __init__(self, *parts: Field) -> None:
        self.parts = parts

    def to(self, device: torch.device | str) -> SumField:
        """Return the sum with all its parts on a device."""
        return SumField(*(part.to(device) for part in self.parts))

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        values, gradients = zip(*(part.value_and_gradient(points) for part in self.parts), strict=True)
        return torch.stack(values).sum(dim=0), torch.stack(gradients).sum(dim=0)

    def value(self, points: Points) -> Values:
        return torch.stack([part(points) for part in self.parts]).sum(dim=0)
