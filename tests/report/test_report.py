"""The page of a result: self-contained, with the values of the files, and what it says of missing data and accuracy."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import torch

from nerif.analysis.evaluation import evaluate_views
from nerif.cli.cli import main
from nerif.data.reprojection import Reprojection
from nerif.data.volume import Volume
from nerif.geometry import Box, Grid
from nerif.geometry.symmetry import Axis, Symmetry
from nerif.physics.gas import GasSettings
from nerif.physics.medium import derive
from nerif.plotting.notebook import number
from nerif.report import html, packing
from nerif.report.result_plots import residuals_over_sigma
from nerif.report.scene import scene_of
from nerif.report.summary import LEVELS, Statement, statements
from nerif.report.view_images import _shrink, lattice_step, view_images
from nerif.results.directory import Result, ResultDirectory
from nerif.results.metrics_file import Metrics
from refusals import refused
from report.page_reading import quantity_of, unpack

PARTS = ("run.toml", "metrics.json", "history.csv", "volume.nc", "reprojection.nc")


def smooth(shape: tuple[int, int, int]) -> Volume:
    """A warm column with a little noise, in a box of three different edges."""
    grid = Grid(Box((-25.0, -20.0, -15.0), (25.0, 20.0, 15.0)), shape)
    x, y, z = grid.points().unbind(-1)
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    excess = -2e-4 * torch.exp(-(x**2 + y**2) / 80) * (1 + 0.2 * torch.sin(z)) + 3e-7 * noise
    return Volume(excess, grid, attributes={"n_ambient": 1.00027})


def derived(excess: Volume, *quantities: str) -> dict[str, Volume]:
    return {"index_excess": excess, **{q: derive(excess, q, GasSettings()) for q in quantities}}


def test_the_page_is_complete_and_loads_nothing(whole):
    text = (whole / "report.html").read_text()
    assert not re.findall(r"""(?:src|href|action)\s*=\s*["']?(?:https?:)?//""", text)
    assert not re.findall(r"url\(\s*['\"]?(?:https?:)?//|@import", text)
    scripts = [p.read_text() for p in html.ASSETS.glob("*.js") if not p.name.startswith("three")]
    assert len(scripts) == 3
    assert not any(re.search(r"fetch\(|XMLHttpRequest|WebSocket|importScripts", s) for s in scripts)
    result, metrics = ResultDirectory(whole).read(), json.loads((whole / "metrics.json").read_text())
    assert not result.missing
    withheld = next(v for v in metrics["views"] if v["withheld"])
    for phrase in (
        "Measurement", "Reconstruction", "Accuracy", "withheld", "170deg", "bootstrap of 2", "Against the truth",
        "Gladstone-Dale", "101325 Pa", "arXiv:2409.14722", f"CC {number(withheld['cc'], 5)}",
        f"{number(withheld['rms'], 3)} px = {withheld['rms_over_sigma']:.2f} σ", f"L2 {metrics['l2']:.2%}",
    ):  # fmt: skip
        assert phrase in text, phrase
    assert 0 <= metrics["coverage"]["two_sigma"] <= 1


def test_packed_values_are_recovered():
    values = smooth((7, 6, 5)).values.double().numpy()
    values[1, 2, 3] = np.nan
    packed = packing.pack(values)
    back = unpack(packed, values.shape)
    np.testing.assert_array_equal(np.isnan(back), np.isnan(values))
    assert packed["step"] == pytest.approx((np.nanmax(values) - np.nanmin(values)) / 65534)
    assert np.nanmax(np.abs(back - values)) <= 1.001 * 0.5 * packed["step"]
    np.testing.assert_allclose(unpack(packing.pack(np.full((2, 3, 4), 5.0)), (2, 3, 4)), 5.0)
    assert np.isnan(unpack(packing.pack(np.full((2, 3, 4), np.nan)), (2, 3, 4))).all()


@pytest.mark.parametrize("quantity", ["n", "density", "temperature"])
def test_relations_are_those_of_the_files(quantity):
    volume = smooth((9, 8, 7))
    volume.values[0, 0, :3] = torch.tensor([-2.8e-4, -2.6999e-4, 3e-4])  # below vacuum, far too hot, too cold
    quantities = derive(volume, quantity, GasSettings("N2", pressure_pa=9e4, uniform_pressure="yes"))
    expected = quantities.values.double().numpy() - (quantity == "n")
    values = quantity_of(packing.relation(quantity, quantities.attributes), volume.values.double().numpy())
    np.testing.assert_array_equal(np.isnan(values), np.isnan(expected))
    np.testing.assert_allclose(values, expected, rtol=2e-6)


