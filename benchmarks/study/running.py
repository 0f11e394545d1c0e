"""Running the cases of a study: each in a process of its own, its record on disk as soon as it is done.

A process of its own gives each case an honest peak of memory (of the libraries of all methods, too: they are imported
once, before the processes part), and a case that fails or is killed leaves the others be.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import torch

from nerif.analysis.evaluation import evaluate_volume
from nerif.analysis.metrics import volume_errors
from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.base import Field
from nerif.fields.phantoms import Octahedron, make_phantom
from nerif.forward.deflection import MODELS
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Grid
from nerif.reconstruction.base import Reconstruction, State, Step
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.neural.neural import NeRIF
from nerif.simulation.simulate import add_noise, simulate
from study.cases import BOX, N_AMBIENT, NOISE_SEED, Case
from study.octahedron import pixels_per_unit, to_plain
from study.records import read_record, write_record
from study.resolution import measure_resolution
from study.results import Record

__all__ = ["OnProgress", "run_case", "run_cases"]

FORWARD_RAYS, FORWARD_SAMPLES = 4000, 400
SHARES = (0.03, 0.06, 0.1, 0.15, 0.22, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Of a run, after which its error is looked at (when the run is over)."""

PRELOADED = [
    # of the study's own modules forkserver knows no path before Python 3.12.8; they are small
    *("nerif.analysis.evaluation", "nerif.simulation.simulate"),
    *(f"nerif.reconstruction.voxels.{name}" for name in ("landweber", "tikhonov", "total_variation")),
    "nerif.reconstruction.neural.neural",
    *("xarray", "h5netcdf", "dask.array", "skimage.metrics", "nerif.reconstruction.voxels.kernels_numba"),
    # every optimiser imports it; with CUDA a process must not inherit what the import found out of the GPU
    *(() if torch.backends.cuda.is_built() else ("torch._dynamo",)),
]
"""Modules that a case needs, imported once for all processes: else it takes each as long as a short reconstruction."""

OnProgress = Callable[[str, float], None]
"""Told what is being done, and the share of it that is done."""


