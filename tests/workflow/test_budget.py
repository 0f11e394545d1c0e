"""A time limit is shared among the fits of a run; the steps of the pipeline own the sections of metrics.json."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest

from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.metrics import Metrics
from nerif.workflow import budget
from nerif.workflow.budget import LEAST, NO_LIMIT, Budget
from nerif.workflow.steps import CLOSING, STEPS, Bootstrap, DrawErrors


@pytest.fixture
def clock(monkeypatch) -> SimpleNamespace:
    """A clock that is set by hand."""
    now = SimpleNamespace(seconds=1000.0)
    monkeypatch.setattr(budget, "time", SimpleNamespace(time=lambda: now.seconds, perf_counter=lambda: now.seconds))
    return now


def test_fits_share_what_is_left_after_the_reserve(clock):
    limit = Budget(60.0, 1000.0, 10.0)
    clock.seconds = 1005.0
    assert limit.allot(Tikhonov(time_limit=60.0), 1 / 3).time_limit == pytest.approx(45 / 3)
    clock.seconds = 1040.0
    assert limit.allot(NeRIF(time_limit=60.0)).time_limit == pytest.approx(10.0)
    clock.seconds = 1100.0
    assert limit.allot(NeRIF(time_limit=60.0)).time_limit == pytest.approx(LEAST * 60)  # a fit takes a few steps


def test_without_a_limit_settings_stay():
    settings = NeRIF(max_steps=5)
    assert NO_LIMIT.allot(settings, 0.1) is settings


def test_the_limit_counts_from_the_start_and_reserves_time_for_the_rest(measurement, clock):
    by_network = Budget.of(NeRIF(time_limit=60.0, device="cpu"), measurement, 8, start=990.0)
    assert (by_network.limit, by_network.start) == (60.0, 990.0)
    assert by_network.reserve >= budget.REPORT
    assert Budget.of(Tikhonov(), measurement, 8, None).limit == 0


def test_sampling_a_larger_volume_reserves_more_time(measurement):
    small, large = (Budget.of(NeRIF(time_limit=60.0, device="cpu"), measurement, n, None).reserve for n in (8, 400))
    assert large > small


def test_every_section_of_the_metrics_belongs_to_one_step_or_to_the_evaluation():
    assert DrawErrors.sections == Bootstrap.sections  # one or the other
    sections = [name for step in (*STEPS, *CLOSING) if step is not DrawErrors for name in step.sections]
    assert len(sections) == len(set(sections))
    truth = {"truth", "quantity", "l2", "l2_variation", "cc", "ssim", "psnr", "slices", "aligned", "coverage"}
    assert {*sections, *truth, "version"} == {field.name for field in dataclasses.fields(Metrics)}
