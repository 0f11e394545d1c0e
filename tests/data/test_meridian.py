"""The half plane of a symmetric flow: what it reads of volumes, its files and its images in a result."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from nerif.cli.cli import main
from nerif.data.meridian import Meridian
from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, paper_rig
from nerif.geometry.symmetry import Symmetry
from nerif.report.meridian_figure import draw_centre_line, draw_profiles
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import simulate


def test_it_is_the_field_around_the_axis():
    box = Box.cube(50.0)
    phantom, grid = make_phantom("gaussian-jet", box, 0), Grid.of_resolution(box, 80)
    symmetry = Symmetry.about("axis", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.01)
    meridian = Meridian.of({"index_excess": Volume.of(phantom.sample(grid), grid, "index_excess", 1.00027)}, symmetry)
    import torch

    h, r = torch.meshgrid(torch.from_numpy(meridian.h), torch.from_numpy(meridian.r), indexing="ij")
    truth = phantom(symmetry.places(r, torch.zeros_like(r), h)).numpy()
    inside = np.isfinite(meridian.quantities["index_excess"])
    error = (meridian.quantities["index_excess"] - truth)[inside]
    assert inside.mean() > 0.95
    assert np.linalg.norm(error) < 0.02 * np.linalg.norm(truth[inside])
    line = meridian.profile("index_excess", 3.1)
    assert line[0] == pytest.approx(float(phantom(torch.tensor([[0.0, 0.0, 3.1]], dtype=torch.float64))), rel=0.02)


def test_it_is_missing_where_most_azimuths_are():
    """A sector of 216 of 360 degrees without values leaves none around the axis; one of 144 degrees leaves all."""
    grid = Grid.of_resolution(Box.cube(20.0), 20)
    symmetry = Symmetry.about("axis", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.01)
    x, y, _ = grid.points().unbind(-1)
    for degrees, missing in ((216, True), (144, False)):
        values = x.new_ones(x.shape).masked_fill(y.atan2(x).rad2deg() % 360 < degrees, np.nan)
        volume = Volume.of(values, grid, "index_excess", 1.00027)
        meridian = Meridian.of({"index_excess": volume}, symmetry)
        ring = meridian.quantities["index_excess"][5, (meridian.r > 5) & (meridian.r < 9)]
        assert np.isnan(ring).all() == missing
        assert np.isfinite(ring).all() != missing


def of_numbers(axial: bool = True, **quantities: float) -> Meridian:
    """Quantities that are the same everywhere, but for what they grow along h."""
    r, h = np.linspace(0 if axial else -3, 3, 7), np.linspace(-2, 2, 5)
    grown = np.broadcast_to(1e-9 * h[:, None], (5, 7))
    return Meridian(r, h, {name: value + grown for name, value in quantities.items()}, axial)


def test_files_keep_the_digits_of_n(tmp_path):
    meridian = of_numbers(n=1.000271234567, density=1.2)
    meridian.write(tmp_path / "m.nc")
    meridian.write_csv(tmp_path / "m.csv")
    table = np.genfromtxt(tmp_path / "m.csv", delimiter=",", names=True)
    with xr.open_dataset(tmp_path / "m.nc") as data:
        assert data["density"].dtype == np.float32
        np.testing.assert_array_equal(data["n"].values, meridian.quantities["n"])
        np.testing.assert_allclose(table["n"], meridian.quantities["n"].ravel(), rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("quantity", "others", "line", "low", "high"),
    [
        ("density", {"density_std": 0.1}, 1.2, 1.2 - 0.1645, 1.2 + 0.1645),
        ("temperature", {"temperature_std": 5, "temperature_p05": 280, "temperature_p95": 340}, 300, 280, 340),
        ("n", {"n_std": 1e-5}, 2.7e-4, 2.7e-4 - 1.645e-5, 2.7e-4 + 1.645e-5),
    ],
)
def test_bands_are_those_of_the_percentiles_else_about_the_mean(quantity, others, line, low, high):
    meridian = of_numbers(density=1.2, temperature=300, n=1.00027, **others)
    for draw in (draw_profiles, draw_centre_line):
        axes = draw(Figure().subplots(), meridian, quantity)
        band = axes.collections[0].get_paths()[0].get_extents()
        assert axes.get_lines()[0].get_ydata()[0] == pytest.approx(line, rel=1e-4)
        assert (band.y0, band.y1) == pytest.approx((low, high), rel=1e-4)


def test_only_an_axial_flow_has_an_axis():
    assert draw_centre_line(Figure().subplots(), of_numbers(n=1.1), "n").get_ylabel() == "n − 1 [1] on the axis"
    planar = draw_centre_line(Figure().subplots(), of_numbers(False, n=1.1), "n")
    assert planar.get_ylabel() == "n − 1 [1] at r = 0.0 mm"


@pytest.mark.slow
def test_a_result_has_it_as_files_and_in_the_report(tmp_path):
    cameras, box = paper_rig(24)
    measured = simulate(make_phantom("gaussian-jet", box, 0), cameras[:1], box, 1.00027, 0.03, 0)
    measured.write(tmp_path / "m.nc")
    quick = ["--symmetry", "axis", "--method", "tikhonov", "--voxels", "16", "--uncertainty", "fast"]
    assert main(["reconstruct", str(tmp_path / "m.nc"), "-o", str(tmp_path / "r"), *quick]) == 0
    with xr.open_dataset(tmp_path / "r" / "meridian.nc") as data:
        assert data["density"].dims == ("h", "r")
        assert data["density"].attrs["units"] == "kg m-3"
        assert float(data["density_std"].max()) > 0
        shape = data["density"].shape
    table = np.genfromtxt(tmp_path / "r" / "meridian.csv", delimiter=",", names=True)
    assert len(table) == shape[0] * shape[1]
    assert "density_std" in table.dtype.names
    page = (tmp_path / "r" / "report.html").read_text()
    assert "Around the axis" in page
    assert "Density in a plane through the axis" in page
    assert ResultDirectory(tmp_path / "r").read().meridian is not None
