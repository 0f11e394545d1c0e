"""Fused layers against the plain network."""

from __future__ import annotations

import pytest
import torch

from nerif.fields.network import UNBOUNDED, Network
from nerif.fields.network_shape import NetworkShape
from nerif.reconstruction.neural import fused
from nerif.reconstruction.neural.losses import MixedPrecision

CPU = torch.device("cpu")


def derivatives(network: Network, value: torch.Tensor, gradient: torch.Tensor) -> list[torch.Tensor]:
    """Value, gradient, and the derivatives of a loss of both by every weight."""
    network.zero_grad()
    ((value - 0.3).square().mean() + (gradient - 0.1).square().mean()).backward()
    return [value.detach(), gradient.detach(), *(w.grad.clone() for w in network.parameters())]


@pytest.mark.parametrize("bounds", [UNBOUNDED, (-0.05, 0.04)])
@pytest.mark.parametrize("depth", [1, 2, 4])
def test_value_gradient_and_derivatives_are_those_of_the_plain_network(depth, bounds, monkeypatch):
    monkeypatch.setattr(fused, "TILE", 64)  # of 150 points: two tiles and a part
    torch.manual_seed(depth)
    network = Network(NetworkShape(depth=depth, width=24, octaves=2), bounds=bounds)
    p = 2 * torch.rand(150, 3) - 1
    ours = derivatives(network, *fused.value_and_gradient(network, p))
    plain = derivatives(network, *network.value_and_gradient(p)[:2])
    for a, b in zip(ours, plain, strict=True):
        assert a.shape == b.shape
        assert float((a - b).abs().max()) <= 2e-5 * float(b.abs().max())


@pytest.mark.parametrize(
    ("shape", "precision", "compile", "expected"),
    [({}, "float32", "auto", True), ({}, "float32", "off", False), ({"activation": "tanh"}, "float32", "auto", False),
     ({"head_width": 4}, "float32", "auto", False), ({"skip": 2}, "float32", "auto", False),
     ({}, "bf16", "auto", False)],
)  # fmt: skip
def test_networks_with_fused_layers(shape, precision, compile, expected):
    mixed, calls = MixedPrecision(Network(NetworkShape(width=8, **shape)), CPU, precision, compile), []
    if mixed.fused is not None:
        mixed.fused = lambda *args: calls.append(args) or fused.value_and_gradient(*args)
    mixed.value_and_gradient(torch.rand(5, 3), False)
    assert bool(calls) == expected
