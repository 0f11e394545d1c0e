"""The command line from end to end on a tiny case, and what bad input gets: one clear line, exit code 2."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr

from nerif.analysis.evaluation import evaluate_views
from nerif.analysis.prediction import reproject
from nerif.cli.cli import VERBS, main
from nerif.data.measurement import Measurement
from nerif.data.volume_file import read_volume
from nerif.forward.deflection import MODELS
from nerif.reconstruction.files import read_field

TINY = ["--image-size", "18", "22", "--pixel-pitch", "0.2", "--views", "4", "--steps", "40", "--truth-voxels", "16"]
QUICK = [
    "--network.depth", "2", "--network.width", "24", "--network.octaves", "2", "--network.directions", "3",
    "--max-steps", "40", "--samples", "12", "16", "--sample-jitter", "2", "--points-per-batch", "600",
    "--voxels", "12", "--device", "cpu",
    "--precision", "float32",
]  # fmt: skip


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a simulated measurement and a reconstruction of it."""
    folder = tmp_path_factory.mktemp("cli")
    measurement = str(folder / "m.nc")
    assert main(["simulate", "--phantom", "gaussians", "--noise", "0.05", "-o", measurement, *TINY]) == 0
    assert main(["reconstruct", measurement, "-o", str(folder / "r"), "--withhold", "170deg", *QUICK]) == 0
    return folder


@pytest.fixture
def spoil(work: Path, tmp_path: Path):
    """Write a copy of the measurement with something changed."""

    def change(edit) -> str:
        dataset = xr.load_dataset(work / "m.nc", engine="h5netcdf")
        dataset = edit(dataset) or dataset
        path = tmp_path / "spoilt.nc"
        dataset.to_netcdf(path, engine="h5netcdf")
        return str(path)

    return change


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    """Run, expect exit code 2 and a single line on standard error, and return it."""
    capsys.readouterr()
    assert main(arguments) == 2
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1, captured.err
    assert "Traceback" not in lines[0]
    return lines[0]


def test_result_directory_is_complete(work):
    names = {p.name for p in (work / "r").iterdir()}
    listed = "volume.nc volume.vti field.safetensors run.toml metrics.json history.csv checkpoint.safetensors"
    listed += " reprojection.nc report.html"
    assert names >= set(listed.split())
    assert not [n for n in names if n.endswith(".part")]
    metrics = json.loads((work / "r/metrics.json").read_text())
    assert metrics["outcome"] == "steps"
    assert metrics["device"] == "cpu"
    assert metrics["seconds"] > 0
    assert metrics["peak_memory_bytes"] > 1e6
    assert [v["withheld"] for v in metrics["views"]] == [False, False, False, True]
    assert set(metrics["views"][0]) >= {"name", "withheld", "cc", "ssim", "psnr", "rms_px"}
    volume = xr.load_dataset(work / "r/volume.nc", engine="h5netcdf")
    assert set(volume.data_vars) == {"index_excess", "n", "density", "temperature"}
    assert volume["n"].dtype == np.float64
    np.testing.assert_allclose(volume["n"] - 1.00027, volume["index_excess"], atol=1e-10)
    history = (work / "r/history.csv").read_text().splitlines()
    assert history[0].startswith("step,epoch,seconds")
    assert len(history) > 2


def test_run_toml_repeats_the_run(work, tmp_path):
    settings = tomllib.loads((work / "r/run.toml").read_text())
    assert settings["network"]["width"] == 24
    assert settings["withhold"] == ["170deg"]
    again = tmp_path / "again"
    assert main(["reconstruct", "--config", str(work / "r/run.toml"), "-o", str(again), str(work / "m.nc")]) == 0
    points = torch.rand(20, 3)
    assert torch.equal(read_field(work / "r")[0](points), read_field(again)[0](points))


def test_evaluate(work, capsys):
    result = str(work / "r")
    assert main(["evaluate", result, "--truth", str(work / "m.truth.nc"), "--measurement", str(work / "m.nc")]) == 0
    said = capsys.readouterr().out
    assert "L2" in said
    assert "CC" in said
    metrics = json.loads((work / "r/metrics.json").read_text())
    assert set(metrics) >= {"l2", "l2_variation", "cc", "ssim", "psnr", "slices", "views", "seconds"}
    field, _, n_ambient = read_field(work / "r")
    truth = read_volume(work / "m.truth.nc")
    error = (field.sample(truth.grid) - truth.values).double().norm()
    assert metrics["l2_variation"] == pytest.approx(float(error / truth.values.double().norm()), rel=1e-4)
    assert metrics["l2"] == pytest.approx(float(error / (truth.values.double() + n_ambient - 1).norm()), rel=1e-4)


