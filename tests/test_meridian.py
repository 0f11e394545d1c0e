"""The half plane of a symmetric flow: what it reads of volumes, its files and its pictures in a result."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from nerif.cli import main
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, paper_rig
from nerif.geometry.symmetry import Symmetry
from nerif.meridian import Meridian
from nerif.result import ResultDirectory
from nerif.simulation import simulate
from nerif.volume import Volume


def test_it_is_the_field_around_the_axis():
    box = Box.cube(50.0)
    phantom, grid = make_phantom("gaussian-jet", box, 0), Grid.of_resolution(box, 80)
    symmetry = Symmetry.about("axis", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.01)
    found = Meridian.of({"index_excess": Volume.of(phantom.sample(grid), grid, "index_excess", 1.00027)}, symmetry)
    import torch

    h, r = torch.meshgrid(torch.from_numpy(found.h), torch.from_numpy(found.r), indexing="ij")
    truth = phantom(symmetry.places(r, torch.zeros_like(r), h)).numpy()
    known = np.isfinite(found.quantities["index_excess"])
    apart = (found.quantities["index_excess"] - truth)[known]
    assert known.mean() > 0.95
    assert np.linalg.norm(apart) < 0.02 * np.linalg.norm(truth[known])
    line = found.profile("index_excess", 3.1)
    assert line[0] == pytest.approx(float(phantom(torch.tensor([[0.0, 0.0, 3.1]], dtype=torch.float64))), rel=0.02)


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
