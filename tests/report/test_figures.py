"""Figures for print, small images for pages, isosurfaces."""

from __future__ import annotations

import base64
import io
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nerif.analysis.metrics import LEVELS, coverage
from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.data.reprojection import Reprojection
from nerif.data.volume import Volume
from nerif.geometry import Box, Grid, Ring
from nerif.imaging.calibration.result import ImageError
from nerif.plotting import drawing
from nerif.plotting.notebook import show_views
from nerif.report import result_plots
from nerif.report.calibration_figure import draw_errors
from nerif.report.displacement_figure import save_displacements
from nerif.report.isosurface import default_level, draw_isosurface, stl_of, surface_triangles
from nerif.report.journal_figures import figures_of, slices, view
from nerif.report.journals import JOURNALS
from nerif.report.rig_figure import draw_two_sides
from nerif.report.slice_images import bar_image, slice_aspect, slice_image
from nerif.results.directory import Result, ResultDirectory
from nerif.results.metrics_file import Metrics

GRID = Grid(Box((-5.0, -4.0, -3.0), (5.0, 4.0, 3.0)), (12, 16, 20))


@pytest.fixture
def volume() -> Volume:
    """A ball beside the centre, in a box of three different edges."""
    x, y, z = GRID.points().unbind(-1)
    return Volume(-2e-4 * torch.exp(-((x - 1) ** 2 + y**2 + z**2) / 4), GRID, attributes={"n_ambient": 1.00027})


@pytest.mark.slow
def test_every_figure_is_complete(whole):
    """All expected; nothing beyond the edge of the paper; a unit on every axis; no empty panel."""
    names = []
    with drawing.style():
        for name, figure in figures_of(ResultDirectory(whole).read(), *JOURNALS["elsevier"]):
            FigureCanvasAgg(figure).draw()
            names.append(name)
            left, bottom, right, top = figure.get_tightbbox().extents
            width, height = figure.get_size_inches()
            assert min(left, bottom, width - right, height - top) > -0.01, name
            assert round(width * 25.4) in JOURNALS["elsevier"]
            for axes in figure.axes:
                assert axes.has_data() or axes.collections or axes.patches, name
                for label in (axes.get_xlabel(), axes.get_ylabel()):
                    assert not label or "[" in label, (name, label)
    quantities = ("n", "density", "temperature")
    expected = [*(f"slices_{q}" for q in quantities), *(f"slices_{q}_std" for q in quantities), "comparison"]
    expected += [f"isosurface_{q}" for q in quantities]
    expected += [f"view_{v}" for v in ("0deg", "56.6667deg", "113.333deg", "170deg")]
    expected += ["rig", "history", "residuals", "views", *(f"bands_{q}" for q in quantities)]
    assert names == [*expected, "reliability", "slice_scores"]


def figure_of_a_view(size: tuple[int, int], sigma: bool) -> Figure:
    """Displacements on a small image; the first pixel is invalid."""
    ring = Ring(views=2, image_size=size, pixel_pitch=0.2)
    d = torch.randn(2, *size, 2, generator=torch.Generator().manual_seed(0))
    d[:, 0, 0] = torch.nan
    noise = torch.full_like(d, 0.3) if sigma else None
    m = Measurement(ring.cameras(), d, Box((-9.0,) * 3, (9.0,) * 3), 1.00027, sigma=noise)
    return view(Reprojection(m, {"deflection": d.nan_to_num() + 0.1}, (m.names[1],)), 1, 190)


@pytest.mark.parametrize(("size", "lines"), [((1, 41), 1), ((2, 30), 2), ((41, 1), 1)])
def test_images_of_few_rows_are_drawn_as_lines(size, lines):
    figure = figure_of_a_view(size, sigma=size[0] != 2)
    FigureCanvasAgg(figure).draw()
    panels = figure.axes
    assert len(panels) == 2 * 2 * lines  # u and v, with their differences
    for above, below in zip(panels[::2], panels[1::2], strict=True):
        assert above.get_window_extent().height > 80  # px, at 100 an inch
        assert below.get_window_extent().height > 40
        assert not above.images
    assert panels[-1].get_xlabel() == ("row [px]" if size[0] > 3 else "column [px]")
    above, below = panels[:2]
    assert (above.get_ylabel(), below.get_ylabel()) == ("u [px]", "residual [px]")
    measured = above.containers[0].lines[0].get_ydata()
    assert np.isnan(measured[0])
    assert len(measured) == max(size)
    np.testing.assert_allclose(below.containers[0].lines[0].get_ydata()[1:], 0.1, atol=1e-5)
    assert above.containers[0].has_yerr == (size[0] != 2)
    assert above.get_title() == ("row 0" if lines == 2 else "")


