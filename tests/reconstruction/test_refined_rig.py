"""What is made of a refined rig: how well it is known, views not seen, voxels, the check, and what cannot be told."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from matplotlib.figure import Figure

from nerif.analysis.rig_check import check_rig
from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.fields.base import Field
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Ring
from nerif.geometry.pose import GEOMETRY, Corrections
from nerif.reconstruction.rig.numbers import NAMES
from nerif.reconstruction.rig.posterior import with_posterior
from nerif.reconstruction.rig.refined import UNTOLD, moved_lines, with_corrections
from nerif.reconstruction.rig.refinement import Refinement
from nerif.reconstruction.rig.refit import refit
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.report.figures import draw_corrections
from nerif.simulation.simulate import simulate
from refusals import refused

BOX = Box((-20.0,) * 3, (20.0,) * 3)
RING = Ring(views=7, arc=(0.0, 154.0), image_size=(26, 28), pixel_pitch=0.15)
BALLS = make_phantom("gaussians", BOX, 2)
ASKED = {"refine": ("cameras",), "pose_sigma_mm": 0.4, "pose_sigma_deg": 0.02, "shift_sigma_px": 0.05, "open_faces": ()}


class Column(Field):
    """Hot gas that is the same along z and around it."""

    def value_and_gradient(self, points):
        value = -2e-4 * torch.exp(-points[..., :2].square().sum(-1) / 50)
        gradient = torch.zeros_like(points)
        gradient[..., :2] = value[..., None] * -2 * points[..., :2] / 50
        return value, gradient

    def to(self, device):
        return self


def simulated(field: Field, ring: Ring = RING, noise: float = 0.02) -> Measurement:
    return simulate(field, ring.cameras(), BOX, 1.00027, noise, 1, 40)


@pytest.fixture(autouse=True)
def _coarse(monkeypatch):
    """How well a rig is known hardly depends on the grid, its time does."""
    monkeypatch.setattr("nerif.reconstruction.rig.posterior.VOXELS", 8)


@pytest.fixture(scope="module")
def measured() -> Measurement:
    return simulated(BALLS)


def knocked(measurement: Measurement, view: int = 2, mm: float = 3.0) -> Measurement:
    """The measurement as of cameras of which one is calibrated elsewhere."""
    values = torch.zeros(len(measurement.cameras), len(GEOMETRY), dtype=torch.float64)
    values[view, GEOMETRY.index("shift_y")] = -mm
    return replace(measurement, cameras=Corrections(measurement.cameras, values).corrected)


def posterior(measurement: Measurement, field: Field, **asked) -> list[dict]:
    settings = {**ASKED, **asked}
    table = Refinement.of_table(measurement, settings, ()).table()
    return with_posterior(table, measurement, field, settings)


def test_what_is_told_is_smaller_afterwards_and_never_larger_than_before(measured):
    rows = posterior(measured, BALLS)
    for row in rows:
        assert row["told"] > UNTOLD
        assert row["rms_after"] == pytest.approx(1, abs=0.15)
        assert all(0 < row["sigma_after"][name] <= 1.001 * row["sigma"][name] for name in row["values"])
    assert max(row["aside_sigma_px"] for row in rows) < 0.6 * aside_before(measured)
    worse = posterior(replace(measured, sigma=3 * measured.sigma), BALLS)
    assert worse[0]["aside_sigma_px"] > 1.2 * rows[0]["aside_sigma_px"]


def aside_before(measurement: Measurement) -> float:
    rig = Refinement.of_table(measurement, ASKED, ())
    return float((rig.aside(0) * rig.sigma[0, rig.columns]).norm(dim=1).max())


def test_what_a_view_shows_of_the_middle_moves_as_its_camera_says(measured):
    rig = Refinement.asked(measured, ["cameras", "shift"])
    values = 0.1 * torch.randn(rig.sigma.shape, generator=torch.Generator().manual_seed(0)).double() * rig.sigma
    rig.restore({**rig.kept(), "values": values})
    for v, row in enumerate(rig.table()):
        expected = float((rig.aside(v) @ values[v, rig.columns]).norm())
        assert row["aside_px"] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(
    "case",
    ["noise above the signal", pytest.param("a column the same around and along its axis", marks=pytest.mark.slow)],
)
def test_where_the_data_tell_nothing_it_is_said(measured, case):
    if case.startswith("noise"):
        louder = 300 * measured.sigma
        drawn = torch.randn(louder.shape, generator=torch.Generator().manual_seed(1))
        m = replace(measured, displacement=measured.displacement + louder * drawn, sigma=louder)
        rows = posterior(m, BALLS)
    else:  # the column goes on beyond the box: where it ended, heights would be told
        rows = posterior(simulated(Column()), Column(), open_faces=("z-", "z+"))
    assert max(row["told"] for row in rows) < UNTOLD
    assert "the data tell next to nothing of how any view stands" in moved_lines(rows)[1]


def test_of_three_views_it_is_said_that_the_field_can_follow():
    three = simulated(BALLS, replace(RING, views=3, arc=(0.0, 120.0)))
    lines = moved_lines(posterior(three, BALLS))
    assert any(line.startswith("of 3 views the field can follow nearly any movement") for line in lines)


def test_a_view_that_was_not_seen_is_refined_against_a_field_that_stays(measured):
    (row,) = refit(BALLS, alone(knocked(measured)), {**ASKED, "pose_sigma_mm": 2.0})
    assert row["aside_px"] > 1.2
    mended = with_corrections(alone(knocked(measured)), [row]).cameras[0]
    right, centre = measured.cameras[2], torch.zeros(1, 3, dtype=torch.float64)
    assert float((mended.project(centre) - right.project(centre)).norm()) < 0.2


def alone(measurement: Measurement) -> Measurement:
    return measurement.select([measurement.names[2]])


@pytest.mark.parametrize("method", [Tikhonov, pytest.param(TotalVariation, marks=pytest.mark.slow)])
def test_voxels_follow_a_rig_that_is_refined(measured, method):
    wrong = knocked(measured)
    settings = method(voxels=20, refine=("cameras",), pose_sigma_mm=2.0, coarse_to_fine=False, device="cpu")
    result = settings(wrong)
    rows = result.rig
    assert max(rows, key=lambda row: row["aside_px"])["name"] == wrong.names[2]
    mended = with_corrections(wrong, rows)
    centre = torch.zeros(1, 3, dtype=torch.float64)
    there = measured.cameras[2].project(centre)
    before, after = (float((m.cameras[2].project(centre) - there).norm()) for m in (wrong, mended))
    assert after < 0.6 * before


def test_a_view_that_displacements_do_not_show_has_no_posterior(measured):
    """A rig refined by images has views of which no displacement was found."""
    rig = Refinement.asked(measured, ASKED["refine"], 0.4, 0.02, 0.05)
    rig.values = 0.1 * rig.sigma
    table, shown = rig.table(), measured.without([measured.names[1]])
    found = with_posterior(table, shown, BALLS, ASKED)
    assert [row["name"] for row in found] == list(measured.names)
    assert found[1] == table[1]
    alone = with_posterior([row for i, row in enumerate(table) if i != 1], shown, BALLS, ASKED)
    assert [row for i, row in enumerate(found) if i != 1] == alone


@pytest.mark.slow
def test_voxels_that_are_stopped_while_the_rig_is_refined_go_on_undisturbed(measured):
    settings = Tikhonov(voxels=12, regularisation=1e-3, iterations=12, refine=("cameras", "shift"), device="cpu")
    whole = settings(measured)
    parted = settings(measured, on_step=lambda step: step.step == 37)
    assert parted.outcome.reason == "interrupted"
    again = settings(measured, resume=parted.state)
    for a, b in zip(whole.rig, again.rig, strict=True):  # but for the directions of conjugate gradients, begun anew
        off = [abs(a["values"][name] - b["values"][name]) / sigma for name, sigma in a["sigma"].items()]
        assert max(off) < 0.05


@pytest.mark.slow
def test_the_check_names_a_camera_that_was_knocked(tmp_path):
    ring = Ring(views=9, arc=(0.0, 160.0), image_size=(52, 56), pixel_pitch=0.075)
    measured = simulated(BALLS, ring)
    knocked(measured, mm=1.5).write(tmp_path / "m.nc")
    words = ["check", str(tmp_path / "m.nc"), "--refine", "cameras", "--time-limit", "45", "--pose-sigma-mm", "0.2"]
    words += ["--pose-sigma-deg", "0.02", "--strict"]  # in a process of its own, where no types are checked
    done = subprocess.run([sys.executable, "-m", "nerif", *words], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert f"FOUND: view {measured.names[2]} is not where its calibration says" in done.stdout
    assert done.stdout.count("FOUND") == 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["cameras", "--time-limit", "0"], "time_limit: expected seconds above 0"),
        (["lens"], "refine: expected some of"),
    ],
)
def test_a_check_that_cannot_be_is_refused(measured, tmp_path, capsys, words, told):
    measured.write(tmp_path / "m.nc")
    assert main(["check", str(tmp_path / "m.nc"), "--refine", *words]) == 2
    assert told in capsys.readouterr().err


@pytest.mark.slow
def test_the_check_in_python_gives_the_table(measured):
    found = check_rig(measured, ["shift"], 2.0)
    assert [row["name"] for row in found.table] == list(measured.names)
    assert set(found.table[0]["values"]) == set(NAMES[8:])


@pytest.mark.slow
def test_a_check_by_a_field_that_does_not_fit_yet_says_so(measured):
    noise = 0.02 * measured.sigma * torch.randn(measured.sigma.shape, generator=torch.Generator().manual_seed(0))
    exact = replace(measured, displacement=measured.displacement + noise, sigma=measured.sigma / 50)
    (remark,) = (r for r in check_rig(exact, ["shift"], 1.0).remarks if "after 1 s" in r)
    assert re.match(r"the field still leaves [\d.]+ sigma in view \S+ after 1 s", remark)


@pytest.mark.slow
def test_a_result_tells_how_well_its_rig_is_known_and_how_a_view_not_seen_fits_both_ways(measured, tmp_path):
    knocked(measured).write(tmp_path / "m.nc")
    out, held = tmp_path / "r", measured.names[2]
    words = ["reconstruct", str(tmp_path / "m.nc"), "-o", str(out), "--method", "tv", "--voxels", "16"]
    words += ["--refine", "cameras", "--withhold", held, "--device", "cpu"]
    assert main(words) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert all({"told", "sigma_after", "rms_before", "rms_after"} <= set(row) for row in metrics["rig"])
    (before,) = [view for view in metrics["views"] if view["withheld"]]
    (after,) = metrics["views_refitted"]
    assert after["name"] == held
    assert after["rms"] < before["rms"]
    page = (out / "report.html").read_text()
    assert "Corrections of the cameras" in page
    assert f"{held}, camera refined" in page
    drawn = draw_corrections(Figure().subplots(), metrics["rig"])
    assert [text.get_text() for text in drawn.get_legend().get_texts()] == [row["name"] for row in metrics["rig"]]


@pytest.mark.parametrize("table", [[{"name": "a"}], [{"name": "a", "values": {"lens": 1.0}}]])
def test_a_table_that_is_none_is_refused(measured, table):
    with refused("rig"):
        with_corrections(measured, table)