def test_a_run_that_found_no_field_says_so_in_its_report_and_exits_with_1(work, tmp_path, capsys):
    words = ["reconstruct", str(work / "m.nc"), "-o", str(tmp_path / "r"), *QUICK, "--learning-rate", "1e4"]
    assert main([*words, "--max-steps", "55", "--points-per-batch", "200"]) == 1
    assert "collapsed: no field was found" in capsys.readouterr().out
    metrics = json.loads((tmp_path / "r/metrics.json").read_text())
    assert metrics["outcome"] == "collapsed"
    assert "try a smaller --learning-rate" in metrics["message"]
    assert "taken_back" in (tmp_path / "r/history.csv").read_text().splitlines()[0]
    assert "The field collapsed to the ambient. " in (tmp_path / "r/report.html").read_text()
    assert bool(torch.isfinite(read_volume(tmp_path / "r/volume.nc").values).all())


@pytest.mark.slow
def test_views_are_compared_by_the_model_of_the_reconstruction(work, tmp_path):
    """At the end of reconstruct and by evaluate: one model throughout, and not always the default."""
    out = tmp_path / "r"
    assert main(["reconstruct", str(work / "m.nc"), "-o", str(out), "--model", "paraxial", *QUICK]) == 0
    measurement, field = Measurement.read(work / "m.nc"), read_field(out)[0]
    by_model = {model: evaluate_views(reproject(field, measurement, model=model)) for model in MODELS}
    scores = {model: [v["rms_px"] for v in views] for model, views in by_model.items()}
    assert scores["paraxial"] != pytest.approx(scores["lever_arm"], rel=1e-4)
    for _ in range(2):
        kept = json.loads((out / "metrics.json").read_text())["views"]
        assert [v["rms_px"] for v in kept] == pytest.approx(scores["paraxial"], rel=1e-5)
        assert main(["evaluate", str(out), "--measurement", str(work / "m.nc")]) == 0


def test_project_into_the_same_and_other_cameras(work, tmp_path, capsys):
    out = tmp_path / "p.nc"
    arguments = ["project", str(work / "r"), "-o", str(out), "--cameras", str(work / "m.nc")]
    assert main([*arguments, "--names", "170deg", "--samples", "128"]) == 0
    predicted = Measurement.read(out)
    assert predicted.names == ("170deg",)
    measured = Measurement.read(work / "m.nc")
    residual = (predicted.displacement[0] - measured.displacement[3])[measured.usable[3]]
    assert float(residual.norm()) < 0.95 * float(measured.displacement[3][measured.usable[3]].norm())
    ring = ["--names", "170deg", "--force"]
    assert "cameras" in refused(capsys, ["project", str(work / "r"), "-o", str(out), *ring])
    for model in ("curved", "paraxial"):
        extra = [
            "--extra-angles",
            "33",
            "--image-size",
            "10",
            "12",
            "--pixel-pitch",
            "0.3",
            "--model",
            model,
            "--force",
        ]
        assert main(["project", str(work / "r"), "-o", str(out), "--samples", "30", *extra]) == 0
        assert "33deg" in Measurement.read(out).names


@pytest.mark.parametrize("ending", ["vti", "nc", "csv"])
def test_export(work, tmp_path, ending):
    out = tmp_path / f"x.{ending}"
    part = ["--shape", "3", "4", "5", "--lower", "-9", "-8", "-7", "--upper", "9", "8", "7"]
    quantities = ["--quantities", "index_excess", "density", "temperature"]
    assert main(["export", str(work / "r"), "-o", str(out), *part, *quantities]) == 0
    if ending == "csv":
        table = np.loadtxt(out, delimiter=",", skiprows=1)
        assert table.shape == (60, 6)
        density = table[:, 4]
    else:
        volume = read_volume(out, "density")
        assert volume.grid.shape == (3, 4, 5)
        assert volume.grid.box.upper == pytest.approx((9, 8, 7))
        density = volume.values.numpy()
    assert 0.05 < density.min() < density.max() < 1.6


