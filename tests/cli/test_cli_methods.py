"""The voxel methods on the command line: from a measurement to a result and its use, as with NeRIF."""

from __future__ import annotations

import csv
import os
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from commands import metrics_of, run
from nerif.fields.voxel_field import VoxelField
from nerif.reconstruction.field_files import read_field

TINY = str.split("--image-size 18 22 --pixel-pitch 0.2 --views 5 --steps 40 --truth-voxels 16")


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a simulated measurement and a reconstruction of it."""
    folder = tmp_path_factory.mktemp("methods")
    assert run("simulate", "--phantom", "gaussians", "--noise", "0.05", "-o", folder / "m.nc", *TINY) == 0
    words = str.split("--method tv --withhold 85deg --voxels 14 --iterations 20 --no-report")
    assert run("reconstruct", folder / "m.nc", "-o", folder / "tv", *words) == 0
    return folder


def history_of(result: Path) -> list[dict[str, str]]:
    with (result / "history.csv").open() as file:
        return list(csv.DictReader(file))


def test_result_directory_and_its_evaluation(work, tmp_path):
    result = shutil.copytree(work / "tv", tmp_path / "r")
    assert isinstance(read_field(result)[0], VoxelField)
    metrics = metrics_of(result)
    assert [v["name"] for v in metrics["views"] if v["withheld"]] == ["85deg"]
    assert all(v["cc"] > 0.5 for v in metrics["views"])
    assert metrics["seconds"] > 0
    assert metrics["peak_memory_bytes"] > 0
    with xr.open_dataset(result / "volume.nc", engine="h5netcdf") as volume:
        assert volume.index_excess.shape == (14, 14, 14)
        assert {"n", "density"} <= set(volume)
    settings = tomllib.loads((result / "run.toml").read_text())
    assert (settings["method"], settings["voxels"]) == ("tv", 14)
    rows = history_of(result)
    assert float(rows[-1]["residual"]) < float(rows[0]["residual"])
    assert float(rows[-1]["voxels"]) == 14
    assert run("evaluate", result, "--truth", work / "m.truth.nc") == 0
    assert metrics_of(result)["cc"] > 0.75


def test_penalty_basis_model_and_bounds_are_options(work, tmp_path):
    words = str.split("--method tikhonov --voxels 12 --penalty laplacian --basis linear --model paraxial")
    words += str.split("--regularisation 1e-3 --upper 0 --lower -3e-4 --iterations 5 --device cpu --no-report")
    words += ["--withhold", "none"]
    assert run("reconstruct", work / "m.nc", "-o", tmp_path / "r", *words) == 0
    field = read_field(tmp_path / "r")[0]
    assert field.degree == 1
    assert float(field.coefficients[1:-1, 1:-1, 1:-1].max()) <= 0


@pytest.mark.slow
def test_networks_and_voxels_start_from_each_other(work, tmp_path):
    small = str.split("--network.depth 2 --network.width 24 --network.octaves 2 --max-steps 5 --samples 12 16")
    small += str.split("--sample-jitter 2 --points-per-batch 600 --voxels 12 --device cpu --precision float32")
    small += ["--set", "fit_steps=300", "--no-report"]
    m, warm, cold = work / "m.nc", tmp_path / "warm", tmp_path / "cold"
    assert run("reconstruct", m, "-o", warm, "--start-from", work / "tv", *small) == 0
    losses = [float(r["fit_loss"]) for r in history_of(warm) if r["fit_loss"]]
    assert losses[-1] < 0.7 * losses[0]
    assert run("reconstruct", m, "-o", cold, *small) == 0
    rms = [max(v["rms"] for v in metrics_of(d)["views"]) for d in (warm, cold)]
    assert rms[0] < rms[1]
    words = str.split("--method tikhonov --voxels 14 --iterations 2 --device cpu --no-report")
    assert run("reconstruct", m, "-o", tmp_path / "t", "--start-from", warm, *words) == 0
    assert {float(r["voxels"]) for r in history_of(tmp_path / "t")} == {14.0}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("tv --regularisation -1", ["regularisation", "0 or more", "-1"]),
        ("tv --voxels 5000", ["5000 x 5000 x 5000", "GiB", "--voxels"]),
        ("landweber --relaxation 3", ["relaxation"]),
        ("tikhonov --ambient-faces top", ["--ambient-faces", "top"]),
        ("tikhonov --open-faces x- x+ y- y+ z- z+", ["--open-faces"]),
        ("tikhonov --start-from nowhere", ["nowhere"]),
    ],
)
def test_invalid_options(work, tmp_path, refusal, arguments, words):
    line = refusal("reconstruct", work / "m.nc", "-o", tmp_path / "r", "--method", *arguments.split())
    assert all(word in line for word in words), line
    assert not (tmp_path / "r").exists()


def test_empty_masks_and_boxes_out_of_view_or_of_another_result(work, tmp_path, refusal):
    dataset = xr.load_dataset(work / "m.nc", engine="h5netcdf")
    dataset["flow_mask"] = (("view", "row", "column"), np.zeros(dataset.displacement.shape[:3], dtype=np.uint8))
    dataset.to_netcdf(tmp_path / "masked.nc", engine="h5netcdf")
    words = ["-o", tmp_path / "r", "--method", "tv", "--voxels", "12"]
    assert "flow_mask: " in refusal("reconstruct", tmp_path / "masked.nc", *words)
    dataset = xr.load_dataset(work / "m.nc", engine="h5netcdf")
    dataset["box"] = dataset["box"] + 1000.0
    dataset.to_netcdf(tmp_path / "off.nc", engine="h5netcdf")
    assert "no ray" in refusal("reconstruct", tmp_path / "off.nc", *words)
    assert sorted(os.listdir(tmp_path)) == ["masked.nc", "off.nc"]
    other = tmp_path / "o.nc"
    assert run("simulate", "--phantom", "gaussians", "--box", "40", "44", "48", "-o", other, *TINY) == 0
    assert f"{work / 'tv'}: expected" in refusal("reconstruct", other, *words, "--start-from", work / "tv")
