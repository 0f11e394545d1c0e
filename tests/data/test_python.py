"""Measurements, volumes and reconstructions as users of NumPy, xarray and PyVista expect them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import nerif
from nerif.data.cameras_file import CalibratedCamera
from refusals import refused


@pytest.fixture(scope="module")
def result(measurement):
    return nerif.Tikhonov(voxels=12, device="cpu", regularisation=1e-2)(measurement)


def test_each_is_one_line_of_text(measurement, result, ball, box):
    volume = result.volume(12)
    for thing, words in (
        (measurement, ("Measurement", "views", "px", "sigma known", measurement.names[0])),
        (volume, ("Volume", "index_excess", "voxels", "mm")),
        (result, ("Reconstruction", "refractive index", result.outcome.reason)),
    ):
        text = repr(thing)
        assert len(text) < 300
        assert "\n" not in text
        assert all(word in text for word in words), text
    masked = nerif.Volume(torch.full((2, 2, 2), torch.nan), nerif.Grid(box, (2, 2, 2)))
    assert "masked everywhere" in repr(masked)


@pytest.mark.usefixtures("unchecked")
def test_arrays_and_lists_become_tensors_and_other_things_are_refused_by_name(measurement, result, box, tmp_path):
    camera, array = measurement.cameras[0], np.asarray
    names = ("intrinsics", "rotation", "translation", "distortion")
    plane = nerif.Plane(array(camera.background.normal), camera.background.offset)
    other = replace(camera, background=plane, **{name: getattr(camera, name).tolist() for name in names})
    assert all(torch.equal(getattr(other, name), getattr(camera, name)) for name in names)
    again = replace(measurement, displacement=array(measurement.displacement), sigma=array(measurement.sigma))
    assert torch.equal(again.displacement, measurement.displacement)
    grid = nerif.Grid(box, (2, 3, 4))
    assert nerif.Volume(np.ones((2, 3, 4)), grid).values.dtype == torch.float32
    with refused("values"):
        nerif.Volume("field", grid)
    calibrated = tuple(CalibratedCamera.from_camera(c) for c in measurement.cameras)
    with refused("cameras"):
        replace(measurement, cameras=calibrated)
    for name in ("x.mat", "x.vti", "x"):
        with refused(tmp_path / name):
            measurement.write(tmp_path / name)
    with refused("grid"):
        result.volume(nerif.Grid(nerif.Box((0.0, 0.0, 0.0), tuple(2 * v for v in box.upper)), (4, 4, 4)))
    for field, value in (("pressure_pa", 1.013), ("wavelength_nm", 0.532)):
        with refused(field):
            nerif.GasSettings(**{field: value})


def test_single_voxels_are_not_the_range_that_is_shown(box):
    values = torch.full((20, 20, 20), 1600.0)
    values[0, 0, :4] = torch.tensor([3334.0, 150.0, 3000.0, 250.0])
    volume = nerif.Volume(values, nerif.Grid(box, (20, 20, 20)), "temperature", "K")
    for text in (repr(volume), dict(volume.summary())["Temperature"]):
        assert "1600 to 1600 K (0.1 to 99.9 %" in text


@pytest.mark.usefixtures("unchecked")
def test_views_by_name(measurement):
    first, *others = measurement.names
    assert measurement[first].names == (first,)
    assert measurement[[first, others[0]]].names == (first, others[0])
    assert measurement.select(first).names == (first,)
    assert measurement.drop(first).names == tuple(others)
    assert measurement.drop(first, others[0]).names == tuple(others[1:])
    with refused("view"):
        measurement[first[:-1]]
    with refused("view"):
        measurement[0]
    with refused("view"):
        measurement.select(["none such"])


def test_a_volume_is_an_array(result, tmp_path):
    volume = result.volume(12)
    array = np.asarray(volume)
    assert array.shape == volume.grid.shape
    assert np.array(volume, dtype=np.float64).dtype == np.float64
    assert np.asarray(volume, dtype=np.float64).dtype == np.float64
    assert float(np.max(volume)) == float(volume.values.max())
    labelled = volume.to_xarray()
    assert labelled.dims == ("z", "y", "x")
    assert labelled.attrs["units"] == "1"
    assert labelled.attrs["n_ambient"] == pytest.approx(1.00027)
    np.testing.assert_allclose(labelled.x, volume.grid.x)
    corner = [float(axis[0]) for axis in (volume.grid.z, volume.grid.y, volume.grid.x)]
    assert float(labelled.sel(dict(zip("zyx", corner, strict=True)))) == array[0, 0, 0]
    assert result.to_xarray(8).sizes["x"] <= 8
    volume.write(tmp_path / "v.nc")
    with refused(tmp_path / "v.nc"):
        volume.write(tmp_path / "v.nc")
    volume.write(tmp_path / "v.nc", force=True)
    again = nerif.read(tmp_path / "v.nc")
    torch.testing.assert_close(again.values, volume.values)
    result.write(tmp_path / "r.vti", 8)
    assert nerif.read(tmp_path / "r.vti").grid == result.volume(8).grid


def test_a_figure(result):
    from matplotlib import pyplot

    figure = result.plot(12)
    assert len(figure.axes) == 4
    assert figure.axes[-1].get_ylabel() or figure.axes[-1].get_xlabel()
    pyplot.close(figure)


def test_fields_take_lists_and_arrays(ball, result):
    points = [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]
    tensor = torch.tensor(points)
    for field in (ball, result.field):
        for points_as in (points, np.array(points), np.array(points, dtype=np.float32), points[1]):
            value, slope = field(points_as), field.gradient(points_as)
            expected = tensor[1] if points_as is points[1] else tensor
            torch.testing.assert_close(value, field(expected).float(), check_dtype=False)
            assert np.asarray(slope).shape == np.shape(points_as)
    with refused("points"):
        ball([1.0, 2.0])


def test_presets_with_changes():
    assert nerif.preset("fast", max_steps=500).max_steps == 500
    with refused("preset"):
        nerif.preset("fast", max_stepps=500)


def test_any_file_is_read(measurement, result, tmp_path):
    measurement.write(tmp_path / "m.nc")
    assert nerif.read(tmp_path / "m.nc").names == measurement.names
    nerif.reconstruct_into(
        tmp_path / "r", measurement, nerif.Tikhonov(voxels=8, device="cpu", regularisation=1e-2),
        nerif.RunSettings(report=False, withhold=("none",)),
    )  # fmt: skip
    assert nerif.read(tmp_path / "r").metrics.views
    with refused(tmp_path / "absent"):
        nerif.read(tmp_path / "absent")
    (tmp_path / "notes.txt").write_text("text")
    with refused(tmp_path / "notes.txt"):
        nerif.read(tmp_path / "notes.txt")
