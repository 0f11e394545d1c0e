"""What the classical methods cost: seconds and memory of 50 iterations on grids of 40 to 160 voxels an edge.

    python benchmarks/voxel_cost.py --write benchmarks/results/voxel-cost-cpu.md

Flame on the paper's rig, Tikhonov with a fixed weight, no coarse grids. Every row is a process of its own, so that the
memory is that row's; the base is a process that has read the data and done nothing. "plain" is the same operator in
PyTorch (kernels_torch.py), what CUDA runs, timed here on one iteration.
"""

from __future__ import annotations

import argparse
import time
from typing import Literal

import torch

from bench import N_AMBIENT, Table, add_write, alone
from nerif.data.measurement import Measurement
from nerif.fields.phantoms import make_phantom
from nerif.forward.deflection import LeverArm
from nerif.geometry import Grid, paper_rig
from nerif.reconstruction.device import keep_freed_memory, peak_memory, resolve_device
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.simulation.simulate import simulate

COLUMNS = (
    "grid", "basis", "samples [million]", "iterations", "seconds", "ns a sample and iteration", "of it operator",
    "memory above base [GiB]", "memory [GiB]", "estimate [GiB]",
)  # fmt: skip

Basis = Literal["linear", "cubic"]


def memory_of_data(measurement: Measurement, device: str) -> int:
    """Peak memory (bytes) of a process that has the rays and does nothing with them."""
    keep_freed_memory()
    measurement.rays()
    return peak_memory(resolve_device(device))


def run(
    measurement: Measurement, voxels: int, basis: Basis, iterations: int, device: str, threads: int, base: int
) -> list[str]:
    """Measure one grid and return the row without grid and basis."""
    torch.set_num_threads(threads)
    keep_freed_memory()
    where = resolve_device(device)
    rays, displacement, _ = measurement.rays()
    settings = Tikhonov(
        voxels=voxels, basis=basis, iterations=iterations, tolerance=0, regularisation=1e-3,
        coarse_to_fine=False, device=device,
    )  # fmt: skip
    settings_once = Tikhonov(voxels=12, basis=basis, iterations=1, regularisation=1e-3, device=device)
    settings_once(measurement)  # what is compiled once is not counted
    result = settings(measurement)
    memory = peak_memory(where)
    grid = Grid.of_resolution(measurement.box, voxels)
    operator = VoxelOperator(rays, grid, LeverArm(N_AMBIENT), basis, device=where)
    x, y = torch.rand(grid.shape, device=where), displacement.to(where)
    times = []
    for _ in range(3):
        start = time.perf_counter()
        operator(x)
        float(operator.T(y).sum())
        times.append(time.perf_counter() - start)
    samples = operator.samples
    estimate = settings.memory_bytes(measurement, grid) / 2**30
    cells = [f"{samples / 1e6:.1f}", str(iterations), f"{result.seconds:.1f}"]
    cells += [f"{result.seconds / iterations / samples * 1e9:.1f}", f"{min(times) * iterations / result.seconds:.0%}"]
    return [*cells, f"{(memory - base) / 2**30:.2f}", f"{memory / 2**30:.2f}", f"{estimate:.2f}"]


def plain(measurement: Measurement, voxels: int, basis: Basis, threads: int) -> tuple[float, float]:
    """Seconds of one application and its adjoint by the compiled and the plain kernels on the CPU."""
    torch.set_num_threads(threads)
    keep_freed_memory()
    rays, _, _ = measurement.rays()
    grid = Grid.of_resolution(measurement.box, voxels)
    operator = VoxelOperator(rays, grid, LeverArm(N_AMBIENT), basis)
    x = torch.rand(grid.shape)
    operator.T(operator(x))
    start = time.perf_counter()
    operator.T(operator(x))
    fast = time.perf_counter() - start
    start = time.perf_counter()
    operator.compiled = False
    operator.T(operator(x))
    return fast, time.perf_counter() - start


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--voxels", type=int, nargs="+", default=[40, 64, 100, 160])
    parser.add_argument("--basis", nargs="+", default=["linear", "cubic"])
    parser.add_argument("--iterations", type=int, default=50)
    parser.add_argument("--pixels", type=int, default=200)
    parser.add_argument("--device", default="auto")
    add_write(parser)
    arguments = parser.parse_args()

    threads = torch.get_num_threads()
    cameras, box = paper_rig(arguments.pixels)
    measurement = simulate(make_phantom("flame", box, 0), cameras, box, N_AMBIENT, steps=40)
    base = alone(memory_of_data, measurement, arguments.device)
    table = Table(
        "What the voxel operator costs",
        COLUMNS,
        arguments.write,
        f"; {len(measurement.rays()[0])} rays; base {base / 2**30:.2f} GiB",
    )
    for basis in arguments.basis:
        for voxels in arguments.voxels:
            values = (measurement, voxels, basis, arguments.iterations, arguments.device, threads)
            table.row([f"{voxels}³", basis, *alone(run, *values, base)])
    if not torch.cuda.is_available():
        for basis in arguments.basis:
            fast, slow = alone(plain, measurement, 64, basis, threads)
            table.text("", f"64³ {basis}, A and A^T once: compiled {fast:.2f} s, plain PyTorch {slow:.2f} s.")


if __name__ == "__main__":
    main()
