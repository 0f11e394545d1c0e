"""Files of volumes: written and read value for value, by nerif and by the readers of other programs."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
import xarray as xr

from nerif.common.conventions import InputError
from nerif.common.settings import merge
from nerif.data.volume import FORMATS, Volume, export, write_netcdf
from nerif.data.volume_file import read_volume, read_volumes
from nerif.geometry import Box, Grid
from nerif.physics.gas import GasSettings
from nerif.physics.media import MediumChanges
from nerif.physics.medium import derive
from refusals import refused

GRID = Grid(Box((-1.0, 2.0, -3.0), (3.0, 8.0, 7.0)), (5, 3, 4))
VALUES = torch.arange(60, dtype=torch.float32).reshape(5, 3, 4) * 1e-6


@pytest.fixture
def volumes() -> list[Volume]:
    """Index excess, n, density and temperature; one voxel with n < 1 and one too hot are masked."""
    excess = -1e-4 * torch.rand(GRID.shape, generator=torch.Generator().manual_seed(1))
    excess[1, 2, 3] = -3.0e-4  # n - 1 < 0
    excess[4, 0, 1] = -2.69e-4  # n - 1 = 1e-6: 80,000 K
    first = Volume(excess, GRID, attributes={"n_ambient": 1.00027})
    gas = GasSettings("N2", uniform_pressure="yes")
    return [derive(first, q, gas) for q in ("index_excess", "n", "density", "temperature")]


def test_masked_voxels_are_counted_and_explained(volumes):
    density, temperature = volumes[2:]
    assert torch.isnan(density.values).nonzero().tolist() == [[1, 2, 3]]
    assert torch.isnan(temperature.values).nonzero().tolist() == [[1, 2, 3], [4, 0, 1]]
    assert (density.notes["masked_voxels"], temperature.notes["masked_voxels"]) == (1, 2)
    assert "Gladstone-Dale" in density.notes["assumption"]
    assert "101325 Pa" in temperature.notes["assumption"]
    assert "N2" in temperature.notes["assumption"]


def test_the_gas_is_that_of_the_run_unless_changed():
    run = {"gas": {"composition": "CO2", "wavelength_nm": 633.0, "pressure_pa": 9e4}}
    changes = MediumChanges()
    assert changes.of(run) == GasSettings("CO2", 633.0, 9e4)
    assert merge(changes, {"gas.pressure_pa": 101325.0}).of(run) == GasSettings("CO2", 633.0)
    assert merge(changes, {"gas.composition": "N2"}).of({}) == GasSettings("N2")


def test_volumes_of_netcdf_3(volumes, tmp_path):
    path, classic = tmp_path / "v.nc", tmp_path / "classic.nc"
    write_netcdf(path, volumes)
    with xr.open_dataset(path) as dataset:
        dataset.to_netcdf(classic, engine="scipy", format="NETCDF3_64BIT")
    back = read_volumes(classic)
    for v in volumes:
        assert torch.equal(back[v.quantity].values.nan_to_num(-1), v.values.nan_to_num(-1))
        assert back[v.quantity].grid == v.grid


@pytest.mark.parametrize("ending", [".nc", ".vti", ".NC", ".Vti"])
def test_volumes_are_read_as_written(volumes, tmp_path, ending):
    path = tmp_path / f"v{ending}"
    export(path, volumes)
    back = read_volumes(path)
    assert list(back) == [v.quantity for v in volumes]
    for v in volumes:
        read = back[v.quantity]
        assert torch.equal(read.values.nan_to_num(-1), v.values.nan_to_num(-1))
        assert read.unit == v.unit
        assert {k: read.notes[k] for k in v.notes} == v.notes
        assert read.attributes["n_ambient"] == 1.00027
        assert read.grid.shape == GRID.shape
        assert [*read.grid.box.lower, *read.grid.box.upper] == pytest.approx([*GRID.box.lower, *GRID.box.upper])
    assert torch.equal(read_volume(path).values, volumes[0].values)
    assert torch.equal(read_volume(path, "density").values.nan_to_num(-1), volumes[2].values.nan_to_num(-1))


def test_every_format_leaves_only_its_file(volumes, tmp_path):
    for ending in FORMATS:
        export(tmp_path / f"v{ending}", volumes)
    assert {p.name for p in tmp_path.iterdir()} == {f"v{ending}" for ending in FORMATS}


FULL = """
import errno, resource, sys, torch
from nerif.data.volume import FORMATS, export
from nerif.data.volume import Volume
from nerif.geometry import Box, Grid
volume = Volume(torch.rand(30, 31, 32), Grid(Box.cube(1.0), (30, 31, 32)), attributes={"n_ambient": 1.00027})
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
for ending in FORMATS:
    try:
        export(sys.argv[1] + "/v" + ending, [volume])
    except OSError as error:
        print(ending, error.errno == errno.EFBIG, error.filename)
