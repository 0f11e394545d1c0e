"""A run that tells how it goes on: what is written, only if asked, and how little of the time it takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import nerif.results.live
from nerif.geometry import Ring
from nerif.reconstruction.base import Step
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.progress import QUIET
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.live import Live, read_live, read_look
from nerif.simulation.simulate import Simulation
from nerif.workflow.job import Run
from nerif.workflow.pipeline import reconstruct_into

RING = Ring(views=4, arc=(0.0, 135.0), image_size=(12, 18), pixel_pitch=0.22)


@pytest.fixture(scope="module")
def measurement():
    return Simulation(phantom="gaussians", truth_voxels=6)(RING.cameras())[0]


METHODS = [NeRIF(max_steps=10, points_per_batch=256), Tikhonov(voxels=8, iterations=10, regularisation=0.1)]


@pytest.mark.parametrize("method", METHODS, ids=["nerif", "voxels"])
@pytest.mark.parametrize(
    "withhold", [pytest.param(("45deg",), marks=pytest.mark.slow), ("auto",)], ids=["held out", "auto"]
)
def test_a_run_tells_how_it_goes_on(measurement, method, withhold, tmp_path, monkeypatch):
    monkeypatch.setattr(nerif.results.live, "FIRST", 0.0)
    for name, value in {"SHARE": 1e9, "VOXELS": 8, "SAMPLES": 16}.items():
        monkeypatch.setattr(nerif.results.live, name, value)
    run = Run(withhold=withhold, report=False)
    result = reconstruct_into(tmp_path / "r", measurement, method, run, voxels=8, live=True)
    live, look = read_live(tmp_path / "r"), read_look(tmp_path / "r")
    assert live["progress"] == 1 or isinstance(method, Tikhonov)  # which may end before
    assert live["step"] >= live["curve"]["step"][-1]
    assert live["view"] == ("45deg" if withhold == ("45deg",) else look.view)
    assert len(live["curve"]["seconds"]) == len(live["curve"]["step"]) > 1
    assert look.view == live["view"]
    assert look.withheld == (withhold == ("45deg",))
    assert look.components == ("u", "v")
    assert look.measured.shape == look.predicted.shape == (12, 18, 2)
    assert look.quantity == result.quantity
    assert max(look.values.shape) == nerif.results.live.VOXELS
    assert np.isfinite(look.values).all()
    known = np.isfinite(look.measured)
    assert np.mean((look.predicted - look.measured)[known] ** 2) < 2 * np.mean(look.measured[known] ** 2)


def test_only_if_asked(measurement, tmp_path):
    reconstruct_into(tmp_path, measurement, Tikhonov(voxels=8), Run(report=False, withhold=("none",)), force=True)
    assert read_live(tmp_path) == {}
    assert read_look(tmp_path) is None


def test_looks_take_a_share_of_the_time(measurement, tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    live = Live(tmp_path, measurement, NeRIF())
    looks = []

    def look(title, step, withheld):
        looks.append(clock[0])
        clock[0] += 0.5

    monkeypatch.setattr(live, "_look", look)
    step = Step(1, 0.0, 0.0, 0.5, {"loss": 1.0}, 1.0, lambda: None, lambda: None)
    with live.watching(QUIET, withheld=False).training("training") as told:
        for i in range(4000):
            clock[0] += 0.05
            assert not told(replace(step, step=i))
    assert 0.8 * nerif.results.live.SHARE < len(looks) * 0.5 / clock[0] <= nerif.results.live.SHARE
    assert len(read_live(tmp_path)["curve"]["step"]) <= nerif.results.live.POINTS
