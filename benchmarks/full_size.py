"""Whole runs of `nerif reconstruct` within a time limit, from small cameras to cameras of full size.

Seconds from the start of the process to its end, and what of them trained the field: the main run, and the
cross-validation with its prediction of a view, whose field is the start of the main run. The flame is seen by the same
rig at every size; the displacements are to first order along straight rays, and the noise of a pixel is the same share
of their rms. The memory is that of the process.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.runner import N_AMBIENT, Settings
from nerif.analysis.prediction import predict
from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid, paper_rig
from nerif.simulation.simulate import add_noise

COLUMNS = {
    "pixels": "{pixels}²", "options": "{options}", "seconds": "{seconds:.1f}", "main run": "{main:.1f}",
    "cross-validation": "{validation:.1f}", "share of both": "{share:.0%}", "memory [GiB]": "{memory:.2f}",
    "L2 of variation": "{l2_variation:.2%}", "L2": "{l2:.3%}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    limits = ((50, 10),) if quick else ((120, 90), (200, 90), (1000, 60), (1000, 150))
    size = {"flame_voxels": 60, "truth_voxels": 40} if quick else {"flame_voxels": 160, "truth_voxels": 100}
    for pixels, limit in limits:
        yield {"pixels": pixels, "noise": 0.05, "options": f"--time-limit {limit}", **size, "device": "auto"}
    short = 50 if quick else 120
    yield {"pixels": short, "noise": 0.05, "options": "--max-steps 2 --withhold none", **size, "device": "auto"}


def flame(box: Box, voxels: int) -> VoxelField:
    """Return the flame on voxels, through which millions of rays are traced in seconds."""
    grid = Grid.of_resolution(box, voxels)
    return VoxelField.through(make_phantom("flame", box, 0).sample(grid), grid)


def simulated(folder: Path, pixels: int, noise: float, flame_voxels: int, truth_voxels: int) -> tuple[Path, Path]:
    """Return the files of measurement and truth, simulated once."""
    path, truth = (folder / f"full-size-{pixels}-{flame_voxels}-{noise:g}{end}" for end in (".nc", ".truth.nc"))
    if not truth.is_file():
        cameras, box = paper_rig(pixels)
        field, grid = flame(box, flame_voxels), Grid.of_resolution(box, truth_voxels)
        add_noise(predict(field, cameras, box, N_AMBIENT), noise, seed=1).write(path)
        Volume.of(field.sample(grid), grid, "index_excess", N_AMBIENT).write(truth)
    return path, truth


def measure(
    folder: Path, pixels: int, noise: float, options: str, device: str, flame_voxels: int, truth_voxels: int
) -> dict[str, Any]:  # fmt: skip
    path, truth = simulated(folder, pixels, noise, flame_voxels, truth_voxels)
    out, start = folder / f"full-size-{pixels}", time.perf_counter()
    _nerif("reconstruct", path, "--out", out, "--force", "--device", device, *options.split())
    seconds = time.perf_counter() - start
    memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    _nerif("evaluate", out, "--truth", truth)
    metrics = json.loads((out / "metrics.json").read_text())
    main, validation = metrics["seconds"], (metrics.get("cross_validation") or {}).get("seconds", 0.0)
    return {
        "seconds": seconds, "main": main, "validation": validation, "share": (main + validation) / seconds,
        "memory": memory, "l2": metrics["l2"], "l2_variation": metrics["l2_variation"],
    }  # fmt: skip


def _nerif(*words: Any) -> None:
    subprocess.run([sys.executable, "-m", "nerif", *map(str, words)], check=True, stdout=subprocess.DEVNULL)
