"""nerif reconstruct as a Python call: the result directory, the order of its files, and what is reported."""

from __future__ import annotations

import errno
import os
import re
import time
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerif.analysis.prediction import predict, reproject
from nerif.cli.cli import main
from nerif.common.files import atomic
from nerif.common.written_files import WRITTEN
from nerif.data.measurement import Measurement
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.reconstructor import Reconstruction
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.report.rig_figure import image_corners
from nerif.results.directory import CALIBRATION, FILES, MERIDIAN, REPORT, ResultDirectory
from nerif.workflow import steps
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings
from refusals import refused

QUICK = Tikhonov(voxels=8, basis="linear", iterations=4, regularisation=0.1, device="cpu")
RUN = RunSettings(withhold=("144deg",), report=False)


@pytest.fixture(scope="module")
def made(measurement, tmp_path_factory: pytest.TempPathFactory) -> tuple[ResultDirectory, Reconstruction]:
    """A result of a measurement in memory."""
    out = ResultDirectory(tmp_path_factory.mktemp("workflow") / "r")
    return out, reconstruct_into(out.path, measurement, replace(QUICK, model="paraxial"), RUN)


def test_the_directory_is_complete_and_kept(made, measurement, capsys):
    out, result = made
    assert capsys.readouterr().out == ""
    assert {p.name for p in out.path.iterdir()} == {WRITTEN, *FILES} - {REPORT, CALIBRATION, *MERIDIAN}
    content = out.read()
    assert not content.missing
    assert [v["name"] for v in content.metrics.views if v["withheld"]] == ["144deg"]
    assert [r["error"] for r in content.metrics.reprojection] == [0]
    assert (content.settings["method"], content.settings["voxels"]) == ("tikhonov", 8)
    field, box, n_ambient = out.field()
    assert (box, n_ambient) == (measurement.box, measurement.n_ambient)
    points = torch.rand(20, 3)
    torch.testing.assert_close(field(points), result.field(points))
    with refused(out.path):
        reconstruct_into(out.path, measurement, QUICK)


@pytest.mark.parametrize("n_ambient", [1.333, 0.9997])
def test_water_and_plasma_have_an_index_only(measurement, tmp_path, n_ambient):
    lines: list[str] = []
    reconstruct_into(tmp_path, replace(measurement, n_ambient=n_ambient), QUICK, RUN, monitor=Monitor(say=lines.append))
    assert sum("density and temperature: not computed: the ambient index" in line for line in lines) == 1
    assert set(ResultDirectory(tmp_path).read().volumes) == {"index_excess", "n"}
    assert main(["export", str(tmp_path), "-o", str(tmp_path / "f.vti"), "--voxels", "8"]) == 0
    assert main(["export", str(tmp_path), "-o", str(tmp_path / "g.vti"), "--quantities", "density"]) == 2


@pytest.mark.skipif(os.name == "nt", reason="modes of POSIX")
def test_others_may_read_the_files_as_any_new_file(made, tmp_path):
    (tmp_path / "new").touch()
    modes = {path.name: path.stat().st_mode for path in made[0].path.iterdir()}
    assert modes == dict.fromkeys(modes, (tmp_path / "new").stat().st_mode)


def test_project_takes_the_model_of_a_result(made, measurement, tmp_path):
    out, path, predicted = made[0], str(tmp_path / "m.nc"), tmp_path / "p.nc"
    measurement.write(path)
    words = ["project", str(out.path), "-o", str(predicted), "--cameras", path, "--names", "72deg", "--force"]
    displacement = {}
    for model in ("", "paraxial", "lever_arm"):
        assert main([*words, *(["--model", model] if model else [])]) == 0
        displacement[model] = Measurement.read(predicted).displacement
    assert torch.equal(displacement[""], displacement["paraxial"])
    assert not torch.allclose(displacement[""], displacement["lever_arm"], rtol=1e-3)


def test_field_and_volumes_are_written_before_the_reprojection(measurement, tmp_path, monkeypatch):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(steps, "reproject", interrupt)
    out = ResultDirectory(tmp_path / "r")
    with pytest.raises(KeyboardInterrupt):
        reconstruct_into(out.path, measurement, QUICK)
    assert all(out.has(name) for name in ("field.safetensors", "volume.nc", "volume.vti", "history.csv"))
    assert out.metrics().outcome
    assert not out.metrics().views


