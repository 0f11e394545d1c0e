"""Sequences on disc: measurements and volumes over time."""

from __future__ import annotations

import dataclasses
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr

from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.volume import Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.fields.network import Network, NeuralField
from nerif.fields.phantoms import Flame
from nerif.geometry import Box, Grid, Ring
from nerif.report.movie import Movie
from nerif.report.sequence_page import render_sequence
from nerif.simulation.simulate import Simulation
from nerif.workflow.sequence.evaluation import evaluate_sequence
from nerif.workflow.sequence.frames import finished_frame
from nerif.workflow.sequence.plan import SequencePlan, SequenceSettings
from nerif.workflow.sequence.run import outcome_table
from nerif.workflow.sequence.store import SequenceStore
from refusals import refused
from sequence_films import COLD, RIG, blank


def same(a: Measurement, b: Measurement) -> bool:
    return a.names == b.names and torch.equal(a.displacement, b.displacement) and a.box == b.box


def test_frames_come_back_as_they_were_written(short, tmp_path):
    sequence = MeasurementSequence.read(short)
    assert sequence.times == pytest.approx([0, 1e-4, 2e-4, 3e-4, 4e-4])
    first, last = sequence.frame(0), sequence.frame(4)
    assert not torch.equal(first.displacement, last.displacement)
    copy = MeasurementSequence.create(tmp_path / "copy.zarr", [0.0, 1.0], first)
    assert not copy.is_written(1)
    copy.write_frame(1, last)
    assert copy.is_written(1)
    assert same(copy.frame(1), last)
    assert torch.equal(copy.frame(1).sigma, last.sigma)


def test_a_frame_killed_between_directory_and_chunk_is_not_written(short, tmp_path):
    frame = MeasurementSequence.read(short).frame(0)
    store = MeasurementSequence.create(tmp_path / "film.zarr", [0.0, 1.0], frame)
    (store.path / "displacement" / "c" / "1" / "0" / "0" / "0").mkdir(parents=True)
    assert not store.is_written(1)
    store.write_frame(1, frame)
    assert store.is_written(1)
    assert not store.is_written(0)


@pytest.mark.parametrize("again", [False, True])
def test_a_frame_killed_at_any_of_its_arrays_is_not_written(short, tmp_path, monkeypatch, again):
    import zarr

    frame = MeasurementSequence.read(short).frame(0)
    write = zarr.Array.__setitem__
    for name in ("sigma", "displacement", "written"):
        store = MeasurementSequence.create(tmp_path / f"{name}.zarr", [0.0, 1.0], frame)
        if again:
            store.write_frame(1, frame)

        def killed(self, at, value, name=name):
            if self.basename == name and np.any(value):
                raise KeyboardInterrupt
            write(self, at, value)

        monkeypatch.setattr(zarr.Array, "__setitem__", killed)
        with pytest.raises(KeyboardInterrupt):
            store.write_frame(1, frame)
        monkeypatch.setattr(zarr.Array, "__setitem__", write)
        assert not store.is_written(1)
        with pytest.raises(InputError, match="frame 1: no data, or not written completely"):
            store.frame(1)
        store.write_frame(1, frame)
        assert same(store.frame(1), frame)


def test_stores_without_the_variable_written_are_read_and_gone_on_with(short, tmp_path):
    import zarr

    frame = MeasurementSequence.read(short).frame(0)
    store = MeasurementSequence.create(tmp_path / "film.zarr", [0.0, 1.0, 2.0], frame)
    store.write_frame(1, frame)
    del zarr.open_group(store.path, mode="r+")["written"]
    (store.path / "displacement" / "c" / "0" / "0" / "0" / "0").mkdir(parents=True)
    assert [store.is_written(i) for i in range(3)] == [False, True, False]
    assert same(store.frame(1), frame)
    store.write_frame(2, frame)
    assert store.is_written(2)


def test_a_view_that_saw_nothing_is_left_out_and_an_empty_frame_refused(short):
    blank(short, 1, view=0)
    blank(short, 2)
    sequence = MeasurementSequence.read(short)
    names = sequence.frame(0).names
    assert sequence.frame(1).names == names[1:]
    with refused("displacement of view '0deg'"):
        sequence.frame(2)
    blank(short, 0)
    assert sequence.fullest().names == names  # of a later one
    for later in (3, 4):
        blank(short, later, view=0)
    assert sequence.fullest().names == names[1:]


