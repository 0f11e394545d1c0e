"""Flows drawn from a number: the same each time, ambient at the sides, with the gradient of their values."""

from __future__ import annotations

import pytest
import torch

from benchmarks.random_flows import EDGE, random_flow


@pytest.mark.parametrize("number", [0, 3, 4, 14])
def test_the_gradient_is_that_of_the_values(number):
    field, _ = random_flow(number)
    rng = torch.Generator().manual_seed(number)
    points = (torch.rand(40, 3, generator=rng, dtype=torch.float64) - 0.5) * 0.7 * EDGE
    step = 1e-4 * torch.eye(3, dtype=torch.float64)
    slopes = [(field(points + h) - field(points - h)) / 2e-4 for h in step]
    gradient = field.gradient(points)
    torch.testing.assert_close(gradient, torch.stack(slopes, -1), rtol=1e-4, atol=1e-4 * float(gradient.abs().max()))


def test_sides_are_ambient_and_a_number_is_always_the_same_flow():
    kinds = set()
    half = 0.5 * EDGE
    side = torch.tensor([[half, 3.0, 2.0], [-half, 0.0, 9.0], [4.0, half, -8.0], [4.0, -half, -8.0]]).double()
    inside = (torch.rand(200, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5) * half
    for number in range(8):
        (flow, cloudy), (same, _) = random_flow(number), random_flow(number)
        kinds.add(cloudy)
        assert float(flow(side).abs().max()) < 1e-12
        assert torch.equal(flow(inside), same(inside))
        assert float(flow(inside).min()) > -3e-4
    assert kinds == {True, False}
