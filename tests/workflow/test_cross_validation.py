"""A view is kept out first by default: what is told of it, and that nothing is lost where it is broken off."""

from __future__ import annotations

import json
import os
import signal
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch

from nerif.cli.cli import main
from nerif.fields.network import NetworkShape
from nerif.reconstruction.base import Step
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.uncertainty.bootstrap import best_covered
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.report.summary import accuracy_rows, statements
from nerif.results.directory import ResultDirectory
from nerif.workflow.cross_validation import FEWEST, kept_out
from nerif.workflow.pipeline import Run, reconstruct_into

VOXELS = Tikhonov(voxels=16, basis="linear", iterations=8, regularisation=0.1, device="cpu")
SHAPE = NetworkShape(depth=2, width=24, octaves=2)
NETWORK = NeRIF(network=SHAPE, max_steps=60, points_per_batch=600, precision="float32", device="cpu")
SILENT = Run(report=False)


@pytest.fixture(scope="module")
def whole(measurement, tmp_path_factory: pytest.TempPathFactory) -> ResultDirectory:
    """The result of a run that nothing has disturbed."""
    out = ResultDirectory(tmp_path_factory.mktemp("whole") / "r")
    reconstruct_into(out.path, measurement, NETWORK, SILENT)
    return out


@pytest.mark.parametrize("method", [VOXELS, NETWORK], ids=["voxels", "network"])
def test_one_view_is_predicted_before_it_is_used(measurement, tmp_path, method):
    out = ResultDirectory(tmp_path / "r")
    said: list[str] = []
    reconstruct_into(out.path, measurement, method, SILENT, monitor=Monitor(said.append))
    result = out.read()
    name = best_covered(measurement.cameras)[0]
    (unseen,) = result.metrics["cross_validation"]["views"]
    assert (unseen["name"], unseen["withheld"]) == (name, True)
    assert any(line.startswith(f"{name}, not seen so far") for line in said)
    seen = {v["name"]: v for v in result.metrics["views"]}
    assert set(seen) == set(measurement.names)
    assert not any(v["withheld"] for v in seen.values())
    assert seen[name]["rms"] < unseen["rms"]
    figures = dict(accuracy_rows(result))
    assert {f"View {name}, withheld from the first run", f"View {name}, after the whole run"} <= set(figures)
    assert any("Cross-validation: a short run" in s.text for s in statements(result))
    assert result.settings["withhold"] == ["auto"]


def test_the_short_run_has_not_seen_the_view(measurement, tmp_path):
    """What is measured there may be anything."""
    name = best_covered(measurement.cameras)[0]
    own = torch.tensor([n == name for n in measurement.names])[:, None, None, None]
    other = replace(measurement, displacement=torch.where(own, -measurement.displacement, measurement.displacement))
    scores = []
    for number, data in enumerate((measurement, other)):
        reconstruct_into(tmp_path / str(number), data, VOXELS, SILENT)
        scores.append(ResultDirectory(tmp_path / str(number)).metrics()["cross_validation"]["views"][0]["cc"])
    assert scores[0] == pytest.approx(-scores[1], abs=1e-6)


@pytest.mark.parametrize(
    "asked",
    [{"withhold": ("none",)}, {"withhold": ("72deg",)}],
    ids=["none", "named"],
)
def test_none_is_kept_out_first_where_that_is_asked_or_told_otherwise(measurement, tmp_path, asked):
    out = ResultDirectory(tmp_path / "r")
    reconstruct_into(out.path, measurement, VOXELS, replace(SILENT, **asked))
    assert "cross_validation" not in out.metrics()
    assert not out.cross_validation.path.exists()
    withheld = [v["name"] for v in out.metrics()["views"] if v["withheld"]]
    assert withheld == [name for name in asked.get("withhold", ()) if name != "none"]


def test_of_three_views_none_can_be_spared(measurement, tmp_path):
    out = ResultDirectory(tmp_path / "r")
    reconstruct_into(out.path, measurement.select(measurement.names[: FEWEST - 1]), VOXELS, SILENT)
    assert "cross_validation" not in out.metrics()


def test_from_another_result_none_is_kept_out(measurement, tmp_path):
    """That one has seen them all."""
    reconstruct_into(tmp_path / "a", measurement, VOXELS, SILENT)
    reconstruct_into(tmp_path / "b", measurement, VOXELS, replace(SILENT, start_from=tmp_path / "a"))
    assert "cross_validation" not in ResultDirectory(tmp_path / "b").metrics()


def test_views_may_be_called_none():
    assert kept_out(("none",), ("a", "none")) == ("none",)
    assert kept_out(("none",), ("a", "b")) == ()
    assert kept_out(("auto",), ("a", "b")) == ()
    assert kept_out(("a",), ("a", "b")) == ("a",)


@pytest.mark.slow
def test_interrupted_in_the_short_run(measurement, whole, tmp_path):
    """What it has found is there to look at, its view marked as not seen; --resume ends as if nothing had been."""
    broken = ResultDirectory(tmp_path / "broken")

    def told(title: str):
        def update(step: Step) -> bool:
            return "first" in title and step.step == 5

        return nullcontext(update)

    first = reconstruct_into(broken.path, measurement, NETWORK, SILENT, monitor=Monitor(training=told))
    assert first.outcome.reason == "interrupted"
    name = best_covered(measurement.cameras)[0]
    assert [v["name"] for v in broken.metrics()["views"] if v["withheld"]] == [name]
    reconstruct_into(broken.path, measurement, NETWORK, SILENT, resume=True)
    points = torch.rand(20, 3)
    assert torch.equal(broken.field()[0](points), whole.field()[0](points))
    assert broken.metrics()["cross_validation"]["views"] == whole.metrics()["cross_validation"]["views"]
    assert not any(v["withheld"] for v in broken.metrics()["views"])


@pytest.mark.slow
def test_interrupted_after_the_short_run(measurement, whole, tmp_path):
    broken = ResultDirectory(tmp_path / "broken")
    stopped = reconstruct_into(broken.path, measurement, NETWORK, SILENT, on_step=lambda step: step.step == 30)
    assert stopped.outcome.reason == "interrupted"
    scores = broken.metrics()["cross_validation"]
    reconstruct_into(broken.path, measurement, NETWORK, SILENT, resume=True)
    points = torch.rand(20, 3)
    assert torch.equal(broken.field()[0](points), whole.field()[0](points))
    assert broken.metrics()["cross_validation"] == scores


def test_the_command_line_goes_on_with_the_short_run(measurement, tmp_path, capsys, monkeypatch):
    from nerif.cli.commands import output

    measurement.write(tmp_path / "m.nc")
    plain, sent = output.progress_bar, []

    def interrupting(title):
        if "first" not in title or sent:
            return plain(title)

        def update(step: Step) -> None:
            if not sent:
                sent.append(title)
                os.kill(os.getpid(), signal.SIGINT)

        return nullcontext(update)

    monkeypatch.setattr(output, "progress_bar", interrupting)
    words = ["--method", "tikhonov", "--voxels", "12", "--basis", "linear", "--no-report"]
    out = tmp_path / "r"
    assert main(["reconstruct", str(tmp_path / "m.nc"), "-o", str(out), *words]) == 0
    assert sent
    assert main(["reconstruct", "--resume", "-o", str(out), "--no-report"]) == 0
    found = json.loads((out / "metrics.json").read_text())
    assert found["cross_validation"]["views"][0]["name"] == best_covered(measurement.cameras)[0]
    assert "Traceback" not in capsys.readouterr().err
