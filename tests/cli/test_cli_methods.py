"""The classical methods on the command line: the same road as NeRIF from measurement to result and on from there."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr

from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.fields.grid import VoxelField
from nerif.reconstruction.files import read_field

TINY = ["--image-size", "18", "22", "--pixel-pitch", "0.2", "--views", "5", "--steps", "40", "--truth-voxels", "16"]
METHODS = ["tikhonov", "landweber", "tv"]


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a simulated measurement and a reconstruction of it by each method."""
    folder = tmp_path_factory.mktemp("methods")
    measurement = str(folder / "m.nc")
    assert main(["simulate", "--phantom", "gaussians", "--noise", "0.05", "-o", measurement, *TINY]) == 0
    for method in METHODS:
        arguments = ["--method", method, "-o", str(folder / method), "--withhold", "85deg", "--voxels", "14"]
        assert main(["reconstruct", measurement, *arguments, "--iterations", "20", "--no-report"]) == 0
    return folder


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    """Run, expect exit code 2 and a single line on standard error, and return it."""
    capsys.readouterr()
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "Traceback" not in said
    return said


@pytest.mark.parametrize("method", METHODS)
def test_result_directory_is_like_any_other(work, method):
    result = work / method
    assert isinstance(read_field(result)[0], VoxelField)
    metrics = json.loads((result / "metrics.json").read_text())
    held = [v for v in metrics["views"] if v["withheld"]]
    assert [v["name"] for v in held] == ["85deg"]
    assert all(v["cc"] > 0.5 for v in metrics["views"])
    assert metrics["seconds"] > 0
    assert metrics["peak_memory_bytes"] > 0
    with xr.open_dataset(result / "volume.nc", engine="h5netcdf") as volume:
        assert volume.index_excess.shape == (14, 14, 14)
        assert {"n", "density"} <= set(volume)
    settings = tomllib.loads((result / "run.toml").read_text())
    assert settings["method"] == method
    assert settings["voxels"] == 14
    with (result / "history.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[-1]["residual"]) < float(rows[0]["residual"])
    assert float(rows[-1]["voxels"]) == 14


@pytest.mark.parametrize("method", METHODS)
def test_evaluate_project_export_and_info(work, tmp_path, capsys, method):
    result = str(work / method)
    assert main(["evaluate", result, "--truth", str(work / "m.truth.nc")]) == 0
    assert json.loads((work / method / "metrics.json").read_text())["cc"] > 0.75
    assert main(["project", result, "--cameras", str(work / "m.nc"), "-o", str(tmp_path / "p.nc")]) == 0
    measured, predicted = Measurement.read(work / "m.nc"), Measurement.read(tmp_path / "p.nc")
    a, b = measured.displacement.nan_to_num(), predicted.displacement.nan_to_num()
    assert float((a - b).norm() / a.norm()) < 0.7
    assert main(["export", result, "-o", str(tmp_path / "v.vti"), "--voxels", "9"]) == 0
    assert (tmp_path / "v.vti").stat().st_size > 1000
    assert main(["info", result]) == 0
    assert "reconstruction" in capsys.readouterr().out


def test_run_toml_repeats_the_run(work, tmp_path):
    arguments = [
        "reconstruct",
        str(work / "m.nc"),
        "--config",
        str(work / "tv" / "run.toml"),
        "-o",
        str(tmp_path / "r"),
        "--no-report",
    ]
    assert main(arguments) == 0
    again, first = read_field(tmp_path / "r")[0], read_field(work / "tv")[0]
    assert torch.equal(again.coefficients, first.coefficients)


def test_penalty_basis_model_and_bounds_are_options(work, tmp_path):
    arguments = ["reconstruct", str(work / "m.nc"), "--method", "tikhonov", "-o", str(tmp_path / "r"), "--voxels", "12"]
    arguments += ["--penalty", "laplacian", "--basis", "linear", "--model", "paraxial", "--regularisation", "1e-3"]
    arguments += ["--upper", "0", "--lower", "-3e-4", "--iterations", "12", "--device", "cpu", "--no-report"]
    assert main(arguments) == 0
    field = read_field(tmp_path / "r")[0]
    assert field.degree == 1
    assert float(field.coefficients[1:-1, 1:-1, 1:-1].max()) <= 0


@pytest.mark.parametrize("source", [pytest.param("tv", marks=pytest.mark.slow), "nerif"])
def test_start_from_another_result(work, tmp_path, source):
    """A network starts from voxels, and voxels from a network."""
    small = [
        "--network.depth", "2", "--network.width", "24", "--network.octaves", "2", "--max-steps", "5", "--samples",
        "12", "16", "--sample-jitter", "2", "--points-per-batch", "600", "--voxels", "12", "--device", "cpu",
        "--precision", "float32", "--fit-steps", "300", "--no-report",
    ]  # fmt: skip
    m, warm, cold = str(work / "m.nc"), tmp_path / "warm", tmp_path / "cold"
    assert main(["reconstruct", m, "-o", str(warm), "--start-from", str(work / "tv"), *small]) == 0
    with (warm / "history.csv").open() as file:
        rows = list(csv.DictReader(file))
    fits = [float(r["fit_loss"]) for r in rows if r["fit_loss"]]
    assert fits[-1] < 0.7 * fits[0]
    assert main(["reconstruct", m, "-o", str(cold), *small]) == 0
    rms = [max(v["rms_px"] for v in json.loads((d / "metrics.json").read_text())["views"]) for d in (warm, cold)]
    assert rms[0] < rms[1]
    if source == "nerif":
        arguments = ["--method", "tikhonov", "--start-from", str(warm), "--voxels", "14", "--iterations", "2"]
        arguments += ["--device", "cpu", "--no-report"]
        assert main(["reconstruct", m, "-o", str(tmp_path / "t"), *arguments]) == 0
        with (tmp_path / "t" / "history.csv").open() as file:
            assert {float(r["voxels"]) for r in csv.DictReader(file)} == {14.0}


@pytest.mark.slow
def test_ctrl_c_leaves_a_usable_result_to_resume(work, tmp_path):
    out = tmp_path / "r"
    words = [sys.executable, "-m", "nerif", "reconstruct", str(work / "m.nc"), "--method", "tv", "-o", str(out)]
    words += ["--voxels", "40", "--iterations", "100000", "--tolerance", "0", "--regularisation", "1e-2"]
    process = subprocess.Popen([*words, "--device", "cpu"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for _ in range(600):
        if (out / "run.toml").is_file():
            break
        time.sleep(0.1)
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "interrupted" in said
    read_field(out)
    assert main(["reconstruct", "--resume", "-o", str(out), "--iterations", "2", "--tolerance", "1e-4"]) == 0
    assert json.loads((out / "metrics.json").read_text())["outcome"] in ("iterations", "converged")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--method", "sart"], ["method", "nerif, tikhonov, landweber, tv", "sart"]),
        (["--method", "tv", "--regularisation", "-1"], ["regularisation", "0 or more", "-1"]),
        (["--method", "tv", "--regularisation", "much"], ["regularisation", "much"]),
        (["--method", "tv", "--voxels", "5000"], ["5000 x 5000 x 5000", "GiB", "--voxels"]),
        (["--method", "tv", "--learning-rate", "1"], ["--learning-rate"]),
        (["--method", "landweber", "--relaxation", "3"], ["relaxation"]),
        (["--method", "tikhonov", "--ambient-faces", "top"], ["ambient_faces", "top"]),
        (["--method", "tikhonov", "--open-faces", "x-", "x+", "y-", "y+", "z-", "z+"], ["open_faces"]),
        (["--method", "tikhonov", "--start-from", "nowhere"], ["nowhere"]),
        (["--method", "tikhonov", "--device", "cuda:9"], ["cuda:9"]),
    ],
)
def test_what_cannot_be_right_is_one_line_and_leaves_nothing(work, tmp_path, capsys, arguments, words):
    out = tmp_path / "r"
    line = refused(capsys, ["reconstruct", str(work / "m.nc"), "-o", str(out), *arguments])
    for word in words:
        assert word in line
    assert not out.exists()


def test_masks_and_boxes_that_leave_nothing(work, tmp_path, capsys):
    dataset = xr.load_dataset(work / "m.nc", engine="h5netcdf")
    dataset["flow_mask"] = (("view", "row", "column"), np.zeros(dataset.displacement.shape[:3], dtype=np.uint8))
    dataset.to_netcdf(tmp_path / "masked.nc", engine="h5netcdf")
    base = ["-o", str(tmp_path / "r"), "--method", "tv", "--voxels", "12"]
    assert "flow_mask: the masks leave no voxel" in refused(capsys, ["reconstruct", str(tmp_path / "masked.nc"), *base])
    dataset = xr.load_dataset(work / "m.nc", engine="h5netcdf")
    dataset["box"] = dataset["box"] + 1000.0
    dataset.to_netcdf(tmp_path / "off.nc", engine="h5netcdf")
    assert "no ray" in refused(capsys, ["reconstruct", str(tmp_path / "off.nc"), *base])
    assert sorted(os.listdir(tmp_path)) == ["masked.nc", "off.nc"]


def test_start_from_another_box_is_refused(work, tmp_path, capsys):
    other = str(tmp_path / "o.nc")
    assert main(["simulate", "--phantom", "gaussians", "--box", "40", "44", "48", "-o", other, *TINY]) == 0
    words = ["reconstruct", other, "-o", str(tmp_path / "r"), "--start-from", str(work / "tv")]
    assert "expected a reconstruction in the box of the measurement" in refused(capsys, words)


@pytest.mark.parametrize("method", ["nerif", *METHODS])
def test_help_tells_the_options_of_the_method(capsys, method):
    assert main(["reconstruct", "--method", method, "--help"]) == 0
    said = capsys.readouterr().out
    assert "--start-from" in said
    assert ("--learning-rate" in said) is (method == "nerif")
    assert ("--regularisation" in said) is (method in ("tikhonov", "tv"))
