"""The paper's network (App. A): sinusoidal encoding, fully connected layers with a skip, heads for n and grad(n).

The encoding runs along the axes, as in the paper (Eq. (postionencode)), and along diagonals, for oblique fronts. The
gradient of the n head is the reverse pass written out as forward operations. The training loss, which contains this
gradient, then needs a single call of autograd and can be compiled (`torch.compile` cannot differentiate twice).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nerif.common.arrays import Points, Values, Vectors
from nerif.common.conventions import InputError
from nerif.common.transfer import constant
from nerif.fields.field import Field
from nerif.fields.network_shape import DIRECTIONS, NetworkShape, encoded_width
from nerif.geometry import Box

__all__ = [
    "ACTIVATIONS", "UNBOUNDED", "Network", "NeuralField", "encode", "encode_pullback", "wave_vectors",
]  # fmt: skip


def wave_vectors(octaves: int, directions: int) -> tuple[Float[Tensor, "w 3"], Int[Tensor, " w"]]:
    """Return 2^k pi e for k = 0 .. octaves - 1 and each direction e, those along the axes first, and k of each."""
    unit, waves, octave = torch.tensor(DIRECTIONS[directions], dtype=torch.float64), [], []
    for group in (unit[:3], unit[3:]):
        for k in range(octaves):
            waves.append(math.pi * 2.0**k * group)
            octave += [k] * len(group)
    if not waves:
        return torch.zeros(0, 3), torch.zeros(0, dtype=torch.long)
    return torch.cat(waves).float(), torch.tensor(octave)


def encode(
    p: Float[Tensor, "n 3"], waves: Float[Tensor, "w 3"], gains: Float[Tensor, " w"] | None = None
) -> Float[Tensor, "n e"]:
    """Return (p, g sin(k . p), g cos(k . p)) for coordinates p in [-1, 1], wave vectors k and gains g (paper: 1)."""
    x, y, z = waves.to(p).unbind(-1)
    # written out, since a matrix product in reduced precision would change the phases
    phase = torch.addcmul(torch.addcmul(p[:, :1] * x, p[:, 1:2], y), p[:, 2:], z)
    sine, cosine = phase.sin(), phase.cos()
    if gains is not None:
        sine, cosine = sine * gains, cosine * gains
    return torch.cat([p, sine, cosine], dim=1)


def encode_pullback(
    encoded: Float[Tensor, "n e"], cotangent: Float[Tensor, "n e"], waves: Float[Tensor, "w 3"]
) -> Float[Tensor, "n 3"]:
    """Return J^T cotangent, where J = d encode / d p and `encoded` = encode(p, waves).

    d sin(k . p) = k cos(k . p), so the two halves of the encoding are each other's derivative, gains included.
    """
    w = len(waves)
    sine, cosine = encoded[:, 3 : 3 + w], encoded[:, 3 + w :]
    swirl = cotangent[:, 3 : 3 + w] * cosine - cotangent[:, 3 + w :] * sine
    # written out as well, so that no product is in reduced precision
    return cotangent[:, :3] + torch.stack([(swirl * k).sum(dim=1) for k in waves.to(encoded).T], dim=1)


class Activation(NamedTuple):
    """An activation, called for its value and derivative."""

    value: Callable[[Tensor], Tensor]
    both: Callable[[Tensor], tuple[Tensor, Tensor]]

    def __call__(self, a: Tensor) -> tuple[Tensor, Tensor]:
        return self.both(a)


def _silu(a: Tensor) -> tuple[Tensor, Tensor]:
    s = torch.sigmoid(a)
    h = a * s
    return h, s + h * (1 - s)


def _softplus(a: Tensor) -> Tensor:
    return torch.nn.functional.softplus(a, beta=10.0)


def _tanh(a: Tensor) -> tuple[Tensor, Tensor]:
    h = torch.tanh(a)
    return h, 1 - h * h


ACTIVATIONS: dict[str, Activation] = {
    "silu": Activation(torch.nn.functional.silu, _silu),
    # sharpness 10: close to ReLU, but with a second derivative
    "softplus": Activation(_softplus, lambda a: (_softplus(a), torch.sigmoid(10.0 * a))),
    "tanh": Activation(torch.tanh, _tanh),
    "relu": Activation(torch.relu, lambda a: (torch.relu(a), (a > 0).to(a))),
    "sine": Activation(torch.sin, lambda a: (torch.sin(a), torch.cos(a))),
}

UNBOUNDED = (-math.inf, math.inf)
SHARPNESS = 10.0  # of the bounds: the output bends within 0.3 units of one
ATTENUATION = 0.3  # of a signal by one layer with torch's initial weights; compensated in networks deeper than 4


class Network(nn.Module):
    """Maps coordinates in [-1, 1] to the scaled index excess and, by separate heads, its gradient.

    Octave k of the encoding is weighted 2^(-k octave_decay), and from the sixth on (k > 4) 4^(4 - k) as well: its slope
    grows like 2^k, and is noise until the lower octaves represent the field.

    With `bounds` a <= N <= b the n head is not the last layer's output v but

        N = a + (softplus(k (v - a)) - softplus(k (v - b))) / k,     N = v far from both
    """

    layered: ClassVar[bool] = True
    """Whether the n head is a function of the last layer only."""
    compilable: ClassVar[bool] = True
    """Whether PyTorch can compile it."""
    beside: ClassVar[int] = 0
    """Inputs of the first layer beside the encoding."""
    gains: Tensor
    waves: Tensor
    octave: Tensor

    def __init__(self, shape: NetworkShape, bounds: tuple[float, float] = UNBOUNDED) -> None:
        super().__init__()
        self.shape, self.limits = shape, bounds
        e, w = encoded_width(shape.octaves, shape.directions) + self.beside, shape.width
        waves, octave = wave_vectors(shape.octaves, shape.directions)
        self.register_buffer("waves", waves, persistent=False)
        self.register_buffer("octave", octave, persistent=False)
        inputs = [e] + [w + (e if i == shape.skip else 0) for i in range(1, shape.depth + 1)]
        self.layers = nn.ModuleList(nn.Linear(inputs[i], w) for i in range(shape.depth))
        outputs = 4 if shape.gradient_head else 1
        hidden_heads = outputs if shape.head_width else 0
        self.heads = nn.ModuleList(nn.Linear(inputs[-1], shape.head_width) for _ in range(hidden_heads))
        self.outputs = nn.ModuleList(nn.Linear(shape.head_width or inputs[-1], 1) for _ in range(outputs))
        k = torch.arange(shape.octaves)
        # octaves above those of the reference would be steeper than the field
        beyond = 4.0 ** -(k - (NetworkShape.octaves - 1)).clamp(min=0)
        self.register_buffer("gains", beyond * 2.0 ** (-shape.octave_decay * k))
        if shape.depth > NetworkShape.depth:  # the signal is as strong as after the layers of the reference
            lost = (shape.depth - NetworkShape.depth) / (shape.depth - 1)
            with torch.no_grad():
                for layer in self.layers[1:]:
                    _linear(layer).weight.mul_(ATTENUATION**-lost)

    def forward(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Return the scaled index excess."""
        h, _ = self._trunk(p)
        return self.bounded(self._value(p, h)[0])[0]

    def value_and_gradient(
        self, p: Float[Tensor, "n 3"], heads: bool = False
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"], Float[Tensor, "n 3"] | None]:
        """Return the n head, its exact gradient, and the gradient heads (None unless `heads`)."""
        slopes: list[Tensor] = []
        h, encoded = self._trunk(p, slopes)
        value, cotangent, beside = self._value(p, h)
        value, slope = self.bounded(value)
        cotangent = cotangent if slope is None else cotangent * slope[:, None]
        # from here on the reverse pass: cotangent is d value / d (output of the layer)
        to_encoding: Tensor | None = None
        for i in range(self.shape.depth, 0, -1):
            if i == self.shape.skip:
                to_encoding = cotangent[:, self.shape.width :]
                cotangent = cotangent[:, : self.shape.width]
            cotangent = (cotangent * slopes[i - 1]) @ _linear(self.layers[i - 1]).weight
        if to_encoding is not None:
            cotangent = cotangent + to_encoding
        gradient = self.pull_back(p, encoded, cotangent)
        if beside is not None:
            gradient = gradient + (beside if slope is None else beside * slope[:, None])
        return value, gradient, self._gradient_heads(p, h) if heads else None

    def _save_to_state_dict(self, destination: dict[str, Tensor], prefix: str, keep_vars: bool) -> None:
        """Add the bounds, in double precision on the CPU."""
        super()._save_to_state_dict(destination, prefix, keep_vars)
        destination[f"{prefix}bounds"] = torch.tensor(self.limits, dtype=torch.float64)

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *others: Any) -> None:
        """Load weights; older files have no gains and weight octaves by octave_decay only, and have no bounds."""
        state_dict.setdefault(f"{prefix}gains", 2.0 ** (-self.shape.octave_decay * torch.arange(self.shape.octaves)))
        bounds = state_dict.pop(f"{prefix}bounds", None)
        low, high = UNBOUNDED if bounds is None else bounds.tolist()
        self.limits = low, high
        super()._load_from_state_dict(state_dict, prefix, *others)

    def bounded(self, v: Float[Tensor, " n"]) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"] | None]:
        """Return the n head within its bounds, and its derivative; None for 1."""
        if self.limits == UNBOUNDED:
            return v, None
        low, high = self.limits
        v = v.float()
        value, slope = v, torch.ones_like(v)
        for bound, sign in ((low, 1.0), (high, -1.0)):
            if math.isfinite(bound):
                beyond = SHARPNESS * sign * (bound - v)  # above 0 beyond the bound
                value = value + sign * torch.nn.functional.softplus(beyond) / SHARPNESS
                slope = slope - torch.sigmoid(beyond)
        return value.clamp(low, high), slope  # clamps rounding errors only

    def encode(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, "n e"]:
        """Return the input of the first layer at points."""
        return encode(p, self.waves, self.gains[self.octave].to(p))

    def pull_back(self, p: Tensor, encoded: Tensor, cotangent: Tensor) -> Float[Tensor, "n 3"]:
        """Return the derivative by x, y, z from that by the input of the first layer."""
        return encode_pullback(encoded, cotangent, self.waves)

    def _trunk(self, p: Tensor, slopes: list[Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """Output of the last layer, and the encoding; the derivatives of the activations are added to `slopes`."""
        activate = ACTIVATIONS[self.shape.activation]
        encoded = self.encode(p)
        h = encoded
        for i, layer in enumerate(self.layers, start=1):
            if slopes is None:
                h = activate.value(layer(h))
            else:
                h, slope = activate(layer(h))
                slopes.append(slope)
            if i == self.shape.skip:
                h = torch.cat([h, encoded], dim=1)
        return h, encoded

    def _value(self, p: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Output v of the n head, its derivative by h, and its direct derivative by p."""
        return *self._head(0, h), None

    def _head(self, index: int, h: Tensor) -> tuple[Tensor, Tensor]:
        """Output `index` and its derivative by h."""
        output = _linear(self.outputs[index])
        if not self.shape.head_width:
            return output(h)[:, 0], output.weight.expand(h.shape[0], -1)
        head = _linear(self.heads[index])
        inner, slope = ACTIVATIONS[self.shape.activation](head(h))
        return output(inner)[:, 0], (slope * output.weight) @ head.weight

    def _gradient_heads(self, p: Tensor, h: Tensor) -> Tensor:
        if not self.shape.gradient_head:
            raise InputError("expected a network with gradient heads, got one without", field="gradient_head")
        return torch.stack([self._head(i, h)[0] for i in (1, 2, 3)], dim=1)


def _linear(module: nn.Module) -> nn.Linear:
    assert isinstance(module, nn.Linear)
    return module


class NeuralField(Field):
    """A network in physical units: f(x) = scale (network((x - centre) / half_edge) - offset).

    Parameters
    ----------
    box : mm; its longest edge is mapped to [-1, 1]
    scale : field of one unit of network output
    offset : network output of the ambient field (the gauge)
    """

    def __init__(self, network: Network, box: Box, scale: float, offset: float = 0.0) -> None:
        self.network, self.box, self.scale, self.offset = network, box, scale, offset
        self.half_edge = max(box.edges) / 2

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest possible value, to six digits."""
        low, high = (float(f"{limit * self.scale:.6g}") for limit in self.network.limits)
        return low, high

    def to(self, device: torch.device | str) -> NeuralField:
        """Return the field with a copy of its network on a device, or itself if it is there."""
        if next(self.network.parameters()).device == torch.device(device):
            return self
        field = copy.copy(self)
        field.network = copy.deepcopy(self.network).to(device)
        return field

    def normalise(self, points: Points) -> Points:
        """Map points in mm to the coordinates of the network."""
        return (points - constant(self.box.centre, points)) / self.half_edge

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        value, gradient, _ = self.network.value_and_gradient(self.normalise(points.reshape(-1, 3)))
        value = self.scale * (value - self.offset)
        gradient = gradient * (self.scale / self.half_edge)
        return value.reshape(points.shape[:-1]), gradient.reshape(points.shape)

    def value(self, points: Points) -> Values:
        value = self.network(self.normalise(points.reshape(-1, 3)))
        return (self.scale * (value - self.offset)).reshape(points.shape[:-1])
