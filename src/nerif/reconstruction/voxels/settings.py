"""The settings shared by the voxel methods; a method is a generator of iterates (tikhonov.py, landweber.py, ...).

descent.py has the levels from coarse to fine and the loop over iterations.
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
from nerif.reconstruction.voxels.levels import FINE_BIN, bins_of
from nerif.reconstruction.voxels.operator import VoxelOperator, check_step, rays_through
from nerif.reconstruction.voxels.problem import Iterate, Problem

__all__ = ["VoxelReconstructor", "WeightedVoxelReconstructor"]

GRID_ARRAYS = 22  # arrays of the size of the grid that a method holds at once, at most (tests/reconstruction)
DATA_ARRAYS = 8  # of the size of the data
FIRST_RUN, MIN_FIRST_VOXELS = 0.2, 8  # share of the time limit, and voxels, of the first run of two
COMPILER_BYTES = 1 << 28  # of Numba, for any grid (benchmarks/results/voxel-cost-cpu.md)


@dataclass(frozen=True)
class VoxelReconstructor(SharedSettings):
    """Settings of every voxel method."""

    voxels: int = 64
    """Voxels along the longest edge of the box, of the reconstruction and of the written volume."""
    basis: Literal["linear", "cubic"] = "cubic"
    """Interpolation between voxel centres: cubic B-splines, or trilinear (less accurate, hardly faster)."""
    model: str = AUTO
    """Linear forward model; for displacements lever_arm (auto) or paraxial."""
    source: str = "auto"
    """Data to fit (also --from): displacements, images (each pixel, linearised about the displacements), both, or auto:
    displacements if there are any."""
    step: float | None = None
    """Distance between the planes on which rays are sampled, in voxels; at most, and by default, 1 (cubic) or 0.5
    (linear)."""
    coarse_to_fine: bool = True
    """Start on a coarse grid and halve the voxels from solution to solution."""
    tolerance: float = 1e-4
    """Converged when the objective falls by less than this fraction per iteration, averaged over a few."""
    hull: bool = True
    """Fix voxels outside the visual hull at the ambient index, if the measurement has flow masks."""
    precision: Literal["float32", "float64"] = "float32"
    """Floating-point precision of voxels and data."""
    iterations: int = 50
    """Maximum iterations on each grid and with each weight."""

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
        voxels = max(min(MIN_FIRST_VOXELS, self.voxels), self.voxels // 2)
        return replace(self, voxels=voxels, time_limit=FIRST_RUN * self.time_limit), self

    @property
    def weight(self) -> float | None:
        """Weight of the penalty, or None if it is chosen automatically."""
        return 0.0

    @property
    def patience(self) -> int:
        """Iterations over which the decrease of the objective is averaged."""
        return 3

    @abstractmethod
    def iterate(self, problem: Problem, x: Tensor, weight: float) -> Iterator[Iterate]:
        """Yield iterates, starting from x, without end."""

    def begin(self, problem: Problem, x: Tensor) -> Tensor:
        """Return the start of the iterations: x within the bounds."""
        return problem.clip(x)

    @property
    def itemsize(self) -> int:
        """Bytes of a number."""
        return 4 if self.precision == "float32" else 8

    def operator_bytes(self, measurement: Measurement, grid: Grid) -> int:
        """Return the memory of the operators of all techniques."""
        dtype, each = getattr(torch, self.precision), _lens_rays(measurement, grid)
        return sum(
            VoxelOperator.memory_bytes(each * rays, grid, self.basis, dtype, channels, self.step)
            for rays, channels in _counts(measurement, grid)
        )

    def memory_bytes(self, measurement: Measurement, grid: Grid, device: str = "cpu") -> int:
        """Return the memory that a run needs at most, beyond that of the process."""
        counts = _counts(measurement, grid)
        rays, values = sum(n for n, _ in counts), sum(n * channels for n, channels in counts)
        arrays = (GRID_ARRAYS * math.prod(grid.shape) + DATA_ARRAYS * values) * self.itemsize
        preparing = 40 * 8 * rays * _lens_rays(measurement, grid)  # rays in double precision, for the operator
        kernels = kernels_torch.CHUNK_BYTES if device == "cuda" else COMPILER_BYTES
        return self.operator_bytes(measurement, grid) + arrays + preparing + kernels

    def __call__(
        self, measurement: Measurement, on_step: OnStep | None = None, resume: State | None = None,
        start: Field | None = None,
    ) -> Reconstruction:  # fmt: skip
        return Descent(self, measurement, on_step, resume, start)()


@dataclass(frozen=True)
class WeightedVoxelReconstructor(VoxelReconstructor):
    """Settings of the methods with a penalty."""

    regularisation: Literal["auto"] | float = "auto"
    """Weight of the penalty, or auto: discrepancy principle if sigma is known, else L-curve."""

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


def _counts(measurement: Measurement, grid: Grid) -> list[tuple[int, int]]:
    """Rays (of bins) and channels of each technique."""
    pixels, counts = bins_of(measurement, grid, FINE_BIN) ** 2, []
    for o in measurement.observations:
        count = int(measurement.usable_for(o).sum()) // (pixels if o.technique.averaged else 1)
        counts.append((count + 1, len(o.technique.channels)))
    return counts


def _lens_rays(measurement: Measurement, grid: Grid) -> int:
    """The largest number of rays per pixel, from a sample of pixels of each image."""
    largest = 1
    for camera in measurement.cameras:
        lines = [torch.linspace(0, n - 1, min(n, 9), dtype=camera.intrinsics.dtype) for n in camera.image_size[::-1]]
        rays = camera.rays(torch.cartesian_prod(*lines).reshape(-1, 2)).clip(measurement.box)
        largest = max(largest, rays_through(rays, min(grid.spacing)))
    return largest
