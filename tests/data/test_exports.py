"""Files for other programs, opened by those programs' own readers and compared value for value."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
import xarray as xr

from nerif.data.exports import FORMATS, export
from nerif.data.volume import Volume
from nerif.data.volume_file import read_volumes
from nerif.geometry import Box, Grid
from nerif.physics.quantities import GasChanges, GasSettings, derive

GRID = Grid(Box((-1.0, 2.0, -3.0), (3.0, 8.0, 7.0)), (5, 3, 4))


@pytest.fixture
def volumes() -> list[Volume]:
    """A warm spot, a voxel of n < 1 and one too hot: both have to be masked where they stand."""
    excess = -1e-4 * torch.rand(GRID.shape, generator=torch.Generator().manual_seed(1))
    excess[1, 2, 3] = -3.0e-4  # n - 1 < 0
    excess[4, 0, 1] = -2.69e-4  # n - 1 = 1e-6: 80,000 K
    first = Volume(excess, GRID, attributes={"n_ambient": 1.00027})
    return [derive(first, q, GasSettings("N2")) for q in ("index_excess", "n", "density", "temperature")]


def test_masked_voxels_are_counted_and_explained(volumes):
    density, temperature = volumes[2:]
    assert torch.isnan(density.values).nonzero().tolist() == [[1, 2, 3]]
    assert torch.isnan(temperature.values).nonzero().tolist() == [[1, 2, 3], [4, 0, 1]]
    assert (density.notes["masked_voxels"], temperature.notes["masked_voxels"]) == (1, 2)
    assert "Gladstone-Dale" in density.notes["assumption"]
    assert "101325 Pa" in temperature.notes["assumption"]
    assert "N2" in temperature.notes["assumption"]


def test_the_gas_is_that_of_the_run_unless_it_is_changed():
    run = {"gas": {"composition": "CO2", "wavelength_nm": 633.0, "pressure_pa": 9e4}}
    assert GasChanges().of(run) == GasSettings("CO2", 633.0, 9e4)
    assert GasChanges(pressure_pa=8e4).of(run) == GasSettings("CO2", 633.0, 8e4)
    assert GasChanges("N2").of({}) == GasSettings("N2")


def test_netcdf_by_xarray(volumes, tmp_path):
    export(tmp_path / "v.nc", volumes)
    with xr.open_dataset(tmp_path / "v.nc") as data:
        for v in volumes:
            np.testing.assert_array_equal(data[v.quantity].values, v.values.numpy())
            assert data[v.quantity].dims == ("z", "y", "x")
            assert data[v.quantity].attrs["units"] == v.unit
            assert data[v.quantity].attrs["long_name"]
        assert data.attrs["Conventions"].startswith("CF-")
        assert {"title", "source", "history", "references"} <= set(data.attrs)
        assert data.attrs["gas"] == "N2"
        for axis in "xyz":
            assert data[axis].attrs["axis"] == axis.upper()
            np.testing.assert_array_equal(data[axis].values, GRID.axis(axis).numpy())
        assert data["temperature"].attrs["masked_voxels"] == 2
        assert "ideal gas" in data["temperature"].attrs["assumption"]


def test_vti_by_vtk(volumes, tmp_path):
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    export(tmp_path / "v.vti", volumes)
    reader = vtkXMLImageDataReader()
    reader.SetFileName(str(tmp_path / "v.vti"))
    reader.Update()
    image = reader.GetOutput()
    for v in volumes:
        array = image.GetPointData().GetArray(v.quantity)
        np.testing.assert_array_equal(vtk_to_numpy(array).reshape(GRID.shape), v.values.numpy())
    for z, y, x in ((0, 0, 0), (4, 2, 3), (1, 2, 0)):  # by place, not by position in memory
        place = [float(GRID.axis(a)[i]) for a, i in zip("xyz", (x, y, z), strict=True)]
        point = image.FindPoint(*place)
        assert image.GetPoint(point) == pytest.approx(place)
        assert image.GetPointData().GetArray("index_excess").GetValue(point) == float(volumes[0].values[z, y, x])
    said = image.GetFieldData().GetAbstractArray("temperature.assumption").GetValue(0)
    assert said == volumes[3].notes["assumption"]


def test_npz_by_numpy(volumes, tmp_path):
    export(tmp_path / "v.npz", volumes)
    with np.load(tmp_path / "v.npz", allow_pickle=False) as data:
        for v in volumes:
            np.testing.assert_array_equal(data[v.quantity], v.values.numpy())
        np.testing.assert_array_equal(data["y_mm"], GRID.axis("y").numpy())
        about = json.loads(str(data["about"]))
    assert about["n_ambient"] == 1.00027
    assert about["density.units"] == "kg m-3"


def test_mat_by_scipy_and_pymatreader(volumes, tmp_path):
    from pymatreader import read_mat
    from scipy.io import loadmat

    export(tmp_path / "v.mat", volumes)
    data = loadmat(tmp_path / "v.mat")
    assert data["density"].shape == (4, 3, 5)  # x, y, z
    for v in volumes:
        np.testing.assert_array_equal(data[v.quantity][3, 1, 2], v.values.numpy()[2, 1, 3])
        np.testing.assert_array_equal(data[v.quantity].transpose(2, 1, 0), v.values.numpy())
    assert data["z_mm"].ravel().tolist() == GRID.axis("z").tolist()
    about = read_mat(tmp_path / "v.mat")["about"]
    assert about["gladstone_dale_m3_kg_1"] == pytest.approx(2.38e-4, rel=0.01)
    assert "Gladstone-Dale" in about["density_assumption"]


@pytest.mark.parametrize("ending", [".nc", ".vti"])
def test_all_quantities_come_back_with_their_notes(volumes, tmp_path, ending):
    export(tmp_path / f"v{ending}", volumes)
    back = read_volumes(tmp_path / f"v{ending}")
    assert list(back) == [v.quantity for v in volumes]
    for v in volumes:
        assert torch.equal(back[v.quantity].values.nan_to_num(-1), v.values.nan_to_num(-1))
        assert back[v.quantity].unit == v.unit
        assert {k: back[v.quantity].notes[k] for k in v.notes} == v.notes


def test_nothing_half_written_is_left(volumes, tmp_path):
    for ending in FORMATS:
        export(tmp_path / f"v{ending}", volumes)
    assert {p.suffix for p in tmp_path.iterdir()} == set(FORMATS)
