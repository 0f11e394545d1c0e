"""A time limit is shared among the fits of a run."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest

from nerif.fields.network_shape import NetworkShape
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.directory import ResultDirectory
from nerif.workflow import budget
from nerif.workflow.budget import LEAST, Budget
from nerif.workflow.reconstruction_run import ReconstructionRun
from nerif.workflow.run_settings import RunSettings


@pytest.fixture
def clock(monkeypatch) -> SimpleNamespace:
    """A clock that is set by hand."""
    now = SimpleNamespace(seconds=1000.0)
    monkeypatch.setattr(budget, "time", SimpleNamespace(time=lambda: now.seconds, perf_counter=lambda: now.seconds))
    return now


def test_fits_share_the_time_beyond_the_reserve(clock):
    limit = Budget(60.0, 1000.0, 10.0)
    clock.seconds = 1005.0
    assert limit.limited(Tikhonov(time_limit=60.0), 1 / 3).time_limit == pytest.approx(45 / 3)
    clock.seconds = 1040.0
    assert limit.limited(NeRIF(time_limit=60.0)).time_limit == pytest.approx(10.0)
    clock.seconds = 1100.0
    assert limit.limited(NeRIF(time_limit=60.0)).time_limit == pytest.approx(LEAST * 60)  # a fit takes a few steps


def test_without_a_limit_settings_stay():
    settings = NeRIF(max_steps=5)
    assert Budget(0.0, 0.0, 0.0).limited(settings, 0.1) is settings


def test_the_limit_counts_from_the_start_and_reserves_time_for_the_rest(measurement, clock):
    by_network = Budget.of(NeRIF(time_limit=60.0, device="cpu"), measurement, 8, start=990.0)
    assert (by_network.limit, by_network.start) == (60.0, 990.0)
    assert by_network.reserve >= budget.REPORT
    assert Budget.of(Tikhonov(), measurement, 8, None).limit == 0


@pytest.mark.parametrize(
    ("limit", "reserve", "pace", "words"),
    [
        # 9 views of 1000 x 1000 px: 1.2 fits in 15 s
        (60.0, 45.0, 0.1, ("--time-limit 60 is too short", "45 s", "12 s for the fit", "125 steps; 400 take 40 s",
                           "--time-limit 100 or more")),
        (60.0, 10.0, 0.1, ()),  # 417 steps
        (60.0, 10.0, 0.3, ("139 steps", "--time-limit 160 or more")),  # a slow machine
        (60.0, 50.0, 0.0, ("50 s", "8.3 s for the fit.", "--time-limit 100 or more")),  # voxels have no pace
        (60.0, 38.0, 0.0, ()),
        (60.0, 70.0, 0.1, ("5 s for the fit, about 50 steps", "--time-limit 140 or more")),  # nothing is left
        (0.0, 70.0, 0.1, ()),
    ],
)  # fmt: skip
def test_too_short_a_limit_is_said_with_what_it_would_take(clock, limit, reserve, pace, words):
    text = Budget(limit, 1000.0, reserve, 400 if pace else 0, pace).shortage(0, validated=True)
    assert bool(text) == bool(words)
    assert all(word in text for word in words)


def test_trials_and_the_prediction_of_the_withheld_view_take_time_too(clock):
    limit = Budget(60.0, 1000.0, 10.0, 400, 0.1, validation=8.0)
    assert not limit.shortage(0, validated=True)
    assert "18 s, which leaves 13 s" in limit.shortage(2, validated=True)


def test_voxel_methods_count_iterations(measurement, clock):
    coarse, fine = (Budget.of(Tikhonov(voxels=n, time_limit=5.0, device="cpu"), measurement, n, None) for n in (10, 20))
    assert fine.pace == pytest.approx(2 * coarse.pace, rel=0.2)
    assert "iterations on the finest grid; 50 take" in dataclasses.replace(fine, pace=1.0).shortage(0, validated=True)


def test_too_short_a_limit_is_said_before_the_cross_validation(measurement, tmp_path, monkeypatch):
    monkeypatch.setattr(budget, "REPORT", 900.0)
    lines: list[str] = []
    settings = NeRIF(network=NetworkShape(depth=1, width=8, octaves=1), time_limit=1000.0, max_steps=4, device="cpu")
    out, monitor = ResultDirectory(tmp_path / "r"), Monitor(lines.append)
    run = ReconstructionRun.plan(out, measurement, settings, RunSettings(), 8, monitor=monitor).with_live_view()
    assert run.validation is not None
    assert "--time-limit 1000 is too short" in lines[-1]
    assert run.view.remark() == lines[-1]  # shown by the app


def test_sampling_a_larger_volume_reserves_more_time(measurement):
    small, large = (Budget.of(NeRIF(time_limit=60.0, device="cpu"), measurement, n, None).reserve for n in (8, 400))
    assert large > small
