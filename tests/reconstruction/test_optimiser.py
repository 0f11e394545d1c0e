"""The optimiser: every weight is in one part, and a restored one goes on as if nothing had been."""

from __future__ import annotations

import pytest
import torch

from nerif.fields.network import Network, NetworkShape
from nerif.reconstruction.neural.optimiser import REFERENCE, NetworkOptimiser
from refusals import refused

SHAPE = NetworkShape(depth=2, width=16, octaves=2, directions=3)


def network() -> Network:
    torch.manual_seed(0)
    return Network(SHAPE)


def take_steps(optimiser: NetworkOptimiser, net: Network, steps: int) -> None:
    p = torch.linspace(-1, 1, 60).reshape(-1, 3)
    for _ in range(steps):
        optimiser.zero_grad()
        (net(p) - p.sum(1).sin()).square().mean().backward()
        optimiser.step({"adam": 1e-2, "muon": 2e-2})


@pytest.mark.parametrize("kind", ["muon", "adam"])
def test_every_weight_moves_and_the_loss_falls(kind):
    net = network()
    before = [p.detach().clone() for p in net.parameters()]
    optimiser = NetworkOptimiser(kind, net, (0.9, 0.99), 0.9)
    take_steps(optimiser, net, 40)
    p = torch.linspace(-1, 1, 60).reshape(-1, 3)
    assert float((net(p) - p.sum(1).sin()).square().mean().detach()) < 0.05
    assert all(not torch.equal(a, b) for a, b in zip(before, net.parameters(), strict=True))


def test_muon_takes_the_matrices_and_turns_them_by_equal_amounts():
    net = network()
    optimiser = NetworkOptimiser("muon", net, (0.9, 0.99), 0.9)
    # neither biases nor the single output
    assert {p.shape for p in optimiser.parts["muon"].weights} == {(16, 15), (16, 16)}
    before = net.layers[1].weight.detach().clone()
    take_steps(optimiser, net, 1)
    step = torch.linalg.svdvals(net.layers[1].weight.detach() - before) / (2e-2 * 0.2 * 128**0.5)
    gradient = torch.linalg.svdvals(net.layers[1].weight.grad)
    assert 0.7 < float(step[0]) < 1.3
    assert float(step[4] / step[0]) > 5 * float(gradient[4] / gradient[0])


@pytest.mark.parametrize("kind", ["muon", "adam"])
def test_restored_goes_on_bit_for_bit(kind):
    whole = network()
    optimiser = NetworkOptimiser(kind, whole, (0.9, 0.99), 0.9)
    take_steps(optimiser, whole, 5)
    weights = {k: v.clone() for k, v in whole.state_dict().items()}
    tensors = optimiser.tensors()
    take_steps(optimiser, whole, 5)

    again = network()
    again.load_state_dict(weights)
    restored = NetworkOptimiser(kind, again, (0.9, 0.99), 0.9)
    restored.restore(tensors)
    take_steps(restored, again, 5)
    assert all(torch.equal(a, b) for a, b in zip(whole.parameters(), again.parameters(), strict=True))


@pytest.mark.parametrize(("made_by", "asked"), [("muon", "adam"), ("adam", "muon")])
def test_a_checkpoint_of_another_optimiser_is_refused(made_by, asked):
    net = network()
    other = NetworkOptimiser(made_by, net, (0.9, 0.99), 0.9)
    take_steps(other, net, 1)
    with refused("resume"):
        NetworkOptimiser(asked, net, (0.9, 0.99), 0.9).restore(other.tensors())


def test_the_reference_steps_as_torch_has_it():
    """Muon in float32 and one group a matrix: the steps of torch.optim.Muon, up to the rounding of bf16."""
    torch.manual_seed(0)
    net = Network(REFERENCE)
    matrices = [layer.weight for layer in net.layers]
    twins = [m.detach().clone().requires_grad_() for m in matrices]
    optimiser = NetworkOptimiser("muon", net, (0.9, 0.99), 0.9)
    of_torch = torch.optim.Muon(
        twins, lr=2e-2, weight_decay=0.0, momentum=0.9, ns_steps=5, adjust_lr_fn="match_rms_adamw"
    )
    before = [m.detach().clone() for m in matrices]
    for _ in range(3):
        optimiser.zero_grad()
        for matrix, twin in zip(matrices, twins, strict=True):
            matrix.grad = torch.randn_like(matrix)
            twin.grad = matrix.grad.clone()
        optimiser.step({"adam": 1e-2, "muon": 2e-2})
        of_torch.step()
    for start, matrix, twin in zip(before, *([w.detach() for w in part] for part in (matrices, twins)), strict=True):
        ours, theirs = (matrix - start).flatten(), (twin - start).flatten()
        assert float(torch.dot(ours, theirs) / (ours.norm() * theirs.norm())) > 0.995  # up to bf16
        torch.testing.assert_close(ours.norm(), theirs.norm(), rtol=0.02, atol=0)
    assert set(optimiser.parts["adam"].shares) == {1.0}


def test_adam_is_that_of_torch():
    net, twin = network(), network()
    optimiser = NetworkOptimiser("adam", net, (0.9, 0.99), 0.9, by_shape=False)
    of_torch = torch.optim.Adam(twin.parameters(), lr=1e-2, betas=(0.9, 0.99))
    p = torch.linspace(-1, 1, 60).reshape(-1, 3)
    take_steps(optimiser, net, 10)
    for _ in range(10):
        of_torch.zero_grad()
        (twin(p) - p.sum(1).sin()).square().mean().backward()
        of_torch.step()
    for ours, theirs in zip(net.parameters(), twin.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("width", [32, 512])
def test_rates_follow_the_width(width):
    """Source: Yang et al., Tensor Programs V; Yang, Simon & Bernstein, A spectral condition for feature learning."""

    def shares(shape: NetworkShape, kind: str) -> dict[str, float]:
        net = Network(shape)
        optimiser = NetworkOptimiser(kind, net, (0.9, 0.99), 0.9)
        names = {id(p): name for name, p in net.named_parameters()}
        parts = [zip(part.weights, part.shares, strict=True) for part in optimiser.parts.values()]
        return {names[id(p)]: share for part in parts for p, share in part}

    wide, reference = (shares(NetworkShape(width=some), "muon") for some in (width, 128))
    assert wide["layers.1.weight"] == pytest.approx(reference["layers.1.weight"])  # square: the same spectral norm
    assert wide["layers.0.weight"] / reference["layers.0.weight"] == pytest.approx((width / 128) ** 0.5)
    assert wide["outputs.0.weight"] / reference["outputs.0.weight"] == pytest.approx(128 / width)
    adam = shares(NetworkShape(width=width), "adam")
    assert adam["layers.1.weight"] == adam["outputs.0.weight"] == pytest.approx(128 / width)
    assert adam["layers.0.weight"] == adam["layers.1.bias"] == 1
