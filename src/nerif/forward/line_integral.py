"""What absorption, emission and interferometry have in common: the integral of the field along the straight ray.

    y = weight integral f ds
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from nerif.forward.base import ForwardModel, Weights
from nerif.geometry import Rays

__all__ = ["LineIntegral"]


@dataclass(frozen=True)
class LineIntegral(ForwardModel):
    """The integral of the field along the straight ray, one channel."""

    channels = ("",)
    unit = "1"
    limits = (1e-12, 1e12)
    fill = 0.2  # objects fill a part of the box; what they show nothing of counts as 0

    @property
    @abstractmethod
    def weight(self) -> float:
        """What a millimetre of a field of 1 counts for."""

    def weights(self, rays: Rays, s: Float[Tensor, "n m"], step: Float[Tensor, "n m"]) -> Weights:
        return Weights(step, value=step.new_full((len(rays), 1), self.weight))
