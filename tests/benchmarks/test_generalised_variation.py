"""Total generalised variation, the peer in benchmarks/methods.py."""

from __future__ import annotations

import pytest
import torch

from benchmarks.generalised_variation import TotalGeneralisedVariation, _Penalty
from nerif.fields.phantoms import make_phantom
from nerif.geometry import paper_rig
from nerif.reconstruction.voxels.descent import VoxelRun
from nerif.simulation.simulate import simulate


def test_the_adjoint_and_the_objective():
    cameras, box = paper_rig(12)
    measurement = simulate(make_phantom("gaussians", box), cameras, box, 1.00027)
    settings = TotalGeneralisedVariation(voxels=8, device="cpu", precision="float64")
    run = VoxelRun(settings, measurement, None, None, None)
    problem = run._problem(run.levels[-1])
    u, v = torch.randn(2, 4, *problem.operator.domain_shape, dtype=torch.float64)
    penalty = _Penalty(settings, problem, u)
    q = [torch.randn_like(a) for a in penalty(v)]
    there = sum(float((a * b).sum()) for a, b in zip(penalty(v), q, strict=True))
    assert there == pytest.approx(float((v * penalty.adjoint(q)).sum()))
    iterates = settings.iterate(problem, problem.zero(), 0.01)
    objective = [next(iterates).objective(0.01) for _ in range(40)]
    assert objective[-1] < 0.5 * objective[0]