def test_standard_deviations_are_masked_as_in_the_file(tmp_path):
    """A voxel masked in one trial has no standard deviation of density, though one of the index excess."""
    excess = smooth((6, 5, 4))
    std = Volume(torch.full(excess.grid.shape, 4e-3), excess.grid, "density_std", "kg m-3")
    std.values[1, 2, 3] = float("nan")
    volumes = derived(excess, "density") | {"density_std": std}
    volumes["index_excess_std"] = Volume(torch.full(excess.grid.shape, 1e-6), excess.grid, "index_excess_std")
    scene, arrays = scene_of(Result(tmp_path, volumes=volumes))
    unpacked = unpack({**scene["arrays"]["density_std"], "text": arrays["density_std"]}, excess.grid.shape)
    np.testing.assert_array_equal(np.isnan(unpacked), np.isnan(std.values.numpy()))


def test_a_volume_of_128_stays_below_15_megabytes(tmp_path):
    volumes = derived(smooth((128, 128, 128)), "n", "density", "temperature")
    volumes |= {f"{q}_std": volumes[q] for q in ("index_excess", "temperature")}
    html.write(html.render(Result(tmp_path, volumes=volumes)), tmp_path / "r.html")
    assert (tmp_path / "r.html").stat().st_size < 15e6


def test_finer_volumes_are_averaged_in_their_box():
    fine = smooth((12, 16, 20))
    coarse = packing.coarsen(fine, 10)
    assert (coarse.grid.shape, coarse.grid.box) == ((6, 8, 10), fine.grid.box)
    torch.testing.assert_close(coarse.values, fine.values.reshape(6, 2, 8, 2, 10, 2).mean(dim=(1, 3, 5)))
    assert packing.coarsen(fine, 20) is fine


def test_images_of_views_share_their_scales(whole):
    reprojection = ResultDirectory(whole).read().reprojection
    views, [scale] = view_images(reprojection, [])
    assert [v.withheld for v in views] == [False, False, False, True]
    measured = reprojection.measurement.displacement[reprojection.measurement.usable].abs()
    assert (scale.measured, scale.unit) == ("displacement", "px")
    for low, high in (scale.limits, scale.difference_limits):
        assert low == -high
    assert 0 < scale.limits[1] <= float(measured.max())
    assert scale.difference_limits[1] < scale.limits[1]
    assert all(address.startswith("data:image/png") for v in views for row in v.rows.values() for address in row)


QUICK = [("missing", "run.toml"), ("nonsense", "volume.nc")]
DAMAGES = [(how, name) for how in ("missing", "truncated", "nonsense") for name in PARTS]


@pytest.mark.parametrize(
    ("how", "name"), [d if d in QUICK else pytest.param(*d, marks=pytest.mark.slow) for d in DAMAGES]
)
def test_the_page_of_a_damaged_result_names_the_file(copy, capsys, name, how):
    path = copy / name
    if how == "missing":
        path.unlink()
    else:
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2] if how == "truncated" else b"\x00\x01 nonsense")
    assert main(["report", str(copy)]) == 0
    if how != "missing" and (name == "history.csv" or (name, how) == ("run.toml", "truncated")):
        return  # half a table can be a table
    assert name in capsys.readouterr().out
    assert name in (copy / "report.html").read_text()
    level = worst(statements(ResultDirectory(copy).read()))
    assert level == "bad" or name not in ("metrics.json", "volume.nc")


def test_an_aborted_run(copy, capsys):
    for name in ("field.safetensors", "metrics.json", "history.csv", "volume.nc", "reprojection.nc", "report.html"):
        (copy / name).unlink()
    assert main(["report", str(copy)]) == 0
    page = (copy / "report.html").read_text()
    for phrase in (
        "The run has not ended", "--resume", "4 (1 withheld)",  # the measurement is still at its path
        "Not written yet: metrics.json, history.csv, volume.nc, reprojection.nc.",
    ):  # fmt: skip
        assert phrase in page
    assert "has not ended" in ResultDirectory(copy).read(views=False).missing[0].sentence
    assert main(["figures", str(copy)]) == 2
    assert "nothing to draw" in capsys.readouterr().err