def test_a_frame_without_a_view_is_written_with_that_view_empty(short):
    sequence = MeasurementSequence.read(short)
    frame = sequence.frame(3)
    sequence.write_frame(3, frame.select(frame.names[:2]))
    assert sequence.frame(3).names == frame.names[:2]
    stranger = dataclasses.replace(
        frame, cameras=tuple(dataclasses.replace(c, name=c.name + "x") for c in frame.cameras)
    )
    with pytest.raises(InputError, match="expected views out of"):
        sequence.write_frame(3, stranger)
    with pytest.raises(InputError, match="expected a measurement with 'sigma'"):
        sequence.write_frame(3, dataclasses.replace(frame, sigma=None))


def test_what_is_no_sequence_is_refused(short, tmp_path):
    with pytest.raises(InputError, match="no such store"):
        MeasurementSequence.read(tmp_path / "none.zarr")
    (tmp_path / "empty.zarr").mkdir()
    with pytest.raises(InputError, match="not a readable Zarr store"):
        MeasurementSequence.read(tmp_path / "empty.zarr")
    truth = short.with_name("short.truth.zarr")
    with pytest.raises(InputError, match="Conventions"):
        MeasurementSequence.read(truth)
    with refused("times"):
        MeasurementSequence.create(tmp_path / "x.zarr", [0.0, 0.0], MeasurementSequence.read(short).frame(0))
    with pytest.raises(InputError, match="exists already"):
        MeasurementSequence.create(short, [0.0], MeasurementSequence.read(short).frame(0))
    with pytest.raises(InputError, match="no such store"):
        VolumeSequence(tmp_path / "none.zarr")
    with pytest.raises(InputError, match="expected volumes over time"):
        VolumeSequence(short)


def test_the_truth_of_a_simulated_sequence_is_the_phantom_at_its_times(short):
    truth = VolumeSequence(short.with_name("short.truth.zarr"))
    box = Box((-25.0,) * 3, (25.0,) * 3)
    assert truth.grid == Grid(box, (12, 12, 12))
    for i in (0, 4):
        expected = Flame(box, time=i * 1e-4).sample(truth.grid)
        assert torch.allclose(truth.volume(i, "index_excess").values, expected)
    with xr.open_zarr(truth.path, consolidated=False) as found:
        assert found["index_excess"].dims == ("time", "z", "y", "x")
        assert found["time"].attrs["units"] == "s"
        assert found["z"].attrs["units"] == "mm"
    with pytest.raises(InputError, match="expected one of index_excess"):
        truth.volume(0, "density")


def test_volumes_stand_in_the_order_z_y_x(tmp_path):
    grid = Grid(Box((0.0, 0.0, 0.0), (2.0, 3.0, 4.0)), (4, 3, 2))
    store = VolumeSequence.create(tmp_path / "v.zarr", [0.0, 1.0], grid, ("index_excess",), 1.0003)
    values = torch.arange(24.0).reshape(4, 3, 2)
    store.write(1, [Volume(values, grid)])
    again = VolumeSequence(tmp_path / "v.zarr")
    assert again.grid == grid
    assert again.n_ambient == 1.0003
    assert torch.equal(again.volume(1, "index_excess").values, values)
    assert bool(torch.isnan(again.volume(0, "index_excess").values).all())


@pytest.mark.parametrize("times", ["0", "0:1", "0:1:x", "1:0:3", "0:1:0", "a:b:c"])
def test_times_that_mean_nothing_are_refused(times, tmp_path, capsys):
    out = str(tmp_path / "x.zarr")
    assert main(["simulate", "--times", times, "-o", out]) == 2
    assert "times: expected FIRST:LAST:COUNT" in capsys.readouterr().err
    assert not Path(out).exists()


def test_simulate_refuses_what_does_not_move_and_wrong_names(tmp_path, capsys):
    assert main(["simulate", "--phantom", "gaussians", "--times", "0:1:3", "-o", str(tmp_path / "x.zarr")]) == 2
    assert "a phantom that moves" in capsys.readouterr().err
    assert main(["simulate", "--times", "0:1:3", "-o", str(tmp_path / "x.nc")]) == 2
    assert "ending in .zarr" in capsys.readouterr().err


def test_nothing_of_a_sequence_is_nan_but_what_was_not_measured(five):
    sequence = MeasurementSequence.read(five)
    assert len(sequence) == 5
    assert np.isfinite(sequence.frame(4).displacement.numpy()).all()


