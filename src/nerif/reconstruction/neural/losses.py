"""The loss of NeRIF (paper, Eq. (lossfunction)), in normalised units.

    loss = w_c |grad(n)_AD - grad(n)_net| + w_n |d_ND - d| + w_h |d_net - d| + w_a |d_AD - d| + w_g |n|_ambient

d_ND integrates central differences of n, d_net the gradient heads, d_AD the exact gradient of n; the first three
terms are the paper's. The last but one is its noise-free twin, the last the gauge. What is integrated, and how the
samples count, is the forward model's (forward/); one that sees the field and not its gradient has one prediction,
weighed by w_n + w_h + w_a.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.fields.network import NeuralField
from nerif.forward.base import Weights
from nerif.forward.path_integral import places
from nerif.geometry import Rays
from nerif.reconstruction.target import Part

__all__ = ["DATA", "Evaluator", "LossWeights", "loss_terms"]

DATA = ("automatic", "head", "numerical")
"""Names of the terms that compare a prediction with what was measured."""


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of the loss."""

    consistency: float = 0.0
    """|grad(n)_AD - grad(n)_net| over sample points (paper: 1)."""
    numerical: float = 0.0
    """|d_ND - d| over rays (paper: 1)."""
    head: float = 0.0
    """|d_net - d| over rays (paper: 1)."""
    automatic: float = 1.0
    """|d_AD - d| over rays (paper: 0)."""
    gauge: float = 1.0
    """N over the ambient region."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value >= 0:
                raise InputError(f"expected 0 or more, got {value}", field=f"weight of the {name} term")
        if self.numerical + self.head + self.automatic == 0:
            raise InputError("expected a positive numerical, head or automatic weight, got none", field="loss weights")


@runtime_checkable
class Evaluator(Protocol):
    """What the loss asks of a network; see fields/network.py."""

    def value(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Return the n head."""

    def value_and_gradient(
        self, p: Float[Tensor, "n 3"], heads: bool
    ) -> tuple[Tensor, Float[Tensor, "n 3"], Float[Tensor, "n 3"] | None]:
        """Return the n head, its exact gradient, and what the gradient heads say (None unless asked)."""


def loss_terms(
    field: NeuralField,
    network: Evaluator,
    part: Part,
    rays: Rays,
    s: Float[Tensor, "n m"],
    step: Float[Tensor, "n m"],
    weights: LossWeights,
    norm: str,
) -> dict[str, Tensor]:
    """Return the terms with positive weight by name, not yet weighted.

    The network alone may run in low precision; the path integral is summed in float32.

    Parameters
    ----------
    part : pixels, what they measured, and the forward model
    rays : those of the part, or several thin ones in a row for each, whose mean the pixel sees
    s : path lengths of the samples on the rays, mm
    step : length that each sample stands for, mm; the central differences reach half of it to either side, shared
        among the rays of a pixel, whose samples stand between one another
    norm : "l2" (mean length of the residual vectors, the paper's) or "squared" (mean square)
    """
    model, shape, each = part.model, s.shape, len(rays) // len(part)

    def compared(seen: Float[Tensor, "n c"]) -> Tensor:
        return reduce(part.residual(seen if each == 1 else rays.mean_of(each, seen)), norm)

    unit = field.scale / field.half_edge  # 1/mm of one unit of network gradient
    integral = model.weights(rays, s, step).in_units(field.scale, unit)

    @torch.no_grad()
    def look(points: Float[Tensor, "n m 3"]) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m 3"]]:
        value, slope, _ = network.value_and_gradient(field.normalise(points).reshape(-1, 3), False)
        return value.float().reshape(shape) * field.scale, slope.float().reshape(*shape, 3) * unit

    points, tilt = places(model, rays, s, step, look)
    tilt = None if tilt is None else tilt / unit
    p = field.normalise(points).reshape(-1, 3)
    if integral.slope is None:  # no gradient, so that what is asked in three ways is one
        seen = compared(integral(network.value(p).float().reshape(shape), None))
        return {name: seen for name in DATA if getattr(weights, name)}

    def data(value: Tensor | None, gradient: Float[Tensor, "p 3"]) -> Tensor:
        gradient = gradient.float().reshape(*shape, 3)
        gradient = gradient if tilt is None else gradient - tilt
        value = None if value is None else value.float().reshape(shape)
        return compared(integral(value, gradient))

    terms = {}
    if weights.automatic or weights.head or weights.consistency:
        heads = bool(weights.head or weights.consistency)
        value, automatic, head = network.value_and_gradient(p, heads)
        if weights.automatic:
            terms["automatic"] = data(value, automatic)
        if head is not None:
            if weights.head:
                terms["head"] = data(value, head)
            if weights.consistency:
                terms["consistency"] = reduce(automatic.float() - head.float(), norm)
    if weights.numerical:
        reach = step / (2 * each * field.half_edge)
        seen = by_differences(network.value, integral, p.reshape(*shape, 3), reach)
        if tilt is not None:
            seen = seen - Weights(integral.profile, slope=integral.slope)(None, tilt)
        terms["numerical"] = compared(seen)
    return terms


def by_differences(
    value: Callable[[Float[Tensor, "n 3"]], Float[Tensor, " n"]],
    integral: Weights,
    p: Float[Tensor, "n m 3"],
    reach: Float[Tensor, "n m"],
) -> Float[Tensor, "n c"]:
    """Return the prediction by central differences of n (paper, Eq. (samplegrad)).

    B grad(n) asks for the derivatives along the rows of B only, so two evaluations a sample and channel serve.

    Parameters
    ----------
    value : the n head
    integral : Weights in the units of the network
    p : sample points in the coordinates of the network
    reach : of the differences to either side, in the same coordinates; 0 where a ray misses the box
    """
    assert integral.slope is not None
    length = integral.slope.norm(dim=-1)
    along = integral.slope / torch.where(length > 0, length, 1.0)[..., None]
    reach = torch.where(reach > 0, reach, 1.0)  # any: a sample that stands for no length counts for nothing
    offset = reach[..., None, None] * along[:, None]  # n m c 3
    centre = p[:, :, None, :]
    points = torch.stack([centre + offset, centre - offset])  # 2 n m c 3
    n = value(points.reshape(-1, 3)).float().reshape(points.shape[:-1])
    slope = (n[0] - n[1]) / (2 * reach[..., None])  # n m c
    total = (integral.profile[..., None] * slope).sum(dim=1) * length
    if integral.value is not None:
        total = total + Weights(integral.profile, value=integral.value)(n.mean(dim=(0, 3)), None)
    return total


def reduce(residual: Float[Tensor, "n k"], norm: str) -> Tensor:
    """Mean length of the residual vectors ("l2") or mean square of their components ("squared")."""
    if norm == "l2":
        # the tiny term keeps the slope finite where a residual is exactly 0
        return (residual.square().sum(dim=-1) + 1e-24).sqrt().mean()
    return residual.square().mean()
