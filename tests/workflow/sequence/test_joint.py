"""One network over space and time: its gradient, its data, and films reconstructed by it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerif.cli.cli import main
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.fields.network import NetworkShape
from nerif.fields.phantoms import GaussianBalls
from nerif.fields.space_time import AtTimes, SpaceTimeField, SpaceTimeNetwork
from nerif.forward.deflection import Deflection
from nerif.forward.interferometry import Interferometry
from nerif.geometry import Box, Grid
from nerif.reconstruction import files
from nerif.reconstruction.base import State
from nerif.reconstruction.neural import training
from nerif.reconstruction.neural.losses import LossWeights
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.precision import MixedPrecision
from nerif.reconstruction.neural.training_data import FrameData
from nerif.reconstruction.target import Target
from nerif.simulation.simulate import simulate
from nerif.workflow.sequence import joint
from nerif.workflow.sequence.chunk_data import ChunkData
from nerif.workflow.sequence.joint import reconstruct_jointly
from nerif.workflow.sequence.plan import SequencePlan, SequenceSettings
from nerif.workflow.sequence.store import DONE, FAILED, MISSING, SequenceStore, chunk_tau
from sequence_films import QUICK, blank

SHAPE = NetworkShape(depth=2, width=16, octaves=2)
SETTINGS = NeRIF(
    network=SHAPE, samples=(8, 12), sample_jitter=2, points_per_batch=400, device="cpu", precision="float32"
)


@pytest.fixture
def network() -> SpaceTimeNetwork:
    """A network that drifts."""
    torch.manual_seed(1)
    found = SpaceTimeNetwork(SHAPE, 2).double()
    with torch.no_grad():
        found.drift.copy_(torch.tensor([0.1, -0.2, 0.7]))
    return found


def test_the_written_out_gradient_in_space_is_that_of_autograd(network):
    p = (2 * torch.rand(20, 4, dtype=torch.float64) - 1).requires_grad_()
    value, gradient, heads = network.value_and_gradient(p)
    (expected,) = torch.autograd.grad(network(p).sum(), p)
    assert heads is None
    assert torch.allclose(value, network(p))
    assert torch.allclose(gradient, expected[:, :3])
    assert float(expected[:, 3].abs().max()) > 0


def test_what_drifts_with_the_flow_can_stand_still_for_the_network():
    torch.manual_seed(0)
    network = SpaceTimeNetwork(SHAPE, 0).double()
    drift = torch.tensor([0.0, 0.3, 0.5], dtype=torch.float64)
    e = network.layers[0].weight.shape[1]
    with torch.no_grad():
        network.drift.copy_(drift)
        network.layers[0].weight[:, : (e - 1) // 2] = 0  # only what is carried along is seen
        network.layers[0].weight[:, -1] = 0
    p = torch.rand(10, 3, dtype=torch.float64) - 0.5
    at = [torch.cat([p + t * drift, torch.full((10, 1), t, dtype=torch.float64)], dim=1) for t in (-0.7, 0.9)]
    assert torch.allclose(network(at[0]), network(at[1]))


def test_each_ray_is_taken_at_its_own_time(network):
    low = MixedPrecision(network, torch.device("cpu"), "float32", "off")
    tau = torch.tensor([-0.5, 0.25], dtype=torch.float64)
    p = torch.rand(6, 3, dtype=torch.float64)
    value, gradient, _ = AtTimes(low, tau).value_and_gradient(p, False)
    for i, t in enumerate(tau):
        field = SpaceTimeField(network, Box.cube(2.0), float(t), 1.0)
        mine = slice(3 * i, 3 * i + 3)
        expected, slope = field.value_and_gradient(p[mine])
        assert torch.allclose(value[mine], expected)
        assert torch.allclose(gradient[mine], slope)
        assert torch.allclose(AtTimes(low, tau).value(p)[mine], field(p[mine]))


def test_a_chunk_holds_every_ray_of_every_frame(short):
    blank(short, 1, view=0)
    sequence = MeasurementSequence.read(short)
    frames = [sequence.frame(i) for i in range(3)]
    tau = torch.tensor([-1.0, 0.0, 1.0])
    chunk = ChunkData(SETTINGS, [FrameData(SETTINGS, frame) for frame in frames], tau, 2)
    targets = [Target.of(frame) for frame in frames]
    assert len(chunk) == sum(len(t) for t in targets)
    (film,) = chunk.films
    assert len(film.rays) == len(targets[0])
    of_second = (film.known // len(film.rays) == 1).nonzero()[:, 0]
    ((target, at),) = chunk.batch(of_second)
    (wanted,) = targets[1].parts
    assert torch.equal(at, torch.zeros(len(wanted)))
    assert torch.equal(target.measured, wanted.measured)
    assert torch.equal(target.rays.origin, wanted.rays.origin)
    assert torch.equal(target.rays.direction, wanted.rays.direction)
    # weighed by sigma alone, the same for all, with a mean square of 1
    ((everything, _),) = chunk.batch(torch.arange(len(chunk)))
    assert float(everything.of_nothing.square().mean()) == pytest.approx(1, rel=1e-4)
    sigma = frames[1].sigma[frames[1].usable][0, 0]
    other = frames[2].sigma[frames[2].usable][0, 0]
    ((third, _),) = chunk.batch(torch.arange(len(chunk))[-5:])
    assert float(target.inverse_scale[0, 0] / third.inverse_scale[0, 0]) == pytest.approx(
        float(other / sigma), rel=1e-4
    )


def test_instants_of_a_chunk_run_from_minus_one_to_one():
    times = [0.0, 1.0, 3.0, 4.0]
    assert [chunk_tau(times, i, 0, 3) for i in range(3)] == pytest.approx([-1, -1 / 3, 1])
    assert chunk_tau(times, 3, 3, 4) == 0


def begun(film: Path, out: Path, steps: int, **changes: object) -> SequencePlan:
    settings = replace(SETTINGS, **changes)
    sequence = MeasurementSequence.read(film)
    asked = SequenceSettings(
        chunk=len(sequence), temporal="joint", joint_steps=steps, time_octaves=2, voxels=10,
        quantities=("index_excess",),
    )  # fmt: skip
    plan = SequencePlan(film, out, settings, asked)
    grid = Grid.of_resolution(sequence.fullest().box, 10)
    SequenceStore.begin(out, sequence, grid, asked.quantities, SHAPE, plan.kept)
    return plan


def test_a_joint_network_that_found_nothing_fails_every_frame_in_words(five, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "RETRIES", 1)
    monkeypatch.setattr(joint, "ATTEMPTS", 1)
    plan = begun(five, tmp_path / "r.zarr", 26, learning_rate=1e4, points_per_batch=100)
    reconstruct_jointly(plan, 0, 2, lambda told: None)
    store = SequenceStore(plan.out)
    assert store.status.tolist() == [FAILED] * 2 + [MISSING] * 3
    assert all(reason.startswith("no field was found: after 2 attempt") for reason in store.reasons[:2])
    assert not store.checkpoints.exists()


def test_a_film_is_reconstructed_by_one_network(short, tmp_path):
    blank(short, 3)
    plan = begun(short, tmp_path / "r.zarr", 30)
    told: list[dict] = []
    reconstruct_jointly(plan, 0, 5, told.append)
    store = SequenceStore(plan.out)
    assert store.status.tolist() == [DONE, DONE, DONE, FAILED, DONE]
    assert [t["what"] for t in told if t["what"] != "share"] == ["begun", "failed", "done", "done", "done", "done"]
    assert 0 < max(t["share"] for t in told if t["what"] == "share") <= 5
    for i in (0, 4):
        again = store.field(i).sample(store.grid)
        assert torch.equal(again, store.volume(i, "index_excess").values)
    assert not torch.equal(store.volume(0, "index_excess").values, store.volume(4, "index_excess").values)
    assert float(np.nanmin(store.array("cc")[:])) > 0.5
    assert not (tmp_path / "r.zarr.joint" / "0").exists()


def test_a_joint_run_that_broke_off_goes_on_from_its_checkpoint(five, tmp_path, monkeypatch):
    whole, parts = begun(five, tmp_path / "whole.zarr", 10), begun(five, tmp_path / "parts.zarr", 10)
    reconstruct_jointly(whole, 0, 3)
    monkeypatch.setattr(joint, "CHECKPOINT_EVERY", 0.0)
    real = files.write_state

    class Killed(BaseException):
        pass

    def write_and_die(directory: Path, state: State) -> None:
        real(directory, state)
        if state.scalars["budget"]["step"] == 20:
            raise Killed

    monkeypatch.setattr(files, "write_state", write_and_die)
    with pytest.raises(Killed):
        reconstruct_jointly(parts, 0, 3)
    assert (SequenceStore(parts.out).status == MISSING).all()
    steps: list[int] = []
    monkeypatch.setattr(files, "write_state", lambda d, s: steps.append(s.scalars["budget"]["step"]))
    reconstruct_jointly(parts, 0, 3)
    assert steps[0] == 21
    for i in range(3):
        a, b = (SequenceStore(p.out).volume(i, "index_excess").values for p in (whole, parts))
        assert torch.allclose(a, b, rtol=1e-4, atol=1e-9)


def test_a_loss_that_is_no_number_is_recorded_after_three_attempts(five, tmp_path):
    plan = begun(five, tmp_path / "r.zarr", 10, learning_rate=1e30)
    reconstruct_jointly(plan, 0, 5)
    store = SequenceStore(plan.out)
    assert (store.status == FAILED).all()
    assert "non-finite" in store.reasons[2]
    assert store.array("attempts")[2] == 3


def volumes(plan: SequencePlan) -> torch.Tensor:
    store = SequenceStore(plan.out)
    assert store.status.tolist() == [DONE] * 2 + [MISSING] * 3
    return torch.stack([store.volume(i, "index_excess").values for i in range(2)])


def test_the_schedule_of_the_learning_rate_is_that_asked_for(five, tmp_path):
    plans = [begun(five, tmp_path / f"{s}.zarr", 4, schedule=s) for s in ("cosine", "constant")]
    for plan in plans:
        reconstruct_jointly(plan, 0, 2)
    assert not torch.equal(*(volumes(plan) for plan in plans))


def interrupted(plan: SequencePlan, monkeypatch: pytest.MonkeyPatch) -> None:
    """Begin a joint run and leave a checkpoint of it."""

    class Killed(BaseException):
        pass

    def die(told: dict) -> None:
        if told["what"] == "share":
            raise Killed

    monkeypatch.setattr(joint, "CHECKPOINT_EVERY", 0.0)
    monkeypatch.setattr(joint, "TELL_EVERY", 5)
    with pytest.raises(Killed):
        reconstruct_jointly(plan, 0, 2, die)
    monkeypatch.undo()
    assert (SequenceStore(plan.out).checkpoints / "0" / "checkpoint.safetensors").is_file()


@pytest.mark.slow
def test_a_checkpoint_of_other_settings_or_data_is_not_gone_on_with(five, tmp_path, monkeypatch):
    fresh, other = begun(five, tmp_path / "fresh.zarr", 4), begun(five, tmp_path / "r.zarr", 4, seed=3)
    reconstruct_jointly(fresh, 0, 2)
    interrupted(other, monkeypatch)
    same = replace(other, cold=fresh.cold)
    reconstruct_jointly(same, 0, 2)
    assert torch.equal(volumes(same), volumes(fresh))
    assert not SequenceStore(same.out).checkpoints.exists()


def test_a_store_begun_anew_has_no_checkpoint(five, tmp_path, monkeypatch):
    plan = begun(five, tmp_path / "r.zarr", 4)
    interrupted(plan, monkeypatch)
    begun(five, plan.out, 4)
    assert not SequenceStore(plan.out).checkpoints.exists()


def test_a_frame_that_cannot_be_written_costs_only_itself(five, tmp_path, monkeypatch):
    plan = begun(five, tmp_path / "r.zarr", 2)
    real = SequenceStore.write_frame

    def full(store: SequenceStore, index: int, frame: object) -> None:
        if index == 2:
            raise OSError("no space left on device")
        real(store, index, frame)

    monkeypatch.setattr(SequenceStore, "write_frame", full)
    reconstruct_jointly(plan, 0, 5)
    store = SequenceStore(plan.out)
    assert store.status.tolist() == [DONE, DONE, FAILED, DONE, DONE]
    assert "no space left" in store.reasons[2]


def test_a_frame_without_a_technique_costs_only_itself(cameras, box, ball, tmp_path):
    """The second of three frames has no fringes."""
    kinds = [Deflection, Interferometry]
    seen = simulate(ball, cameras, box, 1.00027, 0.02, 0, 20, 532.0, techniques=kinds)
    sequence = MeasurementSequence.create(tmp_path / "m.zarr", [0.0, 1.0, 2.0], seen)
    for i in range(3):
        fringes = seen.maps["fringes"]
        maps = seen.maps if i != 1 else {**seen.maps, "fringes": torch.full_like(fringes, torch.nan)}
        sequence.write_frame(i, replace(seen, maps=maps))
    plan = begun(sequence.path, tmp_path / "r.zarr", 2)
    reconstruct_jointly(plan, 0, 3)
    store = SequenceStore(plan.out)
    assert store.status.tolist() == [DONE, FAILED, DONE]
    assert store.reasons[1] == (
        "joint: expected displacement and fringes in every frame, got a frame that lacks one of them"
    )


CENTRES = torch.tensor([[-3.0, -1.0, 0.5], [3.0, 1.0, -0.5]], dtype=torch.float64)


@pytest.fixture(scope="module")
def moving(cameras, box, tmp_path_factory) -> Path:
    """Two frames of a ball that leaps to the side, with masks of where it is."""
    frames = []
    for centre in CENTRES:
        ball = GaussianBalls(centre[None], torch.tensor([1.5]).double(), torch.tensor([-2e-4]).double())
        seen = simulate(ball, cameras, box, n_ambient=1.00027, noise=0.02, steps=40)
        size = seen.displacement.norm(dim=-1)
        mask = torch.nn.functional.max_pool2d((size > 0.1 * size.max()).float()[:, None], 3, 1, 1)[:, 0] > 0
        frames.append(replace(seen, flow_mask=mask))
    path = tmp_path_factory.mktemp("moving") / "moving.zarr"
    sequence = MeasurementSequence.create(path, [0.0, 1.0], frames[0])
    for i, frame in enumerate(frames):
        sequence.write_frame(i, frame)
    return path


def test_ambient_points_of_an_instant_lie_outside_its_own_masks(moving):
    frames = [FrameData(SETTINGS, MeasurementSequence.read(moving).frame(i)) for i in (0, 1)]
    chunk = ChunkData(SETTINGS, frames, torch.tensor([-1.0, 1.0]), 2)
    points, tau = chunk.ambient_points(40000, torch.Generator().manual_seed(0))
    for own, at in enumerate((-1.0, 1.0)):
        distance = torch.cdist(points[tau == at].double(), CENTRES)
        assert float(distance[:, own].min()) > 1.5
        assert float(distance[:, 1 - own].min()) < 1.5


@pytest.mark.slow
def test_each_frame_of_a_joint_network_is_found_within_its_own_masks(moving, tmp_path):
    """The ambient counts a hundredfold, so that a frame pinned where it is not ambient comes out flat."""
    plan = begun(moving, tmp_path / "r.zarr", 150, points_per_batch=2000, weights=LossWeights(gauge=100.0))
    reconstruct_jointly(plan, 0, 2)
    store = SequenceStore(plan.out)
    for i in (0, 1):
        here, there = store.field(i)(CENTRES.float()[[i, 1 - i]]).tolist()
        assert here < -1.2e-4  # of -2e-4
        assert abs(there) < 0.3e-4


@pytest.mark.slow
def test_the_command_reconstructs_jointly(short, tmp_path, capsys):
    out = tmp_path / "r.zarr"
    arguments = ["sequence", str(short), "-o", str(out), *QUICK, "--temporal", "joint", "--joint-steps", "8"]
    assert main([*arguments, "--chunk", "3", "--workers", "1"]) == 0
    assert "5 of 5 frames done" in capsys.readouterr().out
    truth = short.with_name("short.truth.zarr")
    assert main(["evaluate", str(out), "--truth", str(truth)]) == 0
    assert "mean of 5 frames" in capsys.readouterr().out
    kept = json.loads((tmp_path / "r.metrics.json").read_text())
    assert [f["frame"] for f in kept["frames"]] == [0, 1, 2, 3, 4]
    assert 0 < kept["mean"]["cc"] < 1
    assert main(["evaluate", str(out), "--truth", str(out)]) == 0  # the same volumes, to the grid
    assert "CC 1.00000" in capsys.readouterr().out
    assert main(["evaluate", str(out)]) == 2
    assert main([*arguments, "--chunk", "3", "--temporal", "never"]) == 2
    assert "temporal: expected frames or joint" in capsys.readouterr().err
