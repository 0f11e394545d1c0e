"""nerif reconstruct --uncertainty from end to end: files, report, resuming, refusals."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr

from nerif.cli.cli import main
from nerif.data.volume import Volume
from nerif.data.volume_file import read_volumes, write_netcdf
from nerif.fields.grid import VoxelField
from nerif.geometry import Box, Grid
from nerif.reconstruction.base import Outcome
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.report.pages import slices
from nerif.workflow.pipeline import Run, reconstruct_into

RIG = ["--image-size", "14", "18", "--pixel-pitch", "0.25", "--views", "4", "--steps", "30", "--truth-voxels", "12"]
QUICK = ["--method", "tikhonov", "--voxels", "10", "--basis", "linear", "--iterations", "20"]
QUICK += ["--regularisation", "0.01"]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny measurement with noise, and its truth."""
    path = tmp_path_factory.mktemp("uncertainty") / "m.nc"
    assert main(["simulate", "--phantom", "gaussians", "--noise", "0.05", "-o", str(path), *RIG]) == 0
    return path


@pytest.fixture(scope="module")
def result(measured: Path) -> tuple[Path, str]:
    """A result with fast standard deviations, compared with the truth, and what was said meanwhile."""
    out, said = measured.parent / "r", io.StringIO()
    with redirect_stdout(said):
        words = ["reconstruct", str(measured), "-o", str(out), *QUICK, "--uncertainty", "fast", "--no-report"]
        assert main(words) == 0
        assert main(["evaluate", str(out), "--truth", str(measured.with_suffix(".truth.nc"))]) == 0
    return out, said.getvalue()


def test_standard_deviations_and_percentiles_are_written(result):
    out, said = result
    assert "uncertainty of 2: rms standard deviation of index_excess" in said
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
        sure = volume["index_excess_certainty"]
        np.testing.assert_allclose(sure.values, excess**2 / (excess**2 + std**2), rtol=1e-4, atol=1e-7)
        assert sure.attrs["units"] == "1"
        assert sure.attrs["long_name"].startswith("certainty of")
    assert "index_excess_certainty" in read_volumes(out / "volume.vti")  # an opacity for ParaView
    about = json.loads((out / "metrics.json").read_text())["uncertainty"]
    assert (about["kind"], about["members"], about["diverged"]) == ("fast", 2, [])
    found = json.loads((out / "metrics.json").read_text())
    assert len(found["cross_validation"]["views"]) == 1
    assert "standard deviations" in found["verdict"]["why"]


def test_slices_are_hatched_where_they_are_in_doubt(result):
    volumes = read_volumes(result[0] / "volume.nc")
    density, std = volumes["density"], volumes["density_std"]
    wide = replace(std, values=std.values * 0 + 1e3)
    hatched = [bool(a.collections) for given in (None, wide) for a in slices(density, 100.0, given).axes[:3]]
    assert hatched == [False] * 3 + [True] * 3


def test_the_truth_is_compared_with_them(result):
    out, said = result
    coverage = json.loads((out / "metrics.json").read_text())["coverage"]
    assert 0 <= coverage["share_in_one_in_flow"] <= coverage["share_in_flow"] <= 1
    assert coverage["reliability"] == sorted(coverage["reliability"])
    assert "truth within 2 standard deviations" in said
    assert main(["report", str(out)]) == 0
    page = (out / "report.html").read_text()
    told = ("Standard deviation", "Density with bands of 90 %", "Reliability of the bands", "bootstrap of 2")
    for words in told:
        assert words in page


@pytest.mark.slow
def test_bands_are_among_the_figures(result):
    assert main(["figures", str(result[0])]) == 0
    names = {path.stem for path in (result[0] / "figures").iterdir()}
    assert {"bands_density", "bands_temperature", "reliability", "slices_density_std"} <= names


@pytest.mark.slow
def test_trials_that_are_there_are_not_done_again(measured, tmp_path):
    out = tmp_path / "r"
    words = ["--network.depth", "2", "--network.width", "24", "--network.octaves", "2", "--points-per-batch", "600"]
    words += ["--max-steps", "20", "--precision", "float32", "--device", "cpu", "--voxels", "10", "--no-report"]
    assert main(["reconstruct", str(measured), "-o", str(out), *words, "--uncertainty", "fast"]) == 0
    with xr.open_dataset(out / "volume.nc") as volume:
        before = volume["index_excess_std"].values
    stamps = {p: p.stat().st_mtime_ns for p in sorted((out / "trials").rglob("field.safetensors"))}
    assert len(stamps) == 2
    (out / "trials" / "02" / "field.safetensors").write_bytes(b"broken")
    assert main(["reconstruct", "--resume", "-o", str(out), "--no-report"]) == 0
    with xr.open_dataset(out / "volume.nc") as volume:
        np.testing.assert_allclose(volume["index_excess_std"].values, before, rtol=1e-4)
    assert [p.stat().st_mtime_ns != stamp for p, stamp in stamps.items()] == [False, True]


