"""NeRIF on a small problem: it finds the field, says why it stopped, goes on where it left off, and recovers."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from nerif.analysis.evaluation import evaluate_views, evaluate_volume, reproject
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.network import Network, NetworkShape
from nerif.fields.phantoms import make_phantom
from nerif.forward.base import Weights
from nerif.geometry import Grid, paper_rig
from nerif.reconstruction.base import Reconstruction, Step
from nerif.reconstruction.files import read_state, write_state
from nerif.reconstruction.gauge import AmbientRegion
from nerif.reconstruction.neural import bins, objective, training
from nerif.reconstruction.neural.losses import LossWeights, by_differences
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.presets import PRESETS, preset
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.reconstruction.target import Target
from nerif.simulation.simulate import simulate
from refusals import refused

SMALL = NeRIF(
    network=NetworkShape(depth=2, width=32, octaves=2),
    samples=(12, 16),
    sample_jitter=4,
    points_per_batch=1024,
    max_steps=30,
    device="cpu",
    precision="float32",
)


@pytest.fixture(scope="module")
def trained(measurement: Measurement) -> Reconstruction:
    """A run of 150 steps."""
    return replace(SMALL, max_steps=150)(measurement)


@pytest.fixture(scope="module")
def undisturbed(measurement: Measurement) -> Reconstruction:
    """A run of SMALL that nothing disturbs."""
    return SMALL(measurement)


def test_finds_the_balls_without_seeing_them(measurement, ball):
    result = replace(SMALL, network=NetworkShape(depth=3, width=64, octaves=3), max_steps=170, points_per_batch=2048)(
        measurement
    )
    grid = Grid.of_resolution(measurement.box, 30)
    truth = Volume(ball.sample(grid), grid)
    metrics = evaluate_volume(result.field, truth, measurement.n_ambient)
    assert metrics["l2_variation"] < 0.06
    assert metrics["cc"] > 0.99
    assert min(v["cc"] for v in evaluate_views(reproject(result.field, measurement))) > 0.99
    assert result.outcome.reason == "steps"


@pytest.mark.slow
def test_three_terms_of_the_paper_agree_on_a_fitted_field(measurement):
    """After training with all of them, gradient heads, autograd and central differences predict the same."""
    settings = replace(
        SMALL,
        network=NetworkShape(depth=3, width=48, octaves=2, skip=2, head_width=16, gradient_head=True),
        weights=LossWeights(consistency=1, numerical=1, head=1, automatic=0),
        norm="l2",
        max_steps=150,
        samples=(16, 24),
    )
    result = settings(measurement)
    assert set(result.history[-1]) >= {"consistency", "numerical", "head", "gauge", "loss"}
    last = [record["loss"] for record in result.history[-4:]]  # each of a batch of 70 rays
    assert sum(last) / len(last) < 0.25 * result.history[0]["loss"]
    field = result.field
    grid = Grid.of_resolution(measurement.box, 12)
    p = field.normalise(grid.points().reshape(-1, 3))
    _, automatic, heads = field.network.value_and_gradient(p, heads=True)
    step = 1e-2
    shifts = step * torch.eye(3)
    central = torch.stack([(field.network(p + s) - field.network(p - s)) / (2 * step) for s in shifts], dim=-1)
    scale = automatic.norm()
    assert float((automatic - central).norm() / scale) < 0.02
    assert float((automatic - heads).norm() / scale) < 0.35


def test_numerical_differentiation_meets_the_exact_gradient_as_the_step_shrinks(measurement, trained):
    field, (rays, _, _) = trained.field, measurement.rays()
    rays = rays[:50]
    s = rays.near[:, None] + torch.linspace(0.05, 0.95, 9) * (rays.far - rays.near)[:, None]
    p = field.normalise(rays.at(s))
    integral = Weights(torch.ones_like(s), slope=rays.ends.sensitivity)
    exact = torch.einsum(
        "nij,nmj->ni", rays.ends.sensitivity, field.network.value_and_gradient(p.reshape(-1, 3))[1].reshape(p.shape)
    )
    errors = []
    for reach in (0.8, 0.4, 0.2):
        d = by_differences(field.network, integral, p, torch.full(s.shape, reach / field.half_edge))
        errors.append(float((d - exact).norm()))
    assert 3.5 < errors[0] / errors[1] < 4.5
    assert 3.5 < errors[1] / errors[2] < 4.5


def test_resumed_run_equals_one_that_was_not_interrupted(measurement, undisturbed, tmp_path):
    def stop_at_13(step: Step) -> bool:
        return step.step == 13

    first = SMALL(measurement, on_step=stop_at_13)
    assert first.outcome.reason == "interrupted"
    assert first.state is not None
    write_state(tmp_path, first.state)
    second = SMALL(measurement, resume=read_state(tmp_path))
    assert second.outcome.reason == "steps"
    points = torch.rand(50, 3) * 10 - 5
    assert torch.equal(undisturbed.field(points), second.field(points))
    assert not torch.equal(undisturbed.field(points), first.field(points))


def test_a_resumed_run_keeps_its_history_and_counts_on(measurement):
    seen: list[Step] = []
    first = SMALL(measurement, on_step=lambda step: bool(seen.append(step)) or step.step == 21)
    again = SMALL(measurement, resume=first.state)
    assert [record["step"] for record in again.history] == [1, 20, 30]
    assert again.history[-1]["epoch"] > first.history[-1]["epoch"] > 0
    assert [step.step for step in seen] == list(range(1, 22))


def test_same_seed_same_result_other_seed_another(measurement):
    points = torch.rand(20, 3)
    a, b, c = (replace(SMALL, seed=s, max_steps=8)(measurement).field(points) for s in (1, 1, 2))
    assert torch.equal(a, b)
    assert not torch.equal(a, c)


def test_non_finite_loss_goes_back_to_the_last_good_state(measurement, monkeypatch):
    real, calls = objective.loss_terms, []

    def poisoned(*args, **kwargs):
        calls.append(1)
        terms = real(*args, **kwargs)
        return {k: v * float("nan") for k, v in terms.items()} if len(calls) == 15 else terms

    monkeypatch.setattr(objective, "loss_terms", poisoned)
    monkeypatch.setattr(training, "KEEP_EVERY", 10)
    result = SMALL(measurement)
    assert result.outcome.reason == "steps"
    assert sum("taken_back" in record for record in result.history) == 1
    assert "taken back 1 time" in result.outcome.message
    assert bool(torch.isfinite(result.field(torch.rand(30, 3))).all())


def test_loss_that_stays_non_finite_ends_with_the_last_good_state(measurement, monkeypatch):
    real, calls = objective.loss_terms, []

    def poisoned(*args, **kwargs):
        calls.append(1)
        terms = real(*args, **kwargs)
        return {k: v * float("nan") for k, v in terms.items()} if len(calls) > 15 else terms

    monkeypatch.setattr(objective, "loss_terms", poisoned)
    monkeypatch.setattr(training, "KEEP_EVERY", 10)
    result = SMALL(measurement)
    assert result.outcome.reason == "diverged"
    assert "step 10" in result.outcome.message
    assert bool(torch.isfinite(result.field(torch.rand(30, 3))).all())


@pytest.mark.slow
def test_a_rate_far_too_high_is_lowered_until_it_serves(measurement):
    result = replace(SMALL, learning_rate=0.5, max_steps=80)(measurement)
    assert any("taken_back" in record for record in result.history)
    assert not result.outcome.failed
    assert result.history[-1]["loss"] < 0.5


def test_a_field_that_is_lost_is_taken_back(measurement, monkeypatch):
    """Weights set to nothing in the middle of a run that went well."""
    monkeypatch.setattr(training, "KEEP_EVERY", 40)
    lost: list[int] = []

    def sabotage(step: Step) -> None:
        if step.step == 100 and not lost:
            lost.append(1)
            (run,) = runs
            for weight in run.field.network.parameters():
                weight.data.zero_()

    runs = [training.Training(replace(SMALL, max_steps=200), TrainingData(SMALL, measurement))]
    result = runs[0].run(sabotage)
    assert sum("taken_back" in record for record in result.history) == 1
    assert result.history[-1]["loss"] < 0.1
    assert result.outcome.reason == "steps"


@pytest.mark.parametrize(
    ("octaves", "width", "depth"),
    [
        (8, 32, 2),
        pytest.param(0, 32, 8, marks=pytest.mark.slow),
        pytest.param(8, 128, 8, marks=pytest.mark.slow),
        pytest.param(5, 512, 2, marks=pytest.mark.slow),
    ],
)
def test_sixty_steps_serve_every_shape(measurement, octaves, width, depth):
    shape = NetworkShape(depth=depth, width=width, octaves=octaves)
    settings = NeRIF(network=shape, wave_pixels=0, max_steps=60, device="cpu", precision="float32")
    result = settings(measurement)
    assert result.history[-1]["loss"] < 0.5 or "not explained" in result.outcome.message
    assert not result.outcome.failed


@pytest.mark.parametrize(
    ("pixels", "octaves"), [(16, 3), (24, 4), (40, 4), (48, 5), pytest.param(200, 5, marks=pytest.mark.slow)]
)
def test_waves_that_pixels_cannot_tell_apart_are_left_out(pixels, octaves):
    cameras, box = paper_rig(pixels)
    seen = simulate(make_phantom("gaussians", box, 0), cameras[:2], box, 1.00027, 0.02, 0)
    (edge,) = {float(e) for e in box.edges}
    found = NeRIF().resolved_by(seen).network
    assert found.octaves == octaves
    assert edge / 2 ** (octaves - 1) >= 2.5 * max(seen.pixel_sizes)
    assert octaves == 5 or edge / 2**octaves < 2.5 * max(seen.pixel_sizes)
    assert NeRIF(wave_pixels=0).resolved_by(seen).network == NeRIF().network
    assert NeRIF().resolved_by(seen).resolved_by(seen) == NeRIF().resolved_by(seen)


@pytest.mark.slow
def test_a_few_pixels_are_not_taken_for_waves_between_them():
    """With the waves that 16 pixels cannot tell apart the same flow is found with 1.4 times the error and more."""
    cameras, box = paper_rig(16)
    phantom = make_phantom("flame", box, 5)
    seen = simulate(phantom, cameras[:9], box, 1.00027, 0.05, 1)
    grid = Grid.of_resolution(box, 32)
    settings = NeRIF(max_steps=150, samples=(24, 48), device="cpu")
    off = [
        float((one(seen).field.sample(grid) - phantom.sample(grid)).norm())
        for one in (settings, replace(settings, wave_pixels=0))
    ]
    assert off[1] > 1.4 * off[0]


def test_networks_kept_without_gains_have_octaves_that_count_alike():
    network = Network(NetworkShape(depth=1, width=4, octaves=7))
    assert network.gains.tolist() == [1, 1, 1, 1, 1, 0.25, 0.0625]
    kept = {name: value for name, value in network.state_dict().items() if name != "gains"}
    network.load_state_dict(kept)
    assert network.gains.tolist() == [1] * 7


def test_large_images_begin_with_bins_and_go_on_with_what_there_is_time_for(measurement, monkeypatch):
    """A run that can see all pixels ends with pixels, one that cannot stays with bins; a resumed one goes on alike."""
    monkeypatch.setattr(bins, "FEWEST", 8)  # 20 x 26 px are large
    short, ample = (replace(SMALL, max_steps=n, points_per_batch=300)(measurement) for n in (12, 150))
    assert not any("bin_edge" in record for record in short.history)
    (refined,) = (record["bin_edge"] for record in ample.history if "bin_edge" in record)
    assert refined == 1
    states = []
    settings = replace(SMALL, max_steps=60, points_per_batch=300)
    whole = settings(measurement, on_step=lambda s: states.append(s.capture()) if s.step == 30 else None)
    again = settings(measurement, resume=states[0])
    assert torch.equal(whole.field(torch.zeros(1, 3)), again.field(torch.zeros(1, 3)))


def test_each_limit_is_named(measurement):
    assert replace(SMALL, epochs=0.5, max_steps=0)(measurement).outcome.reason == "epochs"
    assert replace(SMALL, time_limit=1e-6)(measurement).outcome.reason == "time_limit"
    assert replace(SMALL, stop_ratio=0.9, max_steps=400)(measurement).outcome.reason == "converged"


def test_the_rule_of_the_loss_ends_a_run_that_goes_on_from_a_field(measurement, undisturbed):
    """The share is of the loss near which a network begins, not of the little that an earlier run has left."""
    result = replace(SMALL, stop_ratio=0.9)(measurement, start=undisturbed.field)
    assert result.outcome.reason == "converged"
    assert result.history[-1]["step"] < 5


def test_a_small_learning_rate_is_given_the_steps_it_needs(measurement):
    """Preset paper stays at the empty field for about 450 steps of 2048 points, and finds it then."""
    slow = training.Training(replace(SMALL, learning_rate=1e-3), TrainingData(SMALL, measurement))
    assert slow.watch.patience == 15 * training.Training(SMALL, TrainingData(SMALL, measurement)).watch.patience


def test_ambient_is_ambient_on_the_faces(measurement, trained):
    unit = torch.rand(500, 2)
    faces = torch.cat([measurement.box.face_points(f, unit) for f in measurement.ambient_faces])
    values = trained.field(faces)
    assert abs(float(values.mean())) < 2e-6
    assert float(values.abs().max()) < 4e-5


def test_sigma_weighs_the_rays(measurement):
    """A view that is all wrong, but says so in sigma, does no harm."""
    wrong = measurement.displacement.clone()
    wrong[2] = 0.5
    sigma = measurement.sigma.clone()
    sigma[2] = 1e3
    honest = replace(measurement, displacement=wrong, sigma=sigma)
    good = evaluate_views(reproject(replace(SMALL, max_steps=60)(honest).field, measurement))
    blind = evaluate_views(reproject(replace(SMALL, max_steps=60)(replace(honest, sigma=None)).field, measurement))
    others = [0, 1, 3, 4]
    assert max(good[i]["rms_px"] for i in others) < 0.5 * max(blind[i]["rms_px"] for i in others)


def test_invalid_pixels_do_not_count(measurement):
    spoiled = measurement.displacement.clone()
    valid = torch.ones(spoiled.shape[:3], dtype=torch.bool)
    valid[1, 4:9] = False
    one, other = spoiled.clone(), spoiled.clone()
    other[1, 4:9] = float("nan")
    points = torch.rand(10, 3)
    a = replace(SMALL, max_steps=5)(replace(measurement, displacement=one, valid=valid)).field(points)
    b = replace(SMALL, max_steps=5)(replace(measurement, displacement=other)).field(points)
    assert torch.equal(a, b)


def test_masks_widen_the_ambient_region(measurement, ball):
    moving = (measurement.displacement.norm(dim=-1) > 0.01).float()[:, None]
    mask = torch.nn.functional.max_pool2d(moving, 3, 1, 1)[:, 0] > 0
    masked = replace(measurement, flow_mask=mask)
    region = AmbientRegion.of(masked, ())
    points = region.sample(400, torch.Generator().manual_seed(0))
    assert len(points) == 400
    inside = ball(points.double()).abs() > 0.5 * 2e-4
    assert not bool(inside.any())
    far = replace(region, faces=()).sample(20000, torch.Generator().manual_seed(1)).double()
    in_hull = torch.ones(len(far), dtype=torch.bool)
    for camera, own in zip(masked.cameras, mask, strict=True):
        column, row = camera.project(far).round().long().unbind(-1)
        height, width = camera.image_size
        seen = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        in_hull &= ~seen | own[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    assert float(in_hull.double().mean()) < 1e-3  # a corner of a pixel that reaches into the side of a voxel
    result = replace(SMALL, ambient_faces=(), max_steps=20)(masked)
    assert result.outcome.reason == "steps"


def test_open_faces_drop_their_rays(measurement):
    (everything,), (fewer,) = Target.of(measurement).parts, Target.of(measurement, ("z+",)).parts
    through = everything.rays.exit_faces(measurement.box, ("z+",))
    assert 0 < int(through.sum()) < len(everything.rays)
    assert len(fewer.rays) == int((~through).sum())


def test_no_displacement_gives_ambient(measurement):
    still = replace(measurement, displacement=torch.zeros_like(measurement.displacement), sigma=None)
    result = SMALL(still)
    assert float(result.field(torch.rand(50, 3)).abs().max()) < 1e-7  # of a moving field: 4e-6
    assert result.outcome.reason == "steps"  # there is nothing to find, and nothing was missed


def test_bf16_gives_way_to_float32_at_the_end(measurement, undisturbed):
    """Rounding to 8 bits changes a run, but not where it goes; tf32 is a matter of CUDA."""
    result = replace(SMALL, precision="bf16")(measurement)
    assert result.history[-1]["loss"] != undisturbed.history[-1]["loss"]
    assert result.history[-1]["loss"] == pytest.approx(undisturbed.history[-1]["loss"], rel=0.2)
    full = replace(SMALL, precision="bf16", full_precision_from=0.0)(measurement)
    assert full.history[-1]["loss"] == undisturbed.history[-1]["loss"]


COMPILED = """
import torch
from nerif.fields.network import Network, NetworkShape
torch.manual_seed(0)
net = Network(NetworkShape(depth=3, width=32, octaves=2, skip=2, head_width=8, gradient_head=True))
fast = torch.compile(net.value_and_gradient, dynamic=True)
for n in (300, 500):
    p = torch.rand(n, 3)
    for heads in (False, True):
        grads = []
        for call in (net.value_and_gradient, fast):
            net.zero_grad()
            value, gradient, predicted = call(p, heads)
            (value.square().sum() + gradient.square().sum()).backward()
            grads.append([gradient.detach()] + [w.grad.clone() for w in net.layers.parameters()])
        assert all(torch.allclose(a, b, rtol=1e-3, atol=1e-4) for a, b in zip(*grads)), heads
