"""Sequences on disk: measurements and volumes over time."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
import zarr

from commands import run
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.volume import Volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.fields.network import Network, NeuralField
from nerif.fields.phantoms import Flame
from nerif.geometry import Box, Grid, Ring
from nerif.report.sequence_page import render_sequence
from nerif.report.volume_movie import Movie
from nerif.simulation.simulation import Simulation
from nerif.workflow.sequence.chunk import finished_frame
from nerif.workflow.sequence.plan import SequencePlan, SequenceSettings
from nerif.workflow.sequence.run import outcome_table
from nerif.workflow.sequence.sequence_evaluation import evaluate_sequence
from nerif.workflow.sequence.store import SequenceStore
from refusals import refused
from sequence_films import COLD, RIG, blank


def same(a: Measurement, b: Measurement) -> bool:
    return a.names == b.names and torch.equal(a.displacement, b.displacement) and a.box == b.box


@pytest.fixture
def frame(five: Path) -> Measurement:
    return MeasurementSequence.read(five).frame(0)


def test_frames_are_read_as_written(five, tmp_path):
    sequence = MeasurementSequence.read(five)
    assert sequence.times == pytest.approx([0, 1e-4, 2e-4, 3e-4, 4e-4])
    first, last = sequence.frame(0), sequence.frame(4)
    assert not torch.equal(first.displacement, last.displacement)
    assert np.isfinite(last.displacement.numpy()).all()
    copy = MeasurementSequence.create(tmp_path / "copy.zarr", [0.0, 1.0], first)
    (copy.path / "displacement/c/1/0/0/0").mkdir(parents=True)  # killed between directory and chunk
    assert not copy.is_written(1)
    copy.write_frame(1, last)
    assert (copy.is_written(0), copy.is_written(1)) == (False, True)
    assert same(copy.frame(1), last)
    assert torch.equal(copy.frame(1).sigma, last.sigma)


@pytest.mark.parametrize("again", [False, True])
def test_a_frame_killed_at_any_of_its_arrays_is_not_written(frame, tmp_path, monkeypatch, again):
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
        with refused(f"{store.path}, frame 1"):
            store.frame(1)
        store.write_frame(1, frame)
        assert same(store.frame(1), frame)


def test_stores_without_the_variable_written(frame, tmp_path):
    store = MeasurementSequence.create(tmp_path / "film.zarr", [0.0, 1.0, 2.0], frame)
    store.write_frame(1, frame)
    del zarr.open_group(store.path, mode="r+")["written"]
    (store.path / "displacement/c/0/0/0/0").mkdir(parents=True)
    assert [store.is_written(i) for i in range(3)] == [False, True, False]
    assert same(store.frame(1), frame)
    store.write_frame(2, frame)
    assert store.is_written(2)


def test_views_and_frames_without_data(short):
    blank(short, 1, view=0)
    blank(short, 2)
    sequence = MeasurementSequence.read(short)
    frame = sequence.frame(0)
    names = frame.names
    assert sequence.frame(1).names == names[1:]
    with refused("displacement of view '0deg'"):
        sequence.frame(2)
    sequence.write_frame(4, frame.select(names[:2]))
    assert sequence.frame(4).names == names[:2]
    cameras = tuple(replace(c, name=c.name + "x") for c in frame.cameras)
    for invalid in (replace(frame, cameras=cameras), replace(frame, sigma=None)):
        with refused(f"{short}, frame 3"):
            sequence.write_frame(3, invalid)
    blank(short, 0)
    assert sequence.fullest().names == names  # of frame 3
    blank(short, 3, view=0)
    assert sequence.fullest().names == names[1:]


def test_invalid_stores(five, frame, tmp_path):
    truth = five.with_name("short.truth.zarr")
    (tmp_path / "empty.zarr").mkdir()
    for path in (tmp_path / "none.zarr", truth):
        with refused(path):
            MeasurementSequence.read(path)
    with pytest.raises(InputError, match="Zarr"):
        MeasurementSequence.read(tmp_path / "empty.zarr")
    with refused("times"):
        MeasurementSequence.create(tmp_path / "x.zarr", [0.0, 0.0], frame)
    with refused(five):
        MeasurementSequence.create(five, [0.0], frame)
    for path in (tmp_path / "none.zarr", five):
        with refused(path):
            VolumeSequence(path)


class Evil:
    """Makes a file when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self):
        return open, (str(self.mark), "w")


@pytest.mark.parametrize("read", [MeasurementSequence.read, VolumeSequence])
def test_a_foreign_store_whose_filters_unpickle_is_refused(tmp_path, monkeypatch, read):
    pickles = pytest.importorskip("numcodecs.pickles")
    monkeypatch.setattr(pickles, "ALLOW_UNSAFE_PICKLE_DECODE", True, raising=False)  # as in older releases
    filters = [{"id": "vlen-utf8"}, {"id": "pickle", "protocol": 5}]
    common = {"zarr_format": 2, "dtype": "|O", "compressor": None, "filters": filters, "fill_value": "", "order": "C"}
    attributes = {"box_lower_mm": [0, 0, 0], "box_upper_mm": [1, 1, 1], "n_ambient": 1.0}
    (tmp_path / ".zgroup").write_text('{"zarr_format": 2}')
    (tmp_path / ".zattrs").write_text(json.dumps(attributes))
    values = np.array([Evil(tmp_path / "mark"), 1], dtype=object)
    for name in ("time", *"zyx"):
        (tmp_path / name).mkdir()
        (tmp_path / name / ".zarray").write_text(json.dumps({**common, "shape": [2], "chunks": [2]}))
        (tmp_path / name / ".zattrs").write_text(json.dumps({"_ARRAY_DIMENSIONS": [name]}))
        (tmp_path / name / "0").write_bytes(bytes(pickles.Pickle().encode(values)))
    with pytest.raises(InputError):
        read(tmp_path)
    assert not (tmp_path / "mark").exists()


