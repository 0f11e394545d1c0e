"""One network over space and time, (x, y, z, t) -> n: what neighbouring frames have in common is learned once.

    N(x, t) = f(encode(x), encode(x - c tau), tau, sin(2^k pi tau), cos(2^k pi tau)),   tau = t mapped to [-1, 1]

The drift c is learned with the weights: what the flow carries along stands still in x - c tau, and needs no high
frequency in time.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerif.common.conventions import Points
from nerif.fields.network import UNBOUNDED, Network, NetworkShape, NeuralField, encode, encode_pullback, encoded_width
from nerif.geometry import Box

__all__ = ["AtTimes", "SpaceTimeField", "SpaceTimeNetwork", "with_time"]


class SpaceTimeNetwork(Network):
    """Maps (x, y, z, tau) in [-1, 1] to the scaled index excess; its gradient is that in space.

    Parameters
    ----------
    shape : NetworkShape, of the layers
    time_octaves : of the encoding of time
    bounds : lowest and highest value of the n head
    """

    def __init__(self, shape: NetworkShape, time_octaves: int, bounds: tuple[float, float] = UNBOUNDED) -> None:
        self.time_octaves = time_octaves
        space = encoded_width(shape.octaves, shape.directions)
        super().__init__(shape, 2 * space + 1 + 2 * time_octaves, bounds)
        self.drift = nn.Parameter(torch.zeros(3))  # half edges of the box per unit of tau

    def encode(self, p: Float[Tensor, "n 4"]) -> Tensor:
        place, tau = p[:, :3], p[:, 3:]
        waves, gains = self.waves, self.gains[self.octave].to(p)
        angle = math.pi * tau * 2.0 ** torch.arange(self.time_octaves, device=p.device, dtype=p.dtype)
        carried = place - tau * self.drift.to(p)
        return torch.cat(
            [encode(place, waves, gains), encode(carried, waves, gains), tau, angle.sin(), angle.cos()], dim=1
        )

    def pull_back(self, p: Tensor, encoded: Tensor, cotangent: Tensor) -> Float[Tensor, "n 3"]:
        e = encoded_width(self.shape.octaves, self.shape.directions)
        still = encode_pullback(encoded[:, :e], cotangent[:, :e], self.waves)
        return still + encode_pullback(encoded[:, e : 2 * e], cotangent[:, e : 2 * e], self.waves)


def with_time(p: Float[Tensor, "n 3"], tau: Float[Tensor, " m"] | None) -> Float[Tensor, "n k"]:
    """Return (x, y, z, tau), point i of n at tau[i m / n]; (x, y, z) where there is no time."""
    return p if tau is None else torch.cat([p, tau.repeat_interleave(len(p) // len(tau))[:, None]], dim=1)


class AtTimes:
    """A space-time network as a network over space alone, each point at a time of its own; an Evaluator of the loss.

    Parameters
    ----------
    network : evaluates (x, y, z, tau)
    tau : (m,) times in [-1, 1]; point i of n is taken at tau[i m / n]
    """

    def __init__(self, network: Any, tau: Float[Tensor, " m"]) -> None:
        self.network, self.tau = network, tau

    def value(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Return the n head."""
        return self.network.value(with_time(p, self.tau))

    def value_and_gradient(
        self, p: Float[Tensor, "n 3"], heads: bool
    ) -> tuple[Tensor, Float[Tensor, "n 3"], Float[Tensor, "n 3"] | None]:
        """Return the n head, its exact gradient in space, and what the gradient heads say."""
        return self.network.value_and_gradient(with_time(p, self.tau), heads)


class SpaceTimeField(NeuralField):
    """A space-time network at one instant, in physical units.

    Parameters
    ----------
    network : SpaceTimeNetwork
    box : Box, mm; its longest edge is mapped to [-1, 1]
    tau : the instant, in [-1, 1]
    scale : field of one unit of network output
    offset : network output that counts as ambient (the gauge)
    """

    def __init__(
        self, network: SpaceTimeNetwork, box: Box, tau: float, scale: float, offset: float = 0.0
    ) -> None:
        super().__init__(network, box, scale, offset)
        self.network: SpaceTimeNetwork = network
        self.tau = tau

    def _inputs(self, points: Points) -> Float[Tensor, "n 4"]:
        return with_time(self.normalise(points.reshape(-1, 3)), points.new_tensor([self.tau]))
