"""The classical methods from end to end: they find the field, keep to gauge, hull and bounds, stop and resume."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import pytest
import torch
from safetensors import SafetensorError

from nerif.analysis.evaluation import evaluate_views, evaluate_volume, reproject
from nerif.common.conventions import InputError
from nerif.data.volume import Volume
from nerif.fields.grid import VoxelField
from nerif.geometry import Grid
from nerif.reconstruction.base import Reconstruction, State, Step
from nerif.reconstruction.files import CHECKPOINT, read_field, read_state, write_field, write_state
from nerif.reconstruction.voxels import descent, kernels_numba, kernels_torch
from nerif.reconstruction.voxels import settings as voxels_module
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.problem import Iterate
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from refusals import refused

METHODS = [
    Tikhonov(voxels=24, device="cpu"),
    Landweber(voxels=24, device="cpu"),
    TotalVariation(voxels=24, device="cpu"),
]
NAMES = ["tikhonov", "landweber", "tv"]
LEAST_CC = {"Tikhonov": 0.94, "Landweber": 0.86, "TotalVariation": 0.98}  # five views are few
FIXED = Tikhonov(voxels=24, device="cpu", regularisation=1e-3, iterations=8, tolerance=0)


@pytest.fixture(scope="module")
def fixed(measurement) -> Reconstruction:
    """What FIXED makes of the measurement."""
    return FIXED(measurement)


def error(result, ball, n_ambient: float) -> dict[str, float]:
    grid = Grid.of_resolution(result.box, 30)
    return evaluate_volume(result.field, Volume(ball.sample(grid), grid), n_ambient)


@pytest.mark.parametrize("method", METHODS, ids=NAMES)
def test_finds_the_balls_and_comes_down_to_the_noise(measurement, ball, method):
    result = method(measurement)
    metrics = error(result, ball, measurement.n_ambient)
    assert metrics["cc"] > LEAST_CC[type(method).__name__]
    assert isinstance(result.field, VoxelField)
    assert result.history[-1]["residual_over_sigma"] == pytest.approx(1, abs=0.15)
    assert "discrepancy principle" in result.outcome.message
    assert [r["step"] for r in result.history] == list(range(1, len(result.history) + 1))
    assert result.history[0]["voxels"] < result.history[-1]["voxels"] == 24  # coarse to fine
    assert all(v["cc"] > 0.99 for v in evaluate_views(reproject(result.field, measurement)))
    assert result.seconds > 0
    assert result.peak_memory_bytes > 0


@pytest.mark.parametrize("method", METHODS, ids=NAMES)
def test_without_sigma_the_data_alone_decide(measurement, ball, method):
    result = replace(method, iterations=40)(replace(measurement, sigma=None))
    assert error(result, ball, measurement.n_ambient)["cc"] > LEAST_CC[type(method).__name__]
    assert "residual_over_sigma" not in result.history[-1]
    if not isinstance(method, Landweber):
        assert "L-curve" in result.outcome.message


def test_result_survives_the_disc(fixed, measurement, tmp_path):
    write_field(tmp_path, fixed)
    field, box, n_ambient = read_field(tmp_path)
    points = Grid(box, (4, 5, 6)).points()
    assert torch.equal(field(points), fixed.field(points))
    assert (box, n_ambient) == (measurement.box, measurement.n_ambient)


def test_a_full_disc_is_told_with_the_file(tmp_path, monkeypatch):
    def full(*_, **__):
        raise SafetensorError("No space left on device (os error 28)")

    monkeypatch.setattr("safetensors.torch.save_file", full)
    with pytest.raises(OSError, match=r"cannot be written .No space left on device") as refused:
        write_state(tmp_path, State({}, {}))
    assert refused.value.filename == str(tmp_path / CHECKPOINT)


def test_gauge_is_zero_on_the_ambient_faces(measurement):
    result = FIXED(replace(measurement, ambient_faces=("x-", "y+")))
    unit = torch.rand(30, 2)
    scale = float(result.field.sample(Grid(result.box, (8, 9, 10))).abs().max())
    for face in ("x-", "y+"):
        assert float(result.field(measurement.box.face_points(face, unit)).abs().max()) < 1e-3 * scale


def test_sigma_tells_which_view_to_trust(measurement, ball):
    """One view is spoilt; told so, the reconstruction is hardly worse, not told it is."""
    spoilt = measurement.displacement.clone()
    noise = torch.randn(spoilt[2].shape, generator=torch.Generator().manual_seed(3))
    spoilt[2] += 10 * float(spoilt.nan_to_num().square().mean().sqrt()) * noise
    sigma = measurement.sigma.clone()
    sigma[2] *= 1000
    weighted = FIXED(replace(measurement, displacement=spoilt, sigma=sigma))
    blind = FIXED(replace(measurement, displacement=spoilt, sigma=None))
    l2 = [error(r, ball, measurement.n_ambient)["l2_variation"] for r in (weighted, blind)]
    assert l2[0] < 0.6 * l2[1]


def test_pixels_that_are_not_valid_do_not_count(measurement):
    valid = torch.ones(measurement.displacement.shape[:3], dtype=torch.bool)
    valid[:, :7] = False
    spoilt = measurement.displacement.clone()
    spoilt[:, :7] = 50.0
    clean, masked = (
        FIXED(replace(measurement, displacement=d, valid=valid)) for d in (measurement.displacement, spoilt)
    )
    assert torch.equal(clean.field.coefficients, masked.field.coefficients)


def test_voxels_outside_the_visual_hull_are_ambient(measurement):
    mask = torch.zeros(measurement.displacement.shape[:3], dtype=torch.bool)
    mask[:, 5:15, 7:19] = True
    linear = replace(FIXED, basis="linear")
    hull = linear(replace(measurement, flow_mask=mask, ambient_faces=()))
    whole = replace(linear, hull=False)(replace(measurement, flow_mask=mask))
    values = hull.field.sample(hull.field.grid)
    from nerif.reconstruction.gauge import visual_hull

    inside = visual_hull(replace(measurement, flow_mask=mask), hull.field.grid)
    assert float(values[~inside].abs().max()) < 1e-12
    assert float(values[inside].abs().max()) > 1e-5
    assert float(whole.field.sample(whole.field.grid)[~inside].abs().max()) > 1e-7


def test_bounds_hold_everywhere(measurement):
    result = replace(FIXED, lower=-1.0e-4, upper=0.0, iterations=30)(measurement)
    values = result.field.sample(Grid(result.box, (21, 23, 29)))
    assert float(values.min()) >= -1.0e-4 * 1.0001
    assert float(values.max()) <= 1e-9


def test_a_bounded_solution_goes_on_to_a_better_one(measurement):
    result = replace(FIXED, upper=0.0, iterations=30, basis="linear", coarse_to_fine=False)(measurement)
    assert (result.outcome.reason, len(result.history)) == ("iterations", 30)
    assert result.history[-1]["objective"] < 0.95 * result.history[10]["objective"]


@dataclasses.dataclass(frozen=True)
class Rising(Tikhonov):
    """A method whose objective rises after a while."""

    def iterate(self, problem, x, weight):
        for residual in (1.0, 0.5, 0.4, 0.3, 0.6, 0.7, 0.8, 0.9):
            yield Iterate(x, residual, 0.0)


def test_an_objective_that_rises_has_not_converged(measurement):
    result = Rising(voxels=12, device="cpu", regularisation=1e-3, iterations=8)(measurement)
    assert (result.outcome.reason, len(result.history)) == ("iterations", 8)


def test_open_faces_drop_rays(fixed, measurement):
    fewer = replace(FIXED, open_faces=("z+",))(measurement)
    assert not torch.equal(fixed.field.coefficients, fewer.field.coefficients)


def test_coarse_start_is_ahead_of_none(measurement):
    """After the same few iterations on the finest grid the residual is lower."""
    fine, flat = (
        replace(FIXED, coarse_to_fine=c, iterations=4, regularisation=1e-4)(measurement).history for c in (True, False)
    )
    assert fine[-1]["residual"] < flat[-1]["residual"]
    assert {r["voxels"] for r in flat} == {24}


def test_starting_from_a_field_skips_the_coarse_grids(measurement, ball):
    result = replace(FIXED, iterations=1)(measurement, start=ball)
    assert {r["voxels"] for r in result.history} == {24}
    assert result.history[0]["residual"] < 0.3
    on = replace(FIXED, iterations=3)(measurement, resume=result.state)
    assert [r["voxels"] for r in on.history] == [24] * 3


def test_double_precision_agrees_with_single(fixed, measurement):
    single, double = fixed, replace(FIXED, precision="float64")(measurement)
    assert double.field.coefficients.dtype == torch.float64
    difference = (single.field.coefficients - double.field.coefficients).norm() / double.field.coefficients.norm()
    assert float(difference) < 1e-3


@pytest.mark.parametrize("level", [12, 24])
def test_interrupted_run_is_usable_and_goes_on(fixed, measurement, tmp_path, level):
    def stop(step: Step) -> bool:
        return step.losses["voxels"] == level and step.step % 4 == 3

    first = FIXED(measurement, stop)
    assert first.outcome.reason == "interrupted"
    assert first.history[-1]["voxels"] == level
    assert max(first.field.grid.shape) == level
    write_state(tmp_path, first.state)
    again = FIXED(measurement, resume=read_state(tmp_path))
    assert again.outcome.reason == "iterations"
    assert len(again.history) == 2 * FIXED.iterations  # each grid has had its iterations, none twice
    assert again.seconds > first.seconds
    assert again.history[-1]["residual"] == pytest.approx(fixed.history[-1]["residual"], rel=0.2)


def test_resume_goes_on_with_more_iterations(fixed, measurement):
    first = fixed
    more = replace(FIXED, iterations=14)(measurement, resume=first.state)
    assert len(more.history) == len(first.history) + 6
    assert more.history[-1]["objective"] < first.history[-1]["objective"]


def test_time_limit_stops_and_says_where(measurement):
    result = replace(FIXED, iterations=100000, time_limit=1e-3)(measurement)
    assert result.outcome.reason == "time_limit"
    assert "voxels" in result.outcome.message


def test_progress_rises_to_the_end(measurement):
    seen = []
    Tikhonov(voxels=24, device="cpu", iterations=10)(measurement, lambda step: seen.append(step.progress))
    assert all(0 < p <= 1 for p in seen)
    assert seen == sorted(seen)


@dataclasses.dataclass(frozen=True)
class Broken(Tikhonov):
    """A method that turns NaN after two iterations."""

    def iterate(self, problem, x, weight):
        for residual in (1.0, 0.5, float("nan")):
            yield Iterate(x + residual, residual, 0.0)


def test_run_that_turns_non_finite_says_so(measurement, tmp_path):
    result = Broken(voxels=24, device="cpu", regularisation=1e-3)(measurement)
    assert result.outcome.reason == "diverged"
    assert len(result.history) == 2
    assert bool(torch.isfinite(result.field.coefficients).all())
    write_state(tmp_path, result.state)
    again = FIXED(measurement, resume=State(result.state.tensors, {**result.state.scalars, "method": "Tikhonov"}))
    assert again.outcome.reason == "iterations"


def test_settings_are_recorded(fixed):
    assert fixed.settings == dataclasses.asdict(FIXED)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("method", "changes", "words"),
    [
        (Tikhonov, {"regularisation": -1.0}, "regularisation: expected auto"),
        (TotalVariation, {"regularisation": float("nan")}, "regularisation: expected auto"),
        (Tikhonov, {"penalty": "hessian"}, "penalty: expected one of identity, gradient, laplacian, got 'hessian'"),
        (Tikhonov, {"voxels": 0}, "voxels: expected"),
        (Tikhonov, {"iterations": 0}, "iterations: expected"),
        (Tikhonov, {"basis": "quadratic"}, "basis: expected one of linear, cubic, got 'quadratic'"),
        (Tikhonov, {"model": "bent"}, "model: expected one of auto, lever_arm, paraxial, curved"),
        (Tikhonov, {"step": 0.0}, "step: expected above 0 and at most 1 voxels .basis cubic., got 0.0"),
        (Tikhonov, {"tolerance": -1.0}, "tolerance: expected 0 or more, got -1.0"),
        (Tikhonov, {"lower": 1e-5}, "lower, upper: expected bounds of the field around 0"),
        (Landweber, {"relaxation": 2.0}, "relaxation: expected above 0 and below 2"),
        (Landweber, {"relaxation": 1.5}, "with momentum at most 1"),
        (TotalVariation, {"softness": 0.0}, "softness: expected above 0, got 0.0"),
        (TotalVariation, {"round": 0}, "round: expected at least 1 iteration, got 0"),
    ],
)
def test_settings_that_cannot_be_right(method, changes, words):
    with pytest.raises(InputError, match=words):
        method(**changes)


def test_data_that_cannot_be_reconstructed(fixed, measurement, monkeypatch):
    with refused("ambient_faces"):
        FIXED(replace(measurement, ambient_faces=()))
    with refused("flow_mask"):
        FIXED(replace(measurement, flow_mask=torch.zeros(measurement.displacement.shape[:3], dtype=torch.bool)))
    with refused("open_faces"):
        replace(FIXED, open_faces=("x-", "x+", "y-", "y+", "z-", "z+"))(measurement)
    with refused("resume"):
        replace(FIXED, voxels=30)(measurement, resume=fixed.state)
    monkeypatch.setattr(descent, "available_memory", lambda device: 1 << 16)
    with refused("voxels"):
        FIXED(measurement)


@pytest.mark.parametrize(("upper", "step"), [(None, None), (0.0, None), (None, 0.1)])
def test_memory_is_not_underestimated(measurement, monkeypatch, upper, step):
    """Arrays of the size of the grid that are alive at once, counted by torch and NumPy, fit in the estimate."""
    from torch.profiler import ProfilerActivity, profile

    method = TotalVariation(
        voxels=32, device="cpu", regularisation=1e-2, iterations=3, coarse_to_fine=False, upper=upper, step=step
    )
    of_numpy, spread = [], kernels_numba.spread

    def noted(*given):
        planes = spread(*given)
        of_numpy.append(sum(plane.nbytes for plane in planes))
        return planes

    monkeypatch.setattr(kernels_numba, "spread", noted)
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as record:
        method(measurement)
    alive = highest = 0
    for event in record.profiler.kineto_results.events():
        if event.name() == "[memory]":
            alive += event.nbytes()
            highest = max(highest, alive)
    grid = Grid.of_resolution(measurement.box, 32)
    highest += max(of_numpy)
    assert 0 < highest < method.memory_bytes(measurement, grid) - voxels_module.COMPILER_BYTES < 8 * highest


@pytest.mark.parametrize("basis", ["linear", "cubic"])
def test_run_on_the_kernels_of_cuda_agrees(measurement, monkeypatch, basis):
    settings = replace(FIXED, basis=basis, precision="float64", iterations=4, voxels=16)
    compiled = settings(measurement)
    monkeypatch.setattr(VoxelOperator, "_kernels", lambda self: kernels_torch)
    plain = settings(measurement)
    assert torch.allclose(plain.field.coefficients, compiled.field.coefficients, rtol=1e-6, atol=1e-12)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU here")
@pytest.mark.parametrize("method", METHODS, ids=NAMES)
def test_cuda_run_is_as_good(measurement, ball, method):
    metrics = error(replace(method, device="cuda")(measurement), ball, measurement.n_ambient)
    assert metrics["cc"] > LEAST_CC[type(method).__name__]
