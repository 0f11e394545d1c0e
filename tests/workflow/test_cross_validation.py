"""Cross-validation on a withheld view: its scores, when it is skipped, and resuming after an interruption."""

from __future__ import annotations

import json
import signal
from contextlib import nullcontext
from dataclasses import asdict, replace

import pytest
import torch

from nerif.analysis.evaluation import evaluate_views
from nerif.analysis.prediction import reproject
from nerif.cli.cli import main
from nerif.fields.network_shape import NetworkShape
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Grid
from nerif.geometry.pose import GEOMETRY, Corrections
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.reconstructor import Outcome, Reconstruction, Step
from nerif.reconstruction.uncertainty.bootstrap import best_covered
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.report.summary import accuracy_rows, statements
from nerif.results.directory import ResultDirectory
from nerif.workflow.cross_validation import MIN_VIEWS, CrossValidation, withheld_views
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings

VOXELS = Tikhonov(voxels=10, basis="linear", iterations=8, regularisation=0.1, device="cpu")
SHAPE = NetworkShape(depth=2, width=24, octaves=2)
NETWORK = NeRIF(network=SHAPE, max_steps=40, points_per_batch=600, precision="float32", device="cpu")
SILENT = RunSettings(report=False)


@pytest.fixture(scope="module")
def complete(measurement, tmp_path_factory) -> tuple[ResultDirectory, list[str]]:
    """A result of VOXELS, and what was printed."""
    out, lines = ResultDirectory(tmp_path_factory.mktemp("complete") / "r"), []
    reconstruct_into(out.path, measurement, VOXELS, SILENT, monitor=Monitor(lines.append))
    return out, lines


@pytest.mark.parametrize("method", [VOXELS, NETWORK], ids=["voxels", "network"])
def test_a_view_is_predicted_before_it_is_used(measurement, complete, tmp_path, method):
    out, lines = complete if method is VOXELS else (ResultDirectory(tmp_path / "r"), [])
    if method is NETWORK:
        reconstruct_into(out.path, measurement, method, SILENT, voxels=10, monitor=Monitor(lines.append))
    result, name = out.read(), best_covered(measurement.cameras)[0]
    (score,) = result.metrics.cross_validation["views"]
    assert (score["name"], score["withheld"]) == (name, True)
    assert any(line.startswith(f"cross-validation: withheld view {name} predicted") for line in lines)
    views = {v["name"]: v for v in result.metrics.views}
    assert set(views) == set(measurement.names)
    assert not any(v["withheld"] for v in views.values())
    assert views[name]["rms"] < score["rms"]
    figures = dict(accuracy_rows(result))
    assert f"View {name}, withheld from the cross-validation run" in figures
    assert f"View {name}, fitted by the main run" in figures
    assert any("The cross-validation run, without view" in s.text for s in statements(result))
    assert result.settings["withhold"] == ["auto"]


def test_the_field_of_the_short_run_is_seen_by_the_cameras_that_it_refined(measurement, ball, tmp_path):
    """And the withheld view by a camera that is refined against the field."""
    shifts = torch.zeros(len(measurement.cameras), len(GEOMETRY), dtype=torch.float64)
    shifts[:, 3:5] = torch.randn(len(shifts), 2, generator=torch.Generator().manual_seed(0))
    knocked = replace(measurement, cameras=Corrections(measurement.cameras, -shifts).corrected)
    method = replace(VOXELS, refine=("cameras",), pose_sigma_mm=1.0)
    validation = CrossValidation(ResultDirectory(tmp_path), method, knocked)
    assert validation.fit is None
    rows = [dict(zip(GEOMETRY, row, strict=True)) for row in shifts.tolist()]
    rig = [{"name": n, "values": row} for n, row in zip(knocked.names, rows, strict=True) if n != validation.view]
    grid = Grid.of_resolution(measurement.box, 18)
    field = VoxelField.through(ball.sample(grid), grid)
    out, outcome = ResultDirectory(tmp_path).cross_validation, Outcome("converged", "")
    out.path.mkdir()
    out.write_field(Reconstruction(field, measurement.box, measurement.n_ambient, [], outcome, asdict(method), rig=rig))
    fit = validation.fit
    for data in (fit.training, fit.withheld):
        calibrated, refined = (evaluate_views(reproject(fit.field, m)) for m in (knocked.select(data.names), data))
        for before, after in zip(calibrated, refined, strict=True):
            assert after["rms_over_sigma"] < 2 < 0.2 * before["rms_over_sigma"]