def test_the_truth_of_a_simulated_sequence_is_the_phantom_at_its_times(five):
    truth = VolumeSequence(five.with_name("short.truth.zarr"))
    box = Box((-25.0,) * 3, (25.0,) * 3)
    assert truth.grid == Grid(box, (12, 12, 12))
    for i in (0, 4):
        assert torch.allclose(truth.volume(i, "index_excess").values, Flame(box, time=i * 1e-4).sample(truth.grid))
    with xr.open_zarr(truth.path, consolidated=False) as dataset:
        assert dataset["index_excess"].dims == ("time", "z", "y", "x")
        assert (dataset["time"].attrs["units"], dataset["z"].attrs["units"]) == ("s", "mm")
    with refused(truth.path):
        truth.volume(0, "density")


def test_volumes_are_in_the_order_z_y_x(tmp_path):
    grid = Grid(Box((0.0, 0.0, 0.0), (2.0, 3.0, 4.0)), (4, 3, 2))
    store = VolumeSequence.create(tmp_path / "v.zarr", [0.0, 1.0], grid, ("index_excess",), 1.0003)
    values = torch.arange(24.0).reshape(4, 3, 2)
    store.write(1, [Volume(values, grid)])
    again = VolumeSequence(tmp_path / "v.zarr")
    assert (again.grid, again.n_ambient) == (grid, 1.0003)
    assert torch.equal(again.volume(1, "index_excess").values, values)
    assert bool(torch.isnan(again.volume(0, "index_excess").values).all())


@pytest.mark.parametrize(
    ("words", "text"),
    [
        *((f"--times {times}", "times: ") for times in ("0", "0:1", "0:1:x", "1:0:3", "0:1:0", "a:b:c")),
        ("--phantom gaussians --times 0:1:3", "moves"),
        ("--times 0:1:3 -o x.nc", "ending in .zarr"),
    ],
)
def test_invalid_options_of_simulate(words, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run("simulate", "-o", "x.zarr", *words.split()) == 2
    assert text in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def text_of(store: SequenceStore) -> str:
    """Return the report without scripts and styles."""
    return re.sub(r"<(script|style)\b.*?</\1>", "", render_sequence(store), flags=re.DOTALL)


def test_a_store_of_emission(tmp_path):
    """Quantity, unit of the residual, report and movie."""
    film, truth = tmp_path / "film.zarr", tmp_path / "film.truth.zarr"
    words = ["--technique", "emission", "--phantom", "flame", "--times", "0:1e-4:2", "--noise", "0.05"]
    assert run("simulate", *words, "-o", film, *RIG) == 0
    sequence = MeasurementSequence.read(film)
    like = sequence.fullest()
    plan = SequencePlan(film, tmp_path / "r.zarr", COLD, SequenceSettings(voxels=8).for_measurement(like))
    grid = Grid.of_resolution(like.box, 8)
    attributes = {"bounds": [0.0, None], **plan.attributes}
    store = SequenceStore.begin(plan.out, sequence, grid, plan.settings.quantities, COLD.network, attributes)
    field = NeuralField(Network(COLD.network, bounds=(0.0, math.inf)), like.box, 0.02)
    for i in range(2):
        store.write_frame(i, finished_frame(plan, field, sequence.frame(i), "cpu"))
    assert store.quantities == ("emission",)
    assert store.attributes["title"] == "Fields of radiance per length over time"
    assert [scores.rms.attrs["units"] for scores in store.view_scores] == ["1"]
    assert torch.equal(store.field(1).sample(grid), store.volume(1, "emission").values)
    assert " px" not in outcome_table(store)
    assert Movie().quantity_of(store) == "emission"
    text = text_of(store)
    assert "Emission tomography" in text
    assert "Radiance per length" in text
    assert " px" not in text
    metrics = evaluate_sequence(plan.out, truth)
    assert metrics["mean"]["l2"] == pytest.approx(metrics["mean"]["l2_variation"])
    assert run("evaluate", plan.out, "--truth", truth, "--align", "rigid") == 2
    attributes = zarr.open_group(truth, mode="r+").attrs
    attributes["box_upper_mm"] = [1e3, *attributes["box_upper_mm"][1:]]
    with refused(truth):
        evaluate_sequence(plan.out, truth)


def test_views_are_scored_by_every_technique(tmp_path):
    """A view of an interferometer only; bad fringes show in the table and in the report."""
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
    for name, view in (("cc", 0), ("rms_px", 0), ("cc_fringes", 1), ("rms_fringes", 1)):
        assert np.isnan(store.array(name)[0]).nonzero()[0].tolist() == [view]
    assert store.array("rms_fringes")[0, 2] > 35
    assert re.search(r"displacement \S+ px and fringes \S+$", outcome_table(store))
    text = text_of(store)
    for title in ("Fitted views, displacement", "Fitted views, fringes", "Every view over time, fringes"):
        assert title in text
