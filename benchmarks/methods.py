"""Which method for what: NeRIF and the classical methods on Gaussian balls and flame, the paper's rig, with noise.

    python benchmarks/methods.py --write benchmarks/results/methods-cpu.md

Every row is a process of its own, so that the memory is that row's. Truth and reconstruction meet only in the metrics.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from typing import Literal

import torch

from bench import N_AMBIENT, Table, add_write, alone
from nerif.analysis.evaluation import evaluate_volume
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Grid, paper_rig
from nerif.reconstruction.base import Reconstructor
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.neural.presets import preset
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.settings import VoxelReconstructor
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.simulation.simulate import add_noise, simulate

COLUMNS = (
    "phantom", "noise", "method", "grid", "L2", "L2 of variation", "CC", "SSIM", "seconds", "memory [GiB]",
    "iterations", "outcome",
)  # fmt: skip


Basis = Literal["linear", "cubic"]

METHODS: tuple[tuple[str, VoxelReconstructor, Basis], ...] = (
    ("Tikhonov", Tikhonov(), "linear"),
    ("Landweber", Landweber(), "linear"),
    ("TV", TotalVariation(), "cubic"),
)
"""Name, settings, and the basis on the finer grid: cubic where it is worth its time."""


@dataclass(frozen=True)
class Row:
    """A case: what is reconstructed, by what."""

    phantom: str
    noise: float
    name: str
    grid: str
    method: Reconstructor


def rows(arguments: argparse.Namespace) -> list[Row]:
    """All cases, in the order of the table."""
    device = arguments.device
    nerif = replace(preset(arguments.preset), time_limit=arguments.time_limit, epochs=0, device=device)
    found: list[Row] = []
    for phantom in arguments.phantom:
        for noise in arguments.noise:
            found.append(Row(phantom, noise, f"NeRIF {arguments.preset}", "-", nerif))
            for name, method, fine_basis in METHODS:
                grids: tuple[tuple[int, Basis], ...] = ((40, "linear"), (arguments.voxels, fine_basis))
                for voxels, basis in grids:
                    settings = replace(method, voxels=voxels, basis=basis, device=device)
                    found.append(Row(phantom, noise, name, f"{voxels}³ {basis}", settings))
    return found


def run(row: Row, clean: Measurement, threads: int) -> list[str]:
    """Reconstruct one case and return its row."""
    torch.set_num_threads(threads)
    keep_freed_memory()
    grid = Grid.of_resolution(clean.box, 100)
    truth = Volume(make_phantom(row.phantom, clean.box, 0).sample(grid), grid)
    result = row.method(add_noise(clean, row.noise, seed=1))
    m = evaluate_volume(result.field, truth, N_AMBIENT, result.device)
    cells = [row.phantom, f"{row.noise:g}", row.name, row.grid, f"{m['l2']:.2%}", f"{m['l2_variation']:.2%}"]
    cells += [f"{m['cc']:.5f}", f"{m['ssim']:.4f}", f"{result.seconds:.0f}"]
    cells += [f"{result.peak_memory_bytes / 2**30:.2f}", f"{result.history[-1]['step']:.0f}"]
    return [*cells, result.outcome.reason]


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--phantom", nargs="+", default=["gaussians", "flame"])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.1, 0.15])
    parser.add_argument("--pixels", type=int, default=200, help="of an edge of each view (the paper: 200)")
    parser.add_argument("--voxels", type=int, default=80, help="of the finer grid, along an edge")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--time-limit", type=float, default=60.0, help="seconds for NeRIF")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--only", nargs="+", default=[], help="methods by name, e.g. TV Tikhonov")
    add_write(parser)
    arguments = parser.parse_args()

    table = Table("Methods compared on the paper's rig", COLUMNS, arguments.write)
    threads = torch.get_num_threads()
    cameras, box = paper_rig(arguments.pixels)
    clean = {p: simulate(make_phantom(p, box, 0), cameras, box, N_AMBIENT) for p in arguments.phantom}
    for row in rows(arguments):
        if arguments.only and row.name.split()[0] not in arguments.only:
            continue
        start = time.perf_counter()
        table.row(alone(run, row, clean[row.phantom], threads))
        print(f"  {time.perf_counter() - start:.0f} s in all", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
