"""The preconditioner: exact where F^T F is a convolution, changing the way of the minimiser and not its end."""

from __future__ import annotations

import itertools

import pytest
import torch

from nerif.fields.grid import Boundary
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Grid, paper_rig
from nerif.reconstruction.target import Target
from nerif.reconstruction.voxels import problem as problem_module
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.problem import (
    Penalty,
    Problem,
    conjugate_gradients,
    filtered,
    response,
    spectrum_of_differences,
)
from nerif.simulation.simulate import simulate

SHAPE = (6, 8, 9)


def random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def smooth(x: torch.Tensor) -> torch.Tensor:
    """A symmetric convolution with periodic ends, positive definite."""
    neighbours = sum(x.roll(s, a) for a in range(3) for s in (1, -1))
    assert isinstance(neighbours, torch.Tensor)
    return x + 0.1 * neighbours


def test_a_convolution_is_undone():
    x = random(*SHAPE)
    assert torch.allclose(filtered(smooth(x), response(smooth, torch.zeros_like(x), None)), x)


def test_differences_have_the_spectrum_named():
    x, inverse = random(*SHAPE), (1.0, 2.0, 3.0)
    square = sum(i**2 * (2 * x - x.roll(1, a) - x.roll(-1, a)) for a, i in enumerate(inverse))
    spectrum = spectrum_of_differences(x, inverse)
    assert torch.allclose(torch.fft.irfftn(torch.fft.rfftn(x) * spectrum, s=x.shape), square)


def test_the_voxel_asked_is_free_and_a_blind_measurement_is_harmless():
    asked = []
    free = torch.zeros(SHAPE, dtype=torch.bool)
    free[1, 2, 3] = True

    def normal(x):
        asked.append(x.nonzero().tolist())
        return 0 * x

    found = response(normal, torch.zeros(SHAPE, dtype=torch.float64), free)
    assert asked == [[[1, 2, 3]]]
    assert torch.equal(found, torch.ones_like(found))


@pytest.fixture(scope="module")
def problem() -> Problem:
    cameras, box = paper_rig(20)
    measurement = simulate(make_phantom("flame", box, 0), cameras, box, 1.00027, 0.1, 0, steps=20)
    target, grid = Target.of(measurement, linear=True), Grid.of_resolution(box, 10)
    faces = Boundary(measurement.ambient_faces)
    operators = [VoxelOperator(p.rays, grid, p.model, "cubic", faces, dtype=torch.float64) for p in target.parts]
    return Problem(operators, target)


@pytest.mark.parametrize(
    "kind", [k if k == "gradient" else pytest.param(k, marks=pytest.mark.slow) for k in Penalty.KINDS]
)
def test_the_minimum_is_the_same_and_found_in_fewer_iterations(problem, kind, monkeypatch):
    weight = {"identity": 1e-2, "gradient": 1e-3, "laplacian": 1e-6}[kind]

    def objectives() -> list[float]:
        iterates = conjugate_gradients(problem, Penalty(problem, kind), weight, problem.zero())
        return [i.objective(weight) for i in itertools.islice(iterates, 120)]

    scaled = objectives()
    monkeypatch.setattr(problem_module, "filtered", lambda x, spectrum: x)
    plain = objectives()
    assert scaled[-1] == pytest.approx(plain[-1], rel=1e-5)

    def needed(path: list[float]) -> int:
        return next(i for i, objective in enumerate(path) if objective < 1.001 * path[-1])

    assert needed(scaled) < needed(plain)
