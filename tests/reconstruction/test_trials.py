"""Trials whose errors are known: what they are reconstructed from, and the standard deviations that follow."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerif.conventions import InputError
from nerif.fields.grid import VoxelField
from nerif.geometry import Box, Grid, Ring
from nerif.physics.quantities import GasSettings
from nerif.prediction import reproject
from nerif.reconstruction.base import Outcome, Reconstruction
from nerif.reconstruction.neural import NeRIF
from nerif.reconstruction.repetition import Found, Member
from nerif.reconstruction.trials import BLOCK, VOXELS, WIDTH, Deviations, Trials, best_covered
from nerif.volume import Volume

AMBIENT = 1.00027


@pytest.fixture(autouse=True)
def _coarse(monkeypatch):
    monkeypatch.setattr("nerif.reconstruction.trials.VOXELS", 16)


def hot(box: Box, wide: float = 0.2, at: float = 0.0) -> VoxelField:
    """A hot ball in the box, by a spline."""
    grid = Grid.of_resolution(box, 16)
    middle = torch.tensor(box.centre) + at * min(box.edges)
    square = (grid.points(torch.float64) - middle).square().sum(-1) / (wide * min(box.edges)) ** 2
    return VoxelField.through(-2e-4 * torch.exp(-square).double(), grid)


def result_of(field: VoxelField, box: Box) -> Reconstruction:
    return Reconstruction(field, box, AMBIENT, [], Outcome("converged", ""), {})


@pytest.fixture
def found(measurement) -> Found:
    result = result_of(hot(measurement.box), measurement.box)
    return Found(result, NeRIF(seed=3), measurement, dict, lambda field: reproject(field, measurement).maps)


def test_trials_are_of_the_field_found_with_what_was_left_unexplained_in_blocks_of_either_sign(found):
    member = Trials("fast").member(1, found, [])
    grid = Grid.of_resolution(found.result.box, 16)
    torch.testing.assert_close(member.expected.values, found.result.volume(grid).values)
    assert member.left_out == ()
    assert member.reconstructor.seed == 4

    seen = found.seen(VoxelField.through(member.expected.values.double(), grid))["deflection"]
    left = member.measurement.displacement - seen
    original = found.measurement.displacement - found.seen(found.result.field)["deflection"]
    sign = (left / original).nan_to_num(1.0)
    torch.testing.assert_close(sign.abs(), torch.ones_like(sign), rtol=0, atol=0.05)
    block = sign[:, :BLOCK, :BLOCK]
    assert bool((block.sign() == block[:, :1, :1].sign()).all())
    assert 0.2 < float((sign > 0).float().mean()) < 0.8
    again = Trials("full").member(1, found, [])
    assert torch.equal(again.measurement.displacement, member.measurement.displacement)
    assert not torch.equal(Trials("fast").member(2, found, []).measurement.displacement, left + seen)


def test_pixels_that_were_not_measured_stay_so(found):
    values = found.measurement.displacements.clone()
    values[1, 2:5, 3:7] = float("nan")
    holes = replace(found, measurement=replace(found.measurement, displacement=values))
    data = Trials("fast").member(1, holes, []).measurement
    assert torch.equal(data.usable, holes.measurement.usable)
    assert int(holes.measurement.usable.sum()) < int(found.measurement.usable.sum())
    main = Volume.of(torch.zeros(4, 4, 4), Grid(found.result.box, (4, 4, 4)), "index_excess", AMBIENT)
    detail = Trials("fast").taken(holes, main, GasSettings()).detail
    assert detail is not None
    assert bool(torch.isfinite(detail.values).all())


def noisy(found: Found, more: Tensor, sigma: float) -> Found:
    """Measured: what the field found shows, more of it, and noise of that sigma; for one view as for many."""
    seen = found.seen(found.result.field)["deflection"]
    noise = sigma * torch.randn(seen.shape, generator=torch.Generator().manual_seed(3))
    measured = (seen + noise + more).to(seen)
    data = replace(found.measurement, displacement=measured, sigma=torch.full_like(seen, sigma), valid=None)
    return replace(found, measurement=data)


def test_what_no_field_has_taken_up_is_told_by_residuals_beyond_the_noise(found):
    """In proportion to it, where the field has detail; nothing is where they are the noise or that is not known."""
    box = found.measurement.box
    main = Volume.of(torch.zeros(4, 4, 4), Grid(box, (4, 4, 4)), "index_excess", AMBIENT)
    seen = found.seen(found.result.field)["deflection"]
    size = float(seen.square().mean().sqrt())
    pattern = torch.randn(seen.shape, generator=torch.Generator().manual_seed(4))
    lacking = []
    for share in (0.3, 0.6):
        detail = Trials("fast").taken(noisy(found, share * size * pattern, 0.01 * size), main, GasSettings()).detail
        assert detail is not None
        lacking.append(detail.values.double())
    torch.testing.assert_close(lacking[1], 2 * lacking[0], rtol=0.05, atol=0)
    grid = Grid.of_resolution(box, 16)
    distance = (grid.points() - torch.tensor(box.centre)).norm(dim=-1).reshape(grid.shape)
    inside = distance < 0.4 * min(box.edges)
    assert float(lacking[0][inside].abs().mean()) > 5 * float(lacking[0][~inside].abs().mean())
    quiet = noisy(found, torch.zeros_like(seen), 0.2 * size)
    quiet = replace(quiet, measurement=replace(quiet.measurement, sigma=1.1 * quiet.measurement.sigma))
    assert Trials("fast").taken(quiet, main, GasSettings()).detail is None
    unknown = replace(found, measurement=replace(quiet.measurement, sigma=None))
    assert Trials("fast").taken(unknown, main, GasSettings()).detail is None


def test_it_adds_to_the_errors_of_trials(measurement):
    box = Box.cube(40.0)
    grid = Grid.of_resolution(box, 16)
    main = Volume.of(torch.full(grid.shape, -1e-4), grid, "index_excess", AMBIENT)
    detail = Volume.of(torch.full(grid.shape, 4e-6), grid, "index_excess", AMBIENT)
    deviations = Deviations(main, GasSettings(), detail)
    plain = result_of(VoxelField.through(torch.full(grid.shape, -1e-4).double(), grid), box)
    expected = Volume.of(torch.full(grid.shape, -1.03e-4), grid, "index_excess", AMBIENT)
    deviations.add(Member(NeRIF(), measurement, (), expected), plain)
    torch.testing.assert_close(deviations.std().values, torch.full(grid.shape, 5e-6), rtol=1e-3, atol=0)


def test_views_are_covered_by_those_beside_them_and_opposite():
    cameras = Ring(views=4, arc=(0.0, 60.0), extra_angles=(110.0, 190.0), image_size=(8, 8)).cameras()
    order = best_covered(cameras)
    assert order[0] == "190deg"  # which is 10 degrees, between 0 and 20
    assert order[-1] == "110deg"


def test_standard_deviations_average_the_squares_of_known_errors_around_each_voxel(measurement):
    box = Box.cube(40.0)
    grid = Grid.of_resolution(box, 32)
    main = Volume.of(torch.full(grid.shape, -1e-4), grid, "index_excess", AMBIENT)
    deviations = Deviations(main, GasSettings())
    drawn = torch.Generator().manual_seed(0)
    coarse = Grid.of_resolution(box, 16)
    for size in (3e-6, 4e-6):
        error = size * torch.randn(coarse.shape, generator=drawn, dtype=torch.float64)
        expected = Volume.of(torch.full(coarse.shape, -1e-4).double() - error, coarse, "index_excess", AMBIENT)
        plain = result_of(VoxelField.through(torch.full(coarse.shape, -1e-4).double(), coarse), box)
        deviations.add(Member(NeRIF(), measurement, (), expected), plain)
    deviations.add(Member(NeRIF(), measurement, ("a",)), plain)  # of which no error is known
    found = {v.quantity: v for v in deviations.volumes()}
    assert deviations.count == 2
    std = found["index_excess_std"].values
    rms = (0.5 * (3e-6**2 + 4e-6**2)) ** 0.5
    assert float(std.square().mean().sqrt()) == pytest.approx(rms, rel=0.05)
    assert float(std.std() / std.mean()) < 0.5 * (2 * 2 * 1.1) ** -0.5 + 0.3  # smooth, where one error is not
    k = found["density_std"].attributes["gladstone_dale_m3_kg-1"]
    torch.testing.assert_close(found["density_std"].values, std / k, rtol=1e-4, atol=1e-9)
    torch.testing.assert_close(found["n_std"].values, std, rtol=1e-4, atol=1e-12)
    assert set(found) == {*(f"{q}_std" for q in ("index_excess", "n", "density", "temperature")),
                          "temperature_p05", "temperature_p95"}  # fmt: skip
    low, high = (found[f"temperature_{name}"].values for name in ("p05", "p95"))
    middle = 293.15 * (AMBIENT - 1) / (AMBIENT - 1 - 1e-4)
    assert bool((low < high).all())
    assert float(low.mean()) < middle < float(high.mean())
    assert float((high + low).mean()) > 2 * middle  # temperature goes up faster than it comes down
    assert found["temperature_p95"].unit == "K"


def test_temperatures_beyond_the_relation_are_masked_and_counted(measurement):
    box = Box.cube(40.0)
    grid = Grid.of_resolution(box, 8)
    main = Volume.of(torch.full(grid.shape, -2.6e-4), grid, "index_excess", AMBIENT)
    deviations = Deviations(main, GasSettings())
    plain = result_of(VoxelField.through(torch.full(grid.shape, -2.6e-4).double(), grid), box)
    expected = Volume.of(torch.full(grid.shape, -2.3e-4), grid, "index_excess", AMBIENT)
    deviations.add(Member(NeRIF(), measurement, (), expected), plain)
    found = {v.quantity: v for v in deviations.volumes()}
    assert found["temperature_p95"].notes["masked_voxels"] == grid.shape[0] ** 3
    assert float(found["index_excess_std"].values.mean()) == pytest.approx(3e-5, rel=1e-3)


@pytest.mark.parametrize(("kind", "members"), [("off", 0), ("fast", 2), ("full", 8)])
def test_how_many(kind, members):
    assert Trials(kind).members == members


def test_a_kind_that_is_none_is_refused():
    with pytest.raises(InputError, match="uncertainty: expected one of off, fast, full, got 'quick'"):
        Trials("quick")


def test_squares_are_averaged_over_a_few_voxels():
    assert 1 < WIDTH * VOXELS < 4