def run_cases(cases: list[Case], folder: Path, on_progress: Callable[[int, str, float], None]) -> Iterator[Record]:
    """Run the cases that have no record yet, and yield the record of every case, in order.

    Parameters
    ----------
    folder : of the study; records go to folder/cases, simulated measurements to folder/data
    on_progress : told the number of cases done, and what is being done and how far it is
    """
    for name in ("cases", "data"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for i, case in enumerate(cases):
        record = read_record(folder, case)
        if record is None or "failed" in record:
            with _process(case, folder) as told:
                record = _listen(told, lambda what, share, done=i: on_progress(done, what, share))  # type: ignore[misc]
            record = write_record(folder, case, record)
        on_progress(i + 1, case.key, 0.0)
        yield record


def run_case(case: Case, folder: Path, on_progress: OnProgress = lambda what, share: None) -> Record:
    """Simulate (or read what was simulated before), reconstruct, and only then compare with the truth."""
    on_progress("simulating", 0.0)
    phantom = make_phantom(case.phantom, BOX)
    measurement = add_noise(_clean(case, phantom, folder), case.noise, NOISE_SEED)
    snapshots: list[State] = []

    def follow(step: Step) -> None:
        on_progress("reconstructing", step.progress)
        if case.snapshots and any(share <= step.progress for share in SHARES[len(snapshots) :]):
            snapshots.append(step.capture())

    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    result = case.reconstructor(measurement, follow)
    if not result.history:
        raise InputError(f"not a single step was made: {result.outcome.message}")
    on_progress("comparing", 1.0)
    grid = Grid.of_resolution(BOX, case.truth_voxels)
    truth = Volume(phantom.sample(grid), grid)
    last = result.history[-1]
    record: Record = {
        "phantom": case.phantom,
        "noise": case.noise,
        "method": case.method,
        "views": case.ring.views,
        "metrics": evaluate_volume(result.field, truth, N_AMBIENT, result.device),
        "seconds": result.seconds,
        "peak_memory_bytes": result.peak_memory_bytes,
        "device": result.device,
        "outcome": result.outcome.reason,
        "steps": last.get("step"),
        "epochs": last.get("epoch"),
        "loss": last.get("loss"),
    }
    if case.snapshots:
        rays = len(measurement.rays()[0])
        followed = [*_earlier(case, measurement, snapshots), result]
        record["curve"] = [_point(r, truth, rays) for r in followed]
    if case.labels.get("model") == "lever_arm":
        record["forward"] = _forward_models(phantom, measurement)
    if isinstance(phantom, Octahedron):
        record["resolution"] = to_plain(measure_resolution(result.field, phantom, device=result.device))
        record["pixels_per_unit"] = pixels_per_unit(measurement.cameras[0], phantom)
    return record


def _clean(case: Case, phantom: Field, folder: Path) -> Measurement:
    """The simulated measurement without noise, from disk where it is there already."""
    path = folder / "data" / f"{case.data_key}.nc"
    if path.is_file():
        return Measurement.read(path)
    measurement = simulate(phantom, case.ring.cameras(), BOX, N_AMBIENT)
    measurement.write(path)
    return measurement


def _forward_models(phantom: Field, measurement: Measurement) -> dict[str, dict[str, float]]:
    """How far each straight-ray model, on the true field, is from the curved rays of the simulation."""
    rays, curved, _ = measurement.rays()
    some = slice(None, None, max(1, len(rays) // FORWARD_RAYS))
    rays, curved = rays[some], curved[some]
    found = {}
    for model in MODELS:
        straight = project(PathIntegral(MODELS[model](N_AMBIENT), FORWARD_SAMPLES), phantom, rays)
        rms = float((straight - curved).square().mean().sqrt())
        found[model] = {"rms_px": rms, "relative": rms / float(curved.square().mean().sqrt())}
    return found


def _earlier(case: Case, measurement: Measurement, states: list[State]) -> Iterator[Reconstruction]:
    """The reconstruction as it stood in each state: resumed, and stopped before the next step."""
    assert isinstance(case.reconstructor, NeRIF)
    for state in states:
        step = int(state.scalars["budget"]["step"])
        stop = replace(case.reconstructor, time_limit=0.0, max_steps=step, compile="off")
        yield stop(measurement, resume=state)


def _point(result: Reconstruction, truth: Volume, rays: int) -> dict[str, float]:
    assert result.state is not None
    at = result.state.scalars["budget"]
    rec = result.field.sample(truth.grid, result.device).numpy()
    return {
        "step": float(at["step"]),
        "epoch": at["rays_done"] / rays,
        "seconds": float(at["seconds"]),
        "loss": result.history[-1].get("loss", float("nan")),
        **volume_errors(truth.values.numpy(), rec, N_AMBIENT),
    }


# -- a process for each case -----------------------------------------------------------------------------------------


@contextmanager
def _process(case: Case, folder: Path) -> Iterator[Connection]:
    """A process that runs the case and tells of it; it ends with the block."""
    methods = multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
    if "forkserver" in methods:
        context.set_forkserver_preload(PRELOADED)
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(case, folder, there), daemon=True)  # type: ignore[attr-defined]
    process.start()
    there.close()
    try:
        yield here
        process.join(10)  # it has told all; let it clear up after itself
    finally:
        process.terminate()
        process.join()


def _listen(told: Connection, on_progress: OnProgress) -> Record:
    """Pass on what the process tells until it gives its record, or is gone."""
    while True:
        try:
            kind, *words = told.recv()
        except EOFError:
            return {"failed": "its process was killed; by the system for want of memory, perhaps"}
        if kind == "done":
            return dict(words[0])
        on_progress(*words)


def _work(case: Case, folder: Path, tell: Connection) -> None:
    """In the process: run the case; Ctrl-C is the parent's to handle."""
    import signal
    import traceback

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    keep_freed_memory()
    last = [0.0]

    def progress(what: str, share: float) -> None:
        if time.monotonic() - last[0] > 0.2:
            last[0] = time.monotonic()
            tell.send(("at", f"{case.key}: {what}", share))

    try:
        record = run_case(case, folder, progress)
    except Exception as error:  # whatever it is: recorded, and the other cases go on
        place = traceback.extract_tb(error.__traceback__)[-1]
        record = {"failed": f"{type(error).__name__}: {error} ({Path(place.filename).name}, line {place.lineno})"}
    tell.send(("done", record))
