"""A run without a limit: cycles, rays held back, and an end that says why."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch

from nerif.analysis.evaluation import evaluate_volume
from nerif.common.conventions import InputError
from nerif.data.measurement import measurement_of
from nerif.data.volume import Volume
from nerif.fields.network import NetworkShape
from nerif.forward.deflection import Deflection
from nerif.forward.interferometry import Interferometry
from nerif.geometry import Grid, paper_rig
from nerif.reconstruction.base import Step
from nerif.reconstruction.files import read_state, write_state
from nerif.reconstruction.neural import convergence, objective
from nerif.reconstruction.neural.convergence import Cycles
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.some_pixels import hold_back
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.simulation.simulate import add_noise

ENDLESS = NeRIF(
    network=NetworkShape(depth=2, width=32, octaves=2), samples=(12, 16), points_per_batch=512, first_cycle=40,
    device="cpu", precision="float32",
)  # fmt: skip


def cycles(errors: list[float], noise: float = 1.0, longest: float = 1e9) -> tuple[list[int], str]:
    """Lengths of the cycles that end with such errors, a second a step, and why the last was the last."""
    found, step, lengths, outcome = Cycles(100, longest), 0, [], None
    for error in errors:
        assert outcome is None
        lengths.append(found.length)
        step += found.length
        assert found.progress(step, step) == 1
        outcome = found.judge(error, noise, step, step)
    return lengths, outcome.reason if outcome else ""


def test_cycles_double_until_two_gain_next_to_nothing():
    assert cycles([5.0, 3.0, 2.0]) == ([100, 200, 400], "")
    assert cycles([5.0, 3.0, 2.9]) == ([100, 200, 400], "")
    assert cycles([5.0, 3.0, 2.9, 2.95]) == ([100, 200, 400, 800], "converged")
    assert cycles([5.0, 3.0, 3.2, 2.0]) == ([100, 200, 400, 800], "")  # one that scatters is no end
    assert cycles([5.0, 3.0, 3.2, 3.1]) == ([100, 200, 400, 800], "converged")
    assert cycles([1.010, 1.009, 1.008]) == ([100, 200, 400], "converged")  # a fifth of the excess, within the scatter
    assert cycles([5.0, 4.9, 4.8], noise=0.0)[1] == "converged"
    assert cycles([5.0, 3.0], longest=350)[1] == "time_limit"  # the next would not be as long as the last
    assert cycles([2.0**-i for i in range(6)], noise=0.0)[1] == "converged"  # for there are no more cycles
    assert cycles([0.0, 0.0, 0.0], noise=0.0)[1] == "converged"


def test_a_cycle_ends_in_time():
    found = Cycles(100, 50.0)
    assert found.progress(10, 50.0) == 1
    assert found.judge(2.0, 1.0, 10, 50.0).reason == "time_limit"


def test_pixels_withheld_are_of_most_views_and_in_no_batch(measurement):
    rest, held = hold_back(measurement, 1)
    index = [measurement.names.index(name) for name in held.names]
    assert len(index) > len(measurement.names) / 2
    taken = torch.zeros_like(measurement.usable)
    taken[index] = held.usable
    assert torch.equal(taken | rest.usable, measurement.usable)
    assert not bool((taken & rest.usable).any())
    assert bool(rest.usable.flatten(1).any(dim=1).all())
    assert 0.02 < taken.sum() / measurement.usable.sum() < 0.2
    data = TrainingData(ENDLESS, measurement, judged=True)
    assert data.withheld is not None
    assert len(data) + len(data.withheld) == len(TrainingData(ENDLESS, measurement))


@pytest.mark.slow
def test_a_single_pixel_is_withheld_of_a_few_and_none_of_single_ones(measurement):
    valid = torch.zeros_like(measurement.usable)
    valid[:, 10, 10] = True
    few = replace(measurement, valid=valid)
    assert hold_back(few, 1)[1] is None
    assert "what was measured is met to" in replace(ENDLESS, first_cycle=10, longest=20.0)(few).outcome.message
    valid[1, 10, 11] = True
    rest, held = hold_back(replace(measurement, valid=valid), 1)
    assert held.names == (measurement.names[1],)
    assert int(held.usable.sum()) == 1
    assert torch.equal(rest.usable.flatten(1).sum(dim=1), torch.ones(len(measurement.names), dtype=torch.long))


@pytest.mark.slow
def test_a_run_without_a_limit_converges_and_goes_on_where_it_was(measurement, ball, tmp_path, monkeypatch):
    monkeypatch.setattr(convergence, "MOST", 3)
    measurement, states = add_noise(measurement, 0.3, seed=3), {}
    whole = ENDLESS(measurement, lambda s: states.__setitem__(s.step, s.capture()) if s.step == 90 else None)
    assert whole.outcome.reason == "converged"
    assert "rays held back are met to" in whole.outcome.message
    judged = [record["withheld_residual"] for record in whole.history if "withheld_residual" in record]
    assert len(judged) >= 2
    assert judged[0] > judged[-1] > 0.9
    grid = Grid.of_resolution(measurement.box, 24)
    truth = Volume(ball.sample(grid), grid)
    assert evaluate_volume(whole.field, truth, measurement.n_ambient)["l2_variation"] < 0.2
    write_state(tmp_path, states[90])
    again = ENDLESS(measurement, resume=read_state(tmp_path))
    points = torch.rand(50, 3)
    assert torch.equal(again.field(points), whole.field(points))
    assert [r["withheld_residual"] for r in again.history if "withheld_residual" in r] == judged
    told = ENDLESS(measurement, resume=whole.state)
    assert told.outcome.message == whole.outcome.message
    assert len(told.history) == len(whole.history)
    assert torch.equal(told.field(points), whole.field(points))


def test_the_longest_time_ends_it(measurement):
    result = replace(ENDLESS, longest=0.5, first_cycle=10**6)(measurement)
    assert result.outcome.reason == "time_limit"
    assert "--time-limit" in result.outcome.message
    assert 0.4 < result.seconds < 10


@pytest.mark.slow
def test_more_time_goes_on_with_the_next_cycle(measurement):
    short = replace(ENDLESS, longest=0.5, first_cycle=10**6)(measurement)
    again = replace(ENDLESS, longest=2.0, first_cycle=10**6)(measurement, resume=short.state)
    assert again.outcome.reason == "time_limit"
    assert again.history[-1]["step"] > short.history[-1]["step"]
    limited = replace(ENDLESS, max_steps=20)(measurement)
    endless = replace(ENDLESS, first_cycle=10)(measurement, resume=limited.state)
    first = next(record for record in endless.history if "withheld_residual" in record)
    assert first["step"] == 30


@pytest.mark.slow
def test_the_best_cycle_is_kept_with_the_rig_it_had(measurement, monkeypatch):
    errors, rigs = itertools.chain([2.0], itertools.repeat(3.0)), []
    monkeypatch.setattr(objective.Objective, "withheld", lambda self: next(errors))
    monkeypatch.setattr("nerif.reconstruction.rig.refinement.SIGN", -1.0)  # the rig is taken to be off

    def watch(step: Step) -> bool:
        if step.step == 6:
            rigs.append(step.capture().tensors["data.rig.values"])
        return False

    result = replace(ENDLESS, first_cycle=6, refine=("cameras",))(measurement, watch)
    kept = torch.tensor([list(row["values"].values()) for row in result.rig], dtype=torch.float64)
    last = result.state.tensors["data.rig.values"]
    assert torch.equal(kept, rigs[0][:, : kept.shape[1]])
    assert not torch.equal(kept, last[:, : kept.shape[1]])


@pytest.mark.parametrize("interrupted", [pytest.param(False, marks=pytest.mark.slow), True])
def test_the_best_cycle_is_kept(measurement, monkeypatch, interrupted):
    """A cycle that the rays held back like less than the one before gives it back, one that was broken off too."""
    errors, fields = itertools.chain([2.0], itertools.repeat(3.0)), []
    monkeypatch.setattr(objective.Objective, "withheld", lambda self: next(errors))
    settings = replace(ENDLESS, first_cycle=20)

    def watch(step: Step) -> bool:
        if step.step == 20:
            fields.append(step.capture())
        return interrupted and step.step == 30

    result = settings(measurement, watch)
    if interrupted:
        assert result.outcome.reason == "interrupted"
        result = settings(measurement, resume=result.state)
    assert result.outcome.reason == "converged"
    kept = {k.removeprefix("network."): v for k, v in fields[0].tensors.items() if k.startswith("network.")}
    found = result.field.network.state_dict()
    assert all(torch.equal(found[k], v) for k, v in kept.items())


def test_pixels_are_withheld_of_every_technique_where_the_box_is_seen():
    """Of a technique with a few pixels in one view some are, and none of those beside the box."""
    cameras, box = paper_rig(60)
    fringes = torch.full((2, 60, 60, 1), torch.nan)
    fringes[0, 28:31, 30:40] = 1.0
    seen = {Deflection: torch.ones(2, 60, 60, 2), Interferometry: fringes}
    both = measurement_of(seen, cameras[:2], replace(box, lower=(-9.0,) * 3, upper=(9.0,) * 3), 1.00027, 532.0)
    rest, held = hold_back(both, 1)
    assert bool((held.usable <= held.sees_box).all())
    for observation in held.observations:
        assert bool(held.usable_for(observation).any())
    for observation in rest.observations:
        assert bool(rest.usable_for(observation).any())


@pytest.mark.parametrize(("setting", "value"), [("longest", 0.0), ("first_cycle", 0), ("longest", math.nan)])
def test_limits_that_cannot_be_are_refused(setting, value):
    with pytest.raises(InputError, match=setting):
        NeRIF(**{setting: value})
