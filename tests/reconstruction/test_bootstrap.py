"""The bootstrap: the data of its trials, and the standard deviations from their errors."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from nerif.analysis.prediction import reproject
from nerif.data.volume import Volume
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid, Ring
from nerif.physics.gas import GasSettings
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import Outcome, Reconstruction
from nerif.reconstruction.rig_refinement import Refinement
from nerif.reconstruction.uncertainty.bootstrap import (
    BLOCK,
    LOST,
    BootstrapDeviations,
    Member,
    Original,
    Trials,
    best_covered,
)  # fmt: skip
from nerif.reconstruction.uncertainty.deviations import VOXELS, WIDTH
from nerif.reconstruction.uncertainty.rig_posterior import RigPosterior
from refusals import refused

AMBIENT = 1.00027
BOX = Box.cube(40.0)


@pytest.fixture(autouse=True)
def _coarse(monkeypatch):
    monkeypatch.setattr("nerif.reconstruction.uncertainty.bootstrap.VOXELS", 16)


def hot(box: Box, wide: float = 0.2) -> VoxelField:
    """A hot ball in the box, by a spline."""
    grid = Grid.of_resolution(box, 16)
    square = (grid.points(torch.float64) - torch.tensor(box.centre)).square().sum(-1) / (wide * min(box.edges)) ** 2
    return VoxelField.through(-2e-4 * torch.exp(-square).double(), grid)


def result_of(field: VoxelField, box: Box = BOX) -> Reconstruction:
    return Reconstruction(field, box, AMBIENT, [], Outcome("converged", ""), {})


def seeded(trial: int) -> torch.Generator:
    """The random numbers of a trial."""
    return torch.Generator().manual_seed(2_000_003 + trial)


def flat(voxels: int, value: float = -1e-4) -> Volume:
    grid = Grid.of_resolution(BOX, voxels)
    return Volume.of(torch.full(grid.shape, value, dtype=torch.float64), grid, "index_excess", AMBIENT)


def trial_of(volume: Volume, error: torch.Tensor | float) -> Reconstruction:
    return result_of(VoxelField.through(volume.values.double() + error, volume.grid))


@pytest.fixture
def original(measurement) -> Original:
    result = result_of(hot(measurement.box), measurement.box)
    return Original(result, NeRIF(seed=3), measurement, lambda field, data: reproject(field, data).maps)


def test_trials_have_projections_of_the_field_and_residuals_with_random_signs_in_blocks(original):
    member = Trials("fast").member(1, original)
    grid = Grid.of_resolution(original.result.box, 16)
    torch.testing.assert_close(member.truth.values, original.result.volume(grid).values)
    assert member.reconstructor.seed == 4
    data = member.measurement.displacement
    spline = VoxelField.through(member.truth.values.double(), grid)
    residual, before = (
        displacement - original.project(field, original.measurement)["deflection"]
        for displacement, field in ((data, spline), (original.measurement.displacement, original.result.field))
    )
    sign = (residual / before).nan_to_num(1.0)
    torch.testing.assert_close(sign.abs(), torch.ones_like(sign), rtol=0, atol=0.05)
    block = sign[:, :BLOCK, :BLOCK]
    assert bool((block.sign() == block[:, :1, :1].sign()).all())
    assert 0.2 < float((sign > 0).float().mean()) < 0.8
    assert torch.equal(Trials("full").member(1, original).measurement.displacement, data)
    assert not torch.equal(Trials("fast").member(2, original).measurement.displacement, data)


def test_pixels_that_were_not_measured_stay_so(original):
    values = original.measurement.displacements.clone()
    values[1, 2:5, 3:7] = float("nan")
    holes = replace(original, measurement=replace(original.measurement, displacement=values))
    assert torch.equal(Trials("fast").member(1, holes).measurement.usable, holes.measurement.usable)
    assert int(holes.measurement.usable.sum()) < int(original.measurement.usable.sum())


def test_trials_of_a_refined_rig_have_calibrated_cameras_and_are_seen_by_their_own(measurement):
    settings = {"refine": ("cameras", "shift"), "pose_sigma_mm": 2.0, "pose_sigma_deg": 0.2, "shift_sigma_px": 0.1}
    blank = Refinement.of_table(measurement, settings, ())
    random = torch.randn(blank.sigma.shape, generator=torch.Generator().manual_seed(0)).double()
    blank.values = blank.sigma * random
    table, parameters = blank.table(), blank.sigma[:, blank.columns].numel()
    rig = RigPosterior(table, blank, 0.3 * torch.eye(parameters, dtype=torch.float64))
    result = replace(result_of(hot(measurement.box), measurement.box), rig=table)
    original = Original(result, NeRIF(), measurement, lambda field, data: reproject(field, data).maps, rig)
    member = Trials("fast").member(1, original)
    assert member.measurement.cameras == measurement.cameras
    deviations = BootstrapDeviations(member.truth, GasSettings(), original)
    for table_of in (rig.draw(seeded(1)), table):  # the right rig, and that of the reconstruction
        deviations.add_trial(member, replace(trial_of(member.truth, 0.0), rig=table_of))
    right, wrong = deviations.residual_ratios
    assert right == pytest.approx(1.0, rel=0.02)
    assert wrong > 1.2


def test_rigs_are_drawn_with_their_covariance(measurement):
    settings = {"refine": ("background",), "pose_sigma_mm": None, "pose_sigma_deg": None, "shift_sigma_px": 0.1}
    rig = Refinement.of_table(measurement, settings, ())
    root = torch.randn(len(rig.names), len(rig.names), generator=seeded(0), dtype=torch.float64)
    posterior, generator = RigPosterior(rig.table(), rig, root @ root.T), seeded(1)
    draws = [[row["values"]["background"] for row in posterior.draw(generator)] for _ in range(2000)]
    scaled = torch.tensor(draws).T / rig.sigma[:, rig.columns].float()
    assert float((torch.cov(scaled) - root @ root.T).norm() / (root @ root.T).norm()) < 0.1


@pytest.mark.parametrize("share", [1.02, 0.98, 0.9])
def test_deviations_grow_with_the_detail_that_trials_lose(original, share):
    """They do not shrink if trials have more of it."""
    grid = Grid.of_resolution(BOX, 24)
    truth = Volume.of(hot(BOX, 0.1).sample(grid), grid, "index_excess", AMBIENT)
    deviations = BootstrapDeviations(truth, GasSettings(), original)
    for _ in range(2):
        member = Member(NeRIF(), original.measurement, truth)
        deviations.add_trial(member, trial_of(truth, (share - 1) * truth.values.double()))
    assert deviations.lost == pytest.approx(max(1 - share**2, 0), abs=1e-4)
    ratio = float(deviations.std().values.norm() / (abs(1 - share) * truth.values.norm()))
    assert ratio == pytest.approx(deviations.better * math.exp(LOST * deviations.lost**0.5), rel=0.02)


@pytest.mark.parametrize("worse", [1.0, 2.0, 0.0])
def test_deviations_shrink_with_the_residual_relative_to_that_of_trials(original, worse):
    measured = original.measurement.displacement
    projections = original.project(original.result.field, original.measurement)["deflection"].to(measured)
    residual = measured - projections
    truth = original.result.volume(Grid.of_resolution(original.result.box, 16))
    deviations = BootstrapDeviations(truth, GasSettings(), original)
    assert deviations.better == 1.0  # without trials
    for _ in range(2):
        data = replace(original.measurement, displacement=projections + worse * residual)
        deviations.add_trial(Member(NeRIF(), data, truth), original.result)
    assert deviations.better == pytest.approx(1 / worse if worse else 1.0, rel=1e-3)


def test_a_field_without_detail_has_lost_none(original):
    deviations = BootstrapDeviations(flat(16), GasSettings(), original)
    deviations.add_trial(Member(NeRIF(), original.measurement, flat(16)), trial_of(flat(16), -5e-6))
    std = deviations.std().values
    torch.testing.assert_close(std, torch.full_like(std, deviations.better * 5e-6), rtol=1e-3, atol=0)


def test_views_are_covered_by_neighbours_and_opposite_views():
    order = best_covered(Ring(views=4, arc=(0.0, 60.0), extra_angles=(110.0, 190.0), image_size=(8, 8)).cameras())
    assert order[0] == "190deg"  # opposite to 10 degrees, between 0 and 20
    assert order[-1] == "110deg"


def test_standard_deviations_average_the_squares_of_errors_around_each_voxel(original):
    deviations, generator = BootstrapDeviations(flat(32), GasSettings(), original), torch.Generator().manual_seed(0)
    for size in (3e-6, 4e-6):
        error = size * torch.randn(flat(16).grid.shape, generator=generator, dtype=torch.float64)
        deviations.add_trial(Member(NeRIF(), original.measurement, flat(16)), trial_of(flat(16), error))
    volumes = {v.quantity: v for v in deviations.volumes()}
    assert deviations.count == 2
    std = volumes["index_excess_std"].values
    rms = deviations.better * (0.5 * (3e-6**2 + 4e-6**2)) ** 0.5
    assert float(std.square().mean().sqrt()) == pytest.approx(rms, rel=0.05)
    assert float(std.std() / std.mean()) < 0.5 * (2 * 2 * 1.1) ** -0.5 + 0.3  # smooth, where one error is not
    k = volumes["density_std"].attributes["gladstone_dale_m3_kg-1"]
    torch.testing.assert_close(volumes["density_std"].values, std / k, rtol=1e-4, atol=1e-9)
    torch.testing.assert_close(volumes["n_std"].values, std, rtol=1e-4, atol=1e-12)
    assert set(volumes) == {*(f"{q}_std" for q in ("index_excess", "n", "density", "temperature")),
                            "temperature_p05", "temperature_p95"}  # fmt: skip
    low, high = (volumes[f"temperature_{name}"].values for name in ("p05", "p95"))
    middle = 293.15 * (AMBIENT - 1) / (AMBIENT - 1 - 1e-4)
    assert bool((low < high).all())
    assert float(low.mean()) < middle < float(high.mean())
    assert float((high + low).mean()) > 2 * middle  # temperature is convex in the index
    assert volumes["temperature_p95"].unit == "K"


def test_temperatures_beyond_the_relation_are_masked_and_counted(original):
    deviations = BootstrapDeviations(flat(8, -2.6e-4), GasSettings(uniform_pressure="yes"), original)
    member = Member(NeRIF(), original.measurement, flat(8, -2.3e-4))
    deviations.add_trial(member, trial_of(flat(8, -2.6e-4), 0.0))
    volumes = {v.quantity: v for v in deviations.volumes()}
    assert volumes["temperature_p95"].notes["masked_voxels"] == 8**3
    assert float(volumes["index_excess_std"].values.mean()) == pytest.approx(deviations.better * 3e-5, rel=1e-3)


def test_kinds_and_width():
    assert [Trials(kind).members for kind in ("off", "fast", "full")] == [0, 2, 8]
    with refused("uncertainty"):
        Trials("quick")
    assert 1 < WIDTH * VOXELS < 4  # squares are averaged over a few voxels
