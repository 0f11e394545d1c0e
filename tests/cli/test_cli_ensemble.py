"""nerif reconstruct --ensemble from end to end: files, resuming, interruption, refusals."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import xarray as xr

from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.data.volume_file import read_volumes, write_netcdf
from nerif.fields.grid import VoxelField
from nerif.geometry import Box, Grid
from nerif.reconstruction.base import Step

RIG = ["--image-size", "14", "18", "--pixel-pitch", "0.25", "--views", "3", "--steps", "30", "--truth-voxels", "12"]
QUICK = ["--method", "tikhonov", "--voxels", "10", "--basis", "linear", "--iterations", "80", "--tolerance", "1e-7"]
QUICK += ["--regularisation", "0.01"]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny measurement with noise."""
    path = tmp_path_factory.mktemp("ensemble") / "m.nc"
    assert main(["simulate", "--phantom", "gaussians", "--noise", "0.05", "-o", str(path), *RIG]) == 0
    return path


@pytest.fixture(scope="module")
def ensemble(measured: Path) -> tuple[Path, str]:
    """A result with an ensemble of three, and what was said while it was made."""
    out, said = measured.parent / "r", io.StringIO()
    with redirect_stdout(said):
        assert main(["reconstruct", str(measured), "-o", str(out), *QUICK, "--ensemble", "3"]) == 0
    return out, said.getvalue()


def test_mean_and_spread_of_every_quantity_are_written(ensemble):
    out, said = ensemble
    assert "ensemble of 3" in said
    with xr.open_dataset(out / "volume.nc") as volume:
        for quantity in ("index_excess", "n", "density", "temperature"):
            for statistic in ("mean", "std"):
                assert volume[f"{quantity}_{statistic}"].attrs["members"] == 3
            statistics = ("mean", "std", "certainty") if quantity == "index_excess" else ("mean", "std")
            assert volume[quantity].attrs["ancillary_variables"] == " ".join(f"{quantity}_{s}" for s in statistics)
        assert volume["density_std"].attrs["units"] == "kg m-3"
        assert "standard_deviation" in volume["density_std"].attrs["cell_methods"]
        assert float(volume["index_excess_std"].mean()) > 0
    assert json.loads((out / "metrics.json").read_text())["ensemble"]["members"] == 3
    assert "Ensemble mean" in (out / "report.html").read_text()


def test_members_that_are_there_are_not_done_again(measured, ensemble, tmp_path):
    out = Path(shutil.copytree(ensemble[0], tmp_path / "r"))
    with xr.open_dataset(out / "volume.nc") as volume:
        before = volume["index_excess_std"].values
    stamps = {p: p.stat().st_mtime_ns for p in (out / "ensemble").rglob("field.safetensors")}
    assert len(stamps) == 3
    (out / "ensemble" / "01" / "field.safetensors").write_bytes(b"broken")
    assert main(["reconstruct", "--resume", "-o", str(out), "--no-report"]) == 0
    with xr.open_dataset(out / "volume.nc") as volume:
        assert (volume["index_excess_std"].values == before).all()
    again = {p: p.stat().st_mtime_ns for p in stamps}
    assert [again[p] != stamps[p] for p in sorted(stamps)] == [True, False, False]
    assert main(["reconstruct", str(measured), "-o", str(out), *QUICK, "--force", "--no-report"]) == 0
    assert not (out / "ensemble").exists()


def test_members_that_are_there_are_of_what_was_measured(tmp_path):
    out, more = tmp_path / "r", ["--technique", "emission", "--noise", "0.05", *RIG]
    assert main(["simulate", "--phantom", "gaussians", "-o", str(tmp_path / "m.nc"), *more]) == 0
    quick = [*QUICK, "--ensemble", "2", "--no-report"]
    assert main(["reconstruct", str(tmp_path / "m.nc"), "-o", str(out), *quick]) == 0
    before = read_volumes(out / "volume.nc")
    assert main(["reconstruct", "--resume", "-o", str(out), "--no-report"]) == 0
    after = read_volumes(out / "volume.nc")
    assert list(after) == list(before) == ["emission", "emission_mean", "emission_std", "emission_certainty"]
    assert torch.equal(after["emission_std"].values, before["emission_std"].values)


@pytest.mark.slow
def test_members_of_other_settings_are_done_again(measured, tmp_path):
    """Resuming with a view left out, or another weight, must not take members that saw it, or had another weight."""
    out, fresh = tmp_path / "r", tmp_path / "fresh"
    arguments = ["reconstruct", str(measured), *QUICK, "--no-report", "--ensemble", "2"]
    assert main([*arguments, "-o", str(out)]) == 0
    assert main(["reconstruct", "--resume", "-o", str(out), "--leave-one-out"]) == 0
    assert main([*arguments, "-o", str(fresh), "--leave-one-out"]) == 0
    found, expected = (json.loads((d / "metrics.json").read_text())["ensemble"]["left_out"] for d in (out, fresh))
    assert [v["cc"] for v in found] == pytest.approx([v["cc"] for v in expected], abs=1e-6)
    assert main(["reconstruct", "--resume", "-o", str(out), "--ensemble", "0", "--no-leave-one-out"]) == 0
    assert "ensemble" not in json.loads((out / "metrics.json").read_text())  # nor is there one in volume.nc