def test_a_store_of_another_technique_says_what_it_holds(tmp_path):
    """Emission: its own quantity, its unit of the difference, and a page and figures that speak of it."""
    import zarr

    film = tmp_path / "film.zarr"
    words = ["--phantom", "flame", "--times", "0:1e-4:2", "--noise", "0.05", "-o", str(film), *RIG]
    assert main(["simulate", "--technique", "emission", *words]) == 0
    sequence = MeasurementSequence.read(film)
    like = sequence.fullest()
    plan = SequencePlan(film, tmp_path / "r.zarr", COLD, SequenceSettings(voxels=8).for_measurement(like))
    grid = Grid.of_resolution(like.box, 8)
    kept = {"bounds": [0.0, None], **plan.attributes}
    store = SequenceStore.begin(plan.out, sequence, grid, plan.settings.quantities, COLD.network, kept)
    field = NeuralField(Network(COLD.network, bounds=(0.0, math.inf)), like.box, 0.02)
    for i in range(2):
        store.write_frame(i, finished_frame(plan, field, sequence.frame(i), "cpu"))
    assert store.quantities == ("emission",)
    assert store.attributes["title"] == "Fields of radiance per length over time"
    assert [of.rms.attrs["units"] for of in store.view_scores] == ["1"]
    assert torch.equal(store.field(1).sample(grid), store.volume(1, "emission").values)
    assert " px" not in outcome_table(store)
    metrics = evaluate_sequence(plan.out, tmp_path / "film.truth.zarr")
    assert metrics["mean"]["l2"] == pytest.approx(metrics["mean"]["l2_variation"])
    assert main(["evaluate", str(plan.out), "--truth", str(tmp_path / "film.truth.zarr"), "--align", "rigid"]) == 2
    attributes = zarr.open_group(tmp_path / "film.truth.zarr", mode="r+").attrs
    attributes["box_upper_mm"] = [1e3, *attributes["box_upper_mm"][1:]]
    with pytest.raises(InputError, match=r"inside the reconstructed box .* sticks out along x"):
        evaluate_sequence(plan.out, tmp_path / "film.truth.zarr")
    text = re.sub(r"<(script|style)\b.*?</\1>", "", render_sequence(store), flags=re.DOTALL)
    assert "Emission tomography" in text
    assert "Radiance per length" in text
    assert " px" not in text
    assert Movie().quantity_of(store) == "emission"


def test_views_of_a_combined_film_are_scored_by_every_technique(tmp_path):
    """One that is an interferometer alone has its score; bad fringes show in the table and on the page."""
    simulation = Simulation(technique=("deflection", "interferometry"), noise=0.05, steps=10, truth_voxels=8)
    both, _ = simulation(Ring(views=3, image_size=(14, 16), pixel_pitch=0.3).cameras())
    displacement, fringes = both.displacement.clone(), both.maps["fringes"].clone()
    displacement[0], fringes[1] = torch.nan, torch.nan
    fringes[2] += 40.0
    like = replace(both, displacement=displacement, maps={**both.maps, "fringes": fringes})
    sequence = MeasurementSequence.create(tmp_path / "film.zarr", [0.0], like)
    sequence.write_frame(0, like)
    plan = SequencePlan(sequence.path, tmp_path / "r.zarr", COLD, SequenceSettings(voxels=8).for_measurement(like))
    grid = Grid.of_resolution(like.box, 8)
    store = SequenceStore.begin(plan.out, sequence, grid, plan.settings.quantities, COLD.network, plan.attributes)
    field = NeuralField(Network(COLD.network), like.box, 1e-5)
    store.write_frame(0, finished_frame(plan, field, sequence.frame(0), "cpu"))
    for names, unknown in ((("cc", "rms_px"), 0), (("cc_fringes", "rms_fringes"), 1)):
        for name in names:
            assert np.isnan(store.array(name)[0]).nonzero()[0].tolist() == [unknown]
    assert store.array("rms_fringes")[0, 2] > 35
    assert re.search(r"rms difference to the measured displacement \S+ px and fringes \S+$", outcome_table(store))
    page = re.sub(r"<(script|style)\b.*?</\1>", "", render_sequence(store), flags=re.DOTALL)
    for said in ("Training views, displacement", "Training views, fringes", "Every view over time, fringes"):
        assert said in page
