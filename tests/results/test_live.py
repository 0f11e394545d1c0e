"""The status of a live run: its content, only if requested, and its share of the time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from nerif.fields.phantoms import make_phantom
from nerif.geometry import Ring
from nerif.geometry.pose import GEOMETRY, Corrections
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.progress import QUIET
from nerif.reconstruction.reconstructor import Step
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results import live
from nerif.results.live import Live, read_live, read_snapshot
from nerif.simulation.simulation import Simulation
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings

RING = Ring(views=4, arc=(0.0, 135.0), image_size=(12, 18), pixel_pitch=0.22)
METHODS = [NeRIF(max_steps=10, points_per_batch=256), Tikhonov(voxels=8, iterations=10, regularisation=0.1)]


@pytest.fixture(scope="module")
def measurement():
    return Simulation(phantom="gaussians", truth_voxels=6)(RING.cameras())[0]


@pytest.mark.parametrize("method", METHODS, ids=["nerif", "voxels"])
@pytest.mark.parametrize("withhold", [pytest.param(("45deg",), marks=pytest.mark.slow), ("auto",)], ids=str)
def test_the_status_of_a_run(measurement, method, withhold, tmp_path, monkeypatch):
    for name, value in {"FIELD_DELAY": 0.0, "FIELD_SHARE": 1e9, "COARSE_VOXELS": 8, "RAY_SAMPLES": 16}.items():
        monkeypatch.setattr(live, name, value)
    run = RunSettings(withhold=withhold, report=False)
    result = reconstruct_into(tmp_path / "r", measurement, method, run, voxels=8, live=True)
    status, look = read_live(tmp_path / "r"), read_snapshot(tmp_path / "r")
    assert status["progress"] == 1 or isinstance(method, Tikhonov)  # which may converge before
    assert status["step"] >= status["curve"]["step"][-1]
    assert len(status["curve"]["seconds"]) == len(status["curve"]["step"]) > 1
    assert look.view == status["view"] == ("45deg" if withhold == ("45deg",) else look.view)
    assert look.withheld == (withhold == ("45deg",))
    assert look.components == ("u", "v")
    assert look.measured.shape == look.predicted.shape == (12, 18, 2)
    assert look.quantity == result.quantity
    assert max(look.values.shape) == live.COARSE_VOXELS
    assert np.isfinite(look.values).all()
    valid = np.isfinite(look.measured)
    assert np.mean((look.predicted - look.measured)[valid] ** 2) < 2 * np.mean(look.measured[valid] ** 2)


def test_a_long_curve_has_even_steps(measurement, tmp_path):
    status = Live(tmp_path, measurement, METHODS[0])
    with status.watching(QUIET, withheld=False, snapshots=False).training("t") as on_step:
        for number in range(1, 5 * live.CURVE_POINTS):
            on_step(
                Step(
                    number,
                    0.0,
                    float(number),
                    0.5,
                    {"loss": 1.0},
                    0.0,
                    dict,
                    lambda: make_phantom("flame", measurement.box),
                )
            )
    steps = np.array(read_live(tmp_path)["curve"]["step"])
    assert live.CURVE_POINTS / 3 < len(steps) <= live.CURVE_POINTS
    assert set(np.diff(steps)) <= {7, 8}


def test_the_view_is_seen_by_the_camera_that_is_refined(measurement, tmp_path, monkeypatch):
    monkeypatch.setattr(live, "FIELD_DELAY", 0.0)
    shifts = torch.zeros(4, len(GEOMETRY), dtype=torch.float64)
    shifts[:, 4] = 2.0
    knocked = replace(measurement, cameras=Corrections(measurement.cameras, -shifts).corrected)
    rig = [{"name": name, "values": {"shift_y": 2.0}} for name in knocked.names]
    field, looks = make_phantom("gaussians", measurement.box, 0), []
    step = Step(1, 0.0, 0.0, 0.5, {"loss": 1.0}, 1.0, lambda: None, lambda: field)
    for data, table in ((measurement, []), (knocked, rig)):
        with Live(tmp_path, data, NeRIF()).watching(QUIET, withheld=False).training("training") as on_step:
            on_step(replace(step, rig=lambda table=table: table))
        looks.append(read_snapshot(tmp_path).predicted)
    np.testing.assert_allclose(*looks, atol=1e-4 * np.nanmax(np.abs(looks[0])))


def test_a_status_that_cannot_be_written_does_not_end_a_run(measurement, tmp_path, monkeypatch, caplog):
    def full(*_):
        raise OSError(28, "no space")

    monkeypatch.setattr(live, "FIELD_DELAY", 0.0)
    monkeypatch.setattr(live, "write_json", full)
    monkeypatch.setattr(live.np, "savez", full)
    run = RunSettings(report=False, withhold=("none",))
    assert not reconstruct_into(tmp_path, measurement, METHODS[1], run, live=True, force=True).outcome.failed
    assert [record.message for record in caplog.records] == [
        "live view: not written (OSError: [Errno 28] no space); the run goes on"
    ]
    assert read_live(tmp_path) == {}


def test_no_status_unless_requested(measurement, tmp_path):
    run = RunSettings(report=False, withhold=("none",))
    reconstruct_into(tmp_path, measurement, Tikhonov(voxels=8), run, force=True)
    assert read_live(tmp_path) == {}
    assert read_snapshot(tmp_path) is None


@pytest.mark.parametrize(
    ("first", "later", "share", "longest"),  # s to write the field; then of the time, and the longest wait, s
    [
        (0.05, 0.05, 0.013, 6),
        (0.17, 0.17, 0.013, 18),
        (0.5, 0.5, 0.03, 21),  # not more often than every 20 s, at little cost
        (5.0, 5.0, 0.14, 56),  # as of a large field
        (2.0, 0.1, 0.03, 12),  # the first also compiles and imports
        (30.0, 0.1, 0.2, 62),
    ],
)
def test_the_field_is_written_as_often_as_its_duration_allows(
    measurement, tmp_path, monkeypatch, first, later, share, longest
):
    clock, looks = [0.0], []
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    monkeypatch.setattr(live, "STATUS_INTERVAL", 50.0)
    status = Live(tmp_path, measurement, NeRIF())

    def look(title, step, withheld):
        looks.append((clock[0], step.step))
        clock[0] += later if looks[1:] else first

    monkeypatch.setattr(status, "_write_snapshot", look)
    step = Step(1, 0.0, 0.0, 0.5, {"loss": 1.0}, 1.0, lambda: None, lambda: None)
    with status.watching(QUIET, withheld=False).training("training") as on_step:
        for i in range(4000):
            clock[0] += 0.05
            assert not on_step(replace(step, step=i))
    times, steps = zip(*looks, strict=True)
    assert (first + (len(looks) - 1) * later) / clock[0] <= share
    assert max(np.diff([0.0, *times])) <= longest
    assert steps[-1] == 3999  # the field at the end stays to be seen
    assert len(read_live(tmp_path)["curve"]["step"]) <= live.CURVE_POINTS
