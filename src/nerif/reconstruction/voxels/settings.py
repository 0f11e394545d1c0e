"""The settings that the classical methods share; a method is a generator of iterates (tikhonov.py, landweber.py, ...).

The way from coarse to fine, and the loop that watches over the iterations, are in descent.py.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.fields.base import Field
from nerif.fields.grid import DEGREES
from nerif.forward.registry import AUTO, check_model
from nerif.geometry import Grid
from nerif.reconstruction.base import OnStep, Reconstruction, State
from nerif.reconstruction.shared_settings import SharedSettings
from nerif.reconstruction.sources import check_source
from nerif.reconstruction.voxels import kernels_torch
from nerif.reconstruction.voxels.descent import Descent
from nerif.reconstruction.voxels.levels import bins_at_last
from nerif.reconstruction.voxels.operator import VoxelOperator, check_step, rays_through
from nerif.reconstruction.voxels.problem import Iterate, Problem

__all__ = ["VoxelReconstructor", "WeightedVoxelReconstructor"]

VOLUMES = 22  # arrays the size of the grid that the hungriest method holds at once (tests/reconstruction)
FIRST, COARSEST = 0.2, 8  # of a first run of two: the share of the time limit, and the fewest voxels
DATA = 8  # arrays the size of the data
COMPILER_BYTES = 1 << 28  # of Numba, whatever the grid (benchmarks/results/voxel-cost-cpu.md)


@dataclass(frozen=True)
class VoxelReconstructor(SharedSettings):
    """Settings of every classical method."""

    voxels: int = 64
    """Voxels along the longest edge of the box, of the reconstruction and of the written volume."""
    basis: Literal["linear", "cubic"] = "cubic"
    """Between voxel centres: cubic B-splines, or trilinear (less accurate, little faster)."""
    model: str = AUTO
    """Forward model, a linear one: of displacements lever_arm (auto) or paraxial."""
    source: str = "auto"
    """What to go by (also --from): displacements, images (each pixel, linear around the displacements), both, or
    auto: displacements where there are some."""
    step: float | None = None
    """Longest distance between the planes on which rays are sampled, in voxels: at most, and by default, 1 (cubic) or
    0.5 (linear)."""
    coarse_to_fine: bool = True
    """Start on a coarse grid and halve the voxels from solution to solution."""
    tolerance: float = 1e-4
    """Converged when the objective falls by less than this share an iteration, on the mean of a few."""
    hull: bool = True
    """Pin voxels outside the visual hull to the ambient index, where the measurement has flow masks."""
    precision: Literal["float32", "float64"] = "float32"
    """Of voxels and data."""
    iterations: int = 50
    """Most iterations on each grid and with each weight."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, allowed in (("basis", tuple(DEGREES)), ("precision", ("float32", "float64"))):
            if getattr(self, name) not in allowed:
                raise InputError(f"expected one of {', '.join(allowed)}, got '{getattr(self, name)}'", field=name)
        for name in ("voxels", "iterations"):
            if getattr(self, name) < 1:
                raise InputError(f"expected at least 1, got {getattr(self, name)}", field=name)
        if self.step is not None:
            check_step(self.step, self.basis)
        if not self.tolerance >= 0:
            raise InputError(f"expected 0 or more, got {self.tolerance}", field="tolerance")
        check_model(self.model)
        check_source(self.source)

    def in_two(self) -> tuple[VoxelReconstructor, VoxelReconstructor]:
        voxels = max(min(COARSEST, self.voxels), self.voxels // 2)
        return replace(self, voxels=voxels, time_limit=FIRST * self.time_limit), self

    @property
    def weight(self) -> float | None:
        """Weight of the penalty, or None where it is to be chosen."""
        return 0.0

    @property
    def patience(self) -> int:
        """Iterations over which the fall of the objective is averaged."""
        return 3

    @abstractmethod
    def iterate(self, problem: Problem, x: Tensor, weight: float) -> Iterator[Iterate]:
        """Yield one iterate after another, from x, without end."""

    def begin(self, problem: Problem, x: Tensor) -> Tensor:
        """Return what to iterate from, given a field to start from: that field within the bounds."""
        return problem.clip(x)

    @property
    def itemsize(self) -> int:
        """Bytes of a number."""
        return 4 if self.precision == "float32" else 8

    def operator_bytes(self, measurement: Measurement, grid: Grid) -> int:
        """Return what the operators of all techniques hold."""
        dtype, each = getattr(torch, self.precision), _lens_rays(measurement, grid)
        return sum(
            VoxelOperator.memory_bytes(each * rays, grid, self.basis, dtype, channels, self.step)
            for rays, channels in _seen(measurement, grid)
        )

    def memory_bytes(self, measurement: Measurement, grid: Grid, device: str = "cpu") -> int:
        """Return what a run will need at most, beside what the process holds already."""
        seen = _seen(measurement, grid)
        rays, numbers = sum(n for n, _ in seen), sum(n * channels for n, channels in seen)
        volumes, data = VOLUMES * math.prod(grid.shape) * self.itemsize, DATA * numbers * self.itemsize
        each = _lens_rays(measurement, grid)
        preparing = 40 * 8 * rays * each  # rays in double precision, while the operator is made
        around = kernels_torch.CHUNK_BYTES if device == "cuda" else COMPILER_BYTES
        return self.operator_bytes(measurement, grid) + volumes + data + preparing + around

    def __call__(
        self,
        measurement: Measurement,
        on_step: OnStep | None = None,
        resume: State | None = None,
        start: Field | None = None,
    ) -> Reconstruction:
        return Descent(self, measurement, on_step, resume, start)()


@dataclass(frozen=True)
class WeightedVoxelReconstructor(VoxelReconstructor):
    """Settings of a method with a penalty."""

    regularisation: Literal["auto"] | float = "auto"
    """Weight of the penalty, or auto: by the discrepancy principle where sigma is known, else by the L-curve."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.regularisation != "auto" and not (
            isinstance(self.regularisation, int | float) and 0 <= self.regularisation < math.inf
        ):
            raise InputError(
                f"expected auto or a weight of 0 or more, got {self.regularisation}", field="regularisation"
            )

    @property
    def weight(self) -> float | None:
        return None if self.regularisation == "auto" else float(self.regularisation)


def _seen(measurement: Measurement, grid: Grid) -> list[tuple[int, int]]:
    """Rays, those of bins, and channels of each technique."""
    pixels, seen = bins_at_last(measurement, grid) ** 2, []
    for o in measurement.observations:
        count = int(measurement.usable_for(o).sum()) // (pixels if o.technique.averaged else 1)
        seen.append((count + 1, len(o.technique.channels)))
    return seen


def _lens_rays(measurement: Measurement, grid: Grid) -> int:
    """The most rays that a pixel has, as some pixels of each image tell."""
    most = 1
    for camera in measurement.cameras:
        some = [torch.linspace(0, n - 1, min(n, 9), dtype=camera.intrinsics.dtype) for n in camera.image_size[::-1]]
        rays = camera.rays(torch.cartesian_prod(*some).reshape(-1, 2)).clip(measurement.box)
        most = max(most, rays_through(rays, min(grid.spacing)))
    return most
