"""Times of films: in any unit of the CF conventions, as xarray saves them again, and never off by 1000."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from nerif.common.conventions import InputError
from nerif.common.times import same_instants, seconds, whole_steps
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.velocity_sequence import VelocitySequence
from nerif.data.volume import Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.geometry import Box, Grid, Ring
from nerif.imaging.readers.open import open_frames
from nerif.workflow.film_velocity import velocity_of_film

TIMES = (0.0, 0.004, 0.008, 0.016)
BOX = Box.cube(50.0)


@pytest.mark.parametrize(
    ("numbers", "units", "expected"),
    [
        ([0, 4, 8], "ms", [0, 0.004, 0.008]),
        ([0, 4, 8], "milliseconds since 2024-05-03 12:00:00.5", [0, 0.004, 0.008]), ([1.5, 2], "Minutes", [90, 120]),
        ([0, 1], "hours since 1970-01-01", [0, 3600]), ([250, 500], "\u00b5s", [250e-6, 500e-6]),
        ([3, 5], "nanoseconds", [3e-9, 5e-9]), ([2, 3], None, [2, 3]), (np.array([0, 4], "m8[ms]"), None, [0, 0.004]),
        (np.array(["1970-01-01T00:00:01", "1970-01-01T00:00:02"], "M8[s]"), None, [1, 2]),
    ],
)  # fmt: skip
def test_times_in_any_unit_are_seconds(numbers, units, expected):
    times = seconds(np.asarray(numbers), units, "film")
    assert times.tolist() == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(("numbers", "units"), [([1], "frames"), ([1], "months since 2024-01-01"), (["12:00"], None)])
def test_times_in_other_units_are_refused(numbers, units):
    with pytest.raises(InputError, match="film: coordinate time: expected") as error:
        seconds(np.asarray(numbers), units, "film")
    assert error.value.field == "film"


def test_frames_are_counted_by_their_times():
    assert whole_steps(np.array([5.0, 5.1, 5.21, 5.51])).tolist() == [0, 1, 2, 5]
    assert whole_steps(np.array([0.0, 0.1, 0.27])) is None
    assert same_instants((40.0, 40.001), (40.0, 40.001 + 1e-8))
    assert not same_instants((0.0, 0.001), (0.0, 0.001, 0.002))


def film_of(path: Path, kind: type, times: tuple[float, ...] = TIMES) -> None:
    if kind is MeasurementSequence:
        cameras = Ring(views=2, image_size=(6, 7)).cameras()
        flow = Measurement(cameras=cameras, displacement=torch.randn(2, 6, 7, 2), box=BOX, n_ambient=1.00027)
        film = MeasurementSequence.create(path, times, flow)
        for i in range(len(times)):
            film.write_frame(i, replace(flow, displacement=flow.displacement + i))
    else:
        quantities = ("index_excess",) if kind is VolumeSequence else ("u", "v", "w")
        kind.create(path, times, Grid(BOX, (8, 9, 10)), quantities, 1.00027, {"kind": "nerif velocity 1"}
                    if kind is VelocitySequence else {})  # fmt: skip


def times_of(path: Path, kind: type) -> tuple[float, ...]:
    return kind.read(path).times if kind is MeasurementSequence else kind(path).times


@pytest.mark.parametrize("kind", [MeasurementSequence, VolumeSequence, VelocitySequence])
def test_a_film_that_xarray_saved_again_has_its_times(tmp_path, kind):
    import xarray as xr

    film_of(tmp_path / "film.zarr", kind)
    spans = (1e9 * np.array(TIMES)).astype("m8[ns]")
    coordinates = {
        "spans": spans,
        "dates": np.datetime64("2024-05-03T12:00:00", "ns") + spans,
        "ms": ("time", 1e3 * np.array(TIMES), {"units": "ms"}),
        "text": ("time", np.array(TIMES), {"units": "seconds"}),
    }
    for name, time in coordinates.items():
        with xr.open_zarr(tmp_path / "film.zarr", consolidated=False) as film:
            film.assign_coords(time=time).to_zarr(tmp_path / f"{name}.zarr", consolidated=False)
        assert times_of(tmp_path / f"{name}.zarr", kind) == pytest.approx(TIMES, abs=1e-12), name
    with xr.open_zarr(tmp_path / "film.zarr", consolidated=False) as film:
        bare = film.assign_coords(time=1e3 * np.array(TIMES))
        bare.to_zarr(tmp_path / "bare.zarr", consolidated=False)
        thinned = film.isel(time=slice(None, None, 2))
        thinned.to_zarr(tmp_path / "thinned.zarr", consolidated=False)
    with pytest.raises(InputError, match=r"expected frames 0\.004 s apart.*got 4 s; was the unit of time lost"):
        times_of(tmp_path / "bare.zarr", kind)
    assert times_of(tmp_path / "thinned.zarr", kind) == TIMES[::2]


def test_a_film_whose_measurement_has_another_frame_rate_is_refused(tmp_path):
    film_of(tmp_path / "m.zarr", MeasurementSequence)
    slow = tuple(1e3 * t for t in TIMES)
    film_of(tmp_path / "film.zarr", VolumeSequence, slow)
    film = VolumeSequence(tmp_path / "film.zarr")
    film.group.attrs["measurement"] = str(tmp_path / "m.zarr")
    for i in range(len(slow)):
        film.write(i, [Volume.of(-1e-5 * torch.rand(film.grid.shape), film.grid, "index_excess", 1.00027)])
    with pytest.raises(InputError, match=r"expected frames 0\.004 s apart"):
        velocity_of_film(tmp_path / "film.zarr", tmp_path / "v.zarr")


def test_times_of_frames_in_hdf5_have_a_unit(tmp_path):
    with h5py.File(tmp_path / "film.h5", "w") as file:
        file["images"] = np.zeros((3, 4, 5), np.uint8)
        file["times"] = [0, 500, 1500]
        file["times"].attrs["units"] = "us"
    assert open_frames(tmp_path / "film.h5").times.tolist() == pytest.approx([0, 5e-4, 1.5e-3])
