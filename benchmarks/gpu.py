"""What a graphics card does in twelve minutes.

The tests that need a card; 9 views of a flame through thin pupils (rigs.py) by every preset; 9 views of 200² and 1000²
px until the error is 0.7 %, and a film, by the preset of the device; the voxel methods. Each part has a budget of
seconds, after which its process ends; a part that fails costs no other. Seconds are of the fit (film: of a frame), the
compilation of the network included, without the time in which errors are computed. The memory is that of tensors on the
card. Without a card only `--quick` runs, on the CPU.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks import sequence
from benchmarks.full_size import simulated
from benchmarks.goals import METHODS
from benchmarks.runner import ROOT, Settings, Unavailable
from nerif.analysis.evaluation import evaluate_volume
from nerif.analysis.metrics import volume_errors
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.data.volume_file import read_volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.reconstruction.device import peak_memory, resolve_device
from nerif.reconstruction.neural.presets import PRESETS, preset
from nerif.reconstruction.reconstructor import Reconstruction, Step
from nerif.workflow.sequence.chunk import reconstruct_frames
from nerif.workflow.sequence.plan import SequenceSettings
from nerif.workflow.sequence.store import DONE, SequenceStore

GOAL, NOISE = 0.007, 0.05  # L2; of the rms displacement
BETWEEN = 1.1  # ratio of the times of two errors
COLD, WARM, INTERVAL = 250, 80, 1e-4  # steps of the first frame of the film and of others; s between frames
COLUMNS = {
    "part": "{part}", "of": "{subject}", "pixels": "{size}", "device": "{where}", "seconds": "{time:.2f}",
    "L2": "{l2:.3%}", "0.7 % after [s]": "{reached:.1f}", "memory [GiB]": "{memory:.2f}", "outcome": "{outcome}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    common: Settings = {"device": "auto", "needs": "nothing" if quick else "card"}
    common |= {"folder_of_rigs": "../shared/data/rigs"}
    common |= {"voxels": 16 if quick else 100, "frames": 2 if quick else 20}
    pixels = (16, 20) if quick else (200, 1000)
    parts = [
        ("tests", "pytest -m cuda", 0, 100),
        *(("preset", name, pixels[0], 60) for name in PRESETS),
        ("to 0.7 %", "auto", pixels[0], 70),
        ("to 0.7 %", "auto", pixels[1], 150),
        ("film", "auto", 12 if quick else 64, 100),
        *(("voxels", name, pixels[0], 40) for name in METHODS if name != "NeRIF"),
    ]
    for part, subject, size, budget in parts:
        seconds = 1.0 if quick else 0.6 * budget  # of the fit
        yield {"part": part, "subject": subject, "pixels": size, "seconds": seconds, "budget": budget, **common}


def measure(
    folder: Path, part: str, subject: str, pixels: int, seconds: float, budget: float, device: str, needs: str,
    folder_of_rigs: str, voxels: int, frames: int,
) -> dict[str, Any]:  # fmt: skip
    where, small = resolve_device(device), needs != "card"
    if where.type == "cpu" and not small:
        raise Unavailable("no graphics card that PyTorch can use; --quick runs on the CPU")
    if part == "tests":
        return {"where": str(where), **tested(0.9 * budget)}
    if part == "film":
        return {"where": str(where), **filmed(folder, subject, pixels, frames, voxels, str(where), small)}
    if part == "preset" and not small:
        path = ROOT / folder_of_rigs / "thin.nc"
        truth = path.with_name("truth.nc")
        if not path.is_file():
            raise Unavailable(f"no thin.nc in {folder_of_rigs}")
    else:
        path, truth = simulated(folder, pixels, NOISE, voxels if small else 160, voxels)
    measurement, volume = Measurement.read(path), read_volume(truth)
    if part == "voxels":
        changes: dict[str, Any] = {"voxels": voxels, "time_limit": seconds, "device": device}
        result = METHODS[subject](**changes)(measurement)
        return fitted(result, volume, pixels)
    batch = {"points_per_batch": 1 << 10} if small else {}
    settings = preset(subject, time_limit=seconds, epochs=1e9, device=device, **batch)
    if part == "preset":
        return fitted(settings(measurement), volume, pixels)
    curve = Curve(volume, measurement.n_ambient)
    result = settings(measurement, curve)
    reached = next((t for t, l2 in curve.points if l2 <= GOAL), None)
    metrics = fitted(result, volume, pixels) | {"time": result.seconds - curve.spent}
    return metrics | {"reached": reached, "curve": curve.points}


class Curve:
    """Callback that computes the error at times in a geometric series and stops a run at the goal."""

    def __init__(self, truth: Volume, n_ambient: float) -> None:
        self.truth, self.n_ambient = truth, n_ambient
        self.points: list[tuple[float, float]] = []  # s without those of the errors, L2
        self.spent = 0.0  # s, for the errors

    def __call__(self, step: Step) -> bool:
        seconds, begin = step.seconds - self.spent, time.perf_counter()
        if self.points and seconds < BETWEEN * self.points[-1][0]:
            return False
        l2 = evaluate_volume(step.field(), self.truth, self.n_ambient)["l2"]
        self.points.append((seconds, l2))
        self.spent += time.perf_counter() - begin
        return bool(l2 <= GOAL)


def fitted(result: Reconstruction, truth: Volume, pixels: int) -> dict[str, Any]:
    """Return what a row shows of a run."""
    return {
        "where": result.device, "size": f"{pixels}²", "time": result.seconds, "outcome": result.outcome.reason,
        "l2": evaluate_volume(result.field, truth, result.n_ambient)["l2"],
        "memory": result.peak_memory_bytes / 2**30,
    }  # fmt: skip


def tested(limit: float) -> dict[str, Any]:
    """Run the marked tests; return the last line of pytest. Raise an error for a failure."""
    command = [sys.executable, "-m", "pytest", "-q", "-m", "cuda", "-p", "no:cacheprovider", "tests/reconstruction"]
    begin = time.perf_counter()
    path = os.pathsep.join(filter(None, (str(ROOT / "src"), os.environ.get("PYTHONPATH"))))
    run = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=limit
    )
    last = (run.stdout.strip() or run.stderr.strip() or "no output").splitlines()[-1]
    if run.returncode:
        raise RuntimeError(last)
    return {"time": time.perf_counter() - begin, "outcome": last}


def filmed(
    folder: Path, name: str, pixels: int, frames: int, voxels: int, device: str, small: bool
) -> dict[str, Any]:  # fmt: skip
    """Reconstruct a film, each frame from the one before; time is the mean of a frame, the error that of the last."""
    views, cold, warm = (3, 5, 5) if small else (9, COLD, WARM)
    path = sequence.film(folder, views, frames, pixels, INTERVAL, NOISE, voxels)
    settings = SequenceSettings(chunk=frames, voxels=voxels, quantities=("index_excess",), warm_steps=warm)
    plan = sequence.begin(path, folder / "gpu-film.zarr", cold, settings, name, device)
    begin = time.perf_counter()
    reconstruct_frames(plan, 0, frames)
    seconds, store = time.perf_counter() - begin, SequenceStore(plan.out)
    assert all(store.status[i] == DONE for i in range(frames)), store.reasons
    truth = VolumeSequence(path.with_name(path.stem + ".truth.zarr")).volume(frames - 1, "index_excess")
    last = store.volume(frames - 1, "index_excess")
    l2 = volume_errors(truth.values.numpy(), last.values.numpy(), sequence.N_AMBIENT)["l2"]
    memory = peak_memory(resolve_device(device)) / 2**30
    return {"time": seconds / frames, "l2": l2, "memory": memory, "outcome": f"{frames} frames", "size": f"{pixels}²"}


def notes(rows: list[dict[str, Any]]) -> list[str]:
    return [f"Budgets: {sum(row['budget'] for row in rows):.0f} s in all."]
