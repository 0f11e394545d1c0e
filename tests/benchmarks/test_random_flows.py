"""Flows drawn from a number: alike each time, ambient at the sides, with the gradient of their values."""

from __future__ import annotations

import pytest
import torch

from random_flows import random_flow


@pytest.mark.parametrize("number", [0, 3, 4, 14])
def test_the_gradient_is_that_of_the_values(number):
    field, box = random_flow(number).truth, random_flow(number).box
    drawn = torch.Generator().manual_seed(number)
    points = (torch.rand(40, 3, generator=drawn, dtype=torch.float64) - 0.5) * 0.7 * min(box.edges)
    step = 1e-4 * torch.eye(3, dtype=torch.float64)
    slopes = [(field(points + h) - field(points - h)) / 2e-4 for h in step]
    found = field.gradient(points)
    torch.testing.assert_close(found, torch.stack(slopes, -1), rtol=1e-4, atol=1e-4 * float(found.abs().max()))


def test_sides_are_ambient_and_a_number_is_always_the_same_flow():
    kinds = set()
    for number in range(8):
        one, again = random_flow(number), random_flow(number)
        kinds.add(one.cloudy)
        half = 0.5 * one.box.edges[0]
        side = torch.tensor([[half, 3.0, 2.0], [-half, 0.0, 9.0], [4.0, half, -8.0], [4.0, -half, -8.0]]).double()
        inside = (torch.rand(200, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5) * half
        assert float(one.truth(side).abs().max()) < 1e-12
        assert torch.equal(one.truth(inside), again.truth(inside))
        assert float(one.truth(inside).min()) > -3e-4
    assert kinds == {True, False}
