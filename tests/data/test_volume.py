"""Volumes on disk: .nc, .vti and .csv, value for value."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import torch
import xarray as xr

from nerif.common.conventions import InputError
from nerif.data.exports import export
from nerif.data.volume import Volume
from nerif.data.volume_file import read_volume, write_netcdf
from nerif.geometry import Box, Grid
from refusals import refused

GRID = Grid(Box((-1.0, 2.0, -3.0), (3.0, 8.0, 7.0)), (5, 3, 4))
VALUES = torch.arange(60, dtype=torch.float32).reshape(5, 3, 4) * 1e-6


@pytest.fixture
def volumes() -> list[Volume]:
    attributes: dict[str, float | str] = {"n_ambient": 1.00027, "gas": "air"}
    return [
        Volume(VALUES, GRID, attributes=attributes),
        Volume(VALUES * 1e6 + 0.5, GRID, "density", "kg m-3", attributes),
    ]


@pytest.mark.parametrize("ending", ["nc", "vti"])
def test_round_trip(volumes, tmp_path, ending):
    path = tmp_path / f"v.{ending}"
    export(path, volumes)
    excess, density = read_volume(path), read_volume(path, "density")
    assert excess.quantity == "index_excess"
    assert torch.equal(excess.values, VALUES)
    assert torch.equal(density.values, volumes[1].values)
    assert density.unit == "kg m-3"
    assert excess.grid.shape == GRID.shape
    assert excess.grid.box.lower == pytest.approx(GRID.box.lower)
    assert excess.grid.box.upper == pytest.approx(GRID.box.upper)
    assert excess.attributes["n_ambient"] == 1.00027
    assert excess.attributes["gas"] == "air"
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize("mode", ["Ascii", "Binary", "Appended", "raw"])
@pytest.mark.parametrize("compressor", ["None", "ZLib"])
def test_images_as_vtk_writes_them(tmp_path, mode, compressor):
    """Every way that VTK has of writing an image, with its corner not at index 0."""
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


def test_csv(volumes, tmp_path):
    export(tmp_path / "v.csv", volumes)
    with (tmp_path / "v.csv").open() as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["x_mm", "y_mm", "z_mm", "index_excess [1]", "density [kg m-3]"]
    assert len(rows) == 61
    second = [float(x) for x in rows[2]]
    assert second == pytest.approx([0.5, 3.0, -2.0, 1e-6, 1.5])


def test_n_becomes_index_excess(tmp_path):
    n = Volume(VALUES.double() + 1.00027, GRID, "n", attributes={"n_ambient": 1.00027})
    write_netcdf(tmp_path / "n.nc", [n])
    back = read_volume(tmp_path / "n.nc")
    assert back.quantity == "index_excess"
    assert float((back.values - VALUES).abs().max()) < 1e-12


def test_n_stays_n_where_nobody_said_the_ambient_index(tmp_path):
    n = VALUES.double() + 1.00027
    write_netcdf(tmp_path / "n.nc", [Volume(n, GRID, "n")])
    back = read_volume(tmp_path / "n.nc")
    assert (back.quantity, back.n_ambient) == ("n", None)
    assert torch.equal(back.values, n)


@pytest.mark.parametrize("value", [float("nan"), 0.00027, "air"])
def test_ambient_index_that_cannot_be_one(tmp_path, value):
    write_netcdf(tmp_path / "n.nc", [Volume(VALUES, GRID, attributes={"n_ambient": value})])
    with refused("attribute n_ambient"):
        read_volume(tmp_path / "n.nc")


def test_a_volume_from_elsewhere(tmp_path):
    """Coordinates are enough: the box is half a voxel wider on each side; dimensions may come in any order."""
    values = np.random.default_rng(0).random((4, 3, 5)).astype(np.float32)
    coordinates = {"x": np.linspace(0, 3, 4), "y": np.linspace(-1, 1, 3), "z": np.linspace(10, 12, 5)}
    xr.Dataset({"cfd": (("x", "y", "z"), values)}, coords=coordinates).to_netcdf(tmp_path / "c.nc", engine="h5netcdf")
    volume = read_volume(tmp_path / "c.nc")
    assert volume.grid.shape == (5, 3, 4)
    assert volume.grid.box.lower == pytest.approx((-0.5, -1.5, 9.75))
    np.testing.assert_array_equal(volume.values.numpy(), values.transpose(2, 1, 0))


def test_a_part_cut_out_by_xarray_keeps_its_place(volumes, tmp_path):
    write_netcdf(tmp_path / "v.nc", volumes)
    with xr.open_dataset(tmp_path / "v.nc") as whole:
        whole.isel(z=slice(1, 4)).to_netcdf(tmp_path / "part.nc", engine="h5netcdf")
    part = read_volume(tmp_path / "part.nc")
    assert part.grid.box.lower == pytest.approx((-1, 2, -1))
    assert part.grid.box.upper == pytest.approx((3, 8, 5))
    assert torch.equal(part.values, VALUES[1:4])


def test_refusals(volumes, tmp_path):
    spoilt = Volume(torch.where(VALUES > 3e-5, torch.nan, VALUES), GRID)
    write_netcdf(tmp_path / "nan.nc", [spoilt])
    (tmp_path / "text.vti").write_text("no image")
    (tmp_path / "text.nc").write_text("no volume")
    xr.Dataset({"a": ("x", [1.0])}).to_netcdf(tmp_path / "flat.nc", engine="h5netcdf")
    export(tmp_path / "v.nc", volumes)
    for name, word in (
        ("nan.nc", "NaN"), ("text.vti", "not a VTK image"), ("text.nc", "not a readable"), ("flat.nc", "coordinates"),
        ("absent.nc", "no such file"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=f"{name}.*{word}"):
            read_volume(tmp_path / name)
    with pytest.raises(InputError, match="temperature"):
        read_volume(tmp_path / "v.nc", "temperature")
    with pytest.raises(InputError, match="stl"):
        export(tmp_path / "v.stl", volumes)
    with refused("volume 'index_excess'"):
        Volume(VALUES.movedim(0, 2), GRID)
