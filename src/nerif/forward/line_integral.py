"""The straight-ray integral shared by absorption, emission and interferometry.

y = weight integral f ds
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from nerif.forward.forward_model import ForwardModel, Map, Mask, Samples, Weights
from nerif.geometry import Rays

__all__ = ["MAX_NOISE", "LineIntegral", "share_below"]

MAX_NOISE = 5.0  # standard deviations, beyond which a deviation is not noise
GAUSSIAN = 1.4826  # standard deviation over the median absolute value of a Gaussian variable


def share_below(lowest: float, values: Map, sigma: Map | None, usable: Mask) -> float:
    """Return the share of the usable pixels of a map that are below the lowest possible value by more than their noise.

    Without sigma it is estimated from the median difference of neighbours along rows, which is too large where the map
    is steep in half of its pixels:

        sigma = 1.4826 median |y_(i+1) - y_i| / sqrt(2)
    """
    if not bool(usable.any()):
        return 0.0
    noise: Tensor | float
    if sigma is not None:
        noise = sigma[usable]
    else:
        steps = values.diff(dim=1)[usable[:, 1:] & usable[:, :-1]]
        noise = GAUSSIAN * float(steps.abs().median()) / 2**0.5 if len(steps) else 0.0
    return float((values[usable] < lowest - MAX_NOISE * noise).float().mean())


@dataclass(frozen=True)
class LineIntegral(ForwardModel):
    """The integral of the field along the straight ray, one channel."""

    channels = ("",)
    unit = "1"
    limits = (1e-12, 1e12)
    fill = 0.2  # objects fill a part of the box

    @property
    def weight(self) -> float:
        """Factor of the integral, 1/mm per unit of the field."""
        return 1.0

    def weights(self, rays: Rays, s: Samples, step: Samples) -> Weights:
        return Weights(step, value=step.new_full((len(rays), 1), self.weight))
