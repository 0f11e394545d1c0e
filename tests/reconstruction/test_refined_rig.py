"""Uses of a refined rig: its posterior, withheld views, voxels, nerif check, and the report."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest
import torch
from matplotlib.figure import Figure

from nerif.analysis.rig_check import check_rig
from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Ring
from nerif.geometry.pose import GEOMETRY, Corrections
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.rig_parameters import NAMES, UNCONSTRAINED, refinement_lines, with_corrections
from nerif.reconstruction.rig_refinement import Refinement, refit
from nerif.reconstruction.uncertainty.rig_posterior import RigPosterior
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.report.result_plots import draw_corrections
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import simulate
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings
from refusals import refused

BOX = Box((-20.0,) * 3, (20.0,) * 3)
RING = Ring(views=7, arc=(0.0, 154.0), image_size=(26, 28), pixel_pitch=0.15)
BALLS = make_phantom("gaussians", BOX, 2)
SETTINGS = {"refine": ("cameras",), "pose_sigma_mm": 0.4, "pose_sigma_deg": 0.02, "shift_sigma_px": 0.05}
SETTINGS |= {"open_faces": ()}
CENTRE = torch.zeros(1, 3, dtype=torch.float64)


class Column(Field):
    """Hot gas, uniform along z and axisymmetric."""

    def value_and_gradient(self, points):
        value = -2e-4 * torch.exp(-points[..., :2].square().sum(-1) / 50)
        gradient = torch.zeros_like(points)
        gradient[..., :2] = value[..., None] * -2 * points[..., :2] / 50
        return value, gradient


def simulated(field: Field, ring: Ring = RING) -> Measurement:
    return simulate(field, ring.cameras(), BOX, 1.00027, 0.02, 1, 20)


@pytest.fixture(autouse=True)
def _coarse(monkeypatch):
    """The posterior hardly depends on the grid; its time does."""
    monkeypatch.setattr("nerif.reconstruction.uncertainty.rig_posterior.VOXELS", 8)


@pytest.fixture(scope="module")
def measured() -> Measurement:
    return simulated(BALLS)


def knocked(measurement: Measurement, mm: float = 3.0) -> Measurement:
    """The measurement with a wrong position of its third camera."""
    values = torch.zeros(len(measurement.cameras), len(GEOMETRY), dtype=torch.float64)
    values[2, GEOMETRY.index("shift_y")] = -mm
    return replace(measurement, cameras=Corrections(measurement.cameras, values).corrected)


def error_px(measurement: Measurement, truth: Measurement, view: int = 2) -> float:
    """Error of the middle of the box in an image of the third camera."""
    return float((measurement.cameras[view].project(CENTRE) - truth.cameras[2].project(CENTRE)).norm())


def posterior(measurement: Measurement, field: Field, **settings) -> list[dict]:
    settings = {**SETTINGS, **settings}
    table = Refinement.of_table(measurement, settings, ()).table()
    return RigPosterior.of(table, measurement, field, settings).table


@pytest.mark.slow
def test_posterior_deviations_are_smaller_than_the_prior_and_grow_with_the_noise(measured):
    rows = posterior(measured, BALLS)
    for row in rows:
        assert row["uncertainty_reduction"] > UNCONSTRAINED
        assert row["rms_after"] == pytest.approx(1, abs=0.15)
        assert all(0 < row["posterior_sigma"][name] <= 1.001 * row["prior_sigma"][name] for name in row["values"])
    rig = Refinement.of_table(measured, SETTINGS, ())
    prior_px = float((rig.aside(0) * rig.sigma[0, rig.columns]).norm(dim=1).max())
    assert max(row["image_shift_sigma_px"] for row in rows) < 0.6 * prior_px
    noisier = posterior(replace(measured, sigma=3 * measured.sigma), BALLS)
    assert noisier[0]["image_shift_sigma_px"] > 1.2 * rows[0]["image_shift_sigma_px"]


def test_the_shift_of_the_middle_is_linear_in_the_parameters(measured):
    rig = Refinement.for_measurement(measured, ["cameras", "shift"])
    rig.values = 0.1 * torch.randn(rig.sigma.shape, generator=torch.Generator().manual_seed(0)).double() * rig.sigma
    for v, row in enumerate(rig.table()):
        expected = float((rig.aside(v) @ rig.values[v, rig.columns]).norm())
        assert row["image_shift_px"] == pytest.approx(expected, rel=0.02)


def test_a_stretched_image_does_not_shift_at_its_middle(measured):
    odd = measured.select([measured.names[0]])
    height, width = odd.cameras[0].image_size
    numbers = dict(zip(NAMES[-4:], (0.4, 0.1, -0.2, 0.3), strict=True))
    row = {
        "name": odd.names[0],
        "values": numbers,
        "prior_sigma": {},
        "correction_over_sigma": 0.0,
        "image_shift_px": 0.0,
    }
    change = (with_corrections(odd, [row]).displacement - odd.displacement)[0].nan_to_num()
    corners = change[0, 0] + change[height - 1, width - 1]
    assert float(corners.abs().max()) < 1e-5
    assert float(change[0, 0].abs().max()) > 0.1


@pytest.mark.parametrize("case", ["noise above the signal", pytest.param("column", marks=pytest.mark.slow)])
def test_unconstrained_poses_are_reported(measured, case):
    if case == "column":  # with open faces, since its ends would constrain heights
        rows = posterior(simulated(Column()), Column(), open_faces=("z-", "z+"))
    else:
        sigma = 300 * measured.sigma
        noise = sigma * torch.randn(sigma.shape, generator=torch.Generator().manual_seed(1))
        rows = posterior(replace(measured, displacement=measured.displacement + noise, sigma=sigma), BALLS)
    assert max(row["uncertainty_reduction"] for row in rows) < UNCONSTRAINED
    assert "do not constrain the pose of any view" in refinement_lines(rows)[1]


def test_corrections_of_three_views_are_reported_as_uncertain():
    three = simulated(BALLS, replace(RING, views=3, arc=(0.0, 120.0)))
    assert any(line.startswith("with 3 views the field can") for line in refinement_lines(posterior(three, BALLS)))


def test_a_withheld_view_is_refined_against_the_field(measured):
    view = knocked(measured).select([measured.names[2]])
    (row,) = refit(BALLS, view, {**SETTINGS, "pose_sigma_mm": 2.0})
    assert row["image_shift_px"] > 1.2
    assert error_px(with_corrections(view, [row]), measured, 0) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("method", [Tikhonov, pytest.param(TotalVariation, marks=pytest.mark.slow)])
def test_voxels_refine_a_rig(measured, method):
    wrong = knocked(measured)
    settings = method(voxels=20, refine=("cameras",), pose_sigma_mm=2.0, coarse_to_fine=False, device="cpu")
    rows = settings(wrong).rig
    assert max(rows, key=lambda row: row["image_shift_px"])["name"] == wrong.names[2]
    assert error_px(with_corrections(wrong, rows), measured) < 0.6 * error_px(wrong, measured)


@pytest.mark.slow
def test_a_view_without_displacements_has_no_posterior(measured):
    """As after a refinement with images."""
    rig = Refinement.for_measurement(measured, SETTINGS["refine"], 0.4, 0.02, 0.05)
    rig.values = 0.1 * rig.sigma
    table, rest = rig.table(), measured.without([measured.names[1]])
    rows = RigPosterior.of(table, rest, BALLS, SETTINGS).table
    assert [row["name"] for row in rows] == list(measured.names)
    assert rows.pop(1) == table.pop(1)
    assert rows == RigPosterior.of(table, rest, BALLS, SETTINGS).table


@pytest.mark.slow
def test_a_resumed_refinement_with_voxels_equals_a_complete_one(measured):
    settings = Tikhonov(voxels=12, regularisation=1e-3, iterations=12, refine=("cameras", "shift"), device="cpu")
    whole = settings(measured)
    half = settings(measured, on_step=lambda step: step.step == 37)
    assert half.outcome.reason == "interrupted"
    again = settings(measured, resume=half.state)
    for a, b in zip(whole.rig, again.rig, strict=True):  # except for the directions of conjugate gradients
        assert (
            max(abs(a["values"][name] - b["values"][name]) / sigma for name, sigma in a["prior_sigma"].items()) < 0.05
        )


@pytest.mark.parametrize(
    ("words", "message"), [(["cameras", "--time-limit", "0"], "time-limit: "), (["lens"], "refine: expected some of")]
)
def test_invalid_checks_are_refused(measured, tmp_path, capsys, words, message):
    measured.write(tmp_path / "m.nc")
    assert main(["check", str(tmp_path / "m.nc"), "--refine", *words]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_the_check_in_python_returns_the_table_and_remarks_on_a_poor_fit(measured):
    noise = 0.02 * measured.sigma * torch.randn(measured.sigma.shape, generator=torch.Generator().manual_seed(0))
    exact = replace(measured, displacement=measured.displacement + noise, sigma=measured.sigma / 50)
    check = check_rig(exact, ["shift"], 1.0)
    assert [row["name"] for row in check.table] == list(measured.names)
    assert set(check.table[0]["values"]) == set(NAMES[8:])
    assert any(re.search(r"[\d.]+ sigma after 1 s", remark) for remark in check.remarks)


@pytest.mark.slow
def test_a_result_has_the_posterior_and_the_withheld_view_with_both_cameras(measured, tmp_path):
    knocked(measured).write(tmp_path / "m.nc")
    out, withheld = tmp_path / "r", measured.names[2]
    words = ["reconstruct", str(tmp_path / "m.nc"), "-o", str(out), "--method", "tv", "--voxels", "16"]
    assert main([*words, "--refine", "cameras", "--withhold", withheld, "--device", "cpu"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert all(
        {"uncertainty_reduction", "posterior_sigma", "rms_before", "rms_after"} <= set(row) for row in metrics["rig"]
    )
    (before,) = [view for view in metrics["views"] if view["withheld"]]
    (after,) = metrics["withheld_views"]
    assert after["name"] == withheld
    assert after["rms"] < before["rms"]
    page = (out / "report.html").read_text()
    assert "Corrections of the cameras" in page
    assert f"{withheld}, camera refined" in page
    axes = draw_corrections(Figure().subplots(), metrics["rig"])
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [row["name"] for row in metrics["rig"]]


def test_trials_refine_rigs_of_their_own_which_are_read_again(measured, tmp_path, monkeypatch):
    monkeypatch.setattr("nerif.reconstruction.uncertainty.rig_posterior.VOXELS", 4)
    monkeypatch.setattr("nerif.reconstruction.voxels.descent.ROUNDS", 2)
    monkeypatch.setattr("nerif.reconstruction.uncertainty.bootstrap.VOXELS", 8)
    out, lines, few = ResultDirectory(tmp_path / "r"), [], measured.select(measured.names[::2])
    method = Tikhonov(voxels=8, iterations=2, regularisation=1e-2, refine=("cameras",), device="cpu")
    run = RunSettings(withhold=("none",), uncertainty="fast", report=False)
    for resume in (False, True):
        result = reconstruct_into(out.path, few, method, run, resume=resume, monitor=Monitor(lines.append))
    assert [row["values"] for row in result.rig] == [row["values"] for row in out.rig()]
    values = [[row["values"]["shift_x"] for row in rig] for rig in (out.rig(), *(out.member(i).rig() for i in (1, 2)))]
    assert values[0] != values[1] != values[2]
    first, again = (line for line in lines if line.startswith("uncertainty from 2 trials"))
    assert first == again


@pytest.mark.parametrize("table", [[{"name": "a"}], [{"name": "a", "values": {"lens": 1.0}}], [None]])
def test_invalid_tables_are_refused(measured, table):
    with refused("rig"):
        with_corrections(measured, table)
