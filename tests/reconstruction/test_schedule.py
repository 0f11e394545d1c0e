"""What counts as time of training, and what it is told by."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from nerif.fields.network import NetworkShape
from nerif.reconstruction.neural import schedule as module
from nerif.reconstruction.neural import training
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.schedule import Budget


def test_the_time_limit_is_of_training_alone(measurement, monkeypatch):
    """An optimiser that takes long to be there, as with the first import of what it needs, costs no step."""

    class Slow(training.NetworkOptimiser):
        def __init__(self, *arguments, **more):
            time.sleep(1.3)
            super().__init__(*arguments, **more)

    NeRIF(network=NetworkShape(depth=1, width=8), points_per_batch=64, max_steps=1, device="cpu")(measurement)
    monkeypatch.setattr(training, "NetworkOptimiser", Slow)
    settings = NeRIF(
        network=NetworkShape(depth=1, width=8), points_per_batch=64, time_limit=1.0, max_steps=1, device="cpu"
    )
    assert settings(measurement).history


def test_the_pace_begins_again_where_other_rays_are_counted(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(module.time, "perf_counter", lambda: clock[0])
    budget = Budget(NeRIF(max_steps=10, device="cpu"), 1000, Ranks.from_environment(), torch.device("cpu"))
    budget.count(600)
    clock[0] = 2.0
    assert budget.rays_per_second == pytest.approx(300.0)
    kept = budget.used()
    budget.recount(100)  # 0.6 epochs are 60 of these
    assert budget.rays_done == 60
    budget.count(50)
    clock[0] = 3.0
    assert budget.rays_per_second == pytest.approx(50.0)
    budget.restore({**kept, "rays_done": 0})  # taken back
    budget.count(20)
    clock[0] = 5.0
    assert budget.rays_per_second == pytest.approx(10.0)


def test_slow_steps_have_a_history(measurement, slow_clock):
    """A record every twenty steps and, where these take long, every few seconds."""
    settings = NeRIF(network=NetworkShape(depth=1, width=8, octaves=1), points_per_batch=256, device="cpu")
    slow_clock(0.5)
    slow = replace(settings, max_steps=19)(measurement)
    recorded = [record["seconds"] for record in slow.history]
    assert len(recorded) > 5
    assert max(b - a for a, b in pairwise(recorded)) < 15.0
    slow_clock(1e-4)
    quick = replace(settings, max_steps=41)(measurement)
    assert [record["step"] for record in quick.history] == [1, 20, 40, 41]
