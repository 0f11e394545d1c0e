"""The least-squares solvers against dense linear algebra, on problems small enough to form the matrix."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import scipy.optimize
import torch

from nerif.fields.grid import Boundary
from nerif.geometry import Box, Grid
from nerif.reconstruction.target import Target
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.problem import Differences, Penalty, Problem, conjugate_gradients
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation, at_faces, gradient_square

SHAPE = (4, 5, 6)
COUNT = math.prod(SHAPE)


def last(iterates, count: int):
    """The iterate after `count` iterations."""
    return next(itertools.islice(iterates, count - 1, None))


def columns(linear, shape) -> np.ndarray:
    """The matrix of a linear map of voxels."""
    rows = []
    for i in range(math.prod(shape)):
        unit = torch.zeros(math.prod(shape), dtype=torch.float64)
        unit[i] = 1
        out = linear(unit.reshape(shape))
        out = out if isinstance(out, tuple) else (out,)
        rows.append(torch.cat([o.reshape(-1) for o in out]))
    return torch.stack(rows, dim=1).numpy()


def make(measurement, free=None, bounds=None) -> Problem:
    target = Target.of(measurement)
    (part,), faces = target.parts, Boundary(measurement.ambient_faces)
    operator = VoxelOperator(part.rays, Grid(measurement.box, SHAPE), part.model, boundary=faces, dtype=torch.float64)
    return Problem([operator], target, free, bounds)


@pytest.fixture(scope="module")
def problem(measurement) -> Problem:
    return make(measurement)


def test_data_have_length_one_and_the_gradient_its_adjoint(problem):
    assert float(problem.data.norm()) == pytest.approx(1, abs=1e-5)
    differences = Differences(Grid(Box((0.0, 0.0, 0.0), (3.0, 5.0, 7.0)), SHAPE), Boundary(("x-", "z+")))
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(SHAPE, dtype=torch.float64, generator=generator)
    y = tuple(torch.rand(d.shape, dtype=torch.float64, generator=generator) for d in differences(x))
    there = sum(float((a * b).sum()) for a, b in zip(differences(x), y, strict=True))
    assert there == pytest.approx(float((x * differences.adjoint(y)).sum()), rel=1e-12)


@pytest.mark.parametrize("kind", Penalty.KINDS)
def test_penalty_and_its_adjoint(problem, kind):
    penalty = Penalty(problem, kind)
    matrix = columns(penalty, SHAPE)
    x = torch.rand(SHAPE, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    back = matrix.T @ (matrix @ x.numpy().ravel())
    assert np.allclose(penalty.adjoint(penalty(x)).numpy().ravel(), back, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("kind", Penalty.KINDS)
def test_tikhonov_solves_the_stacked_least_squares_problem(problem, kind):
    weight = 1e-3
    matrix = np.vstack([columns(problem.forward, SHAPE), math.sqrt(weight) * columns(Penalty(problem, kind), SHAPE)])
    right = np.concatenate([problem.data.numpy().ravel(), np.zeros(matrix.shape[0] - problem.data.numel())])
    exact = np.linalg.lstsq(matrix, right, rcond=None)[0]
    iterate = last(Tikhonov(penalty=kind).iterate(problem, problem.zero(), weight), 100)
    assert np.linalg.norm(iterate.x.numpy().ravel() - exact) < 1e-6 * np.linalg.norm(exact)
    misfit = matrix @ exact - right
    assert iterate.residual + weight * iterate.penalty == pytest.approx(float(misfit @ misfit), rel=1e-9)


def test_pinned_voxels_stay_ambient_and_the_rest_fits_without_them(measurement):
    free = torch.zeros(SHAPE, dtype=torch.bool)
    free[1:3, 1:4, 2:5] = True
    problem = make(measurement, free)
    iterate = last(Tikhonov().iterate(problem, problem.zero(), 1e-3), 100)
    assert float(iterate.x[~free].abs().max()) == 0
    chosen = free.numpy().ravel()
    stack = np.vstack([
        columns(problem.forward, SHAPE), math.sqrt(1e-3) * columns(Penalty(problem, "gradient"), SHAPE)
    ])[:, chosen]  # fmt: skip
    right = np.concatenate([problem.data.numpy().ravel(), np.zeros(stack.shape[0] - problem.data.numel())])
    exact = np.linalg.lstsq(stack, right, rcond=None)[0]
    assert np.linalg.norm(iterate.x.numpy().ravel()[chosen] - exact) < 1e-6 * np.linalg.norm(exact)


def test_bounds_are_kept_and_the_solution_is_the_bounded_one(measurement):
    problem = make(measurement, bounds=(-4e-5, 1e-5))
    weight = 1e-3
    iterate = last(Tikhonov().iterate(problem, problem.zero(), weight), 200)
    low, high = problem.bounds
    assert low <= float(iterate.x.min())
    assert float(iterate.x.max()) <= high
    matrix = np.vstack([
        columns(problem.forward, SHAPE), math.sqrt(weight) * columns(Penalty(problem, "gradient"), SHAPE)
    ])  # fmt: skip
    right = np.concatenate([problem.data.numpy().ravel(), np.zeros(matrix.shape[0] - problem.data.numel())])
    exact = scipy.optimize.lsq_linear(matrix, right, (low, high), tol=1e-12)
    assert int((exact.active_mask != 0).sum()) > 3  # the bounds matter
    assert np.linalg.norm(iterate.x.numpy().ravel() - exact.x) < 1e-6 * np.linalg.norm(exact.x)


@pytest.mark.parametrize("method", [Tikhonov(), TotalVariation(round=15)], ids=["tikhonov", "tv"])
def test_what_is_told_of_a_bounded_iterate_is_of_the_field_that_is_given(measurement, method):
    problem = make(measurement, bounds=(-4e-5, 1e-5))
    low, high = problem.bounds
    for iterate in itertools.islice(method.iterate(problem, problem.zero(), 1e-5), 40):
        assert low <= float(iterate.x.min()) <= float(iterate.x.max()) <= high
        misfit = float((problem.forward(iterate.x) - problem.data).square().sum())
        assert iterate.residual == pytest.approx(misfit, rel=1e-9)


def test_no_bounded_iterate_is_worse_than_the_one_before(measurement):
    problem, weight = make(measurement, bounds=(-4e-5, 0.0)), 1e-5
    path = [p.objective(weight) for p in itertools.islice(Tikhonov().iterate(problem, problem.zero(), weight), 200)]
    assert all(b <= a for a, b in itertools.pairwise(path))
    assert path[30] < 1.01 * path[-1]


@pytest.mark.parametrize("momentum", [pytest.param(False, marks=pytest.mark.slow), True])
def test_landweber_comes_to_the_least_residual(problem, momentum):
    matrix = columns(problem.forward, SHAPE)
    right = problem.data.numpy().ravel()
    exact = np.linalg.lstsq(matrix, right, rcond=None)[0]
    least = float(np.sum((matrix @ exact - right) ** 2))
    after = [last(Landweber(momentum=momentum).iterate(problem, problem.zero(), 0.0), n).residual for n in (1, 20, 400)]
    assert after[0] < 0.999  # the first iteration is a step from the zero field, whose residual is 1
    assert after[0] > after[1] > after[2] >= least * (1 - 1e-9)
    assert after[2] < 1.1 * least


def test_momentum_takes_fewer_iterations(problem):
    plain, fast = (
        last(Landweber(momentum=m, relaxation=1.0).iterate(problem, problem.zero(), 0.0), 60).residual
        for m in (False, True)
    )
    assert fast < plain


def test_first_landweber_step_is_the_gradient(problem):
    x = last(Landweber(momentum=False, relaxation=0.7).iterate(problem, problem.zero(), 0.0), 1).x
    gradient = problem.adjoint(problem.data)
    step = float((x * gradient).sum() / gradient.square().sum())
    assert torch.allclose(x, step * gradient)
    norm = np.linalg.norm(columns(problem.forward, SHAPE), 2)
    assert 0.7 / (1.05 * norm) ** 2 < step < 0.7 / norm**2 * 1.0001


def variation(problem: Problem, x: torch.Tensor, softness: float) -> float:
    return float((gradient_square(problem.differences(x)) + softness**2).sqrt().mean())


def test_faces_weigh_as_the_voxels_beside_them(problem):
    generator = torch.Generator().manual_seed(0)
    x, weight = (torch.rand(SHAPE, dtype=torch.float64, generator=generator) for _ in range(2))
    along = problem.differences(x)
    by_face = sum(float((w * d.square()).sum()) for w, d in zip(at_faces(weight), along, strict=True))
    assert by_face == pytest.approx(float((weight * gradient_square(along)).sum()), rel=1e-12)


def test_total_variation_falls_to_a_minimum(problem):
    """Its objective falls from round to round, and no small step from the end of them lowers it."""
    weight, method = 1e-2, TotalVariation(softness=0.1, round=10)
    path = list(itertools.islice(method.iterate(problem, problem.zero(), weight), 200))
    objective = [p.residual + weight * p.penalty for p in path]
    assert all(b <= a + 1e-9 for a, b in itertools.pairwise(objective[9::10]))
    end = path[-1].x
    assert path[-1].penalty == pytest.approx(variation(problem, end, 0.1), rel=1e-9)
    for seed in range(5):
        shift = torch.randn(SHAPE, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
        x = end + 1e-3 * float(end.norm()) * shift / shift.norm()
        misfit = float((problem.forward(x) - problem.data).square().sum())
        assert misfit + weight * variation(problem, x, 0.1) > objective[-1]


def test_zero_data_give_the_ambient_field(measurement):
    from dataclasses import replace

    problem = make(replace(measurement, displacement=torch.zeros_like(measurement.displacement), sigma=None))
    for method in (Tikhonov(), TotalVariation(), Landweber()):
        assert float(last(method.iterate(problem, problem.zero(), 1e-2), 5).x.abs().max()) == 0


def test_conjugate_gradients_stay_where_they_are_done(problem):
    penalty = Penalty(problem, "gradient")
    end = last(conjugate_gradients(problem, penalty, 1e-2, problem.zero()), 400)
    after = last(conjugate_gradients(problem, penalty, 1e-2, end.x), 5)
    assert torch.allclose(end.x, after.x, atol=1e-9)
