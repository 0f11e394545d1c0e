"""The halves of an image of an axisymmetric flow, from the reflection to the verdict."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerif.analysis.asymmetry import Reflection, asymmetry, halved, kept_half, left_of_axis
from nerif.analysis.verdict import WORDS
from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.fields.phantoms import make_phantom
from nerif.geometry import paper_rig
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import simulate
from nerif.workflow.job import Run
from nerif.workflow.pipeline import reconstruct_into
from refusals import refused

ABOUT_Z = Symmetry.about("axis", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.1)
QUICK = ["--symmetry", "axis", "--method", "tikhonov", "--voxels", "20", "--no-report"]


def measured(phantom, noise=0.0, views=1):
    cameras, box = paper_rig(40)
    return simulate(make_phantom(phantom, box, 0), cameras[:views], box, 1.00027, noise, 0)


@pytest.fixture(scope="module")
def jet_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("halves") / "jet.nc"
    measured("gaussian-jet", 0.03).write(path)
    return path


@pytest.mark.parametrize("view", [0, 3])
def test_a_image_reflected_twice_is_itself(view):
    camera = measured("gaussian-jet", views=4).cameras[view]
    reflection, pixels = Reflection(camera, ABOUT_Z), camera.pixel_grid().reshape(-1, 2).double()
    torch.testing.assert_close(reflection(reflection(pixels)), pixels, rtol=0, atol=1e-8)
    assert torch.allclose(reflection.side(pixels), -reflection.side(reflection(pixels)), atol=1e-8)


def test_left_is_left_in_the_image():
    left = left_of_axis(measured("gaussian-jet").cameras[0], ABOUT_Z)
    assert bool(left[:, :19].all())
    assert not bool(left[:, 21:].any())


def test_a_jet_is_its_own_reflection_and_a_flame_is_not():
    for found in asymmetry(measured("underexpanded", views=2), ABOUT_Z):
        assert min(found["cc"].values()) > 0.99
        assert found["departure"] < 0.05
    (flame,) = asymmetry(measured("flame"), ABOUT_Z)
    assert flame["departure"] > 0.3


def test_noise_is_taken_off_the_departure():
    (found,) = asymmetry(measured("gaussian-jet", noise=0.3), ABOUT_Z)
    assert found["departure"] < 0.1


def test_halves_share_out_the_pixels():
    whole = measured("gaussian-jet", views=2)
    parts = halved(whole, ABOUT_Z)
    assert [n.split()[-1] for n in parts.names] == ["left", "right"] * 2
    assert int(parts.usable.sum()) == int(whole.usable.sum())
    assert not bool((parts.usable[0] & parts.usable[1]).any())


def test_half_a_image_is_kept_out_of_symmetric_flows_only():
    whole = measured("gaussian-jet")
    same, names = kept_half(whole, ("auto",), None)
    assert same is whole
    assert names == ("auto",)
    with refused("withhold"):
        kept_half(whole, ("left",), None)
    renamed = replace(whole, cameras=(replace(whole.cameras[0], name="left"),))
    assert kept_half(renamed, ("left",), None) == (renamed, ("left",))


def test_a_half_kept_out_is_predicted_and_evaluated_again(jet_file, capsys):
    out = jet_file.parent / "r"
    assert main(["reconstruct", str(jet_file), "-o", str(out), *QUICK, "--withhold", "left"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert [(v["name"], v["withheld"]) for v in metrics["views"]] == [("0deg left", True), ("0deg right", False)]
    assert metrics["views"][0]["cc"] > 0.97
    assert metrics["asymmetry"][0]["departure"] < 0.1
    assert metrics["axis"]["symmetry"]["kind"] == "axis"
    assert "halves of the displacement correlate" in capsys.readouterr().out
    assert main(["evaluate", str(out), "--measurement", str(jet_file)]) == 0
    again = json.loads((out / "metrics.json").read_text())
    assert [v["withheld"] for v in again["views"]] == [True, False]
    assert again["views"][0]["cc"] == pytest.approx(metrics["views"][0]["cc"], abs=1e-4)


def test_harmonics_of_one_view_are_refused_before_anything_is_written(jet_file, capsys):
    out = jet_file.parent / "bent"
    assert main(["reconstruct", str(jet_file), "-o", str(out), *QUICK, "--symmetry", "axis+1"]) == 2
    assert "symmetry: expected 2 views or more for axis+1, better 3, got 1" in capsys.readouterr().err
    assert not out.exists()


def test_a_half_is_kept_out_first_and_the_verdict_goes_by_it(jet_file):
    out = jet_file.parent / "whole"
    assert main(["reconstruct", str(jet_file), "-o", str(out), *QUICK]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["cross_validation"]["views"][0]["name"] in ("0deg left", "0deg right")
    assert metrics["verdict"]["word"] in ("use", "use with care")
    assert metrics["axis"]["told"] == {"shift_1": True, "shift_2": False, "lean_1": True, "lean_2": False}


def test_a_run_that_is_stopped_while_a_half_is_kept_out_shows_that_half(tmp_path):
    out, lines = ResultDirectory(tmp_path / "r"), []

    def stopped(title: str):
        return nullcontext(lambda step: "without" in title and step.step == 2)

    settings = Tikhonov(voxels=12, regularisation=0.01, symmetry="axis", device="cpu")
    monitor = Monitor(lines.append, training=stopped)
    found = reconstruct_into(out.path, measured("gaussian-jet", 0.03), settings, Run(report=False), monitor=monitor)
    assert found.outcome.reason == "interrupted"
    assert sorted(v["withheld"] for v in out.metrics()["views"]) == [False, True]
    assert out.metrics()["verdict"]["word"] in WORDS


@pytest.mark.slow
def test_a_flow_that_is_not_axisymmetric_is_not_to_be_used(tmp_path):
    measured("flame", noise=0.03).write(tmp_path / "flame.nc")
    assert main(["reconstruct", str(tmp_path / "flame.nc"), "-o", str(tmp_path / "r"), *QUICK]) == 0
    judged = json.loads((tmp_path / "r" / "metrics.json").read_text())["verdict"]
    assert judged["word"] == "do not use"
    assert "axisymmetric: the halves of 0deg correlate by" in judged["why"]


@pytest.mark.parametrize(
    ("words", "message"),
    [(["--symmetry", "round"], "symmetry: expected none, axis"),
     (["--symmetry", "axis", "--axis-point", "90", "0", "0", "--method", "tv"], "axis_point: expected the axis within"),
     (["--withhold", "left"], "withhold: expected half an image")],
)  # fmt: skip
def test_what_cannot_be_is_told_in_one_line(jet_file, tmp_path, capsys, words, message):
    with pytest.raises(SystemExit) as stop:
        raise SystemExit(main(["reconstruct", str(jet_file), "-o", str(tmp_path / "r"), *words]))
    assert stop.value.code == 2
    told = capsys.readouterr().err
    assert message in told
    assert "Traceback" not in told
    assert Measurement.read(jet_file).names == ("0deg",)
