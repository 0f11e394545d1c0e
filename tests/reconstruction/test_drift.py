"""Fields carried along by the flow."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerif.fields.base import Field
from nerif.fields.mlp import Network, NetworkShape, NeuralField
from nerif.fields.phantoms import GaussianBalls
from nerif.geometry import Box, Ring
from nerif.reconstruction.drift import carried, drift_between
from nerif.reconstruction.neural import NeRIF
from nerif.reconstruction.target import Target
from nerif.simulation import simulate

SHAPES = [
    NetworkShape(depth=3, width=12, octaves=3),
    NetworkShape(depth=3, width=12, octaves=3, skip=2),
    NetworkShape(depth=2, width=12, octaves=2, skip=2),
    NetworkShape(depth=2, width=12, octaves=2, skip=2, head_width=8, gradient_head=True),
    NetworkShape(depth=2, width=12, octaves=0),
    NetworkShape(depth=2, width=12, octaves=3, octave_decay=0.5),
]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_a_network_is_carried_along_exactly(shape):
    torch.manual_seed(0)
    field = NeuralField(Network(shape).requires_grad_(False), Box((-4.0, -3.0, -2.0), (4.0, 3.0, 2.0)), 1e-4, 0.2)
    drift = torch.tensor([0.3, -0.2, 1.1])
    moved = carried(field, drift)
    points = torch.rand(50, 3) * 4 - 2
    for a, b in zip(moved.value_and_gradient(points), field.value_and_gradient(points - drift), strict=True):
        assert torch.allclose(a, b, rtol=1e-4, atol=1e-5 * float(b.abs().max()))
    assert torch.allclose(moved(points), field(points - drift), rtol=1e-4, atol=1e-9)


def test_the_drift_of_a_flow_is_found(box):
    centres = torch.tensor([[1.0, -0.5, -0.6], [-2.0, 1.5, -0.8]], dtype=torch.float64)
    widths = torch.tensor([1.6, 1.3], dtype=torch.float64)
    drift = torch.tensor([0.2, -0.3, 0.9], dtype=torch.float64)

    def seen(by: torch.Tensor):
        phantom: Field = GaussianBalls(centres + by, widths, torch.tensor([-2.0e-4, -1.2e-4], dtype=torch.float64))
        ring = Ring(views=4, image_size=(24, 30), pixel_pitch=0.1)
        return simulate(phantom, ring.cameras(), box, 1.00027, steps=40)

    settings = NeRIF(
        network=NetworkShape(depth=2, width=32, octaves=3), samples=(12, 16), points_per_batch=2048, max_steps=300,
        epochs=1e6, device="cpu", precision="float32",
    )  # fmt: skip
    first, second = seen(torch.zeros(3)), seen(drift)
    field = settings(first).field
    assert isinstance(field, NeuralField)
    target = Target.of(second)
    found = drift_between(field, target, torch.zeros(3), 1.00027, 60, 2048, 0)
    assert float((found - drift).norm()) < 0.15
    # a good guess is kept, and a flow that stands still stays where it is
    again = drift_between(field, target, found, 1.00027, 20, 2048, 0)
    assert float((again - drift).norm()) < 0.15
    still = drift_between(field, Target.of(first), torch.zeros(3), 1.00027, 60, 2048, 0)
    assert float(still.norm()) < 0.1

    # so that training goes on from much closer
    one = replace(settings, max_steps=1, rate_after_fit=1e-9)
    losses = [one(second, start=start).history[-1]["loss"] for start in (field, carried(field, found))]
    assert losses[1] < 0.3 * losses[0]