@pytest.fixture
def nobody() -> Iterator[int]:
    """A pipe that nobody reads."""
    read, write = os.pipe()
    os.close(read)
    yield write
    os.close(write)


SLOWER = [pytest.param(words, marks=pytest.mark.slow) for words in (["info", "m.nc"], ["info", "-h"])]


@pytest.mark.parametrize("words", [["--help"], *SLOWER])
def test_a_reader_that_has_seen_enough_ends_a_command_in_silence(work, nobody, words):
    command = [sys.executable, "-m", "nerif", *words]
    done = subprocess.run(command, stdout=nobody, stderr=subprocess.PIPE, text=True, cwd=work)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.slow
def test_a_reconstruction_goes_on_when_nobody_reads_what_it_says(work, nobody, tmp_path):
    command = [sys.executable, "-m", "nerif", "reconstruct", str(work / "m.nc"), "-o", str(tmp_path / "r"), *QUICK]
    done = subprocess.run(command, stdout=nobody, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "r/report.html").is_file()


def test_info_of_each_kind(work, capsys):
    before = sorted(os.listdir(work))
    for path, word in (
        ("m.nc", "4 views"),
        ("m.truth.nc", "index_excess"),
        ("r", "reconstruction"),
        ("r/volume.vti", "volume"),
    ):
        assert main(["info", str(work / path)]) == 0
        assert word in capsys.readouterr().out
    assert sorted(os.listdir(work)) == before


def test_bring_your_own_volume(work, tmp_path):
    out = tmp_path / "own.nc"
    assert main(["simulate", "--phantom", str(work / "m.truth.nc"), "-o", str(out), *TINY]) == 0
    a, b = Measurement.read(work / "m.nc"), Measurement.read(out)
    assert float((a.displacement - b.displacement).norm() / a.displacement.norm()) < 0.2  # 16 voxels, and 5 % noise


def test_resume_goes_on_and_raises_limits(work, tmp_path):
    out = tmp_path / "r"
    shutil.copytree(work / "r", out)
    before = read_field(out)[0](torch.zeros(1, 3))
    assert main(["reconstruct", "--resume", "-o", str(out), "--max-steps", "60", str(work / "m.nc")]) == 0
    assert json.loads((out / "metrics.json").read_text())["outcome"] == "steps"
    history = (out / "history.csv").read_text().splitlines()
    assert history[-1].startswith("60.0,")
    assert not torch.equal(before, read_field(out)[0](torch.zeros(1, 3)))


def test_ctrl_c_leaves_a_usable_result_to_resume(work, tmp_path):
    out = tmp_path / "r"
    command = [sys.executable, "-m", "nerif", "reconstruct", str(work / "m.nc"), "-o", str(out), "--no-report", *QUICK]
    command[command.index("--max-steps") + 1] = "100000"
    command += ["--checkpoint-every", "0.2", "--withhold", "none"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE)
    deadline = time.monotonic() + 90
    while not (out / "checkpoint.safetensors").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
    process.send_signal(signal.SIGINT)
    said, wrong = process.communicate(timeout=90)
    assert process.returncode == 0, wrong
    assert b"interrupted" in said
    assert b"Traceback" not in wrong
    assert json.loads((out / "metrics.json").read_text())["outcome"] == "interrupted"
    steps = int(float((out / "history.csv").read_text().splitlines()[-1].split(",")[0]))
    assert main(["reconstruct", "--resume", "-o", str(out), "--max-steps", str(steps + 20)]) == 0
    assert json.loads((out / "metrics.json").read_text())["outcome"] == "steps"


def test_tensorboard_scalars(work, tmp_path):
    pytest.importorskip("tensorboard")
    out = tmp_path / "r"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TF_CPP_MIN_LOG_LEVEL", "3")
        assert main(["reconstruct", str(work / "m.nc"), "-o", str(out), "--tensorboard", "--no-report", *QUICK]) == 0
    assert list((out / "tensorboard").glob("events*"))


# -- bad input -------------------------------------------------------------------------------------------------------


