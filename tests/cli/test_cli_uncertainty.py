"""nerif reconstruct --uncertainty from end to end: files, report, resuming, diverged runs."""

from __future__ import annotations

import io
import shutil
import signal
from contextlib import nullcontext, redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr

from commands import metrics_of, run
from nerif.data.volume import Volume, write_netcdf
from nerif.data.volume_file import read_volumes
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid
from nerif.reconstruction.reconstructor import Outcome
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.report.journal_figures import slices

RIG = str.split("--image-size 14 18 --pixel-pitch 0.25 --views 4 --steps 30 --truth-voxels 12")
QUICK = str.split("--method tikhonov --voxels 10 --basis linear --iterations 20 --regularisation 0.01")
QUICK += ["--gas.uniform-pressure", "yes"]


def std_of(result: Path) -> np.ndarray:
    with xr.open_dataset(result / "volume.nc") as volume:
        return volume["index_excess_std"].values


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny measurement with noise, and its truth."""
    path = tmp_path_factory.mktemp("uncertainty") / "m.nc"
    assert run("simulate", "--phantom", "gaussians", "--noise", "0.05", "-o", path, *RIG) == 0
    return path


@pytest.fixture(scope="module")
def result(path: Path) -> tuple[Path, str]:
    """A result with standard deviations from two trials, compared with the truth, and the printed lines."""
    out, lines = path.parent / "r", io.StringIO()
    with redirect_stdout(lines):
        assert run("reconstruct", path, "-o", out, *QUICK, "--uncertainty", "fast", "--no-report") == 0
        assert run("evaluate", out, "--truth", path.with_suffix(".truth.nc")) == 0
    return out, lines.getvalue()


def test_standard_deviations_and_percentiles_are_written(result):
    out, lines = result
    assert "uncertainty from 2 trials: rms standard deviation of index_excess" in lines
    with xr.open_dataset(out / "volume.nc") as volume:
        for quantity in ("index_excess", "n", "density", "temperature"):
            assert volume[f"{quantity}_std"].attrs["trials"] == 2
            assert f"{quantity}_std" in volume[quantity].attrs["ancillary_variables"]
            assert f"{quantity}_mean" not in volume
        assert "standard_deviation" in volume["density_std"].attrs["cell_methods"]
        assert volume["temperature_p95"].attrs["long_name"] == "95th percentile of temperature"
        assert "cell_methods" not in volume["temperature_p95"].attrs
        low, high = volume["temperature_p05"].values, volume["temperature_p95"].values
        assert bool((low < high)[np.isfinite(low) & np.isfinite(high)].all())
        assert float(volume["index_excess_std"].min()) > 0
        excess, std = (volume[name].values.astype(float) for name in ("index_excess", "index_excess_std"))
        certainty = volume["index_excess_certainty"]
        np.testing.assert_allclose(certainty.values, excess**2 / (excess**2 + std**2), rtol=1e-4, atol=1e-7)
        assert certainty.attrs["units"] == "1"
        assert certainty.attrs["long_name"].startswith("certainty of")
    assert "index_excess_certainty" in read_volumes(out / "volume.vti")  # an opacity for ParaView
    metrics = metrics_of(out)
    entries = metrics["uncertainty"]
    assert (entries["kind"], entries["trials"], entries["diverged_trials"]) == ("fast", 2, [])
    assert len(metrics["cross_validation"]["views"]) == 1
    assert "standard deviations" in metrics["verdict"]["reasons"]


def test_slices_are_hatched_where_the_standard_deviation_is_large(result):
    volumes = read_volumes(result[0] / "volume.nc")
    density, std = volumes["density"], volumes["density_std"]
    large = replace(std, values=std.values * 0 + 1e3)
    hatched = [bool(a.collections) for s in (None, large) for a in slices(density, 100.0, s).axes[:3]]
    assert hatched == [False] * 3 + [True] * 3


def test_coverage_is_evaluated_and_reported(result, tmp_path):
    out, lines = result
    coverage = metrics_of(out)["coverage"]
    assert 0 <= coverage["one_sigma_in_flow"] <= coverage["two_sigma_in_flow"] <= 1
    assert coverage["reliability"] == sorted(coverage["reliability"])
    assert "truth within 2 standard deviations" in lines
    assert run("report", out) == 0
    page = (out / "report.html").read_text()
    assert all(words in page for words in ("Standard deviation", "Density with bands of 90 %", "bootstrap of 2"))
    # a truth in half of the box, one and three standard deviations off in alternate columns
    out = Path(shutil.copytree(out, tmp_path / "r"))
    volumes = read_volumes(out / "volume.nc")
    half = Grid(Box((-25.0, -25.0, 0.0), (25.0, 25.0, 25.0)), (5, 10, 10))
    both = (volumes["index_excess"], volumes["index_excess_std"])
    field, std = (VoxelField.through(v.values, v.grid).sample(half) for v in both)
    shift = torch.full(half.shape, 1.0)
    shift[:, :, ::2] = 3.0  # standard deviations
    write_netcdf(tmp_path / "t.nc", [Volume(field + shift * std, half, attributes={"n_ambient": 1.00027})])
    assert run("evaluate", out, "--truth", tmp_path / "t.nc") == 0
    assert metrics_of(out)["coverage"]["two_sigma"] == pytest.approx(0.5, abs=0.02)


@pytest.mark.slow
def test_bands_are_among_the_figures(result):
    assert run("figures", result[0]) == 0
    names = {path.stem for path in (result[0] / "figures").iterdir()}
    assert {"bands_density", "bands_temperature", "reliability", "slices_density_std"} <= names


@pytest.mark.slow
def test_complete_trials_are_not_repeated(path, tmp_path):
    out = tmp_path / "r"
    words = str.split("--network.depth 2 --network.width 24 --network.octaves 2 --points-per-batch 600 --max-steps 20")
    words += str.split("--precision float32 --device cpu --voxels 10 --no-report --uncertainty fast")
    assert run("reconstruct", path, "-o", out, *words) == 0
    before = std_of(out)
    stamps = {p: p.stat().st_mtime_ns for p in sorted((out / "trials").rglob("field.safetensors"))}
    assert len(stamps) == 2
    (out / "trials/02/field.safetensors").write_bytes(b"broken")
    assert run("reconstruct", "--resume", "-o", out, "--no-report") == 0
    np.testing.assert_allclose(std_of(out), before, rtol=1e-4)
    assert [p.stat().st_mtime_ns != stamp for p, stamp in stamps.items()] == [False, True]


@pytest.mark.slow
@pytest.mark.parametrize("diverged", ["trial", "main run"])
def test_diverged_runs(path, tmp_path, capsys, monkeypatch, diverged):
    calls, solve = [], Tikhonov.__call__

    def diverging(self, *arguments, **named):
        calls.append(1)
        result = solve(self, *arguments, **named)
        fails = len(calls) == 3 if diverged == "trial" else True
        return replace(result, outcome=Outcome("diverged", "on purpose")) if fails else result

    monkeypatch.setattr(Tikhonov, "__call__", diverging)
    out = tmp_path / "r"
    words = ["reconstruct", path, "-o", out, *QUICK, "--uncertainty", "fast", "--withhold", "none"]
    assert run(*words) == int(diverged == "main run")
    lines = capsys.readouterr().out
    if diverged == "trial":
        assert "trial 2 diverged" in lines
        entries = metrics_of(out)["uncertainty"]
        assert (entries["trials"], entries["diverged_trials"]) == (1, [2])
        assert "trials 2 diverged" in (out / "report.html").read_text()
    else:
        assert len(calls) == 1
        assert "uncertainty: skipped: the main run diverged" in lines
        assert "uncertainty" not in metrics_of(out)


def test_ctrl_c_in_the_second_trial_keeps_the_first_and_resumes(path, result, tmp_path, capsys, monkeypatch):
    from nerif.cli import output

    out, progress_bar = tmp_path / "r", output.progress_bar

    def interrupting(title):
        interrupt = nullcontext(lambda step: signal.raise_signal(signal.SIGINT))
        return interrupt if "trial 2" in title else progress_bar(title)

    monkeypatch.setattr(output, "progress_bar", interrupting)
    assert (
        run("reconstruct", path, "-o", out, *QUICK, "--uncertainty", "fast", "--withhold", "none", "--no-report") == 0
    )
    assert "interrupted after 1 of 2" in capsys.readouterr().out
    assert (out / "volume.nc").is_file()
    monkeypatch.setattr(output, "progress_bar", progress_bar)
    assert run("reconstruct", "--resume", "-o", out, "--no-report") == 0
    std, undisturbed = std_of(out), std_of(result[0])
    assert abs(std - undisturbed).max() < 0.01 * undisturbed.max()  # the solver restarts, and converges
