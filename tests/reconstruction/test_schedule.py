"""The end of a training: limits and their clock, cycles, collapse, and the warning of a run with too few steps."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from nerif.fields.network_shape import NetworkShape
from nerif.reconstruction.neural import schedule as module
from nerif.reconstruction.neural import trainer
from nerif.reconstruction.neural.fit_monitor import EMPTY_RATE, EMPTY_STEPS, MIN_STEPS, FitMonitor
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.presets import preset
from nerif.reconstruction.neural.schedule import PACE_STEPS, Cycles, Pace, Schedule, duration
from nerif.reconstruction.progress import Monitor
from nerif.reconstruction.reconstructor import Step
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.live import read_live
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings

SMALL = NeRIF(network=NetworkShape(depth=1, width=8, octaves=1), points_per_batch=256, device="cpu")


def test_the_time_limit_excludes_imports(measurement, monkeypatch):
    class Slow(trainer.NetworkOptimiser):
        def __init__(self, *arguments):
            time.sleep(0.6)
            super().__init__(*arguments)

    replace(SMALL, max_steps=1)(measurement)
    monkeypatch.setattr(trainer, "NetworkOptimiser", Slow)
    assert replace(SMALL, time_limit=0.5, max_steps=1)(measurement).history


def test_pace_is_measured_from_the_last_change_of_the_rays(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(module.time, "perf_counter", lambda: clock[0])
    schedule = Schedule(NeRIF(max_steps=10, device="cpu"), 1000, Ranks(), torch.device("cpu"))
    schedule.count(600)
    clock[0] = 2.0
    assert schedule.rays_per_second == pytest.approx(300.0)
    state = schedule.state_dict()
    schedule.set_rays(100)  # 0.6 epochs are 60 of these
    assert schedule.rays_done == 60
    schedule.count(50)
    clock[0] = 3.0
    assert schedule.rays_per_second == pytest.approx(50.0)
    schedule.load_state_dict({**state, "rays_done": 0})
    schedule.count(20)
    clock[0] = 5.0
    assert schedule.rays_per_second == pytest.approx(10.0)


@pytest.mark.parametrize(("seconds", "steps"), [(0.5, 19), (1e-4, 41)])
def test_history_has_a_record_every_20_steps_and_every_few_seconds(measurement, slow_clock, seconds, steps):
    slow_clock(seconds)
    history = replace(SMALL, max_steps=steps)(measurement).history
    if steps == 41:
        assert [record["step"] for record in history] == [1, 20, 40, 41]
    else:
        times = [record["seconds"] for record in history]
        assert len(times) > 5
        assert max(b - a for a, b in pairwise(times)) < 15.0


@pytest.mark.parametrize(
    ("errors", "noise", "reason"),
    [
        ([5.0, 3.0, 2.0], 1.0, ""),
        ([5.0, 3.0, 2.9], 1.0, ""),
        ([5.0, 3.0, 2.9, 2.95], 1.0, "converged"),
        ([5.0, 3.0, 3.2, 2.0], 1.0, ""),  # one cycle that scatters is no end
        ([5.0, 3.0, 3.2, 3.1], 1.0, "converged"),
        ([1.010, 1.009, 1.008], 1.0, "converged"),  # a fifth of the excess, within the scatter
        ([5.0, 4.9, 4.8], 0.0, "converged"),
        ([2.0**-i for i in range(6)], 0.0, "converged"),  # the maximum number of cycles
        ([0.0, 0.0, 0.0], 0.0, "converged"),
    ],
)
def test_cycles_double_until_two_gain_too_little(errors, noise, reason):
    cycles, step, outcome = Cycles(100), 0, None
    for i, error in enumerate(errors):
        assert outcome is None
        assert cycles.length == 100 * 2**i
        step += cycles.length
        assert cycles.progress(step) == 1
        outcome = cycles.end(error, noise, step)
    assert (outcome.reason if outcome else "") == reason


def test_the_least_and_the_most_steps_of_cycles():
    for errors, steps in (([1.0] * 6, Cycles(100).least_steps), ([2.0**-i for i in range(6)], Cycles(100).most_steps)):
        cycles = Cycles(100)
        while cycles.outcome is None:
            cycles.end(errors.pop(0), 0.0, cycles.step + cycles.length)
        assert cycles.step == steps


def monitor(values: list[float], noise: float = 0.0, rate: float = EMPTY_RATE) -> FitMonitor:
    result = FitMonitor(noise, rate)
    for step, q in enumerate(values, start=1):
        result.update(2 * q, 2.0, step)
    return result


@pytest.mark.parametrize(
    ("values", "final", "options", "collapsed"),
    [
        ([1.0] * (MIN_STEPS - 1), True, {}, False),
        ([1.0] * MIN_STEPS, True, {}, True),
        ([1.0] * (EMPTY_STEPS - 1), False, {}, False),
        ([1.0] * EMPTY_STEPS, False, {}, True),
        ([1.0] * (4 * EMPTY_STEPS - 1), False, {"rate": EMPTY_RATE / 4}, False),  # a smaller rate needs more steps
        ([1.0] * 4 * EMPTY_STEPS, False, {"rate": EMPTY_RATE / 4}, True),
        ([1.0] * EMPTY_STEPS, False, {"rate": 4 * EMPTY_RATE}, True),
        ([0.1] * 100, True, {}, False),
        ([0.1] * 100 + [0.8] * 60, False, {}, True),  # a field that is lost again
        ([1.0] * EMPTY_STEPS, True, {"noise": 0.95}, False),  # there is only noise
    ],
)
def test_collapse_to_the_ambient_field(values, final, options, collapsed):
    assert monitor(values, **options).collapsed(final) == collapsed


def test_fit_monitor_ignores_noise_missing_signal_and_skipped_steps():
    assert monitor([0.1] * 100).healthy
    assert not monitor([0.1] * 100 + [0.8] * 60).healthy
    assert monitor([0.52] * EMPTY_STEPS, noise=0.5).unexplained < 0.1
    still, rare = FitMonitor(0.0), FitMonitor(0.0)
    for step in range(EMPTY_STEPS):
        still.update(0.1, 0.0, step)
    assert not still.collapsed(final=True)
    for step in range(20, EMPTY_STEPS + 1, 20):
        rare.update(1.0, 1.0, step)
    assert rare.collapsed(final=False)


@pytest.mark.parametrize(
    ("q", "noise", "remark"),
    [(0.7, 0.0, "70%"), (0.2, 0.0, ""), (0.04, 0.01, "the residual is 2.0 sigma"), (0.012, 0.01, ""), (0.04, 0.0, "")],
)
def test_a_poor_fit_is_remarked(q, noise, remark):
    text, converged = (monitor([q] * EMPTY_STEPS, noise=noise).remark(end) for end in (False, True))
    assert remark in text
    assert ("longer run" in text) == ("--network.width" in converged) == ("sigma" in remark)
    assert bool(text) == bool(remark)


def warnings(settings, seconds: float, steps: int, first: int = 1, pass_steps: float = 1.0) -> list[str]:
    """Warnings of a run with steps of that length."""
    lines: list[str] = []
    pace = Pace(settings, lines.append)
    for i in range(first, first + steps):
        pace(Step(i, 0.0, seconds * i, 0.0, {}, 1.0, lambda: None, lambda: None, pass_steps=pass_steps))
    return lines


LIMITED = replace(SMALL, time_limit=257.0)


@pytest.mark.parametrize(
    ("settings", "seconds", "steps", "options", "words"),
    [
        (LIMITED, 18.0, 2, {}, ("18 s per step", "4.3 min of training allow about 14 steps",
                              "100 steps would take 30 min")),
        (LIMITED, 4.0, 40, {}, ("slow",)),
        (LIMITED, 4.0, PACE_STEPS - 2, {}, ()),  # too early
        (LIMITED, 1.0, 100, {}, ()),
        (replace(SMALL, time_limit=10000.0), 18.0, 100, {}, ()),
        (replace(preset("paper"), time_limit=257.0), 4.5, 9, {"pass_steps": 1000.0},
         ("200000 planned steps would take 10 days",)),
        (replace(SMALL, time_limit=60.0, max_steps=150), 1.0, 9, {}, ("150 planned steps",)),
        (replace(SMALL, time_limit=60.0, max_steps=50), 1.0, 60, {}, ()),  # there is time for all steps
        (replace(SMALL, max_steps=50), 100.0, 60, {}, ("50 steps of training take about 83 min here",)),
        (SMALL, 10.0, 9, {}, ("converges after 2800 to 25200 steps, about 7.8 h to 2.9 days here",)),
        (replace(SMALL, time_limit=300.0), 4.0, 9, {"first": 60}, ("about 75 steps",)),  # resumed
        (Tikhonov(time_limit=5.0), 1.0, 9, {}, ()),
    ],
)  # fmt: skip
def test_too_few_steps_are_warned_of_once(settings, seconds, steps, options, words):
    lines = warnings(settings, seconds, steps, **options)
    assert len(lines) == bool(words)
    assert all(word in lines[0] for word in words)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.123, "0.12 s"), (18.2, "18 s"), (119.0, "119 s"), (257.0, "4.3 min"), (3600.0 * 30, "30 h"),
     (86400.0 * 17, "17 days")],
)  # fmt: skip
def test_durations(seconds, text):
    assert duration(seconds) == text


def test_a_run_shows_the_warning_in_terminal_and_app(measurement, tmp_path, slow_clock):
    slow_clock(1.0)
    lines: list[str] = []
    settings = replace(SMALL, time_limit=100.0, max_steps=1000)
    run = RunSettings(withhold=("auto",), report=False)
    reconstruct_into(tmp_path / "r", measurement, settings, run, voxels=8, monitor=Monitor(lines.append), live=True)
    (line,) = [line for line in lines if line.startswith("slow: ")]
    assert "1000 planned steps" in line
    assert read_live(tmp_path / "r")["remark"] == line


def test_steps_of_an_epoch(measurement):
    steps: list[Step] = []
    result = replace(SMALL, samples=(12, 20), epochs=2.0)(measurement, on_step=steps.append)
    assert result.history[-1]["step"] == pytest.approx(2 * steps[0].pass_steps, rel=0.1)