def test_images_of_more_rows_are_maps():
    assert sum(len(axes.images) for axes in figure_of_a_view((20, 30), sigma=True).axes) == 6


def test_the_command_writes_pdf_and_png(copy, tmp_path, capsys):
    for name in ("volume.nc", "reprojection.nc"):  # few figures are quicker
        (copy / name).unlink()
    assert main(["figures", str(copy), "-o", str(tmp_path / "f"), "--journal", "nature", "--dpi", "50"]) == 0
    assert "not drawn: volume.nc is missing" in capsys.readouterr().out
    names = [f"{n}.{e}" for n in ("history", "reliability", "slice_scores", "views") for e in ("pdf", "png")]
    assert sorted(p.name for p in (tmp_path / "f").iterdir()) == [*names, "written.json"]
    assert (tmp_path / "f" / "views.pdf").read_bytes().startswith(b"%PDF")


def test_functions_return_the_axes_they_draw_into(volume, whole):
    result = ResultDirectory(whole).read()
    for draw, *data in (
        (drawing.draw_slice, volume, "y"),
        (drawing.draw_map, np.zeros((3, 4)), (-1.0, 1.0)),
        (result_plots.draw_history, result.history),
        (result_plots.draw_slice_scores, result.metrics.slices),
        (result_plots.draw_view_scores, result.metrics.views),
        (result_plots.draw_residuals, result_plots.residuals_over_sigma(result.reprojection)["displacement"]),
    ):
        axes = Figure().subplots()
        assert draw(axes, *data) is axes


def test_the_curves_of_a_run_on_voxels_are_residual_penalty_and_objective():
    record = {"step": 1.0, "seconds": 1.0, "voxels": 24.0, "bin_edge": 4.0, "weight": 1e-3, "residual": 0.5}
    record |= {"penalty": 0.2, "objective": 0.7, "residual_over_sigma": 1.5}
    axes = result_plots.draw_history(Figure().subplots(), [record, {**record, "seconds": 2.0, "bin_edge": 1.0}])
    labels = {str(line.get_label()) for line in axes.lines}
    assert labels >= {"residual", "penalty", "objective"}
    assert not labels & {"bin edge", "voxels", "weight"}


def test_a_slice_is_the_middle_one_upright(volume):
    axes = drawing.draw_slice(Figure().subplots(), volume, "z")
    image = axes.images[0]
    np.testing.assert_array_equal(image.get_array(), volume.values[6].double().numpy())
    assert image.get_extent() == [-5.0, 5.0, -4.0, 4.0]
    assert image.origin == "lower"
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [mm]", "y [mm]")


def test_the_isosurface_of_a_ball(volume):
    level = default_level(volume)
    assert level == pytest.approx(0.5 * float(volume.values.min()), rel=0.02)
    triangles = surface_triangles(volume, level)
    points = triangles.reshape(-1, 3)
    assert points.mean(axis=0) == pytest.approx([1, 0, 0], abs=0.15)
    assert np.linalg.norm(points - [1, 0, 0], axis=1).mean() == pytest.approx(2 * np.sqrt(np.log(2)), rel=0.05)
    masked = volume.values.clone()
    masked[5:7, 7:9, 10:12] = torch.nan  # inside the ball: no surface
    assert len(surface_triangles(Volume(masked, GRID), level)) == len(triangles)
    for flat in (torch.zeros(GRID.shape), torch.full(GRID.shape, torch.nan)):
        axes = Figure().add_subplot(projection="3d")
        assert draw_isosurface(axes, Volume(flat, GRID), default_level(Volume(flat, GRID))) is axes
        assert not axes.collections


