"""Frames one after the other: warm starts, failures, continuing after an interruption."""

from __future__ import annotations

import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
import zarr

from commands import run
from nerif.common.conventions import InputError
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.fields.symmetric import symmetry_of_field
from nerif.geometry import Grid
from nerif.reconstruction.voxels.symmetry_axis import with_axis
from nerif.workflow.sequence import chunk as frames
from nerif.workflow.sequence.chunk import reconstruct_frames
from nerif.workflow.sequence.plan import SequencePlan, SequenceSettings
from nerif.workflow.sequence.reconstruct_sequence import _store
from nerif.workflow.sequence.run import chunks_of, outcome_table
from nerif.workflow.sequence.store import DONE, FAILED, MISSING, SequenceStore
from refusals import refused
from sequence_films import COLD, blank


def begin(measurement: Path, out: Path, **changes: object) -> SequencePlan:
    """Return a plan, and make its store with every frame missing."""
    settings = SequenceSettings(warm_steps=15, voxels=10, quantities=("index_excess", "temperature"))
    plan = SequencePlan(measurement, out, COLD, replace(settings, **changes))
    sequence = MeasurementSequence.read(measurement)
    grid = Grid.of_resolution(sequence.fullest().box, 10)
    SequenceStore.begin(out, sequence, grid, plan.settings.quantities, COLD.network, plan.attributes)
    return plan


