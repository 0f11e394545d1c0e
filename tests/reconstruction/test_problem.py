"""The least-squares solvers against dense linear algebra, on problems small enough to form the matrix."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
import torch

from nerif.fields.voxel_field import Boundary
from nerif.geometry import Box, Grid
from nerif.reconstruction.target import Target
from nerif.reconstruction.voxels import voxel_problem as problem_module
from nerif.reconstruction.voxels.face_gradients import at_faces, gradient_square
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.reconstruction.voxels.voxel_problem import (
    Differences,
    Penalty,
    Problem,
    conjugate_gradients,
    filtered,
    response,
    spectrum_of_differences,
)  # fmt: skip

SHAPE = (4, 5, 6)
WEIGHTS = {"gradient": 1e-3, "identity": 1e-2, "laplacian": 1e-6}


def last(iterates, count: int):
    """The iterate after `count` iterations."""
    return next(itertools.islice(iterates, count - 1, None))


def columns(linear) -> np.ndarray:
    """The matrix of a linear map of voxels."""
    rows = []
    for unit in torch.eye(math.prod(SHAPE), dtype=torch.float64):
        out = linear(unit.reshape(SHAPE))
        rows.append(torch.cat([o.reshape(-1) for o in (out if isinstance(out, tuple) else (out,))]))
    return torch.stack(rows, dim=1).numpy()


def stacked(problem: Problem, forward: np.ndarray, kind: str, weight: float) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and right side of |F x - b|^2 + weight |L x|^2."""
    matrix = np.vstack([forward, math.sqrt(weight) * columns(Penalty(problem, kind))])
    right = np.zeros(len(matrix))
    right[: problem.data.numel()] = problem.data.numpy()
    return matrix, right


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def make(measurement, free=None, bounds=None, grid: Grid | None = None, basis: str = "linear") -> Problem:
    target = Target.of(measurement)
    (part,), faces = target.parts, Boundary(measurement.ambient_faces)
    grid = grid or Grid(measurement.box, SHAPE)
    operator = VoxelOperator(part.rays, grid, part.model, basis, boundary=faces, dtype=torch.float64)
    return Problem([operator], target, free, bounds)


@pytest.fixture(scope="module")
def problem(measurement) -> Problem:
    return make(measurement)


@pytest.fixture(scope="module")
def forward(problem) -> np.ndarray:
    """The matrix F."""
    return columns(problem.forward)


def test_data_have_length_one_and_the_gradient_its_adjoint(problem):
    assert float(problem.data.norm()) == pytest.approx(1, abs=1e-5)
    differences = Differences(Grid(Box((0.0, 0.0, 0.0), (3.0, 5.0, 7.0)), SHAPE), Boundary(("x-", "z+")))
    x = random(*SHAPE)
    y = tuple(random(*d.shape, seed=1) for d in differences(x))
    product = sum(float((a * b).sum()) for a, b in zip(differences(x), y, strict=True))
    assert product == pytest.approx(float((x * differences.adjoint(y)).sum()), rel=1e-12)


@pytest.mark.parametrize("kind", Penalty.KINDS)
def test_tikhonov_solves_the_stacked_least_squares_problem(problem, forward, kind):
    weight, penalty, x = 1e-3, Penalty(problem, kind), random(*SHAPE)
    matrix, right = stacked(problem, forward, kind, weight)
    square = columns(penalty)
    back = square.T @ (square @ x.numpy().ravel())
    assert np.allclose(penalty.adjoint(penalty(x)).numpy().ravel(), back, rtol=1e-10, atol=1e-10)
    exact = np.linalg.lstsq(matrix, right, rcond=None)[0]
    iterate = last(Tikhonov(penalty=kind).iterate(problem, problem.zero(), weight), 100)
    assert np.linalg.norm(iterate.x.numpy().ravel() - exact) < 1e-6 * np.linalg.norm(exact)
    misfit = matrix @ exact - right
    assert iterate.residual + weight * iterate.penalty == pytest.approx(float(misfit @ misfit), rel=1e-9)