def test_a_member_that_diverged_is_left_out_and_told(measured, tmp_path, capsys, monkeypatch):
    from nerif.reconstruction.base import Outcome
    from nerif.reconstruction.voxels.tikhonov import Tikhonov

    calls, plain = [], Tikhonov.__call__

    def second_diverges(self, *arguments):
        calls.append(1)
        result = plain(self, *arguments)
        return replace(result, outcome=Outcome("diverged", "of itself")) if len(calls) == 3 else result

    monkeypatch.setattr(Tikhonov, "__call__", second_diverges)
    assert main(["reconstruct", str(measured), "-o", str(tmp_path / "r"), *QUICK, "--ensemble", "3"]) == 0
    assert "member 2 diverged" in capsys.readouterr().out
    ensemble = json.loads((tmp_path / "r/metrics.json").read_text())["ensemble"]
    assert (ensemble["members"], ensemble["diverged"]) == (2, [2])
    assert "Members 2 of the ensemble diverged" in (tmp_path / "r/report.html").read_text()


def test_coverage_counts_the_voxels_of_the_truth(ensemble, tmp_path):
    """A truth of half the box is compared within it, not beyond."""
    out = Path(shutil.copytree(ensemble[0], tmp_path / "r"))
    found = read_volumes(out / "volume.nc")
    half = Grid(Box((-25.0, -25.0, 0.0), (25.0, 25.0, 25.0)), (5, 10, 10))
    mean, std = (
        VoxelField.through(v.values, v.grid).sample(half)
        for v in (found["index_excess_mean"], found["index_excess_std"])
    )
    shift = torch.full(half.shape, 1.0)
    shift[:, :, ::2] = 3.0  # standard deviations off: half of the voxels lie within two
    truth = Volume(mean + shift * std, half, attributes={"n_ambient": 1.00027})
    write_netcdf(tmp_path / "t.nc", [truth])
    assert main(["evaluate", str(out), "--truth", str(tmp_path / "t.nc")]) == 0
    coverage = json.loads((out / "metrics.json").read_text())["coverage"]
    assert coverage["share"] == pytest.approx(0.5, abs=0.02)


def test_interrupted_in_the_second_member(measured, ensemble, tmp_path, capsys, monkeypatch):
    """Ctrl-C in a member keeps the main result and the members before it; --resume goes on with that member."""
    from nerif.cli.commands import output

    out = tmp_path / "r"
    arguments = ["reconstruct", str(measured), *QUICK, "--ensemble", "3", "--no-report"]
    plain = output.progress_bar

    def interrupting(title):
        if "member 2" not in title:
            return plain(title)

        class Bar:
            def __enter__(self):
                def update(step: Step) -> None:
                    os.kill(os.getpid(), signal.SIGINT)

                return update

            def __exit__(self, *exception):
                return None

        return Bar()

    monkeypatch.setattr(output, "progress_bar", interrupting)
    assert main([*arguments, "-o", str(out)]) == 0
    assert "interrupted after 1 of 3" in capsys.readouterr().out
    assert not (out / "report.html").exists()
    assert (out / "volume.nc").is_file()
    monkeypatch.setattr(output, "progress_bar", plain)
    assert main(["reconstruct", "--resume", "-o", str(out), "--no-report"]) == 0
    with xr.open_dataset(out / "volume.nc") as a, xr.open_dataset(ensemble[0] / "volume.nc") as b:
        spread, undisturbed = a["index_excess_std"].values, b["index_excess_std"].values
        assert abs(spread - undisturbed).max() < 0.01 * undisturbed.max()  # a solver begins anew, to the same end


def test_without_sigma_the_residual_takes_its_place(measured, tmp_path, capsys):
    replace(Measurement.read(measured), sigma=None).write(tmp_path / "m.nc")
    arguments = [str(tmp_path / "m.nc"), "-o", str(tmp_path / "r"), *QUICK, "--regularisation", "0.1"]
    assert main(["reconstruct", *arguments, "--ensemble", "2", "--no-report"]) == 0
    assert "has no sigma" in capsys.readouterr().out
    assert json.loads((tmp_path / "r/metrics.json").read_text())["ensemble"]["noise"] == "rms residual"


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--ensemble", "1"], "2 members or more"),
        (["--leave-one-out"], "together with --ensemble"),
        (["--ensemble", "2", "--leave-one-out", "--hold-out", "0deg", "85deg"], "two training views"),
    ],
)
def test_refusals(measured, tmp_path, capsys, more, words):
    assert main(["reconstruct", str(measured), "-o", str(tmp_path / "r"), *QUICK, *more]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "r").exists()