@pytest.fixture(scope="module")
def undisturbed(five: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[SequencePlan, list[dict]]:
    """Five frames, and the events of their reconstruction."""
    plan, events = begin(five, tmp_path_factory.mktemp("whole") / "whole.zarr"), []
    reconstruct_frames(plan, 0, 5, events.append)
    return plan, events


def test_the_status_of_one_frame_is_read_for_it(undisturbed, monkeypatch):
    plan, indices, read = undisturbed[0], [], SequenceStore.read

    def record(self, name, index):
        if name == "status":
            indices.append(index)
        return read(self, name, index)

    monkeypatch.setattr(SequenceStore, "read", record)
    reconstruct_frames(plan, 0, 5)
    assert set(indices) == set(range(5))


def test_frames_are_written_with_fields_and_scores(undisturbed, tmp_path):
    plan, events = undisturbed
    assert [e["what"] for e in events] == ["begun", "done"] * 5
    store = SequenceStore(plan.out)
    assert (store.status == DONE).all()
    assert store.array("steps")[:].tolist() == [30, 15, 15, 15, 15]
    for i in (0, 3):
        assert torch.equal(store.field(i).sample(store.grid), store.volume(i, "index_excess").values)
    with xr.open_zarr(plan.out, consolidated=False) as dataset:
        assert dataset["temperature"].dims == ("time", "z", "y", "x")
        assert dataset["temperature"].attrs["units"] == "K"
        assert dataset["cc"].shape == (5, 3)
        assert float(dataset["cc"].min()) > 0
        assert np.isfinite(dataset["rms_px"].values).all()
    assert "5 of 5 frames done" in outcome_table(store)
    other = Path(shutil.copytree(plan.out, tmp_path / "r.zarr"))  # of another version
    group = zarr.open_group(other, mode="r+")
    group.attrs["network"] = {**group.attrs["network"], "gone": 0.0}
    with pytest.raises(InputError, match=r"another version of nerif, or damaged; reconstruct it again \(.*gone"):
        SequenceStore(other).field(0)


@pytest.mark.slow
def test_frames_of_a_symmetric_flow_share_an_axis(short, tmp_path):
    settings = SequenceSettings(warm_steps=3, voxels=8, quantities=("index_excess",))
    cold = replace(COLD, symmetry="axis+1", max_steps=5)
    plan, lines = SequencePlan(short, tmp_path / "r.zarr", cold, settings), []
    sequence = MeasurementSequence.read(short)
    like = sequence.fullest()
    store = _store(plan, sequence, like, False, lines.append)
    assert store.symmetry is not None
    assert any("axis" in line for line in lines)
    assert _store(plan, sequence, like, False, lines.append).symmetry == store.symmetry  # continued
    reconstruct_frames(replace(plan, cold=with_axis(cold, store.symmetry)), 0, 2)
    assert store.status[:2].tolist() == [DONE, DONE]
    assert store.array("steps")[1] == 3  # a warm start
    for i in range(2):
        values = store.volume(i, "index_excess").values
        torch.testing.assert_close(store.field(i).sample(store.grid), values, rtol=1e-5, atol=1e-9)
        assert symmetry_of_field(store.field(i)).near(store.symmetry, 1e-9)


def test_a_sequence_without_any_field_exits_with_1(five, tmp_path, monkeypatch):
    store = SequenceStore(begin(five, tmp_path / "r.zarr").out)
    monkeypatch.setattr("nerif.cli.commands.sequence.run", lambda settings: store)
    assert run("sequence", five, "-o", tmp_path / "r.zarr") == 1


def test_a_warm_frame_starts_from_the_previous_field(undisturbed, five):
    store = SequenceStore(undisturbed[0].out)
    before = store.field(0)
    one_step = replace(COLD, max_steps=1, rate_after_fit=1e-12)
    after = one_step(MeasurementSequence.read(five).frame(1), start=before).field
    x, y = before.sample(store.grid), after.sample(store.grid)
    assert after.scale != before.scale
    # the same field but for the constant of the gauge
    assert float((x - y - (x - y).mean()).abs().max()) < 1e-4 * float(x.abs().max())


@pytest.mark.slow
def test_an_interrupted_chunk_continues_to_the_same_result(undisturbed, short, tmp_path):
    plan = begin(short, tmp_path / "parts.zarr")

    class Killed(BaseException):
        pass

    def die(event: dict) -> None:
        if event == {"frame": 2, "what": "begun"}:
            raise Killed

    with pytest.raises(Killed):
        reconstruct_frames(plan, 0, 5, die)
    assert SequenceStore(plan.out).status.tolist() == [DONE, DONE, MISSING, MISSING, MISSING]
    reconstruct_frames(plan, 0, 5)
    for i in range(5):
        a, b = (SequenceStore(p.out).volume(i, "index_excess").values for p in (undisturbed[0], plan))
        assert torch.equal(a, b)


def test_failed_frames_and_views_without_data(short, tmp_path):
    blank(short, 1, view=2)
    blank(short, 2)
    plan = begin(short, tmp_path / "r.zarr", withhold=("85deg",))
    reconstruct_frames(plan, 0, 4)
    store = SequenceStore(plan.out)
    assert store.status.tolist() == [DONE, DONE, FAILED, DONE, MISSING]
    assert "no valid pixel" in store.reasons[2]
    assert store.array("attempts")[2] == frames.ATTEMPTS
    assert store.array("steps")[3] == 15  # a warm start from frame 1
    assert "1 failed:\n  frame 2:" in outcome_table(store)
    assert np.isnan(store.array("cc")[:2]).tolist() == [[False] * 3, [False, False, True]]
    assert store.attributes["withhold"] == ["85deg"]
    assert bool(torch.isnan(store.volume(2, "index_excess").values).all())
    with refused(store.path):
        store.field(2)
    assert store.forget_failures() == 1
    assert store.status[2] == MISSING


def test_a_failing_frame_is_repeated_cold_then_with_half_the_rate(short, tmp_path, monkeypatch):
    plan = begin(short, tmp_path / "r.zarr")
    attempts: list[tuple[int, float, bool]] = []
    real = frames._frame

    def fail_twice(plan, settings, measurement, start, watch):
        attempts.append((settings.max_steps, settings.learning_rate, start is not None))
        if len(attempts) in (2, 3):
            raise ArithmeticError("diverged")
        return real(plan, settings, measurement, start, watch)

    monkeypatch.setattr(frames, "_frame", fail_twice)
    reconstruct_frames(plan, 0, 2)
    rate = COLD.learning_rate
    assert attempts == [(30, rate, False), (15, rate, True), (30, rate, False), (30, rate / 2, False)]
    assert SequenceStore(plan.out).array("attempts")[:2].tolist() == [1, 3]


def test_chunks_do_not_depend_on_what_is_missing():
    assert chunks_of([0, 1, 9, 23], 8, 24) == [(0, 8), (8, 16), (16, 24)]
    assert chunks_of([17], 8, 20) == [(16, 20)]
    assert chunks_of([], 8, 24) == []


def test_other_settings_are_refused_by_name(short, tmp_path):
    store = SequenceStore(begin(short, tmp_path / "r.zarr").out)
    store.check_same({"settings": asdict(COLD)})
    with pytest.raises(InputError, match=r"seed: expected 0, .* got 3"):
        store.check_same({"settings": asdict(replace(COLD, seed=3))})
    with refused(short.with_name("short.truth.zarr")):
        SequenceStore(short.with_name("short.truth.zarr"))
