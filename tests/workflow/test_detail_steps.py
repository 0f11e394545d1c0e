"""Detail in the pipeline: when it is added, what is written, and how a run with it is resumed."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from nerif.cli.cli import main
from nerif.fields.sum import SumField
from nerif.fields.turbulence import TurbulentPlume
from nerif.geometry import Box, Ring
from nerif.reconstruction.detail.detail import DetailChoice
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import simulate
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings
from nerif.workflow.steps import MOST_BLURRED, MOST_DETAIL, detail_share
from refusals import refused

BOX = Box.around_origin((40.0, 36.0, 30.0))
METHOD = TotalVariation(voxels=16, device="cpu", regularisation=1e-3, iterations=20)


@pytest.fixture(scope="module")
def truth():
    return TurbulentPlume(BOX, seed=11, shortest=0.08)


@pytest.fixture(scope="module")
def turbulence(truth):
    """Six views of a turbulent plume."""
    ring = Ring(views=6, arc=(0.0, 150.0), image_size=(30, 30), pixel_pitch=0.13)
    return simulate(truth, ring.cameras(), BOX, 1.00027, 0.05, seed=2, steps=20)


@pytest.fixture(scope="module")
def made(turbulence, tmp_path_factory):
    """A result with detail and deviations, and what was said."""
    out, lines = ResultDirectory(tmp_path_factory.mktemp("detail") / "r"), list[str]()
    run = RunSettings(report=False, uncertainty="fast")
    result = reconstruct_into(out.path, turbulence, METHOD, run, monitor=Monitor(say=lines.append))
    return out, result, lines


def test_detail_is_added_where_it_predicts_the_withheld_view(made, truth):
    out, result, lines = made
    detail = out.metrics().detail
    assert detail["withheld_after"] < detail["withheld_before"]
    assert detail["residual_after"] < 0.6 * detail["residual_before"]
    assert detail["iterations"] > 0
    assert any("withheld view" in line and "sigma" in line for line in lines)
    field = out.field()[0]
    assert isinstance(field, SumField)
    points = torch.rand(4000, 3) * 20 - 10
    torch.testing.assert_close(field(points), result.field(points), rtol=1e-5, atol=1e-12)
    grid = out.volumes()["index_excess"].grid
    without, whole = (f.sample(grid) - truth.sample(grid) for f in (field.parts[0], field))
    assert float(whole.norm()) < 0.9 * float(without.norm())


def test_views_are_predicted_with_the_detail(made):
    metrics = made[0].metrics()
    residuals = [view["rms_over_sigma"] for view in metrics.views]
    rms = (sum(r**2 for r in residuals) / len(residuals)) ** 0.5
    assert rms == pytest.approx(metrics.detail["residual_after"], rel=0.1)


def test_deviations_are_drawn_from_the_posterior(made, truth):
    out = made[0]
    uncertainty, volumes = out.metrics().uncertainty, out.volumes()
    assert (uncertainty["source"], uncertainty["trials"]) == ("posterior", 2)
    assert not (out / "trials").exists()
    std, field = volumes["index_excess_std"], volumes["index_excess"]
    error = field.values - truth.sample(field.grid)
    assert 0.3 < float(std.values.norm() / error.norm()) < 3
    assert float(volumes["density_std"].values.nan_to_num().max()) > 0


def test_a_run_that_is_resumed_has_the_same_detail(made, turbulence, tmp_path):
    path, calls = tmp_path / "r", []

    def stop(step):
        calls.append(step)
        return len(calls) == 3

    stopped = reconstruct_into(path, turbulence, METHOD, RunSettings(report=False), on_step=stop)
    assert stopped.outcome.reason == "interrupted"
    resumed = reconstruct_into(path, turbulence, METHOD, RunSettings(report=False), resume=True)
    points = torch.rand(4000, 3) * 20 - 10
    expected = made[1].field(points)  # total variation has other weights after an interruption
    assert float((resumed.field(points) - expected).norm()) < 0.05 * float(expected.norm())
    assert ResultDirectory(path).metrics().detail is not None


def test_an_interruption_loses_nothing_of_the_fit(turbulence, tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    run, out = RunSettings(report=False, withhold=("none",), detail="on"), ResultDirectory(tmp_path / "r")
    with monkeypatch.context() as patch:
        patch.setattr(DetailChoice, "solve", interrupt)
        with pytest.raises((KeyboardInterrupt, SystemExit)):
            reconstruct_into(out.path, turbulence, METHOD, run)
    points = torch.rand(4000, 3) * 20 - 10
    before = out.field()[0](points)
    result = reconstruct_into(out.path, turbulence, METHOD, run, resume=True)
    torch.testing.assert_close(result.field.parts[0](points), before)


@pytest.mark.parametrize(
    ("settings", "added"),
    [
        (RunSettings(report=False, detail="off"), False),
        (RunSettings(report=False, withhold=("none",)), False),
        (RunSettings(report=False, withhold=("none",), detail="on"), True),
    ],
)
def test_when_it_is_added(turbulence, tmp_path, settings, added):
    result = reconstruct_into(tmp_path / "r", turbulence, METHOD, settings)
    assert isinstance(result.field, SumField) is added
    assert (ResultDirectory(tmp_path / "r").metrics().detail is not None) is added


def test_without_sigma_it_is_left_out_or_refused(turbulence, tmp_path):
    bare = turbulence.observed({}, {})
    result = reconstruct_into(tmp_path / "r", bare, METHOD, RunSettings(report=False))
    assert not isinstance(result.field, SumField)
    with refused("measurement"):
        reconstruct_into(tmp_path / "q", bare, METHOD, RunSettings(report=False, detail="on"))
    assert not (tmp_path / "q").exists()


def test_the_commands_take_a_result_with_detail(made, turbulence, tmp_path):
    out, path = str(made[0].path), tmp_path / "m.nc"
    turbulence.write(path)
    assert main(["info", out]) == 0
    assert main(["project", out, "-o", str(tmp_path / "p.nc"), "--cameras", str(path)]) == 0
    assert main(["export", out, "-o", str(tmp_path / "v.npz")]) == 0
    assert main(["report", out]) == 0
    again = str(tmp_path / "again")
    words = ["reconstruct", str(path), "-o", again, "--method", "gp", "--voxels", "12", "--no-report"]
    assert main([*words, "--start-from", out]) == 0
    assert ResultDirectory(again).settings()["method"] == "gp"


@pytest.mark.parametrize(
    ("rms", "blurred", "most"), [(0.5, True, MOST_BLURRED), (0.7, True, MOST_DETAIL), (0.5, False, MOST_DETAIL)]
)
def test_training_comes_first_after_a_first_run_that_explains_little(rms, blurred, most):
    scores = {"fitted_views": [{"rms": rms, "rms_measured": 1.0}]}
    job = SimpleNamespace(validation=SimpleNamespace(scores=lambda: scores))
    assert detail_share(job, DetailChoice(blurred=blurred)) == most
