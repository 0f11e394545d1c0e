"""Choosing the weight: on a problem in one line of numbers, where the answer is known."""

from __future__ import annotations

import itertools
import math

import pytest
import torch

from nerif.reconstruction.voxels.problem import Iterate
from nerif.reconstruction.voxels.weight import HIGHEST, LOWEST, choose_weight, sharpest_corner

SINGULAR = torch.logspace(0, -4, 200, dtype=torch.float64)
TRUTH = SINGULAR**0.5  # a smooth field: what the operator sees least is least


def problem(sigma: float, seed: int = 0):
    """A diagonal least-squares problem with identity penalty, solved exactly."""
    noise = sigma * torch.randn(200, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    data = SINGULAR * TRUTH + noise
    tried = []

    def solve(weight: float, x: torch.Tensor) -> Iterate:
        tried.append(weight)
        x = SINGULAR * data / (SINGULAR**2 + weight)
        return Iterate(x, float((SINGULAR * x - data).square().sum()), float(x.square().sum()))

    return solve, data, tried


@pytest.mark.parametrize("sigma", [0.003, 0.01, 0.03])
def test_discrepancy_meets_the_noise(sigma):
    solve, _, tried = problem(sigma)
    noise = 200 * sigma**2
    choice = choose_weight(solve, torch.zeros(200), noise)
    assert solve(choice.weight, choice.x).residual == pytest.approx(noise, rel=0.1)
    assert "discrepancy" in choice.reason
    assert tried[0] == HIGHEST
    assert all(b < a for a, b in itertools.pairwise(tried[:-1]))


def test_discrepancy_goes_up_where_the_noise_is_all_there_is():
    solve, data, _ = problem(1.0)
    most = float(data.square().sum())
    choice = choose_weight(solve, torch.zeros(200), 0.9 * most)
    assert choice.weight > HIGHEST
    assert solve(choice.weight, choice.x).residual == pytest.approx(0.9 * most, rel=0.1)
    hopeless = choose_weight(solve, torch.zeros(200), 1.1 * most)
    assert "does not exceed the noise" in hopeless.reason


@pytest.mark.parametrize("sigma", [0.003, 0.01])
def test_corner_of_the_l_curve_is_near_the_best_weight(sigma):
    solve, _, _ = problem(sigma)

    def error(weight: float) -> float:
        return float((solve(weight, torch.zeros(200)).x - TRUTH).norm())

    best = min(error(10 ** (-i / 4)) for i in range(4, 29))
    choice = choose_weight(solve, torch.zeros(200))
    assert "corner" in choice.reason
    assert error(choice.weight) < 3 * best


def test_noise_that_cannot_be_reached_falls_back_on_the_corner():
    solve, _, _ = problem(0.01)

    def floor(weight: float, x: torch.Tensor) -> Iterate:
        iterate = solve(weight, x)
        return Iterate(iterate.x, iterate.residual + 0.05, iterate.penalty)

    choice = choose_weight(floor, torch.zeros(200), 200 * 0.01**2)
    assert "corner" in choice.reason
    assert "sigma" in choice.reason
    assert LOWEST < choice.weight < HIGHEST


def test_sharpest_corner_of_a_drawn_l():
    flat = [(10.0 ** (3 - i), 1.0 + 0.01 * i) for i in range(5)]  # the residual falls, the penalty stays
    steep = [(0.1 / (1 + 0.01 * i), 10.0**i) for i in range(1, 5)]
    corner, bend = sharpest_corner(flat + steep)
    assert (corner, bend > 0) == (4, True)
    assert sharpest_corner([(math.exp(-i), math.exp(i)) for i in range(6)])[1] == pytest.approx(0, abs=1e-9)
    assert sharpest_corner([(1.0, 1.0), (0.5, 0.9), (0.4, 5.0)]) == (0, 0.0)  # the penalty fell: not an L
