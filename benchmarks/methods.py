"""Which method for what: NeRIF and the classical methods on Gaussian balls and flame, the paper's rig, with noise.

    python benchmarks/methods.py --write benchmarks/results/methods-cpu.md

Every row is a process of its own, so that the memory is that row's. Truth and reconstruction meet only in the metrics.
"""

from __future__ import annotations

import argparse
import datetime
import multiprocessing
import shlex
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from flame import N_AMBIENT, machine
from nerif.evaluation import evaluate_volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Grid, paper_rig
from nerif.measurement import Measurement
from nerif.reconstruction.base import Reconstructor
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.landweber import Landweber
from nerif.reconstruction.presets import preset
from nerif.reconstruction.tikhonov import Tikhonov
from nerif.reconstruction.total_variation import TotalVariation
from nerif.reconstruction.voxels import VoxelReconstructor
from nerif.simulation import add_noise, simulate
from nerif.volume import Volume

COLUMNS = (
    "phantom", "noise", "method", "grid", "L2", "L2 of variation", "CC", "SSIM", "seconds", "memory [GiB]",
    "iterations", "outcome",
)  # fmt: skip


METHODS: tuple[tuple[str, VoxelReconstructor, str], ...] = (
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
    nerif = replace(preset(arguments.preset), time_limit=arguments.time_limit, epochs=1e6, device=device)
    found: list[Row] = []
    for phantom in arguments.phantom:
        for noise in arguments.noise:
            found.append(Row(phantom, noise, f"NeRIF {arguments.preset}", "-", nerif))
            for name, method, fine_basis in METHODS:
                for voxels, basis in ((40, "linear"), (arguments.voxels, fine_basis)):
                    settings = replace(method, voxels=voxels, basis=basis, device=device)
                    found.append(Row(phantom, noise, name, f"{voxels}³ {basis}", settings))
    return found


def run(row: Row, clean: Measurement, threads: int) -> str:
    """Reconstruct one case and return its line."""
    torch.set_num_threads(threads)
    keep_freed_memory()
    grid = Grid.of_resolution(clean.box, 100)
    truth = Volume(make_phantom(row.phantom, clean.box, 0).sample(grid), grid)
    result = row.method(add_noise(clean, row.noise, seed=1))
    m = evaluate_volume(result.field, truth, N_AMBIENT, result.device)
    return (
        f"| {row.phantom} | {row.noise:g} | {row.name} | {row.grid} | {m['l2']:.2%} | {m['l2_variation']:.2%} | "
        f"{m['cc']:.5f} | {m['ssim']:.4f} | {result.seconds:.0f} | {result.peak_memory_bytes / 2**30:.2f} | "
        f"{result.history[-1]['step']:.0f} | {result.outcome.reason} |"
    )


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
    parser.add_argument("--write", type=Path, help="also write the table to this file")
    arguments = parser.parse_args()

    lines = [
        f"Command: `python {shlex.join(sys.argv)}`  ",
        f"Machine: {machine()}  ",
        f"Date: {datetime.date.today().isoformat()}",
        "",
        "| " + " | ".join(COLUMNS) + " |",
        "|" + "---|" * len(COLUMNS),
    ]
    print("\n".join(lines), flush=True)
    threads = torch.get_num_threads()
    spawn = multiprocessing.get_context("spawn")
    cameras, box = paper_rig(arguments.pixels)
    clean = {p: simulate(make_phantom(p, box, 0), cameras, box, N_AMBIENT) for p in arguments.phantom}
    for row in rows(arguments):
        if arguments.only and row.name.split()[0] not in arguments.only:
            continue
        start = time.perf_counter()
        with ProcessPoolExecutor(1, mp_context=spawn) as pool:
            line = pool.submit(run, row, clean[row.phantom], threads).result()
        lines.append(line)
        print(line, file=sys.stdout, flush=True)
        print(f"  {time.perf_counter() - start:.0f} s in all", file=sys.stderr, flush=True)
        if arguments.write:
            arguments.write.parent.mkdir(parents=True, exist_ok=True)
            arguments.write.write_text("# Methods compared on the paper's rig\n\n" + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
