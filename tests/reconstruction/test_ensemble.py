"""The ensemble: what its members see, and the mean and spread of what comes out."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from nerif.common.conventions import InputError
from nerif.fields.grid import VoxelField
from nerif.geometry import Box, Grid
from nerif.physics.quantities import GasSettings
from nerif.reconstruction.base import Outcome, Reconstruction
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.uncertainty.ensemble import Ensemble, Spread
from nerif.reconstruction.uncertainty.repetition import Found, Member
from nerif.reconstruction.voxels.tikhonov import Tikhonov

GRID = Grid(Box((-1.0, 2.0, -3.0), (3.0, 8.0, 7.0)), (5, 3, 4))


def result_of(values: torch.Tensor) -> Reconstruction:
    """A reconstruction that has found these values."""

    return Reconstruction(VoxelField.through(values, GRID), GRID.box, 1.00027, [], Outcome("converged", ""), {})


def found_by(method, measurement, noise) -> Found:
    """What there is to repeat, of a reconstruction that found nothing."""
    return Found(result_of(torch.zeros(GRID.shape)), method, measurement, lambda: {"deflection": noise}, dict)


def test_members_have_other_noise_and_other_seeds(measurement):
    sigma = measurement.sigma
    method = NeRIF(seed=7)
    found = found_by(method, measurement, sigma)
    first, second = (Ensemble(2).member(k, found) for k in (1, 2))
    a, b = first.measurement, second.measurement
    assert (first.reconstructor.seed, second.reconstructor.seed) == (8, 9)
    assert replace(first.reconstructor, seed=7) == method
    added = (a.displacement - measurement.displacement) / sigma
    assert float(added.std()) == pytest.approx(1, abs=0.05)
    assert float(added.mean()) == pytest.approx(0, abs=0.05)
    other = (b.displacement - measurement.displacement) / sigma
    assert abs(float((added * other).mean())) < 0.05
    torch.testing.assert_close(a.sigma, sigma * math.sqrt(2))
    again = Ensemble(5).member(1, found).measurement
    assert torch.equal(again.displacement, a.displacement)


def test_methods_without_a_seed_and_measurements_without_sigma(measurement):
    noise = torch.full(measurement.displacement.shape, 0.1)
    member = Ensemble(2).member(1, found_by(Tikhonov(), replace(measurement, sigma=None), noise))
    assert member.reconstructor == Tikhonov()
    assert member.measurement.sigma is None
    assert float((member.measurement.displacement - measurement.displacement).std()) == pytest.approx(0.1, rel=0.05)


def test_one_view_is_left_out_in_turn(measurement):
    ensemble = Ensemble(7, leave_one_out=True)
    out = [ensemble.left_out(k, measurement) for k in range(1, 8)]
    assert out == [(n,) for n in (*measurement.names, *measurement.names[:2])]
    member = ensemble.member(2, found_by(NeRIF(), measurement, measurement.sigma))
    assert member.left_out == (measurement.names[1],)
    assert member.measurement.names == tuple(n for n in measurement.names if n != measurement.names[1])
    assert Ensemble(3).left_out(1, measurement) == ()


def test_mean_and_standard_deviation(measurement):
    values = [torch.rand(GRID.shape, generator=torch.Generator().manual_seed(k)) * -1e-4 for k in range(4)]
    values[2][0, 0, 0] = -3e-4  # n < 1: temperature is masked there, what is linear in the index is not
    spread = Spread(GRID, GasSettings())
    results = [result_of(v) for v in values]
    for result in results:
        spread.add(Member(NeRIF(), measurement), result)
    found = {v.quantity: v for v in spread.volumes()}
    stacked = torch.stack([result.volume(GRID).values for result in results]).double()
    torch.testing.assert_close(found["index_excess_mean"].values.double(), stacked.mean(dim=0), rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(found["index_excess_std"].values.double(), stacked.std(dim=0), rtol=1e-5, atol=1e-12)
    torch.testing.assert_close(found["n_mean"].values, stacked.mean(dim=0) + 1.00027, rtol=0, atol=1e-13)
    assert torch.isnan(found["temperature_std"].values).nonzero().tolist() == [[0, 0, 0]]
    assert not torch.isnan(found["density_std"].values).any()
    assert found["temperature_mean"].notes["masked_voxels"] == 1
    assert found["temperature_std"].unit == "K"
    assert found["density_std"].notes["members"] == 4
    # sigma of density is that of the index over K
    k = found["density_mean"].attributes["gladstone_dale_m3_kg-1"]
    torch.testing.assert_close(
        found["density_std"].values, found["index_excess_std"].values / k, rtol=1e-4, atol=1e-9
    )


def test_one_member_is_no_ensemble():
    with pytest.raises(InputError, match="2 members"):
        Ensemble(1)
