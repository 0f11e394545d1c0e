"""The straight-ray integral shared by absorption, emission and interferometry.

y = weight integral f ds
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from nerif.forward.base import ForwardModel, Weights
from nerif.geometry import Rays

__all__ = ["IMPOSSIBLE", "LineIntegral", "neighbour_noise", "share_below"]

IMPOSSIBLE = 5.0
"""Standard deviations by which noise does not lead beyond what there can be."""
GAUSSIAN = 1.4826  # standard deviations in the median of the size of a Gaussian variable


def share_below(
    least: float,
    values: Float[Tensor, "row column c"],
    sigma: Float[Tensor, "row column c"] | None,
    usable: Bool[Tensor, "row column"],
) -> float:
    """Return the share of the usable pixels that are below the least value by more than their noise.

    Parameters
    ----------
    least : what there can be without noise
    values, sigma : the map of a view; where sigma is None, what neighbours tell of it is taken
    usable : pixels to look at
    """
    if not bool(usable.any()):
        return 0.0
    noise = neighbour_noise(values, usable) if sigma is None else sigma[usable]
    return float((values[usable] < least - IMPOSSIBLE * noise).float().mean())


def neighbour_noise(values: Float[Tensor, "row column c"], usable: Bool[Tensor, "row column"]) -> float:
    """Return the standard deviation of the noise by the median difference of neighbours along rows; 0 without any.

        sigma = 1.4826 median |y_(i+1) - y_i| / sqrt(2)

    It is too large where the map is steep in half of its pixels.
    """
    steps = values.diff(dim=1)[usable[:, 1:] & usable[:, :-1]]
    return GAUSSIAN * float(steps.abs().median()) / 2**0.5 if len(steps) else 0.0


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
