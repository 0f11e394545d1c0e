"""A field carried along by the flow, before the next frame is trained from it (Taylor's hypothesis).

    min_c  mean over rays |d[N(x - c)] - d|^2 / sigma^2,      N' = N(x - c)

The translation c goes into the weights exactly: sines and cosines of the encoding are turned by w c, the linear part
moves the bias.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerif.fields.mlp import Network, NeuralField
from nerif.physics.deflection import integration_weights
from nerif.reconstruction.precision import MixedPrecision
from nerif.reconstruction.sampling import Guide, sample_rays
from nerif.reconstruction.target import Target

__all__ = ["carried", "drift_between"]

SAMPLES = 24  # a ray
RATE = 0.004  # of the translation, in half edges of the box: Adam's steps are of this size


def drift_between(
    field: NeuralField, target: Target, first: Float[Tensor, " 3"], n_ambient: float, steps: int, points: int, seed: int
) -> Float[Tensor, " 3"]:
    """Return the translation (mm) of a field under which it predicts best what was measured next.

    Parameters
    ----------
    field : of the frame before
    target : what was measured in this one
    first : guess, mm: the translation of the frame before
    steps, points : of Adam, and sample points of each
    seed : of the rays and samples
    """
    device = next(field.network.parameters()).device
    generator = torch.Generator().manual_seed(seed)
    shift = nn.Parameter((first / field.half_edge).float().to(device))
    adam = torch.optim.Adam([shift], lr=RATE, betas=(0.8, 0.95))
    guide = Guide(field)
    guide.update(MixedPrecision(field.network, device, "float32", "off"))
    unit = field.index_scale / field.half_edge / n_ambient
    rays = min(max(1, points // SAMPLES), len(target))
    sum_of_last, last = torch.zeros(3, device=device), max(1, steps // 4)
    for step in range(steps):
        chosen = torch.randint(len(target), (rays,), generator=generator)
        some = target[chosen.to(device)]
        moved = replace(some.rays, origin=some.rays.origin - shift * field.half_edge)
        with torch.no_grad():
            s, interval = sample_rays(moved, SAMPLES, generator, "adaptive", guide)
        _, gradient, _ = field.network.value_and_gradient(field.normalise(moved.at(s)).reshape(-1, 3))
        weight = integration_weights(some.rays, s, interval, "lever_arm") * unit
        d = torch.einsum("nm,nij,nmj->ni", weight, some.rays.sensitivity, gradient.reshape(*s.shape, 3))
        loss = ((d - some.displacement) * some.inverse_scale).square().mean()
        adam.zero_grad()
        loss.backward()
        for group in adam.param_groups:
            group["lr"] = RATE * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * step / steps)))
        adam.step()
        if step >= steps - last:
            sum_of_last += shift.detach()
    return (sum_of_last / last * field.half_edge).cpu()


@torch.no_grad()
def carried(field: NeuralField, drift: Float[Tensor, " 3"]) -> NeuralField:
    """Return the field moved by `drift` (mm), N(x - c), as a network of its own."""
    network = Network(field.network.shape)
    network.load_state_dict(field.network.state_dict())
    shape = network.shape
    c = (drift / field.half_edge).to(next(network.parameters()))
    angle = (math.pi * 2.0 ** torch.arange(shape.octaves).to(c))[:, None] * c
    cosine, sine, m = angle.cos().reshape(-1), angle.sin().reshape(-1), 3 * shape.octaves
    for layer, first in _fed_by_encoding(network):
        encoded = layer.weight[:, first:]
        layer.bias.sub_(encoded[:, :3] @ c)
        of_sine, of_cosine = encoded[:, 3 : 3 + m].clone(), encoded[:, 3 + m :].clone()
        encoded[:, 3 : 3 + m] = of_sine * cosine + of_cosine * sine
        encoded[:, 3 + m :] = of_cosine * cosine - of_sine * sine
    network.eval().requires_grad_(False)
    return NeuralField(network, field.box, field.index_scale, field.offset)


def _fed_by_encoding(network: Network) -> list[tuple[nn.Linear, int]]:
    """Layers that are given the encoding, and the first of their inputs that belongs to it."""
    shape = network.shape
    fed: list[tuple[nn.Module, int]] = [(network.layers[0], 0)]
    if 0 < shape.skip < shape.depth:
        fed.append((network.layers[shape.skip], shape.width))
    elif shape.skip == shape.depth:
        fed += [(head, shape.width) for head in (network.heads or network.outputs)]
    return [(layer, first) for layer, first in fed if isinstance(layer, nn.Linear)]
