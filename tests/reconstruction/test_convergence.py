"""Runs without a limit: cycles, withheld pixels, and the best cycle."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch

from nerif.analysis.evaluation import evaluate_volume
from nerif.data.volume import Volume
from nerif.fields.network_shape import NetworkShape
from nerif.geometry import Grid
from nerif.reconstruction.field_files import read_state, write_state
from nerif.reconstruction.neural import objective, schedule
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.reconstruction.reconstructor import Step
from nerif.simulation.simulate import add_noise
from refusals import refused

ENDLESS = NeRIF(
    network=NetworkShape(depth=2, width=32, octaves=2), samples=(12, 16), points_per_batch=512, first_cycle=40,
    device="cpu", precision="float32",
)  # fmt: skip


def residuals(result):
    return [record["withheld_residual"] for record in result.history if "withheld_residual" in record]


def test_withheld_pixels_are_in_no_batch(measurement):
    data = TrainingData(ENDLESS, measurement, withhold=True)
    assert data.withheld is not None
    assert len(data) + len(data.withheld) == len(TrainingData(ENDLESS, measurement))


@pytest.mark.slow
def test_without_withheld_pixels_the_loss_decides(measurement):
    valid = torch.zeros_like(measurement.usable)
    valid[:, 10, 10] = True
    result = replace(ENDLESS, first_cycle=10)(replace(measurement, valid=valid))
    assert result.outcome.message.startswith("residual ")
    assert "withheld" not in result.outcome.message


@pytest.mark.slow
def test_a_run_converges_and_resumes(measurement, ball, tmp_path, monkeypatch):
    monkeypatch.setattr(schedule, "MAX_CYCLES", 3)
    measurement, states = add_noise(measurement, 0.3, seed=3), {}
    whole = ENDLESS(measurement, lambda s: states.__setitem__(s.step, s.capture()) if s.step == 90 else None)
    assert whole.outcome.reason == "converged"
    assert "residual of withheld pixels" in whole.outcome.message
    errors = residuals(whole)
    assert len(errors) >= 2
    assert errors[0] > errors[-1] > 0.9
    grid = Grid.of_resolution(measurement.box, 24)
    truth = Volume(ball.sample(grid), grid)
    assert evaluate_volume(whole.field, truth, measurement.n_ambient)["l2_variation"] < 0.2
    write_state(tmp_path, states[90])
    again, points = ENDLESS(measurement, resume=read_state(tmp_path)), torch.rand(50, 3)
    assert torch.equal(again.field(points), whole.field(points))
    assert residuals(again) == errors
    finished = ENDLESS(measurement, resume=whole.state)
    assert finished.outcome.message == whole.outcome.message
    assert len(finished.history) == len(whole.history)
    assert torch.equal(finished.field(points), whole.field(points))


def test_a_run_that_had_a_limit_continues_with_a_cycle(measurement):
    limited = replace(ENDLESS, max_steps=20)(measurement)
    settings = replace(ENDLESS, first_cycle=10)
    endless = settings(measurement, lambda step: step.step == 31, resume=limited.state)
    first = next(record for record in endless.history if "withheld_residual" in record)
    assert first["step"] == 30


@pytest.mark.parametrize(
    ("first", "refine", "interrupted"),
    [(20, (), True), pytest.param(20, (), False, marks=pytest.mark.slow),
     pytest.param(6, ("cameras",), False, marks=pytest.mark.slow)],
)  # fmt: skip
def test_the_result_is_that_of_the_best_cycle(measurement, monkeypatch, first, refine, interrupted):
    """Here of the first cycle."""
    errors, states = itertools.chain([2.0], itertools.repeat(3.0)), []
    monkeypatch.setattr(objective.Objective, "withheld_residual", lambda self, density: next(errors))
    monkeypatch.setattr("nerif.reconstruction.rig_refinement.SIGN", -1.0)  # the rig counts as off
    settings = replace(ENDLESS, first_cycle=first, refine=refine)

    def on_step(step: Step) -> bool:
        if step.step == first:
            states.append(step.capture())
        return interrupted and step.step == first + 10

    result = settings(measurement, on_step)
    if interrupted:
        assert result.outcome.reason == "interrupted"
        result = settings(measurement, resume=result.state)
    assert result.outcome.reason == "converged"
    weights = result.field.network.state_dict()
    assert all(torch.equal(weights[k], v) for k, v in states[0].under("network.").items())
    if refine:
        values = torch.tensor([list(row["values"].values()) for row in result.rig], dtype=torch.float64)
        best, last = (s.tensors["data.rig.values"][:, : values.shape[1]] for s in (states[0], result.state))
        assert torch.equal(values, best)
        assert not torch.equal(values, last)


@pytest.mark.parametrize(("setting", "value"), [("first_cycle", 0), ("time_limit", math.nan)])
def test_invalid_limits_are_refused(setting, value):
    with refused(setting):
        NeRIF(**{setting: value})
