"""The command line from end to end on a tiny case, and bad input: one clear line, exit code 2."""

from __future__ import annotations

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

from commands import metrics_of, run
from nerif.analysis.evaluation import evaluate_views
from nerif.analysis.prediction import reproject
from nerif.data.measurement import Measurement
from nerif.data.volume_file import read_volume
from nerif.forward.deflection import MODELS
from nerif.reconstruction.field_files import read_field

TINY = str.split("--image-size 18 22 --pixel-pitch 0.2 --views 4 --steps 40 --truth-voxels 16")
QUICK = str.split("""--network.depth 2 --network.width 24 --network.octaves 2 --network.directions 3 --max-steps 40
    --samples 12 16 --sample-jitter 2 --points-per-batch 600 --voxels 12 --device cpu --precision float32""")

SHORT = str.split("--max-steps 4 --withhold none --no-report")


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a simulated measurement and a reconstruction of it."""
    folder = tmp_path_factory.mktemp("cli")
    assert run("simulate", "--phantom", "gaussians", "--noise", "0.05", "-o", folder / "m.nc", *TINY) == 0
    assert run("reconstruct", folder / "m.nc", "-o", folder / "r", "--withhold", "170deg", *QUICK) == 0
    return folder


@pytest.fixture
def result(work: Path, tmp_path: Path) -> Path:
    """A copy of the reconstruction."""
    return shutil.copytree(work / "r", tmp_path / "r")


@pytest.fixture
def spoil(work: Path, tmp_path: Path):
    """Write a copy of the measurement with a change."""

    def change(edit) -> Path:
        dataset = xr.load_dataset(work / "m.nc", engine="h5netcdf")
        dataset = edit(dataset) or dataset
        dataset.to_netcdf(tmp_path / "spoilt.nc", engine="h5netcdf")
        return tmp_path / "spoilt.nc"

    return change


def test_result_directory_is_complete(work):
    names = {p.name for p in (work / "r").iterdir()}
    files = "volume.nc volume.vti field.safetensors run.toml metrics.json history.csv checkpoint.safetensors"
    assert names >= {*files.split(), "reprojection.nc", "report.html"}
    assert not [n for n in names if n.endswith(".part")]
    metrics = metrics_of(work / "r")
    assert (metrics["outcome"], metrics["device"]) == ("steps", "cpu")
    assert metrics["seconds"] > 0
    assert metrics["peak_memory_bytes"] > 1e6
    assert [v["withheld"] for v in metrics["views"]] == [False, False, False, True]
    assert set(metrics["views"][0]) >= {"name", "withheld", "cc", "ssim", "psnr", "rms"}
    volume = xr.load_dataset(work / "r/volume.nc", engine="h5netcdf")
    assert set(volume.data_vars) == {"index_excess", "n", "density", "temperature"}
    assert volume["n"].dtype == np.float64
    np.testing.assert_allclose(volume["n"] - 1.00027, volume["index_excess"], atol=1e-10)
    history = (work / "r/history.csv").read_text().splitlines()
    assert history[0].startswith("step,epoch,seconds")
    assert len(history) > 2


def test_run_toml_repeats_the_run(work, tmp_path):
    settings = tomllib.loads((work / "r/run.toml").read_text())
    assert (settings["network"]["width"], settings["withhold"]) == (24, ["170deg"])
    assert (
        run("reconstruct", "--config", work / "r/run.toml", "-o", tmp_path / "again", "--no-report", work / "m.nc") == 0
    )
    points = torch.rand(20, 3)
    assert torch.equal(read_field(work / "r")[0](points), read_field(tmp_path / "again")[0](points))


def test_evaluate(work, capsys):
    result, truth = work / "r", read_volume(work / "m.truth.nc")
    assert run("evaluate", result, "--truth", work / "m.truth.nc", "--measurement", work / "m.nc") == 0
    assert {"L2", "CC"} <= set(capsys.readouterr().out.split())
    metrics = metrics_of(result)
    assert set(metrics) >= {"l2", "l2_variation", "cc", "ssim", "psnr", "slices", "views", "seconds"}
    field, _, n_ambient = read_field(result)
    error = (field.sample(truth.grid) - truth.values).double().norm()
    assert metrics["l2_variation"] == pytest.approx(float(error / truth.values.double().norm()), rel=1e-4)
    assert metrics["l2"] == pytest.approx(float(error / (truth.values.double() + n_ambient - 1).norm()), rel=1e-4)


@pytest.mark.slow
def test_a_collapsed_run_is_reported_and_exits_with_1(work, tmp_path, capsys):
    words = ["reconstruct", work / "m.nc", "-o", tmp_path / "r", *QUICK, "--learning-rate", "1e4"]
    assert run(*words, "--max-steps", "55", "--points-per-batch", "200") == 1
    assert "collapsed:" in capsys.readouterr().out
    metrics = metrics_of(tmp_path / "r")
    assert metrics["outcome"] == "collapsed"
    assert "--learning-rate" in metrics["message"]
    assert "rolled_back" in (tmp_path / "r/history.csv").read_text().splitlines()[0]
    assert "The field collapsed to the ambient. " in (tmp_path / "r/report.html").read_text()
    assert bool(torch.isfinite(read_volume(tmp_path / "r/volume.nc").values).all())


@pytest.mark.slow
def test_views_are_compared_by_the_model_of_the_reconstruction(work, tmp_path):
    out, path = tmp_path / "r", work / "m.nc"
    assert run("reconstruct", path, "-o", out, "--model", "paraxial", *QUICK) == 0
    measurement, field = Measurement.read(path), read_field(out)[0]
    by_model = {model: evaluate_views(reproject(field, measurement, model=model)) for model in MODELS}
    scores = {model: [v["rms"] for v in views] for model, views in by_model.items()}
    assert scores["paraxial"] != pytest.approx(scores["lever_arm"], rel=1e-4)
    for _ in range(2):
        assert [v["rms"] for v in metrics_of(out)["views"]] == pytest.approx(scores["paraxial"], rel=1e-5)
        assert run("evaluate", out, "--measurement", path) == 0


def test_project_into_the_same_and_other_cameras(work, tmp_path, refusal):
    words = ["project", work / "r", "-o", tmp_path / "p.nc", "--force"]
    assert run(*words, "--cameras", work / "m.nc", "--names", "170deg", "--samples", "128") == 0
    predicted, measurement = Measurement.read(tmp_path / "p.nc"), Measurement.read(work / "m.nc")
    assert predicted.names == ("170deg",)
    usable = measurement.usable[3]
    residual = (predicted.displacement[0] - measurement.displacement[3])[usable]
    assert float(residual.norm()) < 0.95 * float(measurement.displacement[3][usable].norm())
    assert "names: " in refusal(*words, "--names", "170deg")
    assert "--f-number: " in refusal(*words, "--cameras", work / "m.nc", "--f-number", "8")
    ring = str.split("--extra-angles 33 --image-size 10 12 --pixel-pitch 0.3 --samples 30 --model")
    for model in ("curved", "paraxial"):
        assert run(*words, *ring, model) == 0
        assert "33deg" in Measurement.read(tmp_path / "p.nc").names


@pytest.mark.parametrize("ending", ["vti", "nc", "csv"])
def test_export(work, tmp_path, ending):
    out = tmp_path / f"x.{ending}"
    words = str.split("--shape 3 4 5 --lower -9 -8 -7 --upper 9 8 7 --quantities index_excess density temperature")
    assert run("export", work / "r", "-o", out, *words) == 0
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
def closed_pipe() -> Iterator[int]:
    """A pipe without a reader."""
    read, write = os.pipe()
    os.close(read)
    yield write
    os.close(write)


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("--help", 141),
        pytest.param("info m.nc", 141, marks=pytest.mark.slow),
        pytest.param("info -h", 141, marks=pytest.mark.slow),
        pytest.param(f"reconstruct m.nc -o piped {' '.join(QUICK)}", 0, marks=pytest.mark.slow),
    ],
)
def test_a_closed_pipe_ends_a_command_silently_but_not_a_reconstruction(work, closed_pipe, words, code):
    command = [sys.executable, "-m", "nerif", *words.split()]
    process = subprocess.run(command, stdout=closed_pipe, stderr=subprocess.PIPE, text=True, cwd=work)
    assert process.returncode == code, process.stderr
    if code:
        assert process.stderr == ""
    else:
        assert (work / "piped/report.html").is_file()


def test_info_of_each_kind(work, capsys):
    before = sorted(os.listdir(work))
    kinds = {"m.nc": "4 views", "m.truth.nc": "index_excess", "r": "reconstruction", "r/volume.vti": "volume"}
    for path, word in kinds.items():
        assert run("info", work / path) == 0
        assert word in capsys.readouterr().out
    assert sorted(os.listdir(work)) == before


def test_a_volume_as_phantom(work, tmp_path):
    assert run("simulate", "--phantom", work / "m.truth.nc", "-o", tmp_path / "own.nc", *TINY) == 0
    a, b = (Measurement.read(path).displacement for path in (work / "m.nc", tmp_path / "own.nc"))
    assert float((a - b).norm() / a.norm()) < 0.2  # 16 voxels, and 5 % noise


def test_resume_continues_with_other_limits(work, result):
    before = read_field(result)[0](torch.zeros(1, 3))
    assert run("reconstruct", "--resume", "-o", result, "--max-steps", "50", work / "m.nc") == 0
    assert metrics_of(result)["outcome"] == "steps"
    assert (result / "history.csv").read_text().splitlines()[-1].startswith("50.0,")
    assert not torch.equal(before, read_field(result)[0](torch.zeros(1, 3)))


@pytest.mark.slow
def test_ctrl_c_leaves_a_result_to_resume(work, tmp_path):
    out = tmp_path / "r"
    words = ["reconstruct", work / "m.nc", "-o", out, "--no-report", "--withhold", "none", *QUICK]
    words += ["--max-steps", "100000", "--checkpoint-every", "0.2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "nerif", *map(str, words)], stderr=subprocess.PIPE, stdout=subprocess.PIPE
    )
    deadline = time.monotonic() + 90
    while not (out / "checkpoint.safetensors").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
    process.send_signal(signal.SIGINT)
    lines, errors = process.communicate(timeout=90)
    assert process.returncode == 0, errors
    assert b"interrupted" in lines
    assert b"Traceback" not in errors
    assert metrics_of(out)["outcome"] == "interrupted"
    steps = int(float((out / "history.csv").read_text().splitlines()[-1].split(",")[0]))
    assert run("reconstruct", "--resume", "-o", out, "--max-steps", steps + 20) == 0
    assert metrics_of(out)["outcome"] == "steps"


def test_tensorboard_scalars(work, tmp_path, monkeypatch):
    pytest.importorskip("tensorboard")
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "3")
    assert run("reconstruct", work / "m.nc", "-o", tmp_path / "r", "--tensorboard", *QUICK, *SHORT) == 0
    assert list((tmp_path / "r/tensorboard").glob("events*"))


# -- bad input -------------------------------------------------------------------------------------------------------


def test_nan_and_infinite_pixels_are_masked_and_counted(spoil, tmp_path, capsys):
    def edit(d):
        d["displacement"].values[0, 3, 4:9, 0] = np.nan
        d["displacement"].values[1, 5, 6, 1] = np.inf

    assert run("reconstruct", spoil(edit), "-o", tmp_path / "r", *QUICK, *SHORT) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "left out" in line)
    assert "6 pixels" in line


def _set(name, index, value):
    def edit(dataset):
        dataset[name].values[index] = value

    return edit


def _flip(d):
    d["rotation"].values[1] = d["rotation"].values[1][[1, 0, 2]]


def _box(d):
    d["box"].values[:] += 5000.0
    d["background_offset"].values[:] = -1e6


def _unit(d):
    d["translation"].attrs["units"] = "m"


def _sizes(d):
    return d.drop_vars("rotation").assign(rotation=(("view", "i", "k"), np.zeros((4, 3, 2)), {"units": "1"}))


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (_flip, ["rotation", "view '56.6667deg'"]),
        (_set("background_offset", 2, 300.0), ["background", "view '113.333deg'"]),
        (_box, ["box"]),
        (_set("intrinsics", (0, 0, 0), -1.0), ["intrinsics", "view '0deg'", "positive"]),
        (_set("displacement", 2, np.nan), ["displacement", "view '113.333deg'", "no valid pixel"]),
        (_sizes, ["rotation", "dimensions"]),
        (lambda d: d.drop_vars("translation"), ["translation"]),
        (_unit, ["translation", "mm", "'m'"]),
    ],
)
def test_invalid_measurements(spoil, tmp_path, refusal, edit, words):
    path = spoil(edit)
    line = refusal("reconstruct", path, "-o", tmp_path / "r")
    assert all(word in line for word in [str(path), *words]), line
    assert not (tmp_path / "r").exists()


def test_truncated_foreign_and_missing_files(work, tmp_path, refusal):
    content = (work / "m.nc").read_bytes()
    (tmp_path / "cut.nc").write_bytes(content[: len(content) // 2])
    (tmp_path / "text.nc").write_text("not a NetCDF file")
    for name in ("cut.nc", "text.nc", "absent.nc"):
        for words in (["info"], ["reconstruct", "-o", tmp_path / "r"]):
            assert name in refusal(*words, tmp_path / name)
    assert "got a volume" in refusal("reconstruct", work / "m.truth.nc", "-o", tmp_path / "r")
    assert not (tmp_path / "r").exists()


def test_damaged_results_name_their_file(work, result, refusal):
    (result / "metrics.json").write_text("{")
    for words in (["info", result], ["evaluate", result, "--truth", work / "m.truth.nc"]):
        assert "metrics.json" in refusal(*words)
    for name, words in (("field", ["info", result]), ("checkpoint", ["reconstruct", "--resume", "-o", result])):
        file = result / f"{name}.safetensors"
        file.write_bytes(file.read_bytes()[:200])
        assert file.name in refusal(*words)


def test_nothing_is_overwritten_without_force(work, refusal):
    before = {p: p.stat().st_mtime_ns for p in work.rglob("*") if p.is_file()}
    m, r = work / "m.nc", work / "r"
    for words in (
        ["simulate", "-o", m, *TINY],
        ["reconstruct", m, "-o", r],
        ["export", r, "-o", r / "volume.vti"],
        ["project", r, "-o", m],
        ["demo", "-o", r],
    ):
        assert "--force" in refusal(*words)
    assert {p: p.stat().st_mtime_ns for p in work.rglob("*") if p.is_file()} == before


@pytest.mark.parametrize("bad", ["--withhold x", "--gas.composition phlogiston", "--device cuda:9", "--epochs -1"])
def test_a_forced_run_with_bad_input_keeps_the_old_result(work, result, refusal, bad):
    refusal("reconstruct", work / "m.nc", "-o", result, "--force", *bad.split())
    assert (result / "field.safetensors").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("reconstruct . -o r --preset papr", ["preset", "paper"]),
        ("reconstruct --resume -o nowhere", ["nowhere", "resume"]),
        ("simulate -o s.nc --phantom cloud", ["cloud", "flame"]),
        ("simulate -o s.nc --phantom absent.nc", ["absent.nc"]),
        ("simulate -o s.txt", [".nc"]),
        ("simulate -o s.nc --ambient-faces top", ["--ambient-faces", "top"]),
        ("simulate -o s.nc --n-ambient 0", ["--n-ambient"]),
        ("simulate -o s.nc --background-distance 10", ["background of view '0deg'"]),
        ("simulate -o nowhere/s.nc", ["nowhere"]),
        ("simulate -o s.nc --noise -1", ["noise"]),
        ("evaluate nowhere --truth t.nc", ["nowhere"]),
        ("export . -o x.stl", [".vti"]),
    ],
)
def test_invalid_values(tmp_path, monkeypatch, refusal, arguments, words):
    """Options and their types: test_arguments.py."""
    monkeypatch.chdir(tmp_path)
    command, *options = arguments.split()
    line = refusal(command, *(TINY if "-o s.nc" in arguments else []), *options)
    assert all(word in line for word in words), line
    assert os.listdir(tmp_path) == []


def test_options_override_the_file(tmp_path):
    config = tmp_path / "s.toml"
    config.write_text(
        'phantom = "octahedron"\nviews = 3\nimage-size = [9, 11]\npixel_pitch = 0.3\nsteps = 20\ntruth_voxels = 8\n'
    )
    assert run("simulate", "--config", config, "--views", "2", "-o", tmp_path / "s.nc") == 0
    assert Measurement.read(tmp_path / "s.nc").displacement.shape == (2, 9, 11, 2)
