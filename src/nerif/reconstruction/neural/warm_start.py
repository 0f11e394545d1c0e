"""Starting the network from another field, such as a classical reconstruction of the same data.

From a network of the same shape the weights are copied; to any other field the network is fitted:

min  mean (N - n)^2 / mean n^2  +  mean |grad N - grad n|^2 / mean |grad n|^2       over random points of the box
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import nn

from nerif.fields.field import Field
from nerif.fields.network import UNBOUNDED, NeuralField
from nerif.fields.symmetric import SymmetricNetwork
from nerif.reconstruction.neural.losses import Evaluator
from nerif.reconstruction.neural.optimiser import Optimiser, adam_step

__all__ = ["copy_weights", "fit_network"]

WARM_UP = 20  # steps
MIN_SQUARE = 1e-12  # mean square in units of the network, below which the field is 0
AXIS_TOLERANCE = 0.05  # of half the box, between two estimates of an axis
BETAS = (0.9, 0.999)  # Adam's decay rates


def copy_weights(start: Field, field: NeuralField) -> bool:
    """Copy the weights of a neural field exactly; return False if its shape, box, bounds or axis differ."""
    if not isinstance(start, NeuralField) or type(start.network) is not type(field.network):
        return False
    if start.network.shape != field.network.shape or start.box != field.box:
        return False
    before, now = (f.network.symmetry if isinstance(f.network, SymmetricNetwork) else None for f in (start, field))
    mixing = None
    if before is not None and now is not None:
        if not now.near(before, AXIS_TOLERANCE):
            return False
        mixing = now.mixing(before).float() if now.harmonics else None
    bounded = (start.network.limits, field.network.limits) != (UNBOUNDED, UNBOUNDED)
    if bounded and start.bounds != field.bounds:
        return False
    field.network.load_state_dict(start.network.state_dict())
    if mixing is not None:  # the azimuths a_k count from e1, which depends on the views
        output = field.network.outputs[0]
        assert isinstance(output, nn.Linear)
        with torch.no_grad():
            for values in (output.weight, output.bias):
                values.copy_(mixing.to(values) @ values)
    if bounded:  # bounds bend nearby values in units of the scale, so the scale is copied as well
        field.scale, field.offset = start.scale, start.offset
        return True
    ratio = start.scale / field.scale
    with torch.no_grad():
        for i, output in enumerate(field.network.outputs):
            assert isinstance(output, nn.Linear)  # so that it can take the change of scale
            output.weight.mul_(ratio)
            output.bias.mul_(ratio)
            if i == 0:
                output.bias.sub_(start.offset * ratio)
    return True


def fit_network(
    field: NeuralField, network: Evaluator, start: Field, steps: int, points_per_batch: int, learning_rate: float,
    generator: torch.Generator, on_step: Callable[[int, float], bool] | None = None,
) -> None:  # fmt: skip
    """Fit the network of a field to the values and gradients of another field by Adam.

    Parameters
    ----------
    network : evaluates that network in the precision of the run
    learning_rate : at the start; it falls to a tenth by a cosine
    on_step : called with step and loss; True ends the fit
    """
    weights = list(field.network.parameters())
    adam = Optimiser(weights, [1.0] * len(weights), partial(adam_step, betas=BETAS))
    device = weights[0].device
    start = start.to(device)
    lower, edges = torch.tensor(field.box.lower), torch.tensor(field.box.edges)
    for step in range(steps):
        points = (lower + edges * torch.rand(points_per_batch, 3, generator=generator)).to(device)
        with torch.no_grad():
            value, gradient = start.value_and_gradient(points)
            value, gradient = value / field.scale, gradient * (field.half_edge / field.scale)
            value_scale = 1 / value.square().mean().clamp_min(MIN_SQUARE)
            gradient_scale = 1 / gradient.square().sum(-1).mean().clamp_min(MIN_SQUARE)
        n, slope, _ = network.value_and_gradient(field.normalise(points), False)
        loss = (n.float() - value).square().mean() * value_scale
        loss = loss + (slope.float() - gradient).square().sum(-1).mean() * gradient_scale
        cosine = 0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * step / steps))
        adam.zero_grad()
        loss.backward()
        adam.step(learning_rate * cosine * min(1.0, (step + 1) / WARM_UP))
        if on_step is not None and on_step(step + 1, float(loss.detach())):
            break