"""


@pytest.mark.skipif(os.name == "nt", reason="limits of POSIX")
def test_no_format_crashes_where_there_is_no_space(tmp_path):
    """As on a full disk, here by a limit of the size of files, in a process of its own: HDF5 ended it by a fault."""
    process = subprocess.run([sys.executable, "-c", FULL, str(tmp_path)], capture_output=True, text=True, timeout=100)
    assert process.returncode == 0, process.stderr
    assert process.stdout.splitlines() == [f"{ending} True {tmp_path / f'v{ending}'}" for ending in FORMATS]
    assert not list(tmp_path.iterdir())


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
    for z, y, x in ((0, 0, 0), (4, 2, 3), (1, 2, 0)):  # by coordinates, not by position in memory
        place = [float(GRID.axis(a)[i]) for a, i in zip("xyz", (x, y, z), strict=True)]
        point = image.FindPoint(*place)
        assert image.GetPoint(point) == pytest.approx(place)
        assert image.GetPointData().GetArray("index_excess").GetValue(point) == float(volumes[0].values[z, y, x])
    text = image.GetFieldData().GetAbstractArray("temperature.assumption").GetValue(0)
    assert text == volumes[3].notes["assumption"]


def test_npz_by_numpy(volumes, tmp_path):
    export(tmp_path / "v.npz", volumes)
    with np.load(tmp_path / "v.npz", allow_pickle=False) as data:
        for v in volumes:
            np.testing.assert_array_equal(data[v.quantity], v.values.numpy())
        np.testing.assert_array_equal(data["y_mm"], GRID.axis("y").numpy())
        about = json.loads(str(data["about"]))
    assert (about["n_ambient"], about["density.units"]) == (1.00027, "kg m-3")


def test_mat_by_scipy_and_pymatreader(volumes, tmp_path):
    from pymatreader import read_mat
    from scipy.io import loadmat

    export(tmp_path / "v.mat", volumes)
    data = loadmat(tmp_path / "v.mat")
    assert data["density"].shape == (4, 3, 5)  # x, y, z
    for v in volumes:
        np.testing.assert_array_equal(data[v.quantity].transpose(2, 1, 0), v.values.numpy())
    assert data["z_mm"].ravel().tolist() == GRID.axis("z").tolist()
    about = read_mat(tmp_path / "v.mat")["about"]
    assert about["gladstone_dale_m3_kg_1"] == pytest.approx(2.38e-4, rel=0.01)
    assert "Gladstone-Dale" in about["density_assumption"]


def test_csv_by_numpy(volumes, tmp_path):
    export(tmp_path / "v.csv", volumes)
    head = (tmp_path / "v.csv").read_text().splitlines()[0]
    assert head == "x_mm,y_mm,z_mm,index_excess [1],n [1],density [kg m-3],temperature [K]"
    table = np.loadtxt(tmp_path / "v.csv", delimiter=",", skiprows=1)
    assert table.shape == (60, 7)
    np.testing.assert_allclose(table[1, :4], [0.5, 3.0, -2.0, float(volumes[0].values[0, 0, 1])], rtol=1e-6)


@pytest.mark.parametrize("mode", ["Ascii", "Binary", "Appended", "raw"])
@pytest.mark.parametrize("compressor", ["None", "ZLib"])
def test_images_as_vtk_writes_them(tmp_path, mode, compressor):
    """Every encoding of VTK; the extent does not begin at index 0."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    image = vtkImageData()
    image.SetExtent(2, 5, 0, 2, 1, 5)
    image.SetSpacing(1.0, 2.0, 0.5)
    image.SetOrigin(-3.0, 1.0, 0.25)
    array = numpy_to_vtk(VALUES.double().numpy().ravel(), deep=True)
    array.SetName("index_excess")
    image.GetPointData().AddArray(array)
    writer = vtkXMLImageDataWriter()
    writer.SetFileName(str(tmp_path / "i.vti"))
    writer.SetInputData(image)
    getattr(writer, f"SetDataModeTo{mode.replace('raw', 'Appended')}")()
    writer.SetEncodeAppendedData(mode != "raw")
    getattr(writer, f"SetCompressorTypeTo{compressor}")()
    writer.Write()
    volume = read_volume(tmp_path / "i.vti")
    assert torch.allclose(volume.values, VALUES, rtol=1e-6)
    assert volume.grid.box.lower == pytest.approx((-1.5, 0.0, 0.5))
    assert volume.grid.box.upper == pytest.approx((2.5, 6.0, 3.0))
    image.SetDirectionMatrix(0, 1, 0, 1, 0, 0, 0, 0, 1)
    writer.Write()
    with pytest.raises(InputError, match="along the axes"):
        read_volume(tmp_path / "i.vti")


