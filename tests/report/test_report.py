"""The page of a result: everything inside, figures that are right, and what it says when something is missing."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from nerif.analysis.evaluation import evaluate_views
from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.data.reprojection import Reprojection
from nerif.data.volume import Volume
from nerif.geometry import Box, Grid
from nerif.physics.quantities import GasSettings, derive
from nerif.plotting.notebook import number
from nerif.report import html, packing
from nerif.report.pages import residuals_over_sigma
from nerif.report.scene import scene_of
from nerif.report.summary import LEVELS, Statement, trust
from nerif.report.view_images import _shrink, lattice_step, view_images
from nerif.results.directory import Result, ResultDirectory
from report.page_reading import quantity_of, unpack

PARTS = ("run.toml", "metrics.json", "history.csv", "volume.nc", "reprojection.nc")


def smooth(shape: tuple[int, int, int]) -> Volume:
    """A warm column with a little noise, in a box of three different edges."""
    grid = Grid(Box((-25.0, -20.0, -15.0), (25.0, 20.0, 15.0)), shape)
    x, y, z = grid.points().unbind(-1)
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    excess = -2e-4 * torch.exp(-(x**2 + y**2) / 80) * (1 + 0.2 * torch.sin(z)) + 3e-7 * noise
    return Volume(excess, grid, attributes={"n_ambient": 1.00027})


def test_page_is_whole_and_needs_no_network(whole):
    text = (whole / "report.html").read_text()
    assert not re.findall(r"""(?:src|href|action)\s*=\s*["']?(?:https?:)?//""", text)
    assert not re.findall(r"url\(\s*['\"]?(?:https?:)?//|@import", text)
    own_scripts = [
        p.read_text() for p in (Path(html.__file__).parent / "assets").glob("*.js") if not p.name.startswith("three")
    ]
    assert len(own_scripts) == 3
    assert not any(re.search(r"fetch\(|XMLHttpRequest|WebSocket|importScripts", s) for s in own_scripts)
    for words in ("What was measured", "What came out", "Can it be trusted", "held out", "170deg",
                  "Error bars by 2 trials", "Against the truth", "Gladstone-Dale", "101325 Pa",
                  "arXiv:2409.14722"):  # fmt: skip
        assert words in text, words


def test_figures_on_the_page_are_those_of_the_files(whole):
    result = ResultDirectory(whole).read()
    assert not result.missing
    metrics = json.loads((whole / "metrics.json").read_text())
    held = next(v for v in metrics["views"] if v["withheld"])
    page = (whole / "report.html").read_text()
    assert f"CC {number(held['cc'], 5)}" in page
    assert f"{number(held['rms_px'], 3)} px = {held['rms_over_sigma']:.2f} σ" in page
    assert f"L2 {metrics['l2']:.2%}" in page
    assert metrics["uncertainty"]["members"] == 2
    assert 0 <= metrics["coverage"]["share"] <= 1


def test_what_is_packed_comes_back():
    volume = smooth((7, 6, 5))
    values = volume.values.double().numpy()
    values[1, 2, 3] = np.nan
    packed = packing.pack(values)
    back = unpack(packed, values.shape)
    assert np.isnan(back[1, 2, 3])
    assert np.isnan(back).sum() == 1
    half_a_step = 0.5 * packed["step"]
    assert packed["step"] == pytest.approx((np.nanmax(values) - np.nanmin(values)) / 65534)
    assert np.nanmax(np.abs(back - values)) <= 1.001 * half_a_step
    flat = packing.pack(np.full((2, 3, 4), 5.0))
    np.testing.assert_allclose(unpack(flat, (2, 3, 4)), 5.0)
    assert np.isnan(unpack(packing.pack(np.full((2, 3, 4), np.nan)), (2, 3, 4))).all()


@pytest.mark.parametrize("quantity", ["n", "density", "temperature"])
def test_relations_are_those_of_the_files(quantity):
    volume = smooth((9, 8, 7))
    volume.values[0, 0, :3] = torch.tensor([-2.8e-4, -2.6999e-4, 3e-4])  # below vacuum, far too hot, too cold
    derived = derive(volume, quantity, GasSettings("N2", pressure_pa=9e4, uniform_pressure="yes"))
    expected = derived.values.double().numpy() - (quantity == "n")
    found = quantity_of(packing.relation(quantity, derived.attributes), volume.values.double().numpy())
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    np.testing.assert_allclose(found, expected, rtol=2e-6)