def test_refusals(tmp_path, capsys, whole):
    (tmp_path / "empty").mkdir()
    foreign = tmp_path / "foreign.html"
    foreign.write_text("a page of the user")
    for arguments, phrase in (
        (["report", str(tmp_path / "absent")], "no such directory"),
        (["report", str(tmp_path / "empty")], "expected a result of nerif reconstruct"),
        (["report", str(whole), "-o", str(tmp_path / "r.pdf")], ".html"),
        (["report", str(whole), "-o", str(tmp_path / "no" / "r.html")], "does not exist"),
        (["report", str(whole), "-o", str(foreign)], "exists already"),
        (["figures", str(whole), "--journal", "lancet"], "elsevier"),
        (["figures", str(whole), "--dpi", "3"], "dpi"),
        (["figures", str(tmp_path / "absent")], "no such directory"),
    ):
        assert main(arguments) == 2, arguments
        assert phrase in capsys.readouterr().err
    with refused(tmp_path / "absent"):
        ResultDirectory(tmp_path / "absent").read()
    assert foreign.read_text() == "a page of the user"
    assert main(["report", str(whole), "-o", str(foreign), "--force"]) == 0
    assert foreign.read_text().startswith("<!")


def worst(sentences: list[Statement]) -> str:
    return max((s.level for s in sentences), key=LEVELS.index)


def view(withheld: bool, cc: float, noise: float | None, **more) -> dict:
    row = {"name": "a", "withheld": withheld, "cc": cc, "rms": 0.1, "measured": "displacement", "unit": "px"}
    row |= {"ssim": 0.9, "psnr": 40.0, "pixels": 100, "rms_predicted": 10.0, "rms_measured": 10.0, **more}
    return row if noise is None else {**row, "rms_over_sigma": noise}


TEST = {"grain": 3.0, "white": False, "share": 0.5, "row": 20.0, "column": 36.0, "correlated": 0.3}
SHIFTED = view(False, 0.99, 1.0, rms_predicted=1.0, residual_test={**TEST, "cause": "calibration"})
PLAIN = view(False, 0.99, 1.0, rms_predicted=20.0, residual_test={**TEST, "cause": ""})
UNCORRELATED = view(False, 0.99, 1.0, rms_predicted=1.0, residual_test={**TEST, "cause": "blur", "correlated": 0.0})
FIT, GOOD = view(False, 0.99, 1.0), view(True, 0.99, 1.0)


def test_residuals_without_a_correlated_part_are_no_statement(tmp_path):
    sentences = statements(Result(tmp_path, metrics=Metrics(views=[UNCORRELATED, FIT, GOOD])))
    assert not any("correlated" in s.text for s in sentences)


@pytest.mark.parametrize(
    ("views", "level", "phrase"),
    [
        ([FIT, view(True, 0.98, 1.1)], "good", "predicted with CC 0.98"),
        ([FIT], "warning", "--withhold"),
        ([view(False, 0.99, None), view(True, 0.98, None)], "note", "noise of the measurement is unknown"),
        ([FIT, view(True, 0.9, 1.1)], "warning", "poorly"),
        ([FIT, view(True, 0.5, 3.0)], "bad", "poorly"),
        ([FIT, view(True, 0.5, 1.1)], "warning", "poorly"),
        ([view(True, 0.1, 30.0)], "bad", "poorly"),
        ([FIT, view(True, 0.99, 2.5)], "warning", "2.5 × the noise"),
        ([view(False, 0.99, 0.4), GOOD], "warning", "fits noise"),
        ([view(False, 0.99, 2.0), GOOD], "warning", "possible causes"),
        ([view(False, 0.99, 5.0), GOOD], "bad", "possible causes"),
        ([view(False, 0.99, 0.6), view(False, 0.3, 12.0), GOOD], "bad", "12.0 times"),
        ([view(False, 0.99, 0.6), view(False, 0.3, 2.0), GOOD], "warning", "fits noise"),
        ([view(True, 0.99, 1.8)], "note", "No fitted view"),
        ([view(True, 0.99, None)], "note", "No fitted view"),
        ([SHIFTED, SHIFTED, FIT, GOOD], "warning", "up to 3.0% of the signal in a around row 20, column 36"),
        ([SHIFTED, SHIFTED, FIT, GOOD], "warning", "--refine cameras"),
        ([PLAIN, FIT, GOOD], "note", "Likely cause: a view that does not fit"),
        (None, "warning", "not compared with any view"),
    ],
)
def test_statements_on_views(tmp_path, views, level, phrase):
    sentences = statements(Result(tmp_path, metrics=Metrics(views=views or [])))
    assert worst(sentences) == level
    assert any(s.level == level and phrase in s.text for s in sentences)


