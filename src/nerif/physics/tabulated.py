"""A medium whose index is a monotonic function of one quantity: the function is tabulated and inverted.

    q = f^-1(f(q_ambient) + n - n_ambient)

so that the ambient value is exact whatever the accuracy of n_ambient.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from nerif.common.conventions import with_unit
from nerif.data.quantity_names import QUANTITIES
from nerif.physics.medium import Medium

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["Tabulated"]


@dataclass(frozen=True)
class Tabulated(Medium):
    """A quantity by the inverse of its index."""

    @abstractmethod
    def curve(self, quantity: str) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return values of a quantity, and the index at each, both monotonic."""

    @abstractmethod
    def ambient_value(self, quantity: str) -> float:
        """Return the quantity in the medium around the flow."""

    def values(self, excess: Tensor, n_ambient: float, quantity: str) -> tuple[Tensor, str]:
        import torch

        q, n = self.curve(quantity)
        if n[0] > n[-1]:
            q, n = q[::-1], n[::-1]
        order = np.argsort(q)
        index = np.interp(self.ambient_value(quantity), q[order], n[order]) + excess.cpu().numpy()
        values = np.interp(index, n, q, left=math.nan, right=math.nan)
        where = f"{quantity} beyond {q.min():g} to {with_unit(f'{q.max():g}', QUANTITIES[quantity][0])}"
        return torch.from_numpy(np.asarray(values)).to(excess), where