def test_a_trial_that_diverged_is_named(measured, tmp_path, capsys, monkeypatch):
    calls, plain = [], Tikhonov.__call__

    def third_diverges(self, *arguments, **named):
        calls.append(1)
        result = plain(self, *arguments, **named)
        return replace(result, outcome=Outcome("diverged", "of itself")) if len(calls) == 3 else result

    monkeypatch.setattr(Tikhonov, "__call__", third_diverges)
    words = ["reconstruct", str(measured), "-o", str(tmp_path / "r"), *QUICK, "--uncertainty", "fast"]
    assert main([*words, "--withhold", "none"]) == 0
    assert "trial 2 diverged" in capsys.readouterr().out
    about = json.loads((tmp_path / "r/metrics.json").read_text())["uncertainty"]
    assert (about["members"], about["diverged"]) == (1, [2])
    assert "trials 2 diverged" in (tmp_path / "r/report.html").read_text()


def test_coverage_counts_the_voxels_of_the_truth(result, tmp_path):
    """A truth of half the box is compared within it, not beyond."""
    out = Path(shutil.copytree(result[0], tmp_path / "r"))
    volumes = read_volumes(out / "volume.nc")
    half = Grid(Box((-25.0, -25.0, 0.0), (25.0, 25.0, 25.0)), (5, 10, 10))
    both = (volumes["index_excess"], volumes["index_excess_std"])
    field, std = (VoxelField.through(v.values, v.grid).sample(half) for v in both)
    shift = torch.full(half.shape, 1.0)
    shift[:, :, ::2] = 3.0  # standard deviations off: half of the voxels lie within two
    write_netcdf(tmp_path / "t.nc", [Volume(field + shift * std, half, attributes={"n_ambient": 1.00027})])
    assert main(["evaluate", str(out), "--truth", str(tmp_path / "t.nc")]) == 0
    coverage = json.loads((out / "metrics.json").read_text())["coverage"]
    assert coverage["share"] == pytest.approx(0.5, abs=0.02)


def test_ctrl_c_in_the_second_trial_keeps_the_first_and_resume_goes_on(measured, result, tmp_path, capsys, monkeypatch):
    from nerif.cli.commands import output

    out, plain = tmp_path / "r", output.progress_bar

    def interrupting(title):
        if "trial 2" not in title:
            return plain(title)

        class Bar:
            def __enter__(self):
                return lambda step: os.kill(os.getpid(), signal.SIGINT)

            def __exit__(self, *exception):
                return None

        return Bar()

    monkeypatch.setattr(output, "progress_bar", interrupting)
    words = ["reconstruct", str(measured), "-o", str(out), *QUICK, "--uncertainty", "fast", "--no-report"]
    assert main(words) == 0
    assert "interrupted after 1 of 2" in capsys.readouterr().out
    assert (out / "volume.nc").is_file()
    monkeypatch.setattr(output, "progress_bar", plain)
    assert main(["reconstruct", "--resume", "-o", str(out), "--no-report"]) == 0
    with xr.open_dataset(out / "volume.nc") as a, xr.open_dataset(result[0] / "volume.nc") as b:
        spread, undisturbed = a["index_excess_std"].values, b["index_excess_std"].values
        assert abs(spread - undisturbed).max() < 0.01 * undisturbed.max()  # a solver begins anew, to the same end


def test_a_run_that_failed_is_not_repeated(measured, tmp_path, monkeypatch):
    real, asked = Tikhonov.__call__, []

    def failing(self, *arguments, **named):
        asked.append(1)
        found = real(self, *arguments, **named)
        return replace(found, outcome=Outcome("diverged", "of itself"))

    monkeypatch.setattr(Tikhonov, "__call__", failing)
    lines: list[str] = []
    settings = Tikhonov(voxels=8, regularisation=0.1, device="cpu")
    run = Run(report=False, uncertainty="fast", withhold=("none",))
    reconstruct_into(tmp_path / "r", measured, settings, run, monitor=Monitor(lines.append))
    assert len(asked) == 1
    assert "uncertainty: none of a run that diverged" in lines
    assert lines[-1].startswith("Do not use")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--uncertainty", "quick"], "uncertainty: expected one of off, fast, full, got 'quick'"),
    ],
)
def test_refusals(measured, tmp_path, capsys, more, words):
    assert main(["reconstruct", str(measured), "-o", str(tmp_path / "r"), *QUICK, *more]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "r").exists()