def test_the_short_run_does_not_depend_on_the_withheld_view(measurement, complete, tmp_path):
    name = best_covered(measurement.cameras)[0]
    view = torch.tensor([n == name for n in measurement.names])[:, None, None, None]
    other = replace(measurement, displacement=torch.where(view, -measurement.displacement, measurement.displacement))
    reconstruct_into(tmp_path / "r", other, VOXELS, SILENT)
    results = complete[0], ResultDirectory(tmp_path / "r")
    scores = [result.metrics().cross_validation["views"][0]["cc"] for result in results]
    assert scores[0] == pytest.approx(-scores[1], abs=1e-6)


@pytest.mark.parametrize("reason", ["none", "72deg", "few views", "start"])
def test_skipped(measurement, complete, tmp_path, reason):
    run, withhold = SILENT, [] if reason != "72deg" else [reason]
    if reason in ("none", "72deg"):
        run = replace(run, withhold=(reason,))
    elif reason == "few views":
        measurement = measurement.select(measurement.names[: MIN_VIEWS - 1])
    else:  # an initial field that depends on all views
        run = replace(run, start_from=complete[0].path)
    out = ResultDirectory(tmp_path / "r")
    reconstruct_into(out.path, measurement, VOXELS, run)
    assert out.metrics().cross_validation is None
    assert not out.cross_validation.path.exists()
    assert [v["name"] for v in out.metrics().views if v["withheld"]] == withhold


def test_views_may_have_the_names_of_options():
    assert withheld_views(("none",), ("a", "none")) == ("none",)
    assert withheld_views(("none",), ("a", "b")) == withheld_views(("auto",), ("a", "b")) == ()
    assert withheld_views(("a",), ("a", "b")) == ("a",)


@pytest.mark.slow
@pytest.mark.parametrize("in_short_run", [True, False])
def test_an_interrupted_run_resumes_to_the_same_result(measurement, tmp_path, in_short_run):
    complete, out = ResultDirectory(tmp_path / "complete"), ResultDirectory(tmp_path / "interrupted")
    reconstruct_into(complete.path, measurement, NETWORK, SILENT, voxels=10)
    short = Monitor(training=lambda title: nullcontext(lambda step: "without" in title and step.step == 5))
    stop = {"monitor": short} if in_short_run else {"on_step": lambda step: step.step == 20}
    first = reconstruct_into(out.path, measurement, NETWORK, SILENT, **stop)
    assert first.outcome.reason == "interrupted"
    withheld = [v["name"] for v in out.metrics().views if v["withheld"]]
    assert withheld == ([best_covered(measurement.cameras)[0]] if in_short_run else [])
    scores = out.metrics().cross_validation
    reconstruct_into(out.path, measurement, NETWORK, SILENT, resume=True)
    points = torch.rand(20, 3)
    assert torch.equal(out.field()[0](points), complete.field()[0](points))
    assert in_short_run or out.metrics().cross_validation == scores
    assert out.metrics().cross_validation["views"] == complete.metrics().cross_validation["views"]
    assert not any(v["withheld"] for v in out.metrics().views)


def test_the_command_line_resumes_the_short_run(measurement, tmp_path, capsys, monkeypatch):
    from nerif.cli import output

    measurement.write(tmp_path / "m.nc")
    progress_bar, signals = output.progress_bar, []

    def interrupting(title):
        if "without" not in title or signals:
            return progress_bar(title)

        def update(step: Step) -> None:
            if not signals:
                signals.append(title)
                signal.raise_signal(signal.SIGINT)

        return nullcontext(update)

    monkeypatch.setattr(output, "progress_bar", interrupting)
    words = ["--method", "tikhonov", "--voxels", "12", "--basis", "linear", "--no-report"]
    out = tmp_path / "r"
    assert main(["reconstruct", str(tmp_path / "m.nc"), "-o", str(out), *words]) == 0
    assert signals
    assert main(["reconstruct", "--resume", "-o", str(out), "--no-report"]) == 0
    views = json.loads((out / "metrics.json").read_text())["cross_validation"]["views"]
    assert views[0]["name"] == best_covered(measurement.cameras)[0]
    assert "Traceback" not in capsys.readouterr().err
