"""Cost of the voxel operator.

Seconds and memory of 50 iterations of Tikhonov with a fixed weight, no coarse grids, flame on the paper's rig, 40 to
160 voxels along an edge. The base is the memory of a process that has only read the rays. At 64 voxels A and A^T are
also timed once with the plain PyTorch kernels (kernels_torch.py) that CUDA runs.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import torch

from benchmarks.methods import clean
from benchmarks.runner import N_AMBIENT, Settings
from nerif.forward.deflection import LeverArm
from nerif.geometry import Grid
from nerif.reconstruction.device import peak_memory, resolve_device
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.tikhonov import Tikhonov

COLUMNS = {
    "grid": "{voxels}³", "basis": "{basis}", "samples [million]": "{samples:.1f}", "iterations": "{iterations}",
    "seconds": "{seconds:.1f}", "ns per sample and iteration": "{ns:.1f}", "of it operator": "{operator:.0%}",
    "memory above base [GiB]": "{above_base:.2f}", "memory [GiB]": "{memory:.2f}", "estimate [GiB]": "{estimate:.2f}",
    "A, A^T compiled [s]": "{compiled:.2f}", "plain [s]": "{plain:.2f}",
}  # fmt: skip
PLAIN = 64  # voxels of the comparison with the plain kernels


def cases(quick: bool) -> Iterator[Settings]:
    for basis in ("linear",) if quick else ("linear", "cubic"):
        for voxels in (8, 16) if quick else (40, 64, 100, 160):
            pixels, iterations = (16, 2) if quick else (200, 50)
            yield {
                "voxels": voxels, "basis": basis, "iterations": iterations, "pixels": pixels, "device": "auto",
            }  # fmt: skip


def measure(
    folder: Path, voxels: int, basis: Literal["linear", "cubic"], iterations: int, pixels: int, device: str
) -> dict[str, Any]:
    where, measurement = resolve_device(device), clean(folder, "flame", pixels)
    rays, displacement, _ = measurement.rays()
    base = peak_memory(where)
    settings = Tikhonov(
        voxels=voxels, basis=basis, iterations=iterations, tolerance=0, regularisation=1e-3, coarse_to_fine=False,
        device=device,
    )  # fmt: skip
    Tikhonov(voxels=12, basis=basis, iterations=1, regularisation=1e-3, device=device)(measurement)  # compiles
    result = settings(measurement)
    memory, grid = peak_memory(where), Grid.of_resolution(measurement.box, voxels)
    operator = VoxelOperator(rays, grid, LeverArm(N_AMBIENT), basis, device=where)
    x, y = torch.rand(grid.shape, device=where), displacement.to(where)

    def seconds(data: torch.Tensor | None = None) -> float:
        start = time.perf_counter()
        projection = operator(x)
        float(operator.T(projection if data is None else data).sum())
        return time.perf_counter() - start

    once = min(seconds(y) for _ in range(3))
    metrics = {
        "samples": operator.samples / 1e6,
        "seconds": result.seconds,
        "ns": result.seconds / iterations / operator.samples * 1e9,
        "operator": once * iterations / result.seconds,
        "above_base": (memory - base) / 2**30,
        "memory": memory / 2**30,
        "estimate": settings.memory_bytes(measurement, grid) / 2**30,
    }
    if voxels == PLAIN and where.type == "cpu":
        metrics["compiled"] = seconds()
        operator.compiled = False
        metrics["plain"] = seconds()
    return metrics