def test_statistics_are_masked_on_the_page_where_they_are_in_the_file(tmp_path):
    """A voxel masked in one member: its density has no standard deviation, though its index excess has one."""
    excess = smooth((6, 5, 4))
    density = derive(excess, "density", GasSettings())
    spread = Volume(torch.full(excess.grid.shape, 1e-6), excess.grid, "index_excess_std")
    std = Volume(torch.full(excess.grid.shape, 4e-3), excess.grid, "density_std", "kg m-3")
    std.values[1, 2, 3] = float("nan")
    found = {v.quantity: v for v in (excess, density, spread, std)}
    scene, arrays = scene_of(Result(tmp_path, volumes=found))
    assert scene is not None
    shown = unpack({**scene["arrays"]["density_std"], "text": arrays["density_std"]}, excess.grid.shape)
    np.testing.assert_array_equal(np.isnan(shown), np.isnan(std.values.numpy()))


def test_a_volume_of_128_stays_below_15_megabytes(tmp_path):
    excess = smooth((128, 128, 128))
    values = {q: derive(excess, q, GasSettings()) for q in ("n", "density", "temperature")}
    more = {f"index_excess_{s}": excess for s in ("std",)}
    more |= {f"temperature_{s}": values["temperature"] for s in ("std",)}
    html.write(html.render(Result(tmp_path, volumes={"index_excess": excess, **values, **more})), tmp_path / "r.html")
    assert (tmp_path / "r.html").stat().st_size < 15e6


def test_finer_volumes_are_averaged_down_in_their_box():
    fine = smooth((12, 16, 20))
    coarse = packing.coarsen(fine, 10)
    assert coarse.grid.shape == (6, 8, 10)
    assert coarse.grid.box == fine.grid.box
    blocks = fine.values.reshape(6, 2, 8, 2, 10, 2).mean(dim=(1, 3, 5))
    torch.testing.assert_close(coarse.values, blocks)
    assert packing.coarsen(fine, 20) is fine


def test_images_of_views_share_their_scales(whole):
    reprojection = ResultDirectory(whole).read().reprojection
    assert reprojection is not None
    views, [scale] = view_images(reprojection, [])
    assert [v.withheld for v in views] == [False, False, False, True]
    measured = reprojection.measurement.displacement[reprojection.measurement.usable].abs()
    assert (scale.measured, scale.unit) == ("displacement", "px")
    for low, high in (scale.limits, scale.difference_limits):
        assert low == -high
    assert 0 < scale.limits[1] <= float(measured.max())
    assert scale.difference_limits[1] < scale.limits[1]
    assert all(address.startswith("data:image/png") for v in views for row in v.rows.values() for address in row)


QUICK = [("gone", "run.toml"), ("nonsense", "volume.nc")]
BROKEN = [(how, name) for how in ("gone", "truncated", "nonsense") for name in PARTS]


@pytest.mark.parametrize(
    ("how", "name"), [b if b in QUICK else pytest.param(*b, marks=pytest.mark.slow) for b in BROKEN]
)
def test_a_broken_result_gives_a_page_that_says_what_is_missing(copy, capsys, name, how):
    path = copy / name
    if how == "gone":
        path.unlink()
    elif how == "truncated":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    else:
        path.write_bytes(b"\x00\x01 nonsense")
    if how != "gone" and (name == "history.csv" or (name, how) == ("run.toml", "truncated")):
        assert main(["report", str(copy)]) == 0  # half a table can be a table
        return
    assert main(["report", str(copy)]) == 0
    assert name in capsys.readouterr().out
    page = (copy / "report.html").read_text()
    assert name in page
    level = worst(trust(ResultDirectory(copy).read()))
    assert level == "bad" or name not in ("metrics.json", "volume.nc")