@pytest.mark.parametrize(
    ("views", "setting", "option"),
    [
        ([SHIFTED, SHIFTED, FIT, GOOD], {"refine": ["cameras"]}, "if it finds none, --refine cameras"),
        ([FIT], {"withhold": ["auto"]}, "--withhold auto"),
        ([view(False, 0.99, 2.0), GOOD], {"open_faces": ["z+"]}, "--open-faces"),
    ],
)
def test_statements_advise_no_option_that_is_in_use(tmp_path, views, setting, option):
    for settings, advised in (({}, True), (setting, False)):
        sentences = statements(Result(tmp_path, settings=settings, metrics=Metrics(views=views)))
        assert any(option in s.text for s in sentences) == advised


@pytest.mark.parametrize(("outcome", "advised"), [("time_limit", True), ("converged", False)])
def test_a_longer_run_is_advised_only_to_one_that_a_limit_ended(tmp_path, outcome, advised):
    views = [view(False, 0.99, 2.0), view(True, 0.5, 3.0)]
    sentences = statements(Result(tmp_path, metrics=Metrics(views=views, outcome=outcome)))
    assert sum("a longer --time-limit" in s.text for s in sentences) == 3 * advised  # withheld view, residuals, limit


@pytest.mark.parametrize(
    ("metrics", "level", "phrase"),
    [
        ({"cc": 0.5, "l2_variation": 0.9}, "bad", "90.0%"),
        ({"uncertainty": {"kind": "fast", "trials": 3, "diverged_trials": [2], "seconds": 1.0}}, "warning", "trials 2"),
        ({"outcome": "diverged", "message": "loss is NaN"}, "bad", "loss is NaN"),
        ({"outcome": "collapsed", "message": "no gradient"}, "bad", "collapsed to the ambient. no gradient"),
        ({"outcome": "interrupted"}, "warning", "--resume"),
        ({"outcome": "time_limit"}, "note", "time limit"),
    ],
)
def test_statements_on_the_run(tmp_path, metrics, level, phrase):
    sentences = statements(Result(tmp_path, metrics=Metrics(views=[FIT, GOOD], **metrics)))
    assert worst(sentences) == level
    assert any(s.level == level and phrase in s.text for s in sentences)


def test_the_report_gives_the_axis_and_the_correlation_of_the_halves(tmp_path):
    symmetry = Symmetry.about("axis", (1.5, 0.0, 0.0), (0.0, 0.0, 1.0), 0.1)
    axis = Axis(symmetry, (0.31, 0.0, 0.02, 0.0), (1.5, 1.5, 0.03, 0.03), (0.04, 1.5, 0.001, 0.03), 1.0)
    halves = [{"name": "cam", "measured": "displacement", "cc": {"u": 0.952, "v": 0.938}, "antisymmetry": 0.09}]
    texts = [s.text for s in statements(Result(tmp_path, metrics=Metrics(axis=axis.record, asymmetry=halves)))]
    for phrase in ("Axis: through (1.500, 0.000, 0.000) mm", "+0.31 +- 0.04 mm", "cannot be determined",
                   "the halves of the displacement correlate by u 0.952, v 0.938; 9% of the signal"):  # fmt: skip
        assert sum(phrase in text for text in texts) == 1 + (phrase == "cannot be determined")


def test_missing_curves_and_truth_are_no_fault_of_the_result(copy):
    path = copy / "metrics.json"
    metrics = json.loads(path.read_text()) | {"views": [FIT, GOOD], "truth": "/nowhere/t.nc", "outcome": "epochs"}
    path.write_text(json.dumps(metrics | {"cc": 0.999, "l2_variation": 0.01}))
    (copy / "history.csv").unlink()
    result = ResultDirectory(copy).read()
    assert {gap.name for gap in result.missing} == {"history.csv", "truth"}
    assert result.truth is None
    assert worst([s for s in statements(result) if "masked" not in s.text]) == "note"
    (copy / "t.nc").write_bytes((copy / "volume.nc").read_bytes())  # a truth that was moved with the result is found
    assert ResultDirectory(copy).read().truth is not None


