"""The network: gradient against autograd, encoding and shape against the paper, units, files."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from nerif.fields.network import (
    ACTIVATIONS,
    Network,
    NeuralField,
    encode,
    encode_pullback,
    wave_vectors,
)  # fmt: skip
from nerif.fields.network_shape import NetworkShape, encoded_width
from nerif.geometry import Box
from nerif.reconstruction.field_files import FIELD, read_field, write_field
from nerif.reconstruction.neural.presets import PRESETS
from nerif.reconstruction.reconstructor import Outcome, Reconstruction
from refusals import refused

BASE = NetworkShape(depth=3, width=11, octaves=2, skip=2, head_width=5, gradient_head=True)
SHAPES = {
    "paper-like": BASE,
    "no skip": replace(BASE, skip=0),
    "skip at the end": replace(BASE, skip=3),
    "no heads": replace(BASE, head_width=0),
    "value only": replace(BASE, head_width=0, gradient_head=False),
    "weighted octaves": replace(BASE, octave_decay=0.7),
    "no encoding": replace(BASE, octaves=0),
}


def network(shape: NetworkShape) -> Network:
    torch.manual_seed(0)
    return Network(shape).double()


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_written_out_gradient_is_that_of_autograd(shape, activation):
    net = network(replace(shape, activation=activation))
    p = (2 * torch.rand(17, 3, dtype=torch.float64) - 1).requires_grad_()
    value, gradient, heads = net.value_and_gradient(p, heads=shape.gradient_head)
    (expected,) = torch.autograd.grad(net(p).sum(), p)
    assert torch.allclose(value, net(p), atol=1e-14)
    assert float(expected.abs().max()) > 0
    assert torch.allclose(gradient, expected, atol=1e-12)
    if heads is not None:
        assert torch.equal(heads, net._gradient_heads(p, net._trunk(p, [])[0]))


@pytest.mark.parametrize("activation", [a for a in ACTIVATIONS if a != "relu"])
def test_a_loss_on_the_gradient_trains_the_same_weights_as_double_backward(activation):
    net = network(replace(BASE, activation=activation))
    p = (2 * torch.rand(17, 3, dtype=torch.float64) - 1).requires_grad_()
    weights = list(net.layers.parameters())
    ours = torch.autograd.grad(net.value_and_gradient(p)[1].square().sum(), weights, allow_unused=True)
    (inner,) = torch.autograd.grad(net(p).sum(), p, create_graph=True)
    theirs = torch.autograd.grad(inner.square().sum(), weights, allow_unused=True)
    for a, b in zip(ours, theirs, strict=True):
        assert a is not None
        assert b is not None
        assert torch.allclose(a, b, atol=1e-12)


def test_encoding_is_the_paper_s():
    p = torch.tensor([[0.3, -0.2, 0.7]], dtype=torch.float64)
    e = encode(p, wave_vectors(3, 3)[0])[0]
    assert e.shape == (encoded_width(3, 3),) == (21,)
    assert torch.equal(e[:3], p[0])
    for k in range(3):
        assert torch.allclose(e[3 + 3 * k : 6 + 3 * k], torch.sin(2**k * torch.pi * p[0]))
        assert torch.allclose(e[12 + 3 * k : 15 + 3 * k], torch.cos(2**k * torch.pi * p[0]))


@pytest.mark.parametrize("directions", [3, 9, 13])
def test_encoding_pullback_is_its_transposed_jacobian(directions):
    p = torch.rand(1, 3, dtype=torch.float64)
    waves, octave = wave_vectors(2, directions)
    gains = torch.tensor([1.0, 0.5], dtype=torch.float64)[octave]
    cotangent = torch.rand(1, encoded_width(2, directions), dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(lambda q: encode(q, waves, gains)[0], p)[:, 0]
    got = encode_pullback(encode(p, waves, gains), cotangent, waves)
    assert torch.allclose(got[0], cotangent[0] @ jacobian)


@pytest.mark.parametrize("count", [3, 9, 13])
def test_directions_of_an_octave_are_isotropic(count):
    """Waves of an octave have one length, and their directions sum to a multiple of the identity."""
    waves, octave = wave_vectors(3, count)
    assert len(waves) == 3 * count
    for k in range(3):
        unit = waves[octave == k] / (torch.pi * 2**k)
        assert torch.allclose(unit.norm(dim=1), torch.ones(count))
        assert torch.allclose(unit.T @ unit, count / 3 * torch.eye(3), atol=1e-5)
        assert float((unit @ unit.T - torch.eye(count)).abs().max()) < 0.9  # all differ


def test_paper_s_network():
    net = Network(PRESETS["paper"].network)
    e = 3 * (2 * 5 + 1)
    assert [layer.in_features for layer in net.layers] == [e, 256, 256, 256, 256 + e, 256, 256]
    assert [layer.out_features for layer in net.layers] == [256] * 7
    assert [(h.in_features, h.out_features) for h in net.heads] == [(256, 64)] * 4
    assert [(o.in_features, o.out_features) for o in net.outputs] == [(64, 1)] * 4


def test_units_of_the_field():
    box, net = Box((-3.0, 1.0, -8.0), (5.0, 7.0, 4.0)), network(BASE)
    field = NeuralField(net, box, scale=2e-4, offset=0.3)
    points = torch.rand(4, 5, 3, dtype=torch.float64) * 3
    expected = 2e-4 * (net((points.reshape(-1, 3) - torch.tensor(box.centre)) / 6.0) - 0.3).reshape(4, 5)
    value, gradient = field.value_and_gradient(points)
    assert torch.allclose(field(points), expected, atol=1e-16)
    assert torch.allclose(value, expected, atol=1e-16)
    h = torch.tensor([0.0, 1e-5, 0.0])  # mm
    central = (field(points + h) - field(points - h)) / 2e-5
    assert torch.allclose(gradient[..., 1], central, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize(
    "change", [{"activation": "step"}, {"depth": 0}, {"width": 0}, {"octaves": -1}, {"skip": -1}, {"directions": 5}]
)
def test_invalid_shapes_are_refused(change, unchecked):
    with refused(next(iter(change))):
        replace(BASE, **change)


def test_missing_gradient_heads_are_refused():
    with refused("gradient_head"):
        network(SHAPES["value only"]).value_and_gradient(torch.zeros(1, 3, dtype=torch.float64), heads=True)


def test_a_field_of_an_older_file_without_directions_has_an_encoding_along_the_axes(tmp_path):
    field = NeuralField(Network(NetworkShape(depth=1, width=4, octaves=2, directions=3)), Box.cube(2.0), 1e-4)
    field.network.requires_grad_(False)
    write_field(tmp_path, Reconstruction(field, field.box, 1.00027, [], Outcome("steps", ""), {}))
    path, points = tmp_path / FIELD, torch.rand(20, 3)
    with safe_open(path, framework="pt") as file:
        about = json.loads(file.metadata()["nerif"])
    assert about["network"].pop("directions") == 3
    save_file(load_file(path), path, metadata={"nerif": json.dumps(about)})
    assert torch.equal(read_field(tmp_path)[0](points), field(points))
