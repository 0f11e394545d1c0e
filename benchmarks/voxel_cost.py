"""What the classical methods cost: seconds and memory of 50 iterations on grids of 40 to 160 voxels an edge.

    python benchmarks/voxel_cost.py --write benchmarks/results/voxel-cost-cpu.md

Flame on the paper's rig, Tikhonov with a fixed weight, no coarse grids. Every row is a process of its own, so that the
memory is that row's; the base is a process that has read the data and done nothing. "plain" is the same operator in
PyTorch (kernels_torch.py), what CUDA runs, timed here on one iteration.
"""

from __future__ import annotations

import argparse
import datetime
import multiprocessing
import shlex
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import torch

from flame import N_AMBIENT, machine
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Grid, paper_rig
from nerif.measurement import Measurement
from nerif.reconstruction import kernels_torch
from nerif.reconstruction.device import keep_freed_memory, peak_memory, resolve_device
from nerif.reconstruction.operator import DeflectionOperator
from nerif.reconstruction.tikhonov import Tikhonov
from nerif.simulation import simulate

COLUMNS = (
    "grid", "basis", "samples [million]", "iterations", "seconds", "ns a sample and iteration", "of it operator",
    "memory above base [GiB]", "memory [GiB]", "estimate [GiB]",
)  # fmt: skip


def run(measurement: Measurement, voxels: int, basis: str, iterations: int, device: str, threads: int) -> str:
    """Measure one grid and return its line; 0 voxels measure the base."""
    torch.set_num_threads(threads)
    keep_freed_memory()
    where = resolve_device(device)
    rays, displacement, _ = measurement.rays()
    if not voxels:
        return str(peak_memory(where))
    settings = Tikhonov(
        voxels=voxels, basis=basis, iterations=iterations, tolerance=0, regularisation=1e-3,
        coarse_to_fine=False, device=device,
    )  # fmt: skip
    settings_once = Tikhonov(voxels=12, basis=basis, iterations=1, regularisation=1e-3, device=device)
    settings_once(measurement)  # what is compiled once is not counted
    result = settings(measurement)
    memory = peak_memory(where)
    grid = Grid.of_resolution(measurement.box, voxels)
    operator = DeflectionOperator(rays, grid, N_AMBIENT, basis=basis, device=where)
    x, y = torch.rand(grid.shape, device=where), displacement.to(where)
    times = []
    for _ in range(3):
        start = time.perf_counter()
        operator(x)
        float(operator.T(y).sum())
        times.append(time.perf_counter() - start)
    samples = int(operator._rays[-1].sum())
    estimate = settings.memory_bytes(measurement, grid) / 2**30
    return (
        f"{samples / 1e6:.1f} | {iterations} | {result.seconds:.1f} | "
        f"{result.seconds / iterations / samples * 1e9:.1f} | "
        f"{min(times) * iterations / result.seconds:.0%} | {{above}} | {memory} | {estimate:.2f} |"
    )


def plain(measurement: Measurement, voxels: int, basis: str, threads: int) -> tuple[float, float]:
    """Seconds of one application and its adjoint by the compiled and the plain kernels on the CPU."""
    torch.set_num_threads(threads)
    keep_freed_memory()
    rays, displacement, _ = measurement.rays()
    grid = Grid.of_resolution(measurement.box, voxels)
    operator = DeflectionOperator(rays, grid, N_AMBIENT, basis=basis)
    x = torch.rand(grid.shape)
    padded, out = operator.boundary.extend(x, operator.layers), torch.empty_like(displacement)
    operator.T(operator(x))
    start = time.perf_counter()
    operator.T(operator(x))
    fast = time.perf_counter() - start
    start = time.perf_counter()
    kernels_torch.forward(operator.degree, padded, operator._rays, out)
    kernels_torch.adjoint(operator.degree, out, operator._rays, torch.zeros_like(padded))
    return fast, time.perf_counter() - start


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--voxels", type=int, nargs="+", default=[40, 64, 100, 160])
    parser.add_argument("--basis", nargs="+", default=["linear", "cubic"])
    parser.add_argument("--iterations", type=int, default=50)
    parser.add_argument("--pixels", type=int, default=200)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--write", type=Path, help="also write the table to this file")
    arguments = parser.parse_args()

    threads = torch.get_num_threads()
    spawn = multiprocessing.get_context("spawn")

    def alone(function, *values):  # type: ignore[no-untyped-def]
        with ProcessPoolExecutor(1, mp_context=spawn) as pool:
            return pool.submit(function, *values).result()

    cameras, box = paper_rig(arguments.pixels)
    measurement = simulate(make_phantom("flame", box, 0), cameras, box, N_AMBIENT, steps=40)
    base = int(alone(run, measurement, 0, "linear", 0, arguments.device, threads))
    lines = [
        f"Command: `python {shlex.join(sys.argv)}`  ",
        f"Machine: {machine()}  ",
        f"Date: {datetime.date.today().isoformat()}; {len(measurement.rays()[0])} rays; base {base / 2**30:.2f} GiB",
        "",
        "| " + " | ".join(COLUMNS) + " |",
        "|" + "---|" * len(COLUMNS),
    ]
    print("\n".join(lines), flush=True)
    for basis in arguments.basis:
        for voxels in arguments.voxels:
            line = alone(run, measurement, voxels, basis, arguments.iterations, arguments.device, threads)
            memory = int(line.split(" | ")[-2])
            line = line.replace(f"| {memory} |", f"| {memory / 2**30:.2f} |")
            line = line.format(above=f"{(memory - base) / 2**30:.2f}")
            lines.append(f"| {voxels}³ | {basis} | {line}")
            print(lines[-1], flush=True)
    if not torch.cuda.is_available():
        for basis in arguments.basis:
            fast, slow = alone(plain, measurement, 64, basis, threads)
            lines += ["", f"64³ {basis}, A and A^T once: compiled {fast:.2f} s, plain PyTorch {slow:.2f} s."]
            print(lines[-1], flush=True)
    if arguments.write:
        arguments.write.parent.mkdir(parents=True, exist_ok=True)
        arguments.write.write_text("# What the voxel operator costs\n\n" + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
