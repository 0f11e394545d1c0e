"""The voxel methods from end to end: they find the field, obey gauge, hull and bounds, stop and resume."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import pytest
import torch
from safetensors import SafetensorError

from nerif.analysis.evaluation import evaluate_views, evaluate_volume, reproject
from nerif.data.volume import Volume
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Grid, Lens
from nerif.reconstruction.field_files import CHECKPOINT, read_field, read_state, write_field, write_state
from nerif.reconstruction.gauge import visual_hull
from nerif.reconstruction.reconstructor import Reconstruction, State, Step
from nerif.reconstruction.voxels import descent, kernels_numba, kernels_torch
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.reconstruction.voxels.voxel_problem import Iterate
from nerif.reconstruction.voxels.voxel_settings import COMPILER_BYTES
from refusals import refused

LEAST_CC = {Tikhonov: 0.94, Landweber: 0.86, TotalVariation: 0.98}  # five views are few
METHODS = pytest.mark.parametrize("kind", LEAST_CC, ids=lambda kind: kind.__name__)
FIXED = Tikhonov(voxels=24, device="cpu", regularisation=1e-3, iterations=8, tolerance=0)


@pytest.fixture(scope="module")
def fixed(measurement) -> Reconstruction:
    """The result of FIXED."""
    return FIXED(measurement)


def error(result, ball, n_ambient: float) -> dict[str, float]:
    grid = Grid.of_resolution(result.box, 30)
    return evaluate_volume(result.field, Volume(ball.sample(grid), grid), n_ambient)


@METHODS
def test_finds_the_balls_down_to_the_noise(measurement, ball, kind):
    result = kind(voxels=24, device="cpu")(measurement)
    assert error(result, ball, measurement.n_ambient)["cc"] > LEAST_CC[kind]
    assert isinstance(result.field, VoxelField)
    assert result.history[-1]["residual_over_sigma"] == pytest.approx(1, abs=0.15)
    assert "discrepancy principle" in result.outcome.message
    assert [r["step"] for r in result.history] == list(range(1, len(result.history) + 1))
    assert result.history[0]["voxels"] < result.history[-1]["voxels"] == 24  # coarse to fine
    assert all(v["cc"] > 0.99 for v in evaluate_views(reproject(result.field, measurement)))
    assert result.seconds > 0
    assert result.peak_memory_bytes > 0


@METHODS
def test_without_sigma_the_data_alone_decide(measurement, ball, kind):
    result = kind(voxels=24, device="cpu", iterations=40)(replace(measurement, sigma=None))
    assert error(result, ball, measurement.n_ambient)["cc"] > LEAST_CC[kind]
    assert "residual_over_sigma" not in result.history[-1]
    assert kind is Landweber or "L-curve" in result.outcome.message


def test_a_result_is_read_as_written(fixed, measurement, tmp_path, monkeypatch):
    assert fixed.settings == dataclasses.asdict(FIXED)
    write_field(tmp_path, fixed)
    field, box, n_ambient = read_field(tmp_path)
    points = Grid(box, (4, 5, 6)).points()
    assert torch.equal(field(points), fixed.field(points))
    assert (box, n_ambient) == (measurement.box, measurement.n_ambient)

    def full(*_, **__):
        raise SafetensorError("No space left on device (os error 28)")

    monkeypatch.setattr("safetensors.torch.save_file", full)
    with pytest.raises(OSError, match="No space left on device") as error:
        write_state(tmp_path, State({}, {}))
    assert error.value.filename == str(tmp_path / CHECKPOINT)


# -- data and constraints ------------------------------------------------------------------------------------------


def test_the_field_is_zero_on_the_ambient_faces(measurement):
    result = FIXED(replace(measurement, ambient_faces=("x-", "y+")))
    scale = float(result.field.sample(Grid(result.box, (8, 9, 10))).abs().max())
    for face in ("x-", "y+"):
        assert float(result.field(measurement.box.face_points(face, torch.rand(30, 2))).abs().max()) < 1e-3 * scale


def test_sigma_weights_the_views(measurement, ball):
    """One view has ten times the noise: harmless with its sigma, harmful without."""
    noisy, sigma = measurement.displacement.clone(), measurement.sigma.clone()
    noise = torch.randn(noisy[2].shape, generator=torch.Generator().manual_seed(3))
    noisy[2] += 10 * float(noisy.nan_to_num().square().mean().sqrt()) * noise
    sigma[2] *= 1000
    results = [FIXED(replace(measurement, displacement=noisy, sigma=s)) for s in (sigma, None)]
    l2 = [error(r, ball, measurement.n_ambient)["l2_variation"] for r in results]
    assert l2[0] < 0.6 * l2[1]


def test_invalid_pixels_and_rays_through_open_faces_are_not_used(fixed, measurement):
    valid = torch.ones(measurement.displacement.shape[:3], dtype=torch.bool)
    valid[:, :7] = False
    wrong = torch.where(valid[..., None], measurement.displacement, 50.0)
    fields = [FIXED(replace(measurement, displacement=d, valid=valid)).field for d in (measurement.displacement, wrong)]
    assert torch.equal(fields[0].coefficients, fields[1].coefficients)
    fewer = replace(FIXED, open_faces=("z+",))(measurement)
    assert not torch.equal(fixed.field.coefficients, fewer.field.coefficients)


def test_voxels_outside_the_visual_hull_are_ambient(measurement):
    mask = torch.zeros(measurement.displacement.shape[:3], dtype=torch.bool)
    mask[:, 5:15, 7:19] = True
    linear, masked = replace(FIXED, basis="linear"), replace(measurement, flow_mask=mask)
    hull = linear(replace(masked, ambient_faces=())).field
    values, inside = hull.sample(hull.grid), visual_hull(masked, hull.grid)
    assert float(values[~inside].abs().max()) < 1e-12
    assert float(values[inside].abs().max()) > 1e-5
    whole = replace(linear, hull=False)(masked).field
    assert float(whole.sample(hull.grid)[~inside].abs().max()) > 1e-7


def test_bounds_hold_everywhere_and_a_bounded_solution_improves(measurement):
    result = replace(FIXED, lower=-1.0e-4, upper=0.0, iterations=30)(measurement)
    values = result.field.sample(Grid(result.box, (21, 23, 29)))
    assert float(values.min()) >= -1.0e-4 * 1.0001
    assert float(values.max()) <= 1e-9
    result = replace(FIXED, upper=0.0, iterations=30, basis="linear", coarse_to_fine=False)(measurement)
    assert (result.outcome.reason, len(result.history)) == ("iterations", 30)
    assert result.history[-1]["objective"] < 0.95 * result.history[10]["objective"]


# -- iterations ----------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Prescribed(Tikhonov):
    """A method with prescribed residuals."""

    residuals: tuple[float, ...] = ()

    def iterate(self, problem, x, weight):
        for residual in self.residuals:
            yield Iterate(x + (0.0 if residual < 1 else residual), residual, 0.0)


def test_an_objective_that_rises_has_not_converged_and_one_that_is_not_finite_diverged(measurement, tmp_path):
    rising = Prescribed(voxels=12, device="cpu", regularisation=1e-3, iterations=8,
                        residuals=(1.0, 0.5, 0.4, 0.3, 0.6, 0.7, 0.8, 0.9))(measurement)  # fmt: skip
    assert (rising.outcome.reason, len(rising.history)) == ("iterations", 8)
    broken = Prescribed(voxels=24, device="cpu", regularisation=1e-3, residuals=(1.0, 0.5, float("nan")))(measurement)
    assert (broken.outcome.reason, len(broken.history)) == ("diverged", 2)
    assert bool(torch.isfinite(broken.field.coefficients).all())
    write_state(tmp_path, broken.state)
    again = FIXED(measurement, resume=State(broken.state.tensors, {**broken.state.scalars, "method": "Tikhonov"}))
    assert again.outcome.reason == "iterations"


def test_coarse_grids_and_a_field_to_start_from_are_ahead(measurement, ball):
    """After the same few iterations on the finest grid the residual is lower; a field replaces the coarse grids."""
    fine, flat = (
        replace(FIXED, coarse_to_fine=c, iterations=4, regularisation=1e-4)(measurement).history for c in (True, False)
    )
    assert fine[-1]["residual"] < flat[-1]["residual"]
    result = replace(FIXED, iterations=1)(measurement, start=ball)
    assert {r["voxels"] for r in flat} == {r["voxels"] for r in result.history} == {24}
    assert result.history[0]["residual"] < 0.3
    on = replace(FIXED, iterations=3)(measurement, resume=result.state)
    assert [r["voxels"] for r in on.history] == [24] * 3


def test_double_precision_agrees_with_single(fixed, measurement):
    single, double = fixed.field.coefficients, replace(FIXED, precision="float64")(measurement).field.coefficients
    assert double.dtype == torch.float64
    assert float((single - double).norm() / double.norm()) < 1e-3


@pytest.mark.parametrize("level", [12, 24])
def test_an_interrupted_run_is_usable_and_resumes(fixed, measurement, tmp_path, level):
    first = FIXED(measurement, lambda step: step.losses["voxels"] == level and step.step % 4 == 3)
    assert first.outcome.reason == "interrupted"
    assert first.history[-1]["voxels"] == max(first.field.grid.shape) == level
    write_state(tmp_path, first.state)
    again = FIXED(measurement, resume=read_state(tmp_path))
    assert again.outcome.reason == "iterations"
    assert len(again.history) == 2 * FIXED.iterations  # each grid has had its iterations, none twice
    assert again.seconds > first.seconds
    assert again.history[-1]["residual"] == pytest.approx(fixed.history[-1]["residual"], rel=0.2)


def test_resuming_with_more_iterations_and_the_time_limit(fixed, measurement):
    more = replace(FIXED, iterations=14)(measurement, resume=fixed.state)
    assert len(more.history) == len(fixed.history) + 6
    assert more.history[-1]["objective"] < fixed.history[-1]["objective"]
    limited = replace(FIXED, iterations=100000, time_limit=1e-3)(measurement)
    assert limited.outcome.reason == "time_limit"
    assert "voxels" in limited.outcome.message


def test_progress_rises_to_the_end(measurement):
    steps: list[Step] = []
    Tikhonov(voxels=24, device="cpu", iterations=10)(measurement, steps.append)
    progress = [step.progress for step in steps]
    assert all(0 < p <= 1 for p in progress)
    assert progress == sorted(progress)


@pytest.mark.parametrize(("window", "expected"), [(0.0, 24), (3.0, 40)])
def test_voxels_are_not_smaller_than_pixels_resolve_unless_windows_overlap(measurement, window, expected):
    """In smaller ones, steps between the lines of sight would explain the data: the error rose with the voxels."""
    cameras = tuple(replace(camera, lens=Lens(window=window)) for camera in measurement.cameras)
    settings, note = Tikhonov(voxels=40).resolved(replace(measurement, cameras=cameras))
    assert settings.voxels == expected
    assert ("24 voxels" in note) == (expected == 24)
    within = Tikhonov(voxels=20)
    assert within.resolved(measurement) == (within, "")


# -- invalid input -------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("method", "field", "values"),
    [
        (Tikhonov, "regularisation", (-1.0, float("nan"))), (Tikhonov, "penalty", ("hessian",)),
        (Tikhonov, "voxels", (0,)), (Tikhonov, "iterations", (0,)), (Tikhonov, "basis", ("quadratic",)),
        (Tikhonov, "model", ("bent",)), (Tikhonov, "step", (0.0,)), (Tikhonov, "tolerance", (-1.0,)),
        (Landweber, "relaxation", (1.5, 2.0)), (TotalVariation, "softness", (0.0,)), (TotalVariation, "round", (0,)),
    ],
)  # fmt: skip
def test_invalid_settings(method, field, values):
    for value in values:
        with refused(field):
            method(**{field: value})


def test_invalid_data(fixed, measurement, monkeypatch):
    with refused("lower, upper"):
        Tikhonov(lower=1e-5)
    with refused("ambient_faces"):
        FIXED(replace(measurement, ambient_faces=()))
    with refused("flow_mask"):
        FIXED(replace(measurement, flow_mask=torch.zeros(measurement.displacement.shape[:3], dtype=torch.bool)))
    with refused("open_faces"):
        replace(FIXED, open_faces=("x-", "x+", "y-", "y+", "z-", "z+"))(measurement)
    with refused("resume"):
        replace(FIXED, voxels=20)(measurement, resume=fixed.state)
    monkeypatch.setattr(descent, "available_memory", lambda device: 1 << 16)
    with refused("voxels"):
        FIXED(measurement)


# -- memory and devices --------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("upper", "step"), [(None, None), (0.0, None), (None, 0.1)])
def test_memory_is_not_underestimated(measurement, monkeypatch, upper, step):
    """Arrays of the size of the grid that exist at once, counted by torch and NumPy, fit in the estimate."""
    from torch.profiler import ProfilerActivity, profile

    method = TotalVariation(
        voxels=32, device="cpu", regularisation=1e-2, iterations=3, coarse_to_fine=False, upper=upper, step=step
    )
    numpy_bytes, spread = [], kernels_numba.spread

    def counted(*arguments):
        planes = spread(*arguments)
        numpy_bytes.append(sum(plane.nbytes for plane in planes))
        return planes

    monkeypatch.setattr(kernels_numba, "spread", counted)
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as record:
        method(measurement)
    alive = highest = 0
    for event in record.profiler.kineto_results.events():
        if event.name() == "[memory]":
            alive += event.nbytes()
            highest = max(highest, alive)
    highest += max(numpy_bytes)
    estimate = method.memory_bytes(measurement, Grid.of_resolution(measurement.box, 32)) - COMPILER_BYTES
    assert 0 < highest < estimate < 8 * highest


@pytest.mark.parametrize("basis", ["linear", "cubic"])
def test_a_run_on_the_kernels_of_cuda_agrees(measurement, monkeypatch, basis):
    settings = replace(FIXED, basis=basis, precision="float64", iterations=4, voxels=16)
    compiled = settings(measurement).field.coefficients
    monkeypatch.setattr(VoxelOperator, "_kernels", lambda self: kernels_torch)
    assert torch.allclose(settings(measurement).field.coefficients, compiled, rtol=1e-6, atol=1e-12)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU here")
@METHODS
def test_a_cuda_run_is_as_good(measurement, ball, kind):
    assert error(kind(voxels=24, device="cuda")(measurement), ball, measurement.n_ambient)["cc"] > LEAST_CC[kind]
