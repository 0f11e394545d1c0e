"""A run that has time for too few steps says so once, from the pace of the first ones."""

from __future__ import annotations

from dataclasses import replace

import pytest

from nerif.fields.network import NetworkShape
from nerif.reconstruction.base import Step
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.presets import preset
from nerif.reconstruction.neural.slow_run import LOOK, SlowRun, lasting
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.live import read_live
from nerif.workflow.job import Run
from nerif.workflow.pipeline import reconstruct_into

SMALL = NeRIF(network=NetworkShape(depth=1, width=8, octaves=1), points_per_batch=256, device="cpu")


def said(settings, seconds: float, steps: int, first: int = 1, pass_steps: float = 1.0) -> list[str]:
    """What is said of a run whose steps take so many seconds each."""
    lines: list[str] = []
    slow = SlowRun(settings, lines.append)
    for i in range(first, first + steps):
        slow(Step(i, 0.0, seconds * i, 0.0, {}, 1.0, lambda: None, lambda: None, pass_steps=pass_steps))
    return lines


def test_too_few_steps_are_said_once_and_soon():
    settings = replace(SMALL, time_limit=257.0)
    (line,) = said(settings, 18.0, 2)  # after two steps, since they take long
    assert "a step takes 18 s" in line
    assert "257 s" not in line
    assert "4.3 min allows about 14 steps" in line
    assert "100 steps would take 30 min" in line
    assert "--time-limit" in line
    assert len(said(settings, 4.0, 40)) == 1
    assert said(settings, 4.0, LOOK - 2) == []  # not known yet
    assert said(settings, 1.0, 100) == []
    assert said(replace(settings, time_limit=10000.0), 18.0, 100) == []


def test_the_steps_asked_for_are_what_it_would_take():
    asked = replace(preset("paper"), time_limit=257.0)
    assert "the 200000 steps asked for would take 10 days" in said(asked, 4.5, 9, pass_steps=1000.0)[0]
    assert "150 steps asked for" in said(replace(SMALL, time_limit=60.0, max_steps=150), 1.0, 9)[0]
    assert said(replace(SMALL, time_limit=60.0, max_steps=50), 1.0, 60) == []  # there is time for all of them
    assert said(replace(SMALL, max_steps=50), 100.0, 60) == []  # no clock ends it
    assert "10 min allows about 60 steps" in said(SMALL, 10.0, 9)[0]  # a run without a limit has the longest there is


def test_a_resumed_run_has_what_is_left():
    lines = said(replace(SMALL, time_limit=300.0), 4.0, 9, first=60)
    assert "about 75 steps" in lines[0]
    assert said(Tikhonov(time_limit=5.0), 1.0, 9) == []


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.123, "0.12 s"),
        (18.2, "18 s"),
        (119.0, "119 s"),
        (257.0, "4.3 min"),
        (3600.0 * 30, "30 h"),
        (86400.0 * 17, "17 days"),
    ],
)
def test_durations_in_words(seconds, words):
    assert lasting(seconds) == words


def test_the_user_hears_of_it_and_the_app_shows_it(measurement, tmp_path, slow_clock):
    slow_clock(1.0)
    lines: list[str] = []
    settings = replace(SMALL, time_limit=400.0, max_steps=1000)
    run = Run(withhold=("auto",), report=False)
    reconstruct_into(tmp_path / "r", measurement, settings, run, voxels=8, monitor=Monitor(lines.append), live=True)
    (line,) = [line for line in lines if line.startswith("slow: ")]
    assert "the 1000 steps asked for" in line
    assert read_live(tmp_path / "r")["remark"] == line


def test_a_pass_takes_as_many_steps_as_rays_ask_for(measurement):
    seen: list[Step] = []
    result = replace(SMALL, samples=(12, 20), epochs=2.0)(measurement, on_step=seen.append)
    assert result.history[-1]["step"] == pytest.approx(2 * seen[0].pass_steps, rel=0.1)