def test_a_run_that_was_killed(copy, capsys):
    for name in ("field.safetensors", "metrics.json", "history.csv", "volume.nc", "reprojection.nc", "report.html"):
        (copy / name).unlink()
    assert main(["report", str(copy)]) == 0
    page = (copy / "report.html").read_text()
    assert "The run has not ended" in page
    assert "--resume" in page
    assert "Not there yet: metrics.json, history.csv, volume.nc, reprojection.nc." in page
    assert "4, of which 1 held out, of 22 × 18 px" in page  # the measurement is still where it was
    assert main(["figures", str(copy)]) == 2
    assert "nothing to draw" in capsys.readouterr().err


def test_refusals(tmp_path, capsys, whole):
    (tmp_path / "empty").mkdir()
    there = tmp_path / "there.html"
    there.write_text("somebody's page")
    for arguments, words in (
        (["report", str(tmp_path / "absent")], "no such directory"),
        (["report", str(tmp_path / "empty")], "expected a result of nerif reconstruct"),
        (["report", str(whole), "-o", str(tmp_path / "r.pdf")], ".html"),
        (["report", str(whole), "-o", str(tmp_path / "no" / "r.html")], "does not exist; make it first"),
        (["report", str(whole), "-o", str(there)], "exists already and was left as it is"),
        (["figures", str(whole), "--journal", "lancet"], "elsevier"),
        (["figures", str(whole), "--dpi", "3"], "dpi"),
        (["figures", str(tmp_path / "absent")], "no such directory"),
    ):
        assert main(arguments) == 2, arguments
        assert words in capsys.readouterr().err
    with pytest.raises(InputError, match="no such directory"):
        ResultDirectory(tmp_path / "absent").read()
    assert there.read_text() == "somebody's page"
    assert main(["report", str(whole), "-o", str(there), "--force"]) == 0
    assert there.read_text().startswith("<!")


def worst(statements: list[Statement]) -> str:
    return max((s.level for s in statements), key=LEVELS.index)


def view(withheld: bool, cc: float, noise: float | None) -> dict:
    known = {"name": "a", "withheld": withheld, "cc": cc, "rms": 0.1, "measured": "displacement", "unit": "px"}
    return known if noise is None else {**known, "rms_over_sigma": noise}


def test_leftovers_are_named_with_where_they_point(tmp_path):
    left = {"grain": 3.0, "white": False, "share": 0.5, "row": 20.0, "column": 36.0, "alike": 0.3}
    moved = [{**view(False, 0.99, 1.0), "rms_predicted": 1.0, "leftover": {**left, "cause": "calibration"}}] * 2
    plain = {**view(False, 0.99, 1.0), "rms_predicted": 20.0, "leftover": {**left, "cause": ""}}
    found = trust(Result(tmp_path, metrics={"views": [*moved, plain, view(False, 0.99, 1.0)]}))
    (first,) = [s for s in found if "--refine cameras" in s.text]
    assert first.level == "warning"
    assert "2 training views (a, a)" in first.text
    assert "3.0% of what is predicted, most in a around row 20, column 36" in first.text
    (second,) = [s for s in found if "no cause that is known" in s.text]
    assert second.level == "note"