def test_nan_and_infinite_pixels_are_masked_and_counted(spoil, tmp_path, capsys):
    def edit(d):
        d["displacement"].values[0, 3, 4:9, 0] = np.nan
        d["displacement"].values[1, 5, 6, 1] = np.inf

    path = spoil(edit)
    assert main(["reconstruct", path, "-o", str(tmp_path / "r"), "--no-report", *QUICK]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "left out" in line]
    assert len(lines) == 1
    assert "6 pixels" in lines[0]


def _rotation(d):
    d["rotation"].values[1] = d["rotation"].values[1][[1, 0, 2]]


def _background(d):
    d["background_offset"].values[2] = 300.0


def _box(d):
    d["box"].values[:] = d["box"].values + 5000.0
    d["background_offset"].values[:] = -1e6


def _pixel_size(d):
    d["intrinsics"].values[0, 0, 0] *= -1


def _view_without_pixels(d):
    d["displacement"].values[2] = np.nan


def _sizes(d):
    return d.drop_vars("rotation").assign(rotation=(("view", "i", "k"), np.zeros((4, 3, 2)), {"units": "1"}))


def _missing(d):
    return d.drop_vars("translation")


def _unit(d):
    d["translation"].attrs["units"] = "m"


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (_rotation, ["rotation", "view '56.6667deg'"]),
        (_background, ["background", "view '113.333deg'"]),
        (_box, ["box"]),
        (_pixel_size, ["intrinsics", "view '0deg'", "positive"]),
        (_view_without_pixels, ["displacement", "view '113.333deg'", "no valid pixel"]),
        (_sizes, ["rotation", "dimensions"]),
        (_missing, ["translation"]),
        (_unit, ["translation", "mm", "'m'"]),
    ],
)
def test_measurement_that_cannot_be_right(spoil, tmp_path, capsys, edit, words):
    path = spoil(edit)
    out = tmp_path / "r"
    line = refused(capsys, ["reconstruct", path, "-o", str(out)])
    for word in [path, *words]:
        assert word in line
    assert not out.exists()


def test_truncated_foreign_and_missing_files(work, tmp_path, capsys):
    whole = (work / "m.nc").read_bytes()
    (tmp_path / "cut.nc").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.nc").write_text("not a NetCDF file")
    for name in ("cut.nc", "text.nc", "absent.nc"):
        for verb in (["info"], ["reconstruct", "-o", str(tmp_path / "r")]):
            assert name in refused(capsys, [*verb, str(tmp_path / name)])
    assert "Conventions" in refused(capsys, ["reconstruct", str(work / "m.truth.nc"), "-o", str(tmp_path / "r")])
    assert not (tmp_path / "r").exists()


def test_damaged_results_name_their_file(work, tmp_path, capsys):
    out = tmp_path / "r"
    shutil.copytree(work / "r", out)
    (out / "metrics.json").write_text("{")
    for arguments in (["info", str(out)], ["evaluate", str(out), "--truth", str(work / "m.truth.nc")]):
        assert "metrics.json" in refused(capsys, arguments)
    weights = out / "field.safetensors"
    weights.write_bytes(weights.read_bytes()[:200])
    assert "field.safetensors" in refused(capsys, ["info", str(out)])
    checkpoint = out / "checkpoint.safetensors"
    checkpoint.write_bytes(checkpoint.read_bytes()[:200])
    assert "checkpoint.safetensors" in refused(capsys, ["reconstruct", "--resume", "-o", str(out)])


def test_nothing_is_overwritten_without_force(work, tmp_path, capsys):
    before = {p: p.stat().st_mtime_ns for p in work.rglob("*") if p.is_file()}
    m, r = str(work / "m.nc"), str(work / "r")
    for arguments in (
        ["simulate", "-o", m, *TINY],
        ["reconstruct", m, "-o", r],
        ["export", r, "-o", r + "/volume.vti"],
        ["project", r, "-o", m],
        ["demo", "-o", r],
    ):
        assert "--force" in refused(capsys, arguments)
    assert {p: p.stat().st_mtime_ns for p in work.rglob("*") if p.is_file()} == before


