"""The Gaussian prior of detail: its spectrum, adjoint, and the posterior against linear algebra."""

from __future__ import annotations

import itertools
import math

import pytest
import torch

from nerif.geometry import Box, Grid
from nerif.reconstruction.detail.detail_prior import Prior, WhiteProblem, von_karman
from nerif.reconstruction.target import Target
from nerif.reconstruction.voxels.layout import layout_of
from nerif.reconstruction.voxels.voxel_problem import Problem

SHAPE = (5, 6, 7)  # z, y, x
ITERATIONS = 30


@pytest.fixture(scope="module")
def problem(measurement):
    """A small problem, in double precision."""
    few = measurement.select(measurement.names[:3])
    layout = layout_of(few, None, dtype=torch.float64)
    grid = Grid(few.box, SHAPE)
    target = Target.of(few, edge=4, linear=True)
    operators = [layout.operator(part.rays, grid, part.model) for part in target.parts]
    return Problem(operators, target)


@pytest.fixture(scope="module")
def prior(problem):
    """A prior whose deviation varies in space."""
    varied = 0.2 + torch.rand(SHAPE, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return Prior(0.02 * varied, von_karman(problem.operator.grid, 3.0))


@pytest.fixture(scope="module")
def white(problem, prior):
    """The problem of detail about a mean that is not 0."""
    return WhiteProblem(problem, prior, 0.1 * problem.random())


def after(iterates, count):
    """The last of some iterates."""
    return list(itertools.islice(iterates, count))[-1]


def analytic(white):
    """Mean and covariance of z given the data, by linear algebra."""
    matrix = white.matrix(white.forward)
    information = matrix.T @ matrix / white.variance + torch.eye(matrix.shape[1], dtype=torch.float64)
    covariance = torch.linalg.inv(information)
    return covariance @ (matrix.T @ white.data) / white.variance, covariance


def fields(prior):
    """The prior as a matrix from z to the field."""
    size = math.prod(SHAPE)
    return torch.stack([prior(e.reshape(SHAPE)).flatten() for e in torch.eye(size, dtype=torch.float64)], dim=1)


def test_the_spectrum_is_that_of_von_karman_and_the_variance_1():
    grid, outer = Grid(Box((0.0, 0.0, 0.0), (20.0, 12.0, 9.0)), (9, 12, 20)), 3.0
    spectrum = von_karman(grid, outer)
    k = 2 * math.pi * torch.tensor([3 / 20.0, 2 / 12.0, 1 / 9.0], dtype=torch.float64)
    expected = (1 + outer**2 * k.square().sum()) ** (-11 / 6)
    torch.testing.assert_close(spectrum[1, 2, 3] / spectrum[0, 0, 0], expected)
    torch.testing.assert_close(spectrum[-1, -2, 3], spectrum[1, 2, 3])
    white = torch.randn(400, *grid.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    field = torch.fft.irfftn(torch.fft.rfftn(white, dim=(1, 2, 3)) * spectrum.sqrt(), s=grid.shape, dim=(1, 2, 3))
    assert float(field.square().mean()) == pytest.approx(1.0, abs=0.03)


def test_forward_and_adjoint_are_adjoint(white):
    generator = torch.Generator().manual_seed(0)
    z = torch.randn(SHAPE, generator=generator, dtype=torch.float64)
    y = torch.randn(white.data.shape, generator=generator, dtype=torch.float64)
    torch.testing.assert_close((white.forward(z) * y).sum(), (z * white.adjoint(y)).sum(), rtol=1e-9, atol=0)


def test_the_size_of_the_prior_explains_the_data(problem, prior):
    fitted = WhiteProblem(problem, prior.times(1e-3), problem.zero()).fits()
    white = torch.randn(200, *SHAPE, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    predicted = torch.stack([fitted.forward(z).square().sum() for z in white]).mean()
    excess = float(fitted.data.square().sum()) - fitted.variance * problem.target.numbers
    assert float(predicted) == pytest.approx(excess, rel=0.6)  # of one sample


def test_conjugate_gradients_reach_the_posterior_mean(white, prior):
    mean, _ = analytic(white)
    iterate = after(white.solve(), 2 * ITERATIONS)
    torch.testing.assert_close(iterate.x.flatten(), mean, rtol=0, atol=1e-4 * float(mean.abs().max()))
    whole = fields(prior) @ mean + white.mean.flatten()
    torch.testing.assert_close(white.field(iterate.x).flatten(), whole, rtol=0, atol=1e-4 * float(whole.abs().max()))
    expected = float((white.data - white.forward(iterate.x)).square().sum() / white.variance + mean.square().sum())
    assert white.objective(iterate) == pytest.approx(expected / white.target.numbers, rel=1e-6)


def test_draws_have_mean_and_covariance_of_the_posterior(white, prior):
    mean, covariance = analytic(white)
    generator, count = torch.Generator().manual_seed(11), 20
    z = mean.reshape(SHAPE)
    draws = torch.stack([after(white.draw(z, generator), ITERATIONS).flatten() for _ in range(count)])
    matrix = fields(prior)
    center, spread = matrix @ mean + white.mean.flatten(), matrix @ covariance @ matrix.T
    size = len(center)
    errors = torch.linalg.solve_triangular(torch.linalg.cholesky(spread), (draws - center).T, upper=False)
    assert float(errors.square().mean()) == pytest.approx(1.0, abs=5 * math.sqrt(2 / (size * count)))
    sampled = errors @ errors.T / count - torch.eye(size, dtype=torch.float64)
    assert float(sampled.square().mean().sqrt()) == pytest.approx(math.sqrt((1 + 1 / size) / count), rel=0.05)
    assert float(errors.mean(dim=1).square().sum()) == pytest.approx(size / count, rel=5 * math.sqrt(2 / size))


def test_fixed_voxels_and_bounds(measurement, problem, prior):
    free = torch.ones(SHAPE, dtype=torch.bool)
    free[:2] = False
    bounded = Problem(problem.operators, problem.target, free, (-0.01 * problem.scale, 0.02 * problem.scale))
    white = WhiteProblem(bounded, Prior(bounded.pin(prior.deviation), prior.spectrum), bounded.zero())
    x = white.field(after(white.solve(), 20).x)
    assert not x[:2].any()
    assert float(x.min()) >= -0.01
    assert float(x.max()) <= 0.02
    assert float(x.max()) > 0
