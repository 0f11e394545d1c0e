"""Run one case of the study. Truth and reconstruction are compared only after the reconstruction has finished."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.runner import N_AMBIENT
from benchmarks.study.plan import BOX, Case
from benchmarks.study.resolution import measure_resolution, pixels_per_unit
from nerif.analysis.evaluation import evaluate_volume
from nerif.analysis.metrics import volume_errors
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.field import Field
from nerif.fields.phantoms import Octahedron, make_phantom
from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Grid
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import Reconstruction, State, Step
from nerif.simulation.simulate import add_noise, simulate

NOISE_SEED = 1
FORWARD_RAYS, FORWARD_SAMPLES = 4000, 400
SHARES = (0.03, 0.06, 0.1, 0.15, 0.22, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Of a run, at which its state is captured; errors are computed when the run is over."""


def run_case(case: Case, folder: Path) -> dict[str, Any]:
    """Simulate (or read an earlier simulation), reconstruct, and compare with the truth.

    The record has the metrics of the volume; time [s], memory [GB] and processor; outcome, steps, epochs and loss at
    the end; for some cases the curve of the error, the errors of the forward models, the resolution.
    """
    phantom = make_phantom(case.phantom, BOX)
    path = folder / case.data_name
    if not path.is_file():
        simulate(phantom, case.ring.cameras(), BOX, N_AMBIENT).write(path)
    measurement = add_noise(Measurement.read(path), case.noise, NOISE_SEED)
    snapshots: list[State] = []

    def follow(step: Step) -> None:
        if case.snapshots and any(share <= step.progress for share in SHARES[len(snapshots) :]):
            snapshots.append(step.capture())

    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    result = case.reconstructor(measurement, follow)
    if not result.history:
        raise InputError(f"not a single step was made: {result.outcome.message}")
    grid = Grid.of_resolution(BOX, case.truth_voxels)
    truth = Volume(phantom.sample(grid), grid)
    last = result.history[-1]
    record = {
        **evaluate_volume(result.field, truth, N_AMBIENT, result.device), "time": result.seconds,
        "memory": result.peak_memory_bytes / 1e9, "processor": result.device, "outcome": result.outcome.reason,
        "steps": last.get("step"), "epochs": last.get("epoch"), "loss": last.get("loss"), "views": case.ring.views,
    }  # fmt: skip
    if case.snapshots:
        rays = len(measurement.rays()[0])
        record["curve"] = [_point(state, truth, rays) for state in [*_earlier(case, measurement, snapshots), result]]
    if case.labels.get("model") == "lever_arm":
        record["forward"] = _forward_models(phantom, measurement)
    if isinstance(phantom, Octahedron):
        record["resolution"] = measure_resolution(result.field, phantom, result.device)
        record["pixels_per_unit"] = pixels_per_unit(measurement.cameras[0], phantom)
    return record


def _forward_models(phantom: Field, measurement: Measurement) -> dict[str, dict[str, float]]:
    """Compare each straight-ray model, on the true field, with the curved rays of the simulation."""
    rays, curved, _ = measurement.rays()
    subset = slice(None, None, max(1, len(rays) // FORWARD_RAYS))
    rays, curved = rays[subset], curved[subset]
    differences = {}
    for model in MODELS:
        straight = project(PathIntegral(MODELS[model](N_AMBIENT), FORWARD_SAMPLES), phantom, rays)
        rms = float((straight - curved).square().mean().sqrt())
        differences[model] = {"rms_px": rms, "relative": rms / float(curved.square().mean().sqrt())}
    return differences


def _earlier(case: Case, measurement: Measurement, states: list[State]) -> Iterator[Reconstruction]:
    """Yield the reconstruction of each state: resumed, and stopped before the next step."""
    assert isinstance(case.reconstructor, NeRIF)
    for state in states:
        step = int(state.scalars["schedule"]["step"])
        stop = replace(case.reconstructor, time_limit=0.0, max_steps=step, compile="off")
        yield stop(measurement, resume=state)


def _point(result: Reconstruction, truth: Volume, rays: int) -> dict[str, float]:
    assert result.state is not None
    schedule = result.state.scalars["schedule"]
    values = result.field.sample(truth.grid, result.device).numpy()
    return {
        "step": float(schedule["step"]),
        "epochs": schedule["rays_done"] / rays,
        "seconds": float(schedule["seconds"]),
        "loss": result.history[-1].get("loss", float("nan")),
        **volume_errors(truth.values.numpy(), values, N_AMBIENT),
    }
