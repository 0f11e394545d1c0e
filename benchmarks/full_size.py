"""Cameras of full size.

Error, seconds and memory of NeRIF on the flame seen by the same rig at 100 x 100 and at 1000 x 1000 pixels. The
displacements are to first order along straight rays; the noise of a pixel is the same share of their rms at every
size. The memory includes the measurement.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.runner import N_AMBIENT, Settings
from nerif.analysis.evaluation import evaluate_volume
from nerif.analysis.prediction import predict
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid, paper_rig
from nerif.reconstruction import bins
from nerif.reconstruction.neural.presets import preset as settings_of
from nerif.simulation.simulate import add_noise

COLUMNS = {
    "pixels": "{pixels}²", "edge of the bins [px]": "{bin_edges}", "steps": "{steps:.0f}", "epochs": "{epochs:.2f}",
    "seconds": "{seconds:.0f}", "memory [GiB]": "{memory:.2f}", "L2": "{l2:.3%}",
    "L2 of variation": "{l2_variation:.2%}", "outcome": "{outcome}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    size = {"time_limit": 60.0, "flame_voxels": 160, "truth_voxels": 100}
    size |= {"time_limit": 3.0, "flame_voxels": 60, "truth_voxels": 40} if quick else {}
    for pixels in (50, 100) if quick else (100, 1000):
        yield {"pixels": pixels, "noise": 0.05, "preset": "fast", **size, "device": "auto"}


def flame(box: Box, voxels: int) -> VoxelField:
    """Return the flame on voxels, through which millions of rays are traced in seconds."""
    grid = Grid.of_resolution(box, voxels)
    return VoxelField.through(make_phantom("flame", box, 0).sample(grid), grid)


def measure(
    folder: Path, pixels: int, noise: float, preset: str, time_limit: float, device: str, flame_voxels: int,
    truth_voxels: int,
) -> dict[str, Any]:  # fmt: skip
    path = folder / f"full-size-{pixels}-{flame_voxels}-{noise:g}.nc"
    if not path.is_file():
        cameras, box = paper_rig(pixels)
        add_noise(predict(flame(box, flame_voxels), cameras, box, N_AMBIENT), noise, seed=1).write(path)
    measurement = Measurement.read(path)
    start = time.perf_counter()
    result = replace(settings_of(preset), time_limit=time_limit, epochs=0, device=device)(measurement)
    seconds = time.perf_counter() - start
    grid = Grid.of_resolution(measurement.box, truth_voxels)
    scores = evaluate_volume(
        result.field, Volume(flame(measurement.box, flame_voxels).sample(grid), grid), N_AMBIENT, result.device
    )
    edges = [bins.coarsest_edge(measurement)] + [int(r["bin_edge"]) for r in result.history if "bin_edge" in r]
    last = result.history[-1]
    return {
        "bin_edges": " then ".join(map(str, edges)), "steps": last["step"], "epochs": last["epoch"], "seconds": seconds,
        "memory": result.peak_memory_bytes / 2**30, "l2": scores["l2"], "l2_variation": scores["l2_variation"],
        "outcome": result.outcome.reason,
    }  # fmt: skip
