"""The halves of an image of an axisymmetric flow, from the reflection to the verdict."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch

from nerif.analysis.asymmetry import Reflection, asymmetry, halved, left_of_axis, withhold_half
from nerif.analysis.verdict import RATINGS
from nerif.cli.cli import main
from nerif.fields.phantoms import make_phantom
from nerif.geometry import paper_rig
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import simulate
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings
from refusals import refused

ABOUT_Z = Symmetry.about("axis", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.1)
QUICK = ["--symmetry", "axis", "--method", "tikhonov", "--voxels", "20", "--no-report"]


@cache
def measured(phantom, noise=0.0, views=1):
    cameras, box = paper_rig(40)
    return simulate(make_phantom(phantom, box, 0), cameras[:views], box, 1.00027, noise, 0)


@pytest.fixture(scope="module")
def jet_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("halves") / "jet.nc"
    measured("gaussian-jet", 0.03).write(path)
    return path


def reconstruct(path: Path, out: Path, *options: str) -> dict:
    assert main(["reconstruct", str(path), "-o", str(out), *QUICK, *options]) == 0
    return json.loads((out / "metrics.json").read_text())


@pytest.mark.parametrize("view", [0, 3])
def test_an_image_reflected_twice_is_unchanged(view):
    camera = measured("gaussian-jet", views=4).cameras[view]
    reflection, pixels = Reflection(camera, ABOUT_Z), camera.pixel_grid().reshape(-1, 2).double()
    torch.testing.assert_close(reflection(reflection(pixels)), pixels, rtol=0, atol=1e-8)
    assert torch.allclose(reflection.side(pixels), -reflection.side(reflection(pixels)), atol=1e-8)


def test_left_is_left_in_the_image():
    left = left_of_axis(measured("gaussian-jet").cameras[0], ABOUT_Z)
    assert bool(left[:, :19].all())
    assert not bool(left[:, 21:].any())


def test_the_antisymmetric_part_of_jets_and_of_a_flame():
    for row in asymmetry(measured("underexpanded", views=2), ABOUT_Z):
        assert min(row["cc"].values()) > 0.99
        assert row["antisymmetry"] < 0.05
    assert asymmetry(measured("flame"), ABOUT_Z)[0]["antisymmetry"] > 0.3
    assert asymmetry(measured("gaussian-jet", noise=0.3), ABOUT_Z)[0]["antisymmetry"] < 0.1  # noise is subtracted


def test_halves_share_the_pixels():
    whole = measured("gaussian-jet", views=2)
    parts = halved(whole, ABOUT_Z)
    assert [n.split()[-1] for n in parts.names] == ["left", "right"] * 2
    assert int(parts.usable.sum()) == int(whole.usable.sum())
    assert not bool((parts.usable[0] & parts.usable[1]).any())


def test_halves_of_symmetric_flows_only_are_withheld():
    whole = measured("gaussian-jet")
    assert withhold_half(whole, ("auto",), None) == (whole, ("auto",))
    with refused("withhold"):
        withhold_half(whole, ("left",), None)
    renamed = replace(whole, cameras=(replace(whole.cameras[0], name="left"),))
    assert withhold_half(renamed, ("left",), None) == (renamed, ("left",))


@pytest.mark.slow
def test_a_withheld_half_is_predicted_and_evaluated_again(jet_file, capsys):
    out = jet_file.parent / "r"
    metrics = reconstruct(jet_file, out, "--withhold", "left")
    assert [(v["name"], v["withheld"]) for v in metrics["views"]] == [("0deg left", True), ("0deg right", False)]
    assert metrics["views"][0]["cc"] > 0.97
    assert metrics["asymmetry"][0]["antisymmetry"] < 0.1
    assert metrics["axis"]["symmetry"]["kind"] == "axis"
    assert "halves of the displacement correlate" in capsys.readouterr().out
    assert main(["evaluate", str(out), "--measurement", str(jet_file)]) == 0
    again = json.loads((out / "metrics.json").read_text())
    assert [v["withheld"] for v in again["views"]] == [True, False]
    assert again["views"][0]["cc"] == pytest.approx(metrics["views"][0]["cc"], abs=1e-4)


@pytest.mark.slow
def test_a_half_is_withheld_for_cross_validation(jet_file):
    metrics = reconstruct(jet_file, jet_file.parent / "whole")
    assert metrics["cross_validation"]["views"][0]["name"] in ("0deg left", "0deg right")
    assert metrics["verdict"]["rating"] in ("use", "use with care")
    assert metrics["axis"]["constrained"] == {"shift_1": True, "shift_2": False, "lean_1": True, "lean_2": False}


@pytest.mark.slow
def test_a_cross_validation_that_is_stopped_shows_its_halves(tmp_path):
    out = ResultDirectory(tmp_path / "r")
    settings = Tikhonov(voxels=12, regularisation=0.01, symmetry="axis", device="cpu")
    monitor = Monitor(lambda _: None, training=lambda title: nullcontext(lambda s: "without" in title and s.step == 2))
    data, run = measured("gaussian-jet", 0.03), RunSettings(report=False)
    result = reconstruct_into(out.path, data, settings, run, monitor=monitor)
    assert result.outcome.reason == "interrupted"
    assert sorted(v["withheld"] for v in out.metrics().views) == [False, True]
    assert out.metrics().verdict["rating"] in RATINGS


@pytest.mark.slow
def test_a_flow_that_is_not_axisymmetric_is_not_to_be_used(tmp_path):
    measured("flame", noise=0.03).write(tmp_path / "flame.nc")
    conclusion = reconstruct(tmp_path / "flame.nc", tmp_path / "r")["verdict"]
    assert conclusion["rating"] == "do not use"
    assert "axisymmetric: the halves of 0deg correlate by" in conclusion["reasons"]


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--symmetry", "round"], "symmetry: expected none, axis"),
     (["--symmetry", "axis", "--axis-point", "90", "0", "0", "--method", "tv"],
      "--axis-point: expected the axis within"),
     (["--withhold", "left"], "withhold: expected half an image"),
     ([*QUICK, "--symmetry", "axis+1"], "symmetry: expected 2 views or more for axis+1")],
)  # fmt: skip
def test_refusals_before_anything_is_written(jet_file, tmp_path, capsys, options, message):
    assert main(["reconstruct", str(jet_file), "-o", str(tmp_path / "r"), *options]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
    assert not (tmp_path / "r").exists()