def test_triangles_as_stl():
    corners = np.array([[[0, 0, 0], [2, 0, 0], [0, 3, 0]]], dtype=float)
    data = stl_of(corners)
    assert len(data) == 84 + 50
    numbers = np.frombuffer(data[84:132], "<f4").reshape(4, 3)
    assert numbers[0].tolist() == [0, 0, 1]
    assert np.array_equal(numbers[1:], corners[0])
    assert len(stl_of(np.zeros((0, 3, 3)))) == 84


@pytest.mark.slow
def test_names_of_views_become_names_of_files(whole):
    result = ResultDirectory(whole).read()
    m = result.reprojection.measurement
    names = ("a/b", "a b", "a$x_$", "é<")
    cameras = tuple(replace(c, name=name) for c, name in zip(m.cameras, names, strict=True))
    scores = {"withheld": False, "cc": 0.9, "rms": 0.1, "measured": "displacement", "unit": "px"}
    renamed = Result(
        whole,
        metrics=Metrics(views=[{"name": name, **scores} for name in names]),
        reprojection=replace(result.reprojection, measurement=replace(m, cameras=cameras)),
    )
    files = []
    for name, figure in figures_of(renamed, 90, 190):
        FigureCanvasAgg(figure).draw()
        files.append(name)
    assert files[:4] == ["view_a_b", "view_a_b_1", "view_a_x__", "view_é_"]


NAME = r"$\foo{$"
"""Of a view or quantity: no mathematics."""
SCORES = {"name": NAME, "withheld": False, "cc": 0.9, "rms": 0.1, "measured": "displacement", "unit": NAME}
CORRECTIONS = {"name": NAME, "values": {"shift_x": 0.1}, "prior_sigma": {"shift_x": 0.2}}
CAMERA = replace(Ring(views=1, image_size=(6, 8)).cameras()[0], name=NAME)
ERRORS = SimpleNamespace(names=(NAME,), errors=[ImageError(NAME, "1", 0.1, 9, True, False)], rms=lambda name: 0.1)
VIEWS = Measurement((CAMERA,), torch.zeros(1, 6, 8, 2), Box((-5, -5, -5), (5, 5, 5)), 1.00027)


@pytest.mark.parametrize(
    ("draw", "count"),
    [
        (lambda figure: result_plots.draw_view_scores(figure.subplots(), [SCORES]), 2),
        (lambda figure: result_plots.draw_corrections(figure.subplots(), [CORRECTIONS]), 1),
        (lambda figure: result_plots.draw_refined_rig(figure.subplots(), [CAMERA], [CORRECTIONS]), 1),
        (lambda figure: draw_two_sides(figure, [CAMERA]), 2),
        (lambda figure: draw_errors(figure.subplots(), ERRORS), 1),
        (lambda figure: figure.subplots().set_title(drawing.label_of(NAME)), 1),
        (lambda figure: show_views([NAME], torch.zeros(1, 6, 8, 1).numpy(), ("u",), "d [px]"), 0),
        (lambda figure: save_displacements(io.BytesIO(), VIEWS), 0),
    ],
)
def test_names_are_drawn_as_they_are(draw, count, monkeypatch):
    monkeypatch.setattr("nerif.report.displacement_figure.atomic", nullcontext)
    figure = Figure()
    draw(figure)
    canvas = io.StringIO()
    with drawing.style():
        figure.savefig(canvas, format="svg")
    assert canvas.getvalue().count(NAME) >= count


def test_the_colour_range_excludes_a_few_outliers(volume):
    values = volume.values.double().numpy().copy()
    assert drawing.colour_range(values) == (values.min(), values.max())
    values[0, 0, 0], values[0, 0, 1] = 1.0, np.nan
    low, high = drawing.colour_range(values)
    assert low == pytest.approx(-2e-4, rel=0.2)
    assert high < 1e-6
    page = slices(Volume(torch.from_numpy(values), GRID), 190)
    FigureCanvasAgg(page).draw()
    assert len(page.axes) == 4
    FigureCanvasAgg(slices(Volume(torch.full(GRID.shape, torch.nan), GRID, "temperature", "K"), 190)).draw()


@pytest.mark.parametrize(
    ("quantity", "label"),
    [("n", "n − 1 [1]"), ("density_std", "standard deviation of density [kg m⁻³]"),
     ("temperature_std", "standard deviation of temperature [K]"), ("concentration", "concentration [1]")],
)  # fmt: skip
def test_labels_have_units(quantity, label):
    assert drawing.label_of(quantity) == label


