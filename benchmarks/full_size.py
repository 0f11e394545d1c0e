"""Cameras of full size: error, seconds and memory of the same rig at 100 x 100 and at 1000 x 1000 pixels.

    python benchmarks/full_size.py --write benchmarks/results/full-size-cpu.md

The displacements are to first order along straight rays; the noise of a pixel is the same share of their root mean
square at every size. Each row is a process of its own, so that the memory is that row's; it includes the measurement.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from bench import N_AMBIENT, Table, add_write, alone
from nerif.analysis.evaluation import evaluate_volume
from nerif.analysis.prediction import predict
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.grid import VoxelField
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, paper_rig
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.neural import bins
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.presets import preset
from nerif.simulation.simulate import add_noise

COLUMNS = (
    "pixels", "edge of the bins [px]", "steps", "passes", "seconds", "memory [GiB]", "L2", "L2 of variation", "outcome",
)  # fmt: skip
VOXELS = 160  # along an edge of the box, on which the flame is given


def flame(box: Box) -> VoxelField:
    """The flame on voxels, through which millions of rays are traced in seconds."""
    grid = Grid.of_resolution(box, VOXELS)
    return VoxelField.through(make_phantom("flame", box, 0).sample(grid), grid)


def measured(pixels: int, noise: float, folder: Path) -> Path:
    """Simulate the flame on the paper's rig, and return the measurement file; one that is there already is taken."""
    path = folder / f"flame-{pixels}-{noise:g}.nc"
    if not path.is_file():
        cameras, box = paper_rig(pixels)
        add_noise(predict(flame(box), cameras, box, N_AMBIENT), noise, seed=1).write(path)
    return path


def row(path: Path, settings: NeRIF, fewest: int | None, threads: int) -> list[str]:
    """Reconstruct one measurement, and return its row."""
    torch.set_num_threads(threads)
    keep_freed_memory()
    bins.MIN_BINS = fewest or bins.MIN_BINS
    measurement = Measurement.read(path)
    begun = time.perf_counter()
    result = settings(measurement)
    seconds = time.perf_counter() - begun
    grid = Grid.of_resolution(measurement.box, 100)
    truth = Volume(flame(measurement.box).sample(grid), grid)
    found = evaluate_volume(result.field, truth, N_AMBIENT, result.device)
    assert result.state is not None
    edges = [bins.coarsest_edge(measurement)] + [int(r["bin_edge"]) for r in result.history if "bin_edge" in r]
    last, steps = result.history[-1], " then ".join(map(str, edges))
    return [
        f"{measurement.shape[1]}²",
        steps,
        f"{last['step']:.0f}",
        f"{last['epoch']:.2f}",
        f"{seconds:.0f}",
        f"{result.peak_memory_bytes / 2**30:.2f}",
        f"{found['l2']:.3%}",
        f"{found['l2_variation']:.2%}",
        result.outcome.reason,
    ]


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pixels", type=int, nargs="+", default=[100, 1000], help="of an edge of each view")
    parser.add_argument("--fewest", type=int, nargs="+", default=[0], help="bins along an image at least; 0 as it is")
    parser.add_argument("--noise", type=float, default=0.05)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--time-limit", type=float, default=60.0, help="seconds; 0: until it ends by itself")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--folder", type=Path, help="of the simulated measurements, to keep them")
    add_write(parser)
    arguments = parser.parse_args()

    settings = replace(preset(arguments.preset), time_limit=arguments.time_limit, epochs=0, device=arguments.device)
    more = f"; flame, 9 views, noise {arguments.noise:g}"
    table = Table("Cameras of full size", COLUMNS, arguments.write, more)
    with tempfile.TemporaryDirectory() as temporary:
        for pixels in arguments.pixels:
            path = measured(pixels, arguments.noise, arguments.folder or Path(temporary))
            for fewest in arguments.fewest:
                table.row(alone(row, path, settings, fewest or None, torch.get_num_threads()))


if __name__ == "__main__":
    main()