def test_forced_run_with_bad_input_keeps_what_was_there(work, tmp_path, capsys):
    out = tmp_path / "r"
    shutil.copytree(work / "r", out)
    for bad in (
        ["--withhold", "nobody"],
        ["--gas.composition", "phlogiston"],
        ["--device", "cuda:9"],
        ["--epochs", "-1"],
    ):
        refused(capsys, ["reconstruct", str(work / "m.nc"), "-o", str(out), "--force", *bad])
        assert (out / "field.safetensors").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["reconstrct"], ["reconstruct"]),
        (["reconstruct", "m.nc", "-o", "r", "--learning-rat", "1"], ["--learning-rat", "--learning-rate"]),
        (["reconstruct", "m.nc", "-o", "r", "--epochs", "many"], ["--epochs", "many"]),
        (["reconstruct", "-o", "r"], ["PATH"]),
        (["reconstruct", "m.nc", "-o", "r", "--preset", "papr"], ["preset", "paper"]),
        (["reconstruct", "--resume", "-o", "nowhere"], ["nowhere", "resume"]),
        (["simulate", "-o", "s.nc", "--pixel-pitch", "-0.02"], ["pixel_pitch"]),
        (["simulate", "-o", "s.nc", "--phantom", "cloud"], ["cloud", "flame"]),
        (["simulate", "-o", "s.nc", "--phantom", "absent.nc"], ["absent.nc"]),
        (["simulate", "-o", "s.txt"], [".nc"]),
        (["simulate", "-o", "s.nc", "--ambient-faces", "top", *TINY], ["ambient_faces", "top"]),
        (["simulate", "-o", "s.nc", "--n-ambient", "0", *TINY], ["n_ambient"]),
        (["simulate", "-o", "s.nc", "--background-distance", "10", *TINY], ["background of view '0deg'"]),
        (["simulate", "-o", "nowhere/s.nc"], ["nowhere"]),
        (["simulate", "-o", "s.nc", "--noise", "-1", *TINY], ["noise"]),
        (["evaluate", "nowhere", "--truth", "t.nc"], ["nowhere"]),
        (["export", "nowhere", "-o", "x.stl"], [".vti"]),
    ],
)
def test_command_lines_that_cannot_be_right(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    line = refused(capsys, arguments)
    for word in words:
        assert word in line
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("learning_rat = 1.0", ["learning_rat", "learning_rate"]),
        ("[network]\nwidht = 3", ["widht", "width"]),
        ('epochs = "many"', ["epochs", "many"]),
        ("samples = [1, 2, 3]", ["samples"]),
        ("epochs = ", ["TOML"]),
    ],
)
def test_settings_files_that_cannot_be_right(work, tmp_path, capsys, text, words):
    config = tmp_path / "run.toml"
    config.write_text(text)
    line = refused(capsys, ["reconstruct", str(work / "m.nc"), "-o", str(tmp_path / "r"), "--config", str(config)])
    for word in [str(config), *words]:
        assert word in line
    assert not (tmp_path / "r").exists()


def test_flags_win_over_the_file(work, tmp_path):
    config = tmp_path / "s.toml"
    config.write_text(
        'phantom = "octahedron"\nviews = 3\nimage-size = [9, 11]\npixel_pitch = 0.3\nsteps = 20\ntruth_voxels = 8\n'
    )
    assert main(["simulate", "--config", str(config), "--views", "2", "-o", str(tmp_path / "s.nc")]) == 0
    m = Measurement.read(tmp_path / "s.nc")
    assert m.displacement.shape == (2, 9, 11, 2)


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_takes_a_settings_file(tmp_path, capsys, verb):
    file = tmp_path / "s.toml"
    file.write_text("nothing_of_the_kind = 1\n")
    assert "unknown key 'nothing_of_the_kind'" in refused(capsys, [verb, "--config", str(file)])
    assert "no such settings file" in refused(capsys, [verb, f"--config={tmp_path / 'none.toml'}"])


def test_help_is_quick_and_whole(capsys):
    assert main(["--help"]) == 0
    said = capsys.readouterr().out
    assert all(verb in said for verb in VERBS)
    for verb in VERBS:
        assert main([verb, "--help"]) == 0
        assert "TOML file of settings" in " ".join(capsys.readouterr().out.split())
    code = "import sys; from nerif.cli.cli import main; main(['--help']); print('torch' in sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert loaded.stdout.strip().endswith("False")