@pytest.mark.parametrize(
    ("metrics", "level", "words"),
    [
        ({"views": [view(False, 0.99, 1.0), view(True, 0.98, 1.1)]}, "good", "has not been seen"),
        ({"views": [view(False, 0.99, 1.0)]}, "warning", "--withhold"),
        ({"views": [view(False, 0.99, None), view(True, 0.98, None)]}, "note", "noise of the measurement is not known"),
        ({"views": [view(False, 0.99, 1.0), view(True, 0.9, 1.1)]}, "warning", "poorly"),
        ({"views": [view(False, 0.99, 1.0), view(True, 0.5, 3.0)]}, "bad", "poorly"),
        ({"views": [view(False, 0.99, 1.0), view(True, 0.99, 2.5)]}, "warning", "2.5 times the noise"),
        ({"views": [view(False, 0.99, 0.4), view(True, 0.99, 1.0)]}, "warning", "follows noise"),
        ({"views": [view(False, 0.99, 2.0), view(True, 0.99, 1.0)]}, "warning", "not explained"),
        ({"views": [view(False, 0.99, 5.0), view(True, 0.99, 1.0)]}, "bad", "not explained"),
        ({"views": [view(False, 0.99, 0.6), view(False, 0.3, 12.0), view(True, 0.99, 1.0)]}, "bad", "12.0 times"),
        ({"views": [view(False, 0.99, 0.6), view(False, 0.3, 2.0), view(True, 0.99, 1.0)]}, "warning", "follows noise"),
        ({"views": [view(True, 0.1, 30.0)]}, "bad", "poorly"),
        ({"views": [view(False, 0.99, 1.0), view(True, 0.5, 1.1)]}, "warning", "poorly"),
        ({"views": [view(True, 0.99, 1.8)]}, "note", "No training view"),
        ({"views": [view(True, 0.99, None)]}, "note", "No training view"),
        ({}, "warning", "not compared with any view"),
        ({"views": [view(False, 0.99, 1.0), view(True, 0.99, 1.0)], "cc": 0.5, "l2_variation": 0.9}, "bad", "90.0%"),
        ({"views": [view(False, 0.99, 1.0)], "uncertainty": {"members": 3, "diverged": [2]}}, "warning", "Trials 2"),
        ({"outcome": "diverged", "message": "loss is NaN"}, "bad", "loss is NaN"),
        ({"outcome": "collapsed", "message": "nothing there"}, "bad", "found no field. nothing there"),
        ({"outcome": "interrupted"}, "warning", "--resume"),
        ({"outcome": ["steps"]}, "warning", "not compared with any view"),
        ({"outcome": "time_limit", "views": [view(False, 0.99, 1.0), view(True, 0.98, 1.1)]}, "note", "time limit"),
    ],
)
def test_what_is_said_of_trust(tmp_path, metrics, level, words):
    statements = trust(Result(tmp_path, metrics=metrics))
    assert worst(statements) == level
    assert any(s.level == level and words in s.text for s in statements)


def test_what_cannot_be_shown_does_not_condemn(copy):
    metrics = json.loads((copy / "metrics.json").read_text())
    good = [view(False, 0.99, 1.0), view(True, 0.99, 1.0)]
    metrics |= {"views": good, "truth": "/nowhere/truth.nc", "outcome": "epochs", "cc": 0.999, "l2_variation": 0.01}
    (copy / "metrics.json").write_text(json.dumps(metrics))
    (copy / "history.csv").unlink()
    result = ResultDirectory(copy).read()
    assert {gap.what for gap in result.missing} == {"history.csv", "truth"}
    assert result.truth is None
    statements = [s for s in trust(result) if "masked" not in s.text]
    assert worst(statements) == "note"


def test_a_truth_that_moved_with_the_result_is_found(copy):
    (copy / "t.nc").write_bytes((copy / "volume.nc").read_bytes())
    metrics = json.loads((copy / "metrics.json").read_text()) | {"truth": "/nowhere/t.nc"}
    (copy / "metrics.json").write_text(json.dumps(metrics))
    assert ResultDirectory(copy).read().truth is not None


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("metrics.json", '{"views": [1]}', "views"),
        pytest.param("metrics.json", '{"uncertainty": 2}', "uncertainty", marks=pytest.mark.slow),
        pytest.param("metrics.json", '{"coverage": {}}', "coverage", marks=pytest.mark.slow),
        pytest.param("metrics.json", "[]", "table", marks=pytest.mark.slow),
        ("history.csv", "a,b\n1,2\n", "seconds"),
    ],
)
def test_tables_of_another_kind_are_refused_not_drawn(copy, name, text, words):
    (copy / name).write_text(text)
    (gap,) = [gap for gap in ResultDirectory(copy).read().missing if gap.what == name]
    assert words in gap.sentence
    if words != "views":  # few images are quicker
        (copy / "reprojection.nc").unlink()
    assert main(["report", str(copy)]) == 0


def scene_in(page: Path) -> str:
    """The JSON that the page draws from."""
    match = re.search(r'<script type="application/json" id="scene">(.*?)</script>', page.read_text())
    assert match is not None
    return match[1]