def pixels(address: str) -> np.ndarray:
    """Red, green, blue of a data address."""
    return iio.imread(io.BytesIO(base64.b64decode(address.partition(",")[2])))[..., :3].astype(int)


def test_a_small_slice_is_upright_and_at_its_index():
    values = torch.zeros(5, 4, 3)
    values[4, 1, 2], values[0, 0, 0] = 1.0, torch.nan
    volume = Volume(values, Grid(Box((0, 0, 0), (6, 4, 10)), (5, 4, 3)), "density", "kg m-3")
    across_y = pixels(slice_image(volume, "y", 1, (0.0, 1.0), "gray"))
    assert across_y.shape == (5, 3, 3)
    assert across_y[0, 2].tolist() == [255] * 3  # the highest z above, x to the right
    assert across_y.sum() == 3 * 255
    across_x = pixels(slice_image(volume, "x", -7, (0.0, 1.0), "gray"))  # clamped
    assert across_x[4, 0].tolist() == [190] * 3
    assert slice_aspect(volume, "y") == 0.6
    assert pixels(bar_image("gray"))[0, [0, -1], 0].tolist() == [0, 255]
    index = Volume(torch.full((2, 3, 4), 1.0003, dtype=torch.float64), Grid(Box.cube(2), (2, 3, 4)), "n")
    assert 120 < pixels(slice_image(index, "z", 0, (0.0002, 0.0004), "gray")).mean() < 135  # n - 1


WIDTH = 2 * result_plots.BAND_SIGMAS


@pytest.mark.parametrize(("quantity", "below", "above"), [("density", WIDTH, WIDTH), ("temperature", 7, 11)])
def test_bands_are_those_of_the_percentiles_else_of_the_deviation(quantity, below, above):
    grid = Grid(Box((-4.0, -3.0, -2.0), (4.0, 3.0, 2.0)), (4, 6, 8))
    ramp = torch.arange(4 * 6 * 8, dtype=torch.float32).reshape(grid.shape)
    std = torch.full(grid.shape, 2.0)
    values = {"density": ramp, "density_std": std, "temperature": 300 + ramp, "temperature_std": std}
    values |= {"temperature_p05": 293 + ramp, "temperature_p95": 311 + ramp}
    volumes = {name: Volume(x, grid, name) for name, x in values.items()}
    assert result_plots.banded(volumes) == ["density", "temperature"]
    axes = result_plots.draw_bands(Figure().subplots(), volumes, quantity)
    lines, extents = axes.get_lines(), axes.collections[0].get_paths()[0].get_extents()
    assert [line.get_label() for line in lines] == ["along x", "along y", "along z"]
    line = values[quantity][2, 3]
    np.testing.assert_allclose(lines[0].get_xdata(), np.arange(-3.5, 4))
    np.testing.assert_allclose(lines[0].get_ydata(), line.numpy())
    assert extents.y0 == pytest.approx(float(line.min()) - below, rel=1e-5)
    assert extents.y1 == pytest.approx(float(line.max()) + above, rel=1e-5)


def test_a_reliability_diagram_is_the_diagonal_for_correct_deviations():
    rng = np.random.default_rng(0)
    std = rng.uniform(0.5, 2.0, 40000)
    flow = np.ones(std.shape, dtype=bool)
    flow[::2] = False
    scores = coverage(std * rng.standard_normal(std.shape), std, flow)
    np.testing.assert_allclose(scores["reliability"], LEVELS, atol=0.02)
    assert scores["two_sigma"] == pytest.approx(0.954, abs=0.005)
    assert scores["one_sigma_in_flow"] == pytest.approx(0.683, abs=0.01)
    assert 0.2 < scores["spearman"] < 0.6
    line = result_plots.draw_reliability(Figure().subplots(), scores).get_lines()[1]
    np.testing.assert_allclose(line.get_ydata(), scores["reliability"])
    underestimated = coverage(2 * std * rng.standard_normal(std.shape), std, flow)
    assert underestimated["two_sigma_in_flow"] == pytest.approx(0.683, abs=0.02)