def test_conjugate_gradients_remain_at_their_limit(problem):
    penalty = Penalty(problem, "gradient")
    end = last(conjugate_gradients(problem, penalty, 1e-2, problem.zero()), 400)
    after = last(conjugate_gradients(problem, penalty, 1e-2, end.x), 5)
    assert torch.allclose(end.x, after.x, atol=1e-9)


def test_pinned_voxels_stay_ambient_and_the_rest_fits_without_them(measurement, forward):
    free = torch.zeros(SHAPE, dtype=torch.bool)
    free[1:3, 1:4, 2:5] = True
    problem = make(measurement, free)
    iterate = last(Tikhonov().iterate(problem, problem.zero(), 1e-3), 100)
    assert float(iterate.x[~free].abs().max()) == 0
    inside = free.numpy().ravel()
    matrix, right = stacked(problem, forward, "gradient", 1e-3)
    exact = np.linalg.lstsq(matrix[:, inside], right, rcond=None)[0]
    assert np.linalg.norm(iterate.x.numpy().ravel()[inside] - exact) < 1e-6 * np.linalg.norm(exact)


@pytest.mark.slow
def test_bounds_hold_and_the_solution_is_the_bounded_one(measurement, forward):
    problem = make(measurement, bounds=(-4e-5, 1e-5))
    iterate = last(Tikhonov().iterate(problem, problem.zero(), 1e-3), 200)
    exact = scipy.optimize.lsq_linear(*stacked(problem, forward, "gradient", 1e-3), problem.bounds, tol=1e-12)
    assert int((exact.active_mask != 0).sum()) > 3  # the bounds matter
    assert np.linalg.norm(iterate.x.numpy().ravel() - exact.x) < 1e-6 * np.linalg.norm(exact.x)


@pytest.mark.parametrize("method", [Tikhonov(), TotalVariation(round=15)], ids=["tikhonov", "tv"])
def test_the_residual_of_a_bounded_iterate_is_that_of_its_field(measurement, method):
    problem = make(measurement, bounds=(-4e-5, 1e-5))
    low, high = problem.bounds
    for iterate in itertools.islice(method.iterate(problem, problem.zero(), 1e-5), 40):
        assert low <= float(iterate.x.min()) <= float(iterate.x.max()) <= high
        assert iterate.residual == pytest.approx(problem.residual(iterate.x), rel=1e-9)


def test_no_bounded_iterate_is_worse_than_the_one_before(measurement):
    problem, weight = make(measurement, bounds=(-4e-5, 0.0)), 1e-5
    path = [p.objective(weight) for p in itertools.islice(Tikhonov().iterate(problem, problem.zero(), weight), 200)]
    assert all(b <= a for a, b in itertools.pairwise(path))
    assert path[30] < 1.01 * path[-1]


@pytest.mark.parametrize("momentum", [pytest.param(False, marks=pytest.mark.slow), True])
def test_landweber_converges_to_the_least_residual(problem, forward, momentum):
    right = problem.data.numpy()
    misfit = forward @ np.linalg.lstsq(forward, right, rcond=None)[0] - right
    least = float(misfit @ misfit)
    path = [p.residual for p in itertools.islice(
        Landweber(momentum=momentum).iterate(problem, problem.zero(), 0.0), 400)]  # fmt: skip
    assert path[0] < 0.999  # the first iteration is a step from the zero field, whose residual is 1
    assert path[0] > path[19] > path[-1] >= least * (1 - 1e-9)
    assert path[-1] < 1.1 * least
    if momentum:
        assert path[59] < last(Landweber(momentum=False).iterate(problem, problem.zero(), 0.0), 60).residual


def test_the_first_landweber_step_is_the_gradient(problem, forward):
    x = last(Landweber(momentum=False, relaxation=0.7).iterate(problem, problem.zero(), 0.0), 1).x
    gradient = problem.adjoint(problem.data)
    step = float((x * gradient).sum() / gradient.square().sum())
    assert torch.allclose(x, step * gradient)
    norm = np.linalg.norm(forward, 2)
    assert 0.7 / (1.05 * norm) ** 2 < step < 0.7 / norm**2 * 1.0001


