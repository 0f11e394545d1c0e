"""Trials whose errors are known: what they are reconstructed from, and the standard deviations that follow."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from nerif.analysis.prediction import reproject
from nerif.data.volume import Volume
from nerif.fields.grid import VoxelField
from nerif.geometry import Box, Grid, Ring
from nerif.physics.quantities import GasSettings
from nerif.reconstruction.base import Outcome, Reconstruction
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.uncertainty.bootstrap import (
    BLOCK,
    LOST,
    VOXELS,
    WIDTH,
    Deviations,
    Member,
    Original,
    Trials,
    best_covered,
)
from refusals import refused

AMBIENT = 1.00027


@pytest.fixture(autouse=True)
def _coarse(monkeypatch):
    monkeypatch.setattr("nerif.reconstruction.uncertainty.bootstrap.VOXELS", 16)


def hot(box: Box, wide: float = 0.2, at: float = 0.0) -> VoxelField:
    """A hot ball in the box, by a spline."""
    grid = Grid.of_resolution(box, 16)
    middle = torch.tensor(box.centre) + at * min(box.edges)
    square = (grid.points(torch.float64) - middle).square().sum(-1) / (wide * min(box.edges)) ** 2
    return VoxelField.through(-2e-4 * torch.exp(-square).double(), grid)


def result_of(field: VoxelField, box: Box) -> Reconstruction:
    return Reconstruction(field, box, AMBIENT, [], Outcome("converged", ""), {})


@pytest.fixture
def original(measurement) -> Original:
    result = result_of(hot(measurement.box), measurement.box)
    return Original(result, NeRIF(seed=3), measurement, lambda field: reproject(field, measurement).maps)


def test_trials_are_of_the_field_found_with_what_was_left_unexplained_in_blocks_of_either_sign(original):
    member = Trials("fast").member(1, original)
    grid = Grid.of_resolution(original.result.box, 16)
    torch.testing.assert_close(member.truth.values, original.result.volume(grid).values)
    assert member.reconstructor.seed == 4

    seen = original.project(VoxelField.through(member.truth.values.double(), grid))["deflection"]
    left = member.measurement.displacement - seen
    before = original.measurement.displacement - original.project(original.result.field)["deflection"]
    sign = (left / before).nan_to_num(1.0)
    torch.testing.assert_close(sign.abs(), torch.ones_like(sign), rtol=0, atol=0.05)
    block = sign[:, :BLOCK, :BLOCK]
    assert bool((block.sign() == block[:, :1, :1].sign()).all())
    assert 0.2 < float((sign > 0).float().mean()) < 0.8
    again = Trials("full").member(1, original)
    assert torch.equal(again.measurement.displacement, member.measurement.displacement)
    assert not torch.equal(Trials("fast").member(2, original).measurement.displacement, left + seen)


def test_pixels_that_were_not_measured_stay_so(original):
    values = original.measurement.displacements.clone()
    values[1, 2:5, 3:7] = float("nan")
    holes = replace(original, measurement=replace(original.measurement, displacement=values))
    data = Trials("fast").member(1, holes).measurement
    assert torch.equal(data.usable, holes.measurement.usable)
    assert int(holes.measurement.usable.sum()) < int(original.measurement.usable.sum())


def test_what_trials_lose_of_the_detail_tells_what_was_lost_before(original):
    """Deviations grow with the share of detail that trials do not keep, and stay where they have more of it."""
    box = Box.cube(40.0)
    grid = Grid.of_resolution(box, 24)
    bare = Volume.of(hot(box, 0.1).sample(grid), grid, "index_excess", AMBIENT)
    for kept in (1.02, 0.98, 0.9):
        deviations = Deviations(bare, GasSettings(), original)
        for _ in range(2):
            trial = result_of(VoxelField.through(kept * bare.values.double(), grid), box)
            deviations.add(Member(NeRIF(), original.measurement, bare), trial)
        assert deviations.lost == pytest.approx(max(1 - kept**2, 0), abs=1e-4)
        ratio = float(deviations.std().values.norm() / (abs(1 - kept) * bare.values.norm()))
        assert ratio == pytest.approx(deviations.better * math.exp(LOST * deviations.lost**0.5), rel=0.02)


@pytest.mark.parametrize("worse", [1.0, 2.0, 0.0])
def test_errors_are_as_much_smaller_as_the_data_are_met_better_than_by_trials(original, worse):
    trial = original.result
    seen = original.project(trial.field)["deflection"].to(original.measurement.displacement)
    left = original.measurement.displacement - seen
    known = original.result.volume(Grid.of_resolution(original.result.box, 16))
    deviations = Deviations(known, GasSettings(), original)
    assert deviations.better == 1.0  # of no trial
    for share in (worse, worse):
        data = replace(original.measurement, displacement=seen + share * left)
        deviations.add(Member(NeRIF(), data, known), trial)
    assert deviations.better == pytest.approx(1 / worse if worse else 1.0, rel=1e-3)


def test_a_field_without_detail_has_lost_none(original):
    box = Box.cube(40.0)
    grid = Grid.of_resolution(box, 16)
    main = Volume.of(torch.full(grid.shape, -1e-4, dtype=torch.float64), grid, "index_excess", AMBIENT)
    deviations = Deviations(main, GasSettings(), original)
    flat = result_of(VoxelField.through(torch.full(grid.shape, -1.05e-4).double(), grid), box)
    deviations.add(Member(NeRIF(), original.measurement, main), flat)
    std = deviations.std().values
    torch.testing.assert_close(std, torch.full_like(std, deviations.better * 5e-6), rtol=1e-3, atol=0)


def test_views_are_covered_by_those_beside_them_and_opposite():
    cameras = Ring(views=4, arc=(0.0, 60.0), extra_angles=(110.0, 190.0), image_size=(8, 8)).cameras()
    order = best_covered(cameras)
    assert order[0] == "190deg"  # which is 10 degrees, between 0 and 20
    assert order[-1] == "110deg"


def test_standard_deviations_average_the_squares_of_known_errors_around_each_voxel(original):
    box = Box.cube(40.0)
    grid = Grid.of_resolution(box, 32)
    main = Volume.of(torch.full(grid.shape, -1e-4), grid, "index_excess", AMBIENT)
    deviations = Deviations(main, GasSettings(), original)
    drawn = torch.Generator().manual_seed(0)
    coarse = Grid.of_resolution(box, 16)
    for size in (3e-6, 4e-6):
        error = size * torch.randn(coarse.shape, generator=drawn, dtype=torch.float64)
        expected = Volume.of(torch.full(coarse.shape, -1e-4).double(), coarse, "index_excess", AMBIENT)
        plain = result_of(VoxelField.through(expected.values + error, coarse), box)
        deviations.add(Member(NeRIF(), original.measurement, expected), plain)
    told = {v.quantity: v for v in deviations.volumes()}
    assert deviations.count == 2
    std = told["index_excess_std"].values
    rms = deviations.better * (0.5 * (3e-6**2 + 4e-6**2)) ** 0.5
    assert float(std.square().mean().sqrt()) == pytest.approx(rms, rel=0.05)
    assert float(std.std() / std.mean()) < 0.5 * (2 * 2 * 1.1) ** -0.5 + 0.3  # smooth, where one error is not
    k = told["density_std"].attributes["gladstone_dale_m3_kg-1"]
    torch.testing.assert_close(told["density_std"].values, std / k, rtol=1e-4, atol=1e-9)
    torch.testing.assert_close(told["n_std"].values, std, rtol=1e-4, atol=1e-12)
    assert set(told) == {*(f"{q}_std" for q in ("index_excess", "n", "density", "temperature")),
                          "temperature_p05", "temperature_p95"}  # fmt: skip
    low, high = (told[f"temperature_{name}"].values for name in ("p05", "p95"))
    middle = 293.15 * (AMBIENT - 1) / (AMBIENT - 1 - 1e-4)
    assert bool((low < high).all())
    assert float(low.mean()) < middle < float(high.mean())
    assert float((high + low).mean()) > 2 * middle  # temperature goes up faster than it comes down
    assert told["temperature_p95"].unit == "K"


def test_temperatures_beyond_the_relation_are_masked_and_counted(original):
    box = Box.cube(40.0)
    grid = Grid.of_resolution(box, 8)
    main = Volume.of(torch.full(grid.shape, -2.6e-4), grid, "index_excess", AMBIENT)
    deviations = Deviations(main, GasSettings(), original)
    plain = result_of(VoxelField.through(torch.full(grid.shape, -2.6e-4).double(), grid), box)
    expected = Volume.of(torch.full(grid.shape, -2.3e-4), grid, "index_excess", AMBIENT)
    deviations.add(Member(NeRIF(), original.measurement, expected), plain)
    told = {v.quantity: v for v in deviations.volumes()}
    assert told["temperature_p95"].notes["masked_voxels"] == grid.shape[0] ** 3
    k = told["density_std"].attributes["gladstone_dale_m3_kg-1"]
    torch.testing.assert_close(told["density_std"].values, told["index_excess_std"].values / k, rtol=1e-4, atol=1e-9)
    assert float(told["index_excess_std"].values.mean()) == pytest.approx(deviations.better * 3e-5, rel=1e-3)


@pytest.mark.parametrize(("kind", "members"), [("off", 0), ("fast", 2), ("full", 8)])
def test_how_many(kind, members):
    assert Trials(kind).members == members


def test_a_kind_that_is_none_is_refused():
    with refused("uncertainty"):
        Trials("quick")


def test_squares_are_averaged_over_a_few_voxels():
    assert 1 < WIDTH * VOXELS < 4
