"""The layers in one function against the plain network, its readable twin."""

from __future__ import annotations

import pytest
import torch

from nerif.fields.network import UNBOUNDED, Network, NetworkShape
from nerif.reconstruction.neural import fused
from nerif.reconstruction.neural.losses import MixedPrecision

CPU = torch.device("cpu")


def derivatives(network: Network, p: torch.Tensor, by_layers: bool) -> list[torch.Tensor]:
    """Value, gradient, and the derivatives of a loss of both in every weight."""
    network.zero_grad()
    value, gradient = fused.value_and_gradient(network, p) if by_layers else network.value_and_gradient(p)[:2]
    ((value - 0.3).square().mean() + (gradient - 0.1).square().mean()).backward()
    return [value.detach(), gradient.detach(), *(w.grad.clone() for w in network.parameters())]


@pytest.mark.parametrize("bounds", [UNBOUNDED, (-0.05, 0.04)])
@pytest.mark.parametrize("depth", [1, 2, 4])
def test_value_gradient_and_derivatives_are_those_of_the_plain_network(depth, bounds, monkeypatch):
    monkeypatch.setattr(fused, "TILE", 64)  # of 150 points: two tiles and a part
    torch.manual_seed(depth)
    network = Network(NetworkShape(depth=depth, width=24, octaves=2), bounds=bounds)
    p = 2 * torch.rand(150, 3) - 1
    for ours, plain in zip(derivatives(network, p, True), derivatives(network, p, False), strict=True):
        assert ours.shape == plain.shape
        assert float((ours - plain).abs().max()) <= 2e-5 * float(plain.abs().max())


@pytest.mark.parametrize(
    ("shape", "precision", "compile", "expected"),
    [
        (NetworkShape(width=8), "float32", "auto", True),
        (NetworkShape(width=8), "float32", "off", False),
        (NetworkShape(width=8, activation="tanh"), "float32", "auto", False),
        (NetworkShape(width=8, head_width=4), "float32", "auto", False),
        (NetworkShape(width=8, skip=2), "float32", "auto", False),
        (NetworkShape(width=8), "bf16", "auto", False),
    ],
)
def test_where_it_is_taken(shape, precision, compile, expected):
    mixed = MixedPrecision(Network(shape), CPU, precision, compile)
    called = []
    if mixed.fused is not None:
        whole = mixed.fused
        mixed.fused = lambda *given: called.append(1) or whole(*given)
    mixed.value_and_gradient(torch.rand(5, 3), False)
    assert bool(called) == expected