def test_a_second_run_into_the_directory_is_refused_and_leaves_the_first_alone(measurement, tmp_path, capsys):
    measurement.write(tmp_path / "m.nc")
    out, answers = tmp_path / "r", []

    def begin_another(step):
        if step.step == 2:
            line = ["reconstruct", str(tmp_path / "m.nc"), "--out", str(out), "--force", "--seed", "7"]
            answers.append((main(line), capsys.readouterr().err))

    reconstruct_into(out, measurement, QUICK, RUN, on_step=begin_another, force=True)
    [(code, error)] = answers
    assert code == 2
    assert f"another run writes to it (process {os.getpid()} on " in error
    result = ResultDirectory(out).read()
    assert not result.missing
    assert result.settings["method"] == "tikhonov"
    assert not list(out.glob(".*"))


@pytest.mark.parametrize("resume", [False, True])
def test_the_time_of_the_fit_and_of_the_whole_are_printed_at_the_end(measurement, tmp_path, resume):
    lines: list[str] = []
    out, since = tmp_path / "r", time.time() - 500
    if resume:
        reconstruct_into(out, measurement, QUICK, RUN)
    result = reconstruct_into(out, measurement, QUICK, RUN, resume=resume, monitor=Monitor(lines.append), since=since)
    times = r"(\d+) s for the fit on cpu, (\d+) s (.*)"
    match = re.fullmatch(f"{out}: {times}; open {out / 'volume.vti'} in ParaView", lines[-1])
    assert match is not None
    assert int(match[1]) == round(result.seconds)
    assert int(match[2]) >= 500
    assert match[3] == ("since it was resumed" if resume else "in all")


def test_a_report_that_fails_does_not_end_a_run(measurement, tmp_path, monkeypatch):
    lines, monitor = [], replace(Monitor(), say=lambda line: lines.append(line))
    monkeypatch.setattr("nerif.report.html.render", lambda result: 1 / 0)
    reconstruct_into(tmp_path / "r", measurement, QUICK, replace(RUN, report=True), monitor=monitor)
    assert any(line.startswith("report: not written (ZeroDivisionError") for line in lines)
    assert not ResultDirectory(tmp_path / "r").has(REPORT)


def test_a_full_disk_names_the_file_and_how_to_continue(measurement, tmp_path, monkeypatch):
    def full(self, reprojection):
        with atomic(self / "reprojection.nc") as part:
            raise OSError(errno.ENOSPC, "no space", str(part))

    monkeypatch.setattr(ResultDirectory, "write_reprojection", full)
    with pytest.raises(OSError) as error:
        reconstruct_into(tmp_path / "r", measurement, QUICK, RUN)
    assert error.value.filename == str(tmp_path / "r" / "reprojection.nc")
    assert f"nerif reconstruct --resume --out {tmp_path / 'r'}" in error.value.strerror


def test_corners_beyond_the_distortion_are_left_out_and_reported(measurement, tmp_path):
    camera = measurement.cameras[0]
    corner = float((torch.tensor(camera.image_size) / 2 / camera.intrinsics.diagonal()[:2]).norm())
    folding = torch.tensor([-1 / (3 * (1.35 * corner) ** 2), 0, 0, 0, 0], dtype=torch.float64)
    distorted = replace(camera, distortion=folding)
    whole = replace(measurement, cameras=(distorted, *measurement.cameras[1:]))
    assert 0 < distorted.unseen < 0.1
    assert bool(whole.rays()[0].direction.isfinite().all())
    assert not bool(whole.sees_box[0, 0, 0])
    assert np.allclose(*(image_corners(c, np.zeros(3)).end for c in (distorted, camera)))
    lines, counts = [], []
    counting = nullcontext(lambda done, total: counts.append((done, total)))
    reconstruct_into(tmp_path / "r", whole, QUICK, RUN, monitor=Monitor(lines.append, counting=lambda title: counting))
    assert sum(line.startswith(f"view '{camera.name}': {distorted.unseen:.1%} of the pixels") for line in lines) == 1
    assert any("4 fitted views" in line for line in lines)
    assert counts == [(i, 5) for i in range(1, 6)]
    most = replace(camera, distortion=16 * folding)
    with refused("distortion of view '0deg'"):
        replace(measurement, cameras=(most, *measurement.cameras[1:]))


def test_a_prediction_in_python_is_that_of_the_command(made, measurement):
    field, box, n_ambient = made[0].field()
    predicted = predict(field, measurement.cameras, box, n_ambient, "paraxial")
    views = reproject(field, measurement, model="paraxial").predicted
    torch.testing.assert_close(predicted.displacement, views, atol=1e-4, rtol=1e-3)
    with refused("model"):
        predict(field, measurement.cameras, box, n_ambient, "straight")
