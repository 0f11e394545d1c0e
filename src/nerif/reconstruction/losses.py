"""The loss of NeRIF (paper, Eq. (lossfunction)), in normalised units.

    loss = w_c |grad(n)_AD - grad(n)_net| + w_n |d_ND - d| + w_h |d_net - d| + w_a |d_AD - d| + w_g |n|_ambient

d_ND integrates central differences of n, d_net the gradient heads, d_AD the exact gradient of n; the first three
terms are the paper's. The last but one is its noise-free twin, the last the gauge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.conventions import InputError
from nerif.fields.mlp import NeuralField
from nerif.geometry import Rays
from nerif.physics.deflection import bend, integration_weights
from nerif.reconstruction.target import Target

__all__ = ["Evaluator", "LossWeights", "loss_terms"]


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
                raise InputError(f"weight of the {name} term: expected 0 or more, got {value}")
        if self.numerical + self.head + self.automatic == 0:
            raise InputError("loss weights: expected a positive numerical, head or automatic weight, got none")


@runtime_checkable
class Evaluator(Protocol):
    """What the loss asks of a network; see fields/mlp.py."""

    def value(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Return the n head."""

    def value_and_gradient(
        self, p: Float[Tensor, "n 3"], heads: bool
    ) -> tuple[Tensor, Float[Tensor, "n 3"], Float[Tensor, "n 3"] | None]:
        """Return the n head, its exact gradient, and what the gradient heads say (None unless asked)."""


def loss_terms(
    field: NeuralField,
    network: Evaluator,
    target: Target,
    s: Float[Tensor, "n m"],
    step: Float[Tensor, "n m"],
    weights: LossWeights,
    model: str,
    norm: str,
    n_ambient: float,
) -> dict[str, Tensor]:
    """Return the terms with positive weight by name, not yet weighted.

    The network alone may run in low precision; the path integral is summed in float32.

    Parameters
    ----------
    s : path lengths of the samples, mm
    step : length that each sample stands for, mm; the central differences reach half of it to either side
    norm : "l2" (mean length of the residual vectors, the paper's) or "squared" (mean square)
    """
    rays, shape = target.rays, s.shape
    points, tilt = rays.at(s), None
    unit = field.index_scale / field.half_edge  # 1/mm of one unit of network gradient
    if model == "curved":  # along the ray as the present field bends it
        with torch.no_grad():
            _, bending, _ = network.value_and_gradient(field.normalise(points).reshape(-1, 3), False)
            bending = bending.float().reshape(*shape, 3)
            offset, angle = bend(bending * unit, rays, s, step, n_ambient)
            points = points + offset
            tilt = angle * torch.einsum("nmi,ni->nm", bending, rays.direction)[..., None]
    p = field.normalise(points).reshape(-1, 3)
    weight = integration_weights(rays, s, step, model) * (unit / n_ambient)

    def data(gradient: Float[Tensor, "p 3"]) -> Tensor:
        gradient = gradient.float().reshape(*shape, 3)
        if tilt is not None:
            gradient = gradient - tilt
        d = torch.einsum("nm,nij,nmj->ni", weight, rays.ends.sensitivity, gradient)
        return reduce((d - target.displacement) * target.inverse_scale, norm)

    terms = {}
    if weights.automatic or weights.head or weights.consistency:
        heads = bool(weights.head or weights.consistency)
        _, automatic, head = network.value_and_gradient(p, heads)
        if weights.automatic:
            terms["automatic"] = data(automatic)
        if head is not None:
            if weights.head:
                terms["head"] = data(head)
            if weights.consistency:
                terms["consistency"] = reduce(automatic.float() - head.float(), norm)
    if weights.numerical:
        d = numerical_displacement(network.value, rays, p.reshape(*shape, 3), step / (2 * field.half_edge), weight)
        terms["numerical"] = reduce((d - target.displacement) * target.inverse_scale, norm)
    return terms


def numerical_displacement(
    value: Callable[[Float[Tensor, "n 3"]], Float[Tensor, " n"]],
    rays: Rays,
    p: Float[Tensor, "n m 3"],
    reach: Float[Tensor, "n m"],
    weight: Float[Tensor, "n m"],
) -> Float[Tensor, "n 2"]:
    """Return the displacement by central differences of n (paper, Eq. (samplegrad)), px.

    S grad(n) asks for the derivatives along the two rows of S only, so four evaluations a sample serve.

    Parameters
    ----------
    value : the n head
    p : sample points in the coordinates of the network
    reach : of the differences to either side, in the same coordinates
    weight : lever arm times step in the units of the network
    """
    length = rays.ends.sensitivity.norm(dim=-1)  # px/mm
    along = rays.ends.sensitivity / length[..., None]
    offset = reach[..., None, None] * along[:, None]  # n m 2 3
    centre = p[:, :, None, :]
    points = torch.stack([centre + offset, centre - offset])  # 2 n m 2 3
    n = value(points.reshape(-1, 3)).float().reshape(points.shape[:-1])
    slope = (n[0] - n[1]) / (2 * reach[..., None])  # n m 2
    return (weight[..., None] * slope).sum(dim=1) * length


def reduce(residual: Float[Tensor, "n k"], norm: str) -> Tensor:
    """Mean length of the residual vectors ("l2") or mean square of their components ("squared")."""
    if norm == "l2":
        # the tiny term keeps the slope finite where a residual is exactly 0
        return (residual.square().sum(dim=-1) + 1e-24).sqrt().mean()
    return residual.square().mean()
