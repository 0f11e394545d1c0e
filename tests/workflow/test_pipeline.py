"""What nerif reconstruct does, as a Python call; and what the result directory keeps of it, in which order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from nerif.analysis.prediction import predict, reproject
from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.common.written_files import WRITTEN
from nerif.reconstruction.base import Reconstruction
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.report.rig_figure import image_corners
from nerif.results.directory import CALIBRATION, FILES, MERIDIAN, REPORT, ResultDirectory
from nerif.workflow import pipeline as workflow
from nerif.workflow.pipeline import Run, reconstruct_into
from refusals import refused

QUICK = Tikhonov(voxels=8, basis="linear", iterations=4, regularisation=0.1, device="cpu")


@pytest.fixture(scope="module")
def made(measurement, tmp_path_factory: pytest.TempPathFactory) -> tuple[ResultDirectory, Reconstruction]:
    """A result of a measurement that is in memory only."""
    out = ResultDirectory(tmp_path_factory.mktemp("workflow") / "r")
    run = Run(withhold=("144deg",), report=False)
    return out, reconstruct_into(out.path, measurement, replace(QUICK, model="paraxial"), run)


def test_python_writes_the_whole_directory(made, measurement, capsys):
    out, result = made
    assert capsys.readouterr().out == ""
    assert {p.name for p in out.path.iterdir()} == {WRITTEN, *FILES} - {REPORT, CALIBRATION, *MERIDIAN}
    found = out.read()
    assert not found.missing
    assert [v["name"] for v in found.metrics["views"] if v["withheld"]] == ["144deg"]
    assert [r["error_px"] for r in found.metrics["reprojection"]] == [0]
    assert found.settings["method"] == "tikhonov"
    assert found.settings["voxels"] == 8
    field, box, n_ambient = out.field()
    assert (box, n_ambient) == (measurement.box, measurement.n_ambient)
    points = torch.rand(20, 3)
    torch.testing.assert_close(field(points), result.field(points))
    with pytest.raises(InputError, match="exists already"):
        reconstruct_into(out.path, measurement, QUICK)


def test_run_toml_of_python_is_one_of_the_command_line(made, measurement, tmp_path):
    measurement.write(tmp_path / "m.nc")
    again = ResultDirectory(tmp_path / "r")
    words = ["reconstruct", str(tmp_path / "m.nc"), "-o", str(again.path), "--config", str(made[0] / "run.toml")]
    assert main([*words, "--no-report"]) == 0
    points = torch.rand(20, 3)
    assert torch.equal(again.field()[0](points), made[0].field()[0](points))
    assert again.settings()["model"] == "paraxial"


def test_what_was_computed_is_on_disk_before_it_is_looked_at(measurement, tmp_path, monkeypatch):
    """Field, volumes and metrics do not wait for the re-projection, which takes its time."""

    def broken_off(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(workflow, "reproject", broken_off)
    out = ResultDirectory(tmp_path / "r")
    with pytest.raises(KeyboardInterrupt):
        reconstruct_into(out.path, measurement, QUICK)
    assert all(out.has(name) for name in ("field.safetensors", "volume.nc", "volume.vti", "history.csv"))
    assert out.metrics()["outcome"]
    assert "views" not in out.metrics()


def test_the_monitor_hears_lines_and_counts(measurement, tmp_path):
    from contextlib import nullcontext

    said: list[str] = []
    counts: list[tuple[int, int]] = []
    monitor = Monitor(said.append, counting=lambda title: nullcontext(lambda done, total: counts.append((done, total))))
    reconstruct_into(tmp_path / "r", measurement, QUICK, Run(report=False), monitor=monitor)
    assert counts == [(i, 5) for i in range(1, 6)]
    assert any("5 training views" in line for line in said)


def test_corners_that_a_distortion_folds_back_are_left_out_with_a_word(measurement, tmp_path):
    camera = measurement.cameras[0]
    corner = float((torch.tensor(camera.image_size) / 2 / camera.intrinsics.diagonal()[:2]).norm())
    folded = torch.tensor([-1 / (3 * (1.35 * corner) ** 2), 0, 0, 0, 0], dtype=torch.float64)  # at 0.9 of the way to it
    distorted = replace(camera, distortion=folded)
    whole = replace(measurement, cameras=(distorted, *measurement.cameras[1:]))
    assert 0 < distorted.unseen < 0.1
    assert bool(whole.rays()[0].direction.isfinite().all())
    assert not bool(whole.sees_box[0, 0, 0])
    corners, straight = (image_corners(c, np.zeros(3)) for c in (distorted, camera))
    assert np.allclose(corners.end, straight.end)
    said: list[str] = []
    run = Run(report=False, withhold=("144deg",))
    reconstruct_into(tmp_path / "r", whole, QUICK, run, monitor=Monitor(said.append))
    share = f"view '{camera.name}': {distorted.unseen:.1%} of its pixels left out, for which its distortion"
    assert sum(line.startswith(share) for line in said) == 1
    most = replace(camera, distortion=16 * folded)
    with refused("distortion of view '0deg'"):
        replace(measurement, cameras=(most, *measurement.cameras[1:]))


def test_projecting_takes_the_model_of_the_run(made, measurement, tmp_path):
    out, path = made[0], tmp_path / "p.nc"
    measurement.write(tmp_path / "m.nc")
    words = ["project", str(out.path), "-o", str(path), "--cameras", str(tmp_path / "m.nc"), "--names", "72deg"]
    from nerif.data.measurement import Measurement

    seen = {}
    for chosen in ("", "paraxial", "lever_arm"):
        assert main([*words, "--force", *(["--model", chosen] if chosen else [])]) == 0
        seen[chosen] = Measurement.read(path).displacement
    assert torch.equal(seen[""], seen["paraxial"])
    assert not torch.allclose(seen[""], seen["lever_arm"], rtol=1e-3)


def test_a_prediction_in_python_is_that_of_the_verb(made, measurement):
    field, box, n_ambient = made[0].field()
    predicted = predict(field, measurement.cameras, box, n_ambient, "paraxial")
    views = reproject(field, measurement, model="paraxial").predicted
    torch.testing.assert_close(predicted.displacement, views, atol=1e-4, rtol=1e-3)
    with refused("model"):
        predict(field, measurement.cameras, box, n_ambient, "straight")
