"""Figures for print: every one is there, nothing clipped, units on every axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.data.reprojection import Reprojection
from nerif.data.volume import Volume
from nerif.geometry import Box, Grid, Ring
from nerif.plotting import drawing
from nerif.report import figures
from nerif.report.isosurface import default_level, draw_isosurface, surface_triangles
from nerif.report.pages import JOURNALS, figures_of, residuals_over_sigma, slices, view
from nerif.results.directory import Result, ResultDirectory


@pytest.fixture
def volume() -> Volume:
    """A ball off the middle, in a box of three different edges."""
    grid = Grid(Box((-5.0, -4.0, -3.0), (5.0, 4.0, 3.0)), (12, 16, 20))
    x, y, z = grid.points().unbind(-1)
    return Volume(-2e-4 * torch.exp(-((x - 1) ** 2 + y**2 + z**2) / 4), grid, attributes={"n_ambient": 1.00027})


@pytest.mark.slow
def test_every_figure_is_whole(whole):
    """The names expected; nothing beyond the edge of the paper; a unit on every axis and colour bar; no empty panel."""
    result = ResultDirectory(whole).read()
    names = []
    with drawing.style():
        for name, figure in figures_of(result, *JOURNALS["elsevier"]):
            FigureCanvasAgg(figure).draw()
            names.append(name)
            inches = figure.get_tightbbox().extents
            width, height = figure.get_size_inches()
            assert inches[0] > -0.01, name
            assert inches[1] > -0.01, name
            assert inches[2] < width + 0.01, name
            assert inches[3] < height + 0.01, name
            assert round(width * 25.4) in JOURNALS["elsevier"]
            for axes in figure.axes:
                assert axes.has_data() or axes.collections or axes.patches, name
                for label in (axes.get_xlabel(), axes.get_ylabel()):
                    assert not label or "[" in label, (name, label)
    quantities = [f"{q}{s}" for s in ("", "_std") for q in ("n", "density", "temperature")]
    views = ["0deg", "56.6667deg", "113.333deg", "170deg"]
    expected = [f"slices_{q}" for q in quantities] + ["comparison"]
    expected += [f"isosurface_{q}" for q in ("n", "density", "temperature")] + [f"view_{v}" for v in views]
    bands = [f"bands_{q}" for q in ("n", "density", "temperature")]
    assert names == [*expected, "residuals", "rig", "views", *bands, "reliability", "history", "slice_scores"]


def figure_of_a_view(size: tuple[int, int], sigma: bool) -> Figure:
    """Of displacements on a small image, of which the first pixel is not valid."""
    ring = Ring(views=2, image_size=size, pixel_pitch=0.2)
    generator = torch.Generator().manual_seed(0)
    d = torch.randn(2, *size, 2, generator=generator)
    d[:, 0, 0] = torch.nan
    noise = torch.full_like(d, 0.3) if sigma else None
    m = Measurement(ring.cameras(), d, Box((-9.0,) * 3, (9.0,) * 3), 1.00027, sigma=noise)
    return view(Reprojection(m, {"deflection": d.nan_to_num() + 0.1}, (m.names[1],)), 1, 190)


@pytest.mark.parametrize(("size", "lines"), [((1, 41), 1), ((2, 30), 2), ((41, 1), 1)])
def test_images_of_few_rows_are_drawn_as_lines(size, lines):
    figure = figure_of_a_view(size, sigma=size[0] != 2)
    FigureCanvasAgg(figure).draw()
    panels = figure.axes
    assert len(panels) == 2 * 2 * lines  # u and v, the difference below each
    for above, below in zip(panels[::2], panels[1::2], strict=True):
        assert above.get_window_extent().height > 80  # px, at 100 an inch
        assert below.get_window_extent().height > 40
        assert not above.images
    assert panels[-1].get_xlabel() == ("row [px]" if size[0] > 3 else "column [px]")
    above, below = panels[:2]
    assert (above.get_ylabel(), below.get_ylabel()) == ("u [px]", "difference [px]")
    drawn = above.containers[0].lines[0].get_ydata()
    assert np.isnan(drawn[0])
    assert len(drawn) == max(size)
    np.testing.assert_allclose(below.containers[0].lines[0].get_ydata()[1:], 0.1, atol=1e-5)
    assert above.containers[0].has_yerr == (size[0] != 2)
    assert above.get_title() == ("row 0" if lines == 2 else "")


def test_images_of_more_rows_are_maps():
    figure = figure_of_a_view((20, 30), sigma=True)
    assert sum(len(axes.images) for axes in figure.axes) == 6


def test_the_command_writes_pdf_and_png(copy, tmp_path, capsys):
    for name in ("volume.nc", "reprojection.nc"):  # few figures are quicker
        (copy / name).unlink()
    assert main(["figures", str(copy), "-o", str(tmp_path / "f"), "--journal", "nature", "--dpi", "50"]) == 0
    out = capsys.readouterr().out
    assert "not drawn: volume.nc is not there" in out
    assert sorted(p.name for p in (tmp_path / "f").iterdir()) == [
        *(f"{n}.{e}" for n in ("history", "reliability", "slice_scores", "views") for e in ("pdf", "png")),
        "written.json",
    ]
    assert (tmp_path / "f" / "views.pdf").read_bytes().startswith(b"%PDF")


def test_functions_give_back_the_axes_they_take(volume, whole):
    result = ResultDirectory(whole).read()
    assert result.reprojection is not None
    figure = Figure()
    for draw, *data in (
        (drawing.draw_slice, volume, "y"),
        (drawing.draw_map, np.zeros((3, 4)), (-1.0, 1.0)),
        (figures.draw_history, result.history, "nerif"),
        (figures.draw_slice_scores, result.metrics["slices"]),
        (figures.draw_view_scores, result.metrics["views"]),
        (figures.draw_residuals, residuals_over_sigma(result.reprojection)["displacement"]),
    ):
        axes = Figure().subplots()
        assert draw(axes, *data) is axes
    space = figure.add_subplot(projection="3d")
    assert draw_isosurface(space, volume, default_level(volume)) is space


def test_the_curves_of_a_run_on_voxels_are_residual_penalty_and_objective():
    record = {"step": 1.0, "seconds": 1.0, "voxels": 24.0, "bin_edge": 4.0, "weight": 1e-3, "residual": 0.5}
    record |= {"penalty": 0.2, "objective": 0.7, "residual_over_sigma": 1.5}
    axes = figures.draw_history(Figure().subplots(), [record, {**record, "seconds": 2.0, "bin_edge": 1.0}], "tikhonov")
    drawn = {str(line.get_label()) for line in axes.lines}
    assert drawn >= {"residual", "penalty", "objective"}
    assert not drawn & {"bin edge", "voxels", "weight"}


def test_a_slice_is_the_middle_one_the_right_way_up(volume):
    axes = Figure().subplots()
    drawing.draw_slice(axes, volume, "z")
    image = axes.images[0]
    np.testing.assert_array_equal(image.get_array(), volume.values[6].double().numpy())
    assert image.get_extent() == [-5.0, 5.0, -4.0, 4.0]
    assert image.origin == "lower"
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [mm]", "y [mm]")


def test_the_isosurface_stands_where_the_ball_is(volume):
    level = default_level(volume)
    assert level == pytest.approx(0.5 * float(volume.values.min()), rel=0.02)
    points = surface_triangles(volume, level).reshape(-1, 3)
    assert points.mean(axis=0) == pytest.approx([1, 0, 0], abs=0.15)
    radius = np.linalg.norm(points - [1, 0, 0], axis=1)
    assert radius.mean() == pytest.approx(2 * np.sqrt(np.log(2)), rel=0.05)


def test_masked_voxels_have_no_surface_of_their_own(volume):
    level = default_level(volume)
    whole = surface_triangles(volume, level)
    holed = volume.values.clone()
    holed[5:7, 7:9, 10:12] = torch.nan  # inside the ball
    masked = surface_triangles(Volume(holed, volume.grid), level)
    assert len(masked) == len(whole)


@pytest.mark.slow
def test_names_of_views_become_names_of_files(whole):
    result = ResultDirectory(whole).read()
    assert result.reprojection is not None
    m = result.reprojection.measurement
    odd = ("a/b", "a b", "a$x_$", "é<")
    cameras = tuple(replace(c, name=name) for c, name in zip(m.cameras, odd, strict=True))
    scores = {"withheld": False, "cc": 0.9, "rms": 0.1, "measured": "displacement", "unit": "px"}
    views = [{"name": name, **scores} for name in odd]
    renamed = Result(
        whole,
        metrics={"views": views},
        reprojection=replace(result.reprojection, measurement=replace(m, cameras=cameras)),
    )
    names = []
    for name, figure in figures_of(renamed, 90, 190):
        FigureCanvasAgg(figure).draw()
        names.append(name)
    assert names[:4] == ["view_a_b", "view_a_b_1", "view_a_x__", "view_é_"]


def test_a_flat_volume_has_no_surface_and_no_error():
    grid = Grid(Box.cube(4.0), (4, 5, 6))
    for values in (torch.zeros(grid.shape), torch.full(grid.shape, torch.nan)):
        space = Figure().add_subplot(projection="3d")
        flat = Volume(values, grid)
        draw_isosurface(space, flat, default_level(flat))
        assert not space.collections


def test_colours_do_not_go_to_a_few_outliers(volume):
    values = volume.values.double().numpy().copy()
    assert drawing.colour_range(values) == (values.min(), values.max())
    values[0, 0, 0] = 1.0
    values[0, 0, 1] = np.nan
    low, high = drawing.colour_range(values)
    assert low == pytest.approx(-2e-4, rel=0.2)
    assert high < 1e-6
    page = slices(Volume(torch.from_numpy(values), volume.grid), 190)
    FigureCanvasAgg(page).draw()
    assert len(page.axes) == 4
    everywhere_masked = Volume(torch.full(volume.grid.shape, torch.nan), volume.grid, "temperature", "K")
    FigureCanvasAgg(slices(everywhere_masked, 190)).draw()


@pytest.mark.parametrize(
    ("quantity", "label"),
    [
        ("n", "n − 1 [1]"),
        ("density_std", "standard deviation of density [kg m⁻³]"),
        ("temperature_std", "standard deviation of temperature [K]"),
        ("concentration", "concentration [1]"),
    ],
)
def test_labels_carry_units(quantity, label):
    assert drawing.label_of(quantity) == label