print("same")
"""


@pytest.mark.slow
def test_compiled_network_is_the_plain_one():
    """In a process of its own: annotations that check shapes raise inside compiled code."""
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", COMPILED], capture_output=True, text=True)
    assert done.stdout.strip() == "same", done.stderr[-2000:]


def test_without_a_compiler_a_run_goes_on_and_says_so(measurement, monkeypatch):
    def compiled(function, dynamic):
        def fail(p, heads):
            raise RuntimeError("Failed to find C compiler.\nGive CC")

        return fail

    monkeypatch.setattr(torch, "compile", compiled)
    asked, plain = (replace(SMALL, compile=c, max_steps=3)(measurement) for c in ("on", "off"))
    assert "was not compiled (Failed to find C compiler.)" in asked.outcome.message
    assert "compiled" not in plain.outcome.message
    assert asked.history[-1]["loss"] == plain.history[-1]["loss"]


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU here")
def test_trains_on_a_gpu(measurement):
    result = replace(SMALL, device="cuda", precision="auto", max_steps=100)(measurement)
    assert result.history[-1]["loss"] < result.history[0]["loss"]
    assert result.peak_memory_bytes > 0


def test_presets(measurement: Measurement):
    paper = preset("paper")
    assert (paper.network.depth, paper.network.width, paper.network.skip, paper.network.head_width) == (7, 256, 4, 64)
    assert paper.samples == (60, 200)
    assert (paper.learning_rate, paper.betas, paper.stop_ratio) == (1e-3, (0.9, 0.99), 0.005)
    assert (paper.sampling, paper.norm, paper.schedule) == ("random", "l2", "constant")
    w = paper.weights
    assert (w.consistency, w.numerical, w.head, w.automatic) == (1, 1, 1, 0)
    for name in PRESETS:
        quick = replace(preset(name), points_per_batch=300, max_steps=2, samples=(12, 14), device="cpu", compile="off")
        assert quick(measurement).outcome.reason == "steps"
    with refused("preset"):
        preset("papr")


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"norm": "l3"}, "norm"),
        ({"model": "round"}, "model"),
        ({"epochs": -1}, "epochs"),
        ({"learning_rate": -1}, "learning_rate"),
        ({"time_limit": -1}, "time_limit"),
        ({"samples": (4, 16)}, "samples"),
        ({"points_per_batch": 19}, "points_per_batch"),
        ({"ambient_faces": ("up",)}, "ambient_faces"),
        ({"weights": LossWeights(head=1)}, "gradient_head"),
        ({"device": "cuda:7"}, "device"),
        ({"device": "abacus"}, "device"),
        ({"open_faces": ("x-", "x+", "y-", "y+", "z-", "z+")}, "open_faces"),
    ],
)
def test_settings_that_cannot_be_right(measurement, change, word):
    with pytest.raises(InputError, match=word):
        replace(SMALL, **change)(measurement)


def test_no_gauge_is_refused(measurement):
    with refused("ambient_faces"):
        SMALL(replace(measurement, ambient_faces=()))