@pytest.mark.parametrize("n_ambient", [1.00027, None])
def test_n_becomes_index_excess_if_the_ambient_index_is_given(tmp_path, n_ambient):
    n = VALUES.double() + 1.00027
    write_netcdf(tmp_path / "n.nc", [Volume(n, GRID, "n", attributes={"n_ambient": n_ambient} if n_ambient else {})])
    back = read_volume(tmp_path / "n.nc")
    assert (back.quantity, back.n_ambient) == ("index_excess" if n_ambient else "n", n_ambient)
    assert float((back.values - (VALUES if n_ambient else n)).abs().max()) < 1e-12


@pytest.mark.parametrize("value", [float("nan"), 0.00027, "air"])
def test_invalid_ambient_index(tmp_path, value):
    write_netcdf(tmp_path / "n.nc", [Volume(VALUES, GRID, attributes={"n_ambient": value})])
    with refused("attribute n_ambient"):
        read_volume(tmp_path / "n.nc")


def test_volumes_of_other_programs_and_parts_of_volumes(volumes, tmp_path):
    """Coordinates determine the box; dimensions may come in any order."""
    values = np.random.default_rng(0).random((4, 3, 5)).astype(np.float32)
    coordinates = {"x": np.linspace(0, 3, 4), "y": np.linspace(-1, 1, 3), "z": np.linspace(10, 12, 5)}
    xr.Dataset({"cfd": (("x", "y", "z"), values)}, coords=coordinates).to_netcdf(tmp_path / "c.nc", engine="h5netcdf")
    volume = read_volume(tmp_path / "c.nc")
    assert volume.grid.shape == (5, 3, 4)
    assert volume.grid.box.lower == pytest.approx((-0.5, -1.5, 9.75))
    np.testing.assert_array_equal(volume.values.numpy(), values.transpose(2, 1, 0))
    write_netcdf(tmp_path / "v.nc", volumes)
    with xr.open_dataset(tmp_path / "v.nc") as whole:
        whole.isel(z=slice(1, 4)).to_netcdf(tmp_path / "part.nc", engine="h5netcdf")
    part = read_volume(tmp_path / "part.nc")
    assert part.grid.box.lower == pytest.approx((-1, 2, -1))
    assert part.grid.box.upper == pytest.approx((3, 8, 5))
    assert torch.equal(part.values, volumes[0].values[1:4])


def test_invalid_files(volumes, tmp_path):
    write_netcdf(tmp_path / "nan.nc", [Volume(torch.where(VALUES > 3e-5, torch.nan, VALUES), GRID)])
    (tmp_path / "text.vti").write_text("no image")
    (tmp_path / "text.nc").write_text("no volume")
    xr.Dataset({"a": ("x", [1.0])}).to_netcdf(tmp_path / "flat.nc", engine="h5netcdf")
    for name in ("nan.nc", "text.vti", "text.nc", "flat.nc", "absent.nc"):
        with pytest.raises(InputError, match=str(tmp_path / name)):
            read_volume(tmp_path / name)
    write_netcdf(tmp_path / "v.nc", volumes[:1])
    with refused(tmp_path / "v.nc"):
        read_volume(tmp_path / "v.nc", "temperature")
    with refused(tmp_path / "v.stl"):
        export(tmp_path / "v.stl", volumes)
    with refused("volume 'index_excess'"):
        Volume(VALUES.movedim(0, 2), GRID)


def test_a_quantity_that_is_masked_everywhere_is_read_and_an_index_is_not(tmp_path):
    grid = Grid.of_resolution(Box.cube(10.0), 4)
    nothing = torch.full(grid.shape, torch.nan)
    notes = {"masked_voxels": 64, "masked_where": "the pressure is not uniform"}
    index = Volume.of(nothing, grid, "index_excess", 1.00027)
    write_netcdf(tmp_path / "v.nc", [index, Volume(nothing, grid, "temperature", "K", notes=notes)])
    assert bool(read_volume(tmp_path / "v.nc", "temperature").values.isnan().all())
    for gaps in (False, True):
        with refused(tmp_path / "v.nc"):
            read_volume(tmp_path / "v.nc", gaps=gaps)