def variation(problem: Problem, x: torch.Tensor) -> float:
    return float((gradient_square(problem.differences(x)) + 0.1**2).sqrt().mean())


def test_face_weights_equal_those_of_the_voxels_beside_them(problem):
    x, weight = random(*SHAPE), random(*SHAPE, seed=1)
    along = problem.differences(x)
    by_face = sum(float((w * d.square()).sum()) for w, d in zip(at_faces(weight), along, strict=True))
    assert by_face == pytest.approx(float((weight * gradient_square(along)).sum()), rel=1e-12)


def test_total_variation_converges_to_a_minimum(problem):
    """Its objective falls from round to round, and no small step from the end of them lowers it."""
    weight, method = 1e-2, TotalVariation(softness=0.1, round=10)
    path = list(itertools.islice(method.iterate(problem, problem.zero(), weight), 200))
    objective = [p.objective(weight) for p in path]
    assert all(b <= a + 1e-9 for a, b in itertools.pairwise(objective[9::10]))
    end = path[-1].x
    assert path[-1].penalty == pytest.approx(variation(problem, end), rel=1e-9)
    for seed in range(5):
        shift = random(*SHAPE, seed=seed) - 0.5
        x = end + 1e-3 * float(end.norm()) * shift / shift.norm()
        assert problem.residual(x) + weight * variation(problem, x) > objective[-1]


def test_zero_data_give_the_ambient_field(measurement):
    problem = make(replace(measurement, displacement=torch.zeros_like(measurement.displacement), sigma=None))
    for method in (Tikhonov(), TotalVariation(), Landweber()):
        assert float(last(method.iterate(problem, problem.zero(), 1e-2), 5).x.abs().max()) == 0


# -- preconditioner ----------------------------------------------------------------------------------------------------


def test_the_preconditioner_inverts_a_convolution_and_has_the_spectrum_of_differences():
    def smooth(x: torch.Tensor) -> torch.Tensor:
        return x + 0.1 * torch.stack([x.roll(s, a) for a in range(3) for s in (1, -1)]).sum(dim=0)

    x, inverse = random(6, 8, 9), (1.0, 2.0, 3.0)
    assert torch.allclose(filtered(smooth(x), response(smooth, torch.zeros_like(x), None)), x)
    square = sum(i**2 * (2 * x - x.roll(1, a) - x.roll(-1, a)) for a, i in enumerate(inverse))
    spectrum = spectrum_of_differences(x, inverse)
    assert torch.allclose(torch.fft.irfftn(torch.fft.rfftn(x) * spectrum, s=x.shape), square)


def test_the_response_is_that_of_a_free_voxel_and_a_zero_operator_is_harmless():
    points, free = [], torch.zeros(SHAPE, dtype=torch.bool)
    free[1, 2, 3] = True

    def normal(x):
        points.append(x.nonzero().tolist())
        return 0 * x

    spectrum = response(normal, torch.zeros(SHAPE, dtype=torch.float64), free)
    assert points == [[[1, 2, 3]]]
    assert torch.equal(spectrum, torch.ones_like(spectrum))


@pytest.mark.parametrize(
    "kind", [k if k == "gradient" else pytest.param(k, marks=pytest.mark.slow) for k in Penalty.KINDS]
)
def test_the_preconditioner_reaches_the_same_minimum_in_fewer_iterations(measurement, kind, monkeypatch):
    weight = WEIGHTS[kind]
    problem = make(measurement, grid=Grid.of_resolution(measurement.box, 10), basis="cubic")

    def objectives() -> list[float]:
        iterates = conjugate_gradients(problem, Penalty(problem, kind), weight, problem.zero())
        return [i.objective(weight) for i in itertools.islice(iterates, 120)]

    def iterations(path: list[float]) -> int:
        return next(i for i, objective in enumerate(path) if objective < 1.001 * path[-1])

    preconditioned = objectives()
    monkeypatch.setattr(problem_module, "filtered", lambda x, spectrum: x)
    plain = objectives()
    assert preconditioned[-1] == pytest.approx(plain[-1], rel=1e-5)
    assert iterations(preconditioned) < iterations(plain)
