"""Frames one after the other: warm starts, failures, going on where a run broke off."""

from __future__ import annotations

import dataclasses
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
import zarr

from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.fields.symmetric import symmetry_of_field
from nerif.geometry import Grid
from nerif.reconstruction.symmetry import with_axis
from nerif.workflow.sequence import frames
from nerif.workflow.sequence.frames import reconstruct_frames
from nerif.workflow.sequence.plan import SequencePlan, SequenceSettings
from nerif.workflow.sequence.reconstruct import _store
from nerif.workflow.sequence.run import chunks_of, outcome_table
from nerif.workflow.sequence.store import DONE, FAILED, MISSING, SequenceStore
from sequence_films import COLD, blank


def begun(measurement: Path, out: Path, **changes: object) -> SequencePlan:
    """A plan, and its store with every frame missing."""
    settings = SequenceSettings(warm_steps=15, voxels=10, quantities=("index_excess", "temperature"))
    plan = SequencePlan(measurement, out, COLD, replace(settings, **changes))
    sequence = MeasurementSequence.read(measurement)
    grid = Grid.of_resolution(sequence.fullest().box, 10)
    SequenceStore.begin(out, sequence, grid, plan.settings.quantities, COLD.network, plan.attributes)
    return plan


@pytest.fixture(scope="module")
def undisturbed(five: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[SequencePlan, list[dict]]:
    """Five frames reconstructed without disturbance, and what was told of them."""
    plan, told = begun(five, tmp_path_factory.mktemp("whole") / "whole.zarr"), []
    reconstruct_frames(plan, 0, 5, told.append)
    return plan, told


def test_every_frame_is_written_with_what_it_came_from(undisturbed):
    plan, told = undisturbed
    assert [t["what"] for t in told] == ["begun", "done"] * 5
    store = SequenceStore(plan.out)
    assert (store.status == DONE).all()
    assert store.array("steps")[:].tolist() == [30, 15, 15, 15, 15]
    for i in (0, 3):
        again = store.field(i).sample(store.grid)
        assert torch.equal(again, store.volume(i, "index_excess").values)
    with xr.open_zarr(plan.out, consolidated=False) as found:
        assert found["temperature"].dims == ("time", "z", "y", "x")
        assert found["temperature"].attrs["units"] == "K"
        assert found["cc"].shape == (5, 3)
        assert float(found["cc"].min()) > 0
        assert np.isfinite(found["rms_px"].values).all()
    assert "5 of 5 frames done" in outcome_table(store)


@pytest.mark.slow
def test_frames_of_a_symmetric_film_share_an_axis_and_are_read_back_as_they_were(short, tmp_path):
    settings = SequenceSettings(warm_steps=3, voxels=8, quantities=("index_excess",))
    cold = replace(COLD, symmetry="axis+1", max_steps=5)
    plan, said = SequencePlan(short, tmp_path / "r.zarr", cold, settings), []
    sequence = MeasurementSequence.read(short)
    like = sequence.fullest()
    store = _store(plan, sequence, like, False, said.append)
    assert store.symmetry is not None
    assert any("axis" in line for line in said)
    assert _store(plan, sequence, like, False, said.append).symmetry == store.symmetry  # gone on with
    reconstruct_frames(replace(plan, cold=with_axis(cold, store.symmetry)), 0, 2)
    assert store.status[:2].tolist() == [DONE, DONE]
    assert store.array("steps")[1] == 3  # warm: the weights are taken over
    for i in range(2):
        found, kept = store.field(i).sample(store.grid), store.volume(i, "index_excess").values
        torch.testing.assert_close(found, kept, rtol=1e-5, atol=1e-9)
        assert symmetry_of_field(store.field(i)).near(store.symmetry, 1e-9)


def test_a_film_of_which_no_frame_is_found_exits_with_1(five, tmp_path, monkeypatch):
    store = SequenceStore(begun(five, tmp_path / "r.zarr").out)
    monkeypatch.setattr("nerif.cli.commands.sequence.run", lambda settings: store)
    assert main(["sequence", str(five), "-o", str(tmp_path / "r.zarr")]) == 1


def test_weights_of_another_version_are_refused(undisturbed, tmp_path):
    copied = Path(shutil.copytree(undisturbed[0].out, tmp_path / "r.zarr"))
    group = zarr.open_group(copied, mode="r+")
    group.attrs["network"] = {**group.attrs["network"], "gone": 0.0}
    with pytest.raises(InputError, match=r"another version of nerif, or damaged; reconstruct it again \(.*gone"):
        SequenceStore(copied).field(0)


def test_a_warm_frame_begins_where_the_one_before_ended(undisturbed, five):
    plan, _ = undisturbed
    before = SequenceStore(plan.out).field(0)
    one = replace(COLD, max_steps=1, rate_after_fit=1e-12)
    after = one(MeasurementSequence.read(five).frame(1), start=before).field
    grid = SequenceStore(plan.out).grid
    x, y = before.sample(grid), after.sample(grid)
    assert after.scale != before.scale
    # the same field but for the constant that the ambient pins
    assert float((x - y - (x - y).mean()).abs().max()) < 1e-4 * float(x.abs().max())


def test_going_on_gives_what_an_undisturbed_run_gives(undisturbed, short, tmp_path):
    plan = begun(short, tmp_path / "parts.zarr")

    class Killed(BaseException):
        pass

    def die(told: dict) -> None:
        if told == {"frame": 2, "what": "begun"}:
            raise Killed

    with pytest.raises(Killed):
        reconstruct_frames(plan, 0, 5, die)
    store = SequenceStore(plan.out)
    assert store.status.tolist() == [DONE, DONE, MISSING, MISSING, MISSING]
    reconstruct_frames(plan, 0, 5)
    for i in range(5):
        a, b = (SequenceStore(p.out).volume(i, "index_excess").values for p in (undisturbed[0], plan))
        assert torch.equal(a, b)


def test_a_frame_of_nan_is_recorded_and_the_next_starts_from_the_last_good_one(short, tmp_path):
    blank(short, 2)
    plan = begun(short, tmp_path / "r.zarr")
    told: list[dict] = []
    reconstruct_frames(plan, 0, 5, told.append)
    store = SequenceStore(plan.out)
    assert store.status.tolist() == [DONE, DONE, FAILED, DONE, DONE]
    assert "no valid pixel" in store.reasons[2]
    assert store.array("attempts")[2] == frames.ATTEMPTS
    assert store.array("steps")[3] == 15  # warm
    assert "frame 2:" in outcome_table(store)
    assert "1 failed" in outcome_table(store)
    assert bool(torch.isnan(store.volume(2, "index_excess").values).all())
    with pytest.raises(InputError, match="frame 2 is not done"):
        store.field(2)
    assert store.forget_failures() == 1
    assert store.status[2] == MISSING


def test_a_frame_that_fails_warm_is_tried_from_nothing_then_with_half_the_rate(short, tmp_path, monkeypatch):
    plan = begun(short, tmp_path / "r.zarr")
    tries: list[tuple[int, float, bool]] = []
    real = frames._frame

    def fail_twice(plan, settings, measurement, start, watch):
        tries.append((settings.max_steps, settings.learning_rate, start is not None))
        if len(tries) in (2, 3):
            raise ArithmeticError("diverged")
        return real(plan, settings, measurement, start, watch)

    monkeypatch.setattr(frames, "_frame", fail_twice)
    reconstruct_frames(plan, 0, 2)
    rate = COLD.learning_rate
    assert tries == [(30, rate, False), (15, rate, True), (30, rate, False), (30, rate / 2, False)]
    assert SequenceStore(plan.out).array("attempts")[:2].tolist() == [1, 3]


def test_a_view_that_is_missing_in_one_frame_has_no_score_there(short, tmp_path):
    blank(short, 1, view=2)
    plan = begun(short, tmp_path / "r.zarr", withhold=("85deg",))
    reconstruct_frames(plan, 0, 2)
    store = SequenceStore(plan.out)
    cc = store.array("cc")[:2]
    assert np.isnan(cc).tolist() == [[False] * 3, [False, False, True]]
    assert store.attributes["withhold"] == ["85deg"]


def test_chunks_do_not_depend_on_what_is_missing():
    assert chunks_of([0, 1, 9, 23], 8, 24) == [(0, 8), (8, 16), (16, 24)]
    assert chunks_of([17], 8, 20) == [(16, 20)]
    assert chunks_of([], 8, 24) == []


def test_other_settings_are_refused_by_name(short, tmp_path):
    store = SequenceStore(begun(short, tmp_path / "r.zarr").out)
    store.check_same({"settings": asdict(COLD)})
    with pytest.raises(InputError, match=r"seed: expected 0, with which it was begun, got 3"):
        store.check_same({"settings": asdict(dataclasses.replace(COLD, seed=3))})
    with pytest.raises(InputError, match="expected the result of nerif sequence"):
        SequenceStore(short.with_name("short.truth.zarr"))
