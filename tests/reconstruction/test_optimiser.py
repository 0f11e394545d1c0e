"""The optimiser: which weights Muon and Adam take, their steps against PyTorch's, rates by shape, checkpoints."""

from __future__ import annotations

import pytest
import torch

from nerif.fields.network import Network
from nerif.fields.network_shape import NetworkShape
from nerif.reconstruction.neural.optimiser import REFERENCE, NetworkOptimiser
from refusals import refused

SHAPE = NetworkShape(depth=2, width=16, octaves=2, directions=3)
P = torch.linspace(-1, 1, 60).reshape(-1, 3)


def network(kind: str, shape: NetworkShape = SHAPE, by_shape: bool = True) -> tuple[Network, NetworkOptimiser]:
    torch.manual_seed(0)
    net = Network(shape)
    return net, NetworkOptimiser(kind, net, (0.9, 0.99), 0.9, by_shape)


def loss(net: Network) -> torch.Tensor:
    return (net(P) - P.sum(1).sin()).square().mean()


def train(net: Network, optimiser: NetworkOptimiser, steps: int) -> None:
    for _ in range(steps):
        optimiser.zero_grad()
        loss(net).backward()
        optimiser.step({"adam": 1e-2, "muon": 2e-2})


@pytest.mark.parametrize("kind", ["muon", "adam"])
def test_every_weight_moves_and_the_loss_falls(kind):
    net, optimiser = network(kind)
    before = [p.detach().clone() for p in net.parameters()]
    train(net, optimiser, 40)
    assert float(loss(net).detach()) < 0.05
    assert all(not torch.equal(a, b) for a, b in zip(before, net.parameters(), strict=True))


def test_muon_takes_the_matrices_and_steps_equally_in_all_directions():
    net, optimiser = network("muon")
    # neither biases nor the single output
    assert {p.shape for p in optimiser.parts["muon"].weights} == {(16, 15), (16, 16)}
    before = net.layers[1].weight.detach().clone()
    train(net, optimiser, 1)
    step = torch.linalg.svdvals(net.layers[1].weight.detach() - before) / (2e-2 * 0.2 * 128**0.5)
    gradient = torch.linalg.svdvals(net.layers[1].weight.grad)
    assert 0.7 < float(step[0]) < 1.3
    assert float(step[4] / step[0]) > 5 * float(gradient[4] / gradient[0])


@pytest.mark.parametrize("kind", ["muon", "adam"])
def test_a_checkpoint_continues_bit_for_bit_and_another_optimiser_refuses_it(kind):
    whole, optimiser = network(kind)
    train(whole, optimiser, 5)
    weights, state = {k: v.clone() for k, v in whole.state_dict().items()}, optimiser.state_dict()
    train(whole, optimiser, 5)
    again, resumed = network(kind)
    again.load_state_dict(weights)
    resumed.load_state_dict(state)
    train(again, resumed, 5)
    assert all(torch.equal(a, b) for a, b in zip(whole.parameters(), again.parameters(), strict=True))
    with refused("resume"):
        network("adam" if kind == "muon" else "muon")[1].load_state_dict(state)


@pytest.mark.skipif(not hasattr(torch.optim, "Muon"), reason="torch before 2.9 has no Muon")
def test_muon_is_that_of_torch():
    """In the reference, up to the rounding of bf16."""
    net, optimiser = network("muon", REFERENCE)
    matrices = [layer.weight for layer in net.layers]
    twins = [m.detach().clone().requires_grad_() for m in matrices]
    muon = torch.optim.Muon(twins, lr=2e-2, weight_decay=0.0, momentum=0.9, ns_steps=5, adjust_lr_fn="match_rms_adamw")
    before = [m.detach().clone() for m in matrices]
    for _ in range(3):
        optimiser.zero_grad()
        for matrix, twin in zip(matrices, twins, strict=True):
            matrix.grad = torch.randn_like(matrix)
            twin.grad = matrix.grad.clone()
        optimiser.step({"adam": 1e-2, "muon": 2e-2})
        muon.step()
    for start, matrix, twin in zip(before, *([w.detach() for w in part] for part in (matrices, twins)), strict=True):
        ours, theirs = (matrix - start).flatten(), (twin - start).flatten()
        assert float(torch.dot(ours, theirs) / (ours.norm() * theirs.norm())) > 0.995
        torch.testing.assert_close(ours.norm(), theirs.norm(), rtol=0.02, atol=0)
    assert set(optimiser.parts["adam"].shares) == {1.0}


def test_adam_is_that_of_torch():
    net, optimiser = network("adam", by_shape=False)
    twin, _ = network("adam")
    adam = torch.optim.Adam(twin.parameters(), lr=1e-2, betas=(0.9, 0.99))
    train(net, optimiser, 10)
    for _ in range(10):
        adam.zero_grad()
        loss(twin).backward()
        adam.step()
    for ours, theirs in zip(net.parameters(), twin.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("width", [32, 512])
def test_rates_depend_on_the_width(width):
    """Source: Yang et al., Tensor Programs V; Yang, Simon & Bernstein, A spectral condition for feature learning."""

    def shares(width: int, kind: str) -> dict[str, float]:
        net, optimiser = network(kind, NetworkShape(width=width))
        names = {id(p): name for name, p in net.named_parameters()}
        parts = [zip(part.weights, part.shares, strict=True) for part in optimiser.parts.values()]
        return {names[id(p)]: share for part in parts for p, share in part}

    muon, reference, adam = shares(width, "muon"), shares(128, "muon"), shares(width, "adam")
    ratio = {name: muon[name] / reference[name] for name in muon}
    assert ratio["layers.1.weight"] == pytest.approx(1)  # square: the same spectral norm
    assert ratio["layers.0.weight"] == pytest.approx((width / 128) ** 0.5)
    assert (
        ratio["outputs.0.weight"] == adam["layers.1.weight"] == adam["outputs.0.weight"] == pytest.approx(128 / width)
    )
    assert adam["layers.0.weight"] == adam["layers.1.bias"] == 1