def test_the_gas_is_doubted_in_a_liquid(tmp_path):
    grid = Grid(Box.cube(4.0), (4, 5, 6))
    water = Volume(torch.zeros(grid.shape), grid, attributes={"n_ambient": 1.333})
    found = {q: derive(water, q, GasSettings()) for q in ("n", "density", "temperature")}
    statements = trust(Result(tmp_path, volumes={"index_excess": water, **found}))
    assert any("do not apply here" in s.text and s.level == "warning" for s in statements)
    html.write(html.render(Result(tmp_path, volumes={"index_excess": water, **found})), tmp_path / "r.html")
    assert "NaN" not in scene_in(tmp_path / "r.html")


def test_residuals_are_those_of_every_ray_through_the_box(measurement):
    """Also where the field is exactly 0, as outside a visual hull."""
    nothing = Reprojection(measurement, {"deflection": torch.zeros_like(measurement.displacement)})
    found = residuals_over_sigma(nothing)["displacement"]
    seen = measurement.usable & measurement.sees_box
    assert found.size == 2 * int(seen.sum())
    scores = evaluate_views(nothing)
    pixels = [int(seen[i].sum()) for i in range(len(scores))]
    rms = np.sqrt(sum(n * v["rms_over_sigma"] ** 2 for n, v in zip(pixels, scores, strict=True)) / sum(pixels))
    assert np.sqrt(np.mean(found**2)) == pytest.approx(rms, rel=1e-5)


def test_of_many_pixels_a_regular_lattice_is_taken(measurement):
    nothing = Reprojection(measurement, {"deflection": torch.zeros_like(measurement.displacement)})
    assert lattice_step(measurement, 10**6) == 1
    assert lattice_step(measurement, measurement.displacement[..., 0].numel() // 9 + 1) == 3
    seen = (measurement.usable & measurement.sees_box)[:, ::3, ::3]
    some = residuals_over_sigma(nothing, measurement.displacement[..., 0].numel() // 9 + 1)["displacement"]
    assert some.size == 2 * int(seen.sum())
    expected = -(measurement.displacement / measurement.sigma)[:, ::3, ::3][seen]
    np.testing.assert_allclose(np.sort(some), np.sort(expected.flatten().numpy()), rtol=1e-5)


def test_the_images_of_many_views_stay_small(measurement, monkeypatch):
    nothing = Reprojection(measurement, {"deflection": torch.zeros_like(measurement.displacement)})
    assert {v.bin_size for v in view_images(nothing, [])[0]} == {(1, 1)}
    monkeypatch.setattr("nerif.report.view_images.ALL_IMAGES", 6 * 5 * 13**2)
    assert {v.bin_size for v in view_images(nothing, [])[0]} == {(2, 2)}


def test_images_of_narrow_and_large_views():
    """Shrunk along each edge by itself."""
    assert _shrink(np.ones((2, 900)), (1, 3)).shape == (2, 300)
    image = np.arange(24.0).reshape(4, 6)
    np.testing.assert_array_equal(_shrink(image, (2, 3)), [[4, 7], [16, 19]])
    image[0, 0] = np.nan
    assert np.isnan(_shrink(image, (2, 3))).tolist() == [[True, False], [False, False]]


def test_evaluating_again_keeps_what_was_withheld(copy):
    measurement = json.loads((copy / "metrics.json").read_text())["measurement"]
    assert main(["evaluate", str(copy), "--measurement", measurement]) == 0
    views = json.loads((copy / "metrics.json").read_text())["views"]
    assert [v["name"] for v in views if v["withheld"]] == ["170deg"]


def test_masked_voxels_are_told(tmp_path):
    volume = smooth((6, 5, 4))
    volume.values[:3] = -3e-4
    density = derive(volume, "density", GasSettings())
    statements = trust(Result(tmp_path, volumes={"density": density}))
    assert any("60 voxels (50.00%)" in s.text and s.level == "warning" for s in statements)


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (2.75123e-4, 3, "2.75 × 10⁻⁴"),
        (1454.2, 3, "1450"),
        (0.0, 3, "0"),
        (296.94, 4, "296.9"),
        (None, 3, "–"),
        (float("nan"), 3, "–"),
    ],
)
def test_numbers_for_people(value, digits, text):
    assert number(value, digits) == text