@pytest.mark.parametrize(
    ("name", "content", "phrase"),
    [
        ("metrics.json", '{"version": 1, "views": [1]}', "views"),
        pytest.param("metrics.json", '{"version": 1, "uncertainty": 2}', "uncertainty", marks=pytest.mark.slow),
        pytest.param("metrics.json", '{"version": 1, "coverage": {}}', "coverage", marks=pytest.mark.slow),
        pytest.param("metrics.json", "[]", "table", marks=pytest.mark.slow),
        ("history.csv", "a,b\n1,2\n", "seconds"),
    ],
)
def test_tables_of_another_kind_are_not_drawn(copy, name, content, phrase):
    (copy / name).write_text(content)
    (gap,) = [gap for gap in ResultDirectory(copy).read().missing if gap.name == name]
    assert phrase in gap.sentence
    if phrase != "views":  # few images are quicker
        (copy / "reprojection.nc").unlink()
    assert main(["report", str(copy)]) == 0


def test_a_liquid_has_no_temperature(tmp_path):
    grid = Grid(Box.cube(4.0), (4, 5, 6))
    volumes = derived(Volume(torch.zeros(grid.shape), grid, attributes={"n_ambient": 1.333}), "density", "temperature")
    result = Result(tmp_path, {"gas": {}}, volumes=volumes)
    assert any("not computed: the ambient index 1.333" in s.text and s.level == "warning" for s in statements(result))
    scene = re.search(r'<script type="application/json" id="scene">(.*?)</script>', html.render(result))
    assert "NaN" not in scene[1]


def test_masked_voxels_are_reported(tmp_path):
    volume = smooth((6, 5, 4))
    volume.values[:3] = -3e-4
    density = derive(volume, "density", GasSettings(uniform_pressure="yes"))
    sentences = statements(Result(tmp_path, volumes={"density": density}))
    assert any("60 voxels (50.00%)" in s.text and s.level == "warning" for s in sentences)


@pytest.fixture
def nothing(measurement) -> Reprojection:
    """The prediction of a field that is 0, as outside a visual hull."""
    return Reprojection(measurement, {"deflection": torch.zeros_like(measurement.displacement)})


def test_residuals_are_those_of_every_ray_through_the_box(measurement, nothing):
    residuals = residuals_over_sigma(nothing)["displacement"]
    valid = measurement.usable & measurement.sees_box
    assert residuals.size == 2 * int(valid.sum())
    rows = evaluate_views(nothing)
    pixels = [row["pixels"] for row in rows]
    rms = np.sqrt(sum(n * v["rms_over_sigma"] ** 2 for n, v in zip(pixels, rows, strict=True)) / sum(pixels))
    assert np.sqrt(np.mean(residuals**2)) == pytest.approx(rms, rel=1e-5)


def test_of_many_pixels_a_regular_lattice_is_used(measurement, nothing):
    count = measurement.displacement[..., 0].numel() // 9 + 1
    assert (lattice_step(measurement, 10**6), lattice_step(measurement, count)) == (1, 3)
    valid = (measurement.usable & measurement.sees_box)[:, ::3, ::3]
    expected = -(measurement.displacement / measurement.sigma)[:, ::3, ::3][valid]
    residuals = residuals_over_sigma(nothing, count)["displacement"]
    np.testing.assert_allclose(np.sort(residuals), np.sort(expected.flatten().numpy()), rtol=1e-5)


def test_images_shrink_along_each_edge(nothing, monkeypatch):
    assert {v.bin_size for v in view_images(nothing, [])[0]} == {(1, 1)}
    monkeypatch.setattr("nerif.report.view_images.MAX_PAGE_PIXELS", 6 * 5 * 14**2)
    assert {v.bin_size for v in view_images(nothing, [])[0]} == {(2, 2)}
    assert _shrink(np.ones((2, 900)), (1, 3)).shape == (2, 300)
    image = np.arange(24.0).reshape(4, 6)
    np.testing.assert_array_equal(_shrink(image, (2, 3)), [[4, 7], [16, 19]])
    image[0, 0] = np.nan
    assert np.isnan(_shrink(image, (2, 3))).tolist() == [[True, False], [False, False]]


def test_evaluating_again_uses_the_same_withheld_views(copy):
    path = copy / "metrics.json"
    assert main(["evaluate", str(copy), "--measurement", json.loads(path.read_text())["measurement"]]) == 0
    assert [v["name"] for v in json.loads(path.read_text())["views"] if v["withheld"]] == ["170deg"]


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(2.75123e-4, 3, "2.75 × 10⁻⁴"), (1454.2, 3, "1450"), (0.0, 3, "0"), (296.94, 4, "296.9"), (None, 3, "–"),
     (float("nan"), 3, "–")],
)  # fmt: skip
def test_printed_numbers(value, digits, text):
    assert number(value, digits) == text
