"""Settings of the voxel methods; each method is a generator of iterates (tikhonov.py, landweber.py, ...)."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

from nerif.common.settings import Count, NonNegative
from nerif.forward.model_names import AUTO, MODEL_NAMES
from nerif.reconstruction.shared_settings import SHORT_RUN, SharedSettings, Source
from nerif.reconstruction.voxels.plane_spacing import check_step

if TYPE_CHECKING:
    from torch import Tensor

    from nerif.data.measurement import Measurement
    from nerif.geometry import Grid
    from nerif.reconstruction.voxels.voxel_problem import Iterate, Problem

__all__ = ["VoxelSettings"]

VOLUME_ARRAYS = 22  # arrays of the size of the grid held by the most demanding method (tests/reconstruction)
DATA_ARRAYS = 8  # arrays of the size of the data
COMPILER_BYTES = 1 << 28  # of Numba, for any grid (benchmarks/results/voxel-cost-cpu.md)
RAY_SECONDS = 2.5e-8  # of an iteration on one core, per ray and voxel along the longest edge (same table)
MIN_VOXELS = 8  # along the longest edge in the cross-validation run


@dataclass(frozen=True)
class VoxelSettings(SharedSettings):
    """Settings of every voxel method."""

    coarse: ClassVar[float] = 100
    """Times the tolerance, for solutions that are only a start."""
    voxels: Count = 64
    """Voxels along the longest edge of the box, in the reconstruction, where they are not smaller than 0.7 of a pixel,
    and in the written volume."""
    basis: Literal["linear", "cubic"] = "cubic"
    """Interpolation between voxel centres: cubic B-splines, or trilinear (less accurate, slightly faster)."""
    model: Literal[*MODEL_NAMES] = AUTO  # type: ignore[valid-type]
    """Linear forward model of displacements: lever_arm (auto) or paraxial."""
    source: Source = "auto"
    """Data to fit: displacements, images (pixel by pixel, linearised about the displacements), both, or
    auto (displacements where available)."""
    step: float | None = None
    """Largest distance between sampling planes along a ray, in voxels (default: 1 for cubic, 0.5 for linear)."""
    coarse_to_fine: bool = True
    """Start on a coarse grid and halve the voxel size from solution to solution."""
    tolerance: NonNegative = 1e-4
    """Convergence criterion: relative decrease of the objective per iteration, averaged over several."""
    hull: bool = True
    """Fix voxels outside the visual hull of the flow masks at the ambient index."""
    precision: Literal["float32", "float64"] = "float32"
    """Floating-point precision of voxels and data."""
    iterations: Count = 50
    """Maximum number of iterations per grid and regularisation weight."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.step is not None:
            check_step(self.step, self.basis)

    def split_for_cross_validation(self) -> tuple[VoxelSettings, VoxelSettings]:
        voxels = max(min(MIN_VOXELS, self.voxels), self.voxels // 2)
        return replace(self, voxels=voxels, time_limit=SHORT_RUN * self.time_limit), self

    def resolved(self, measurement: Measurement) -> tuple[VoxelSettings, str]:
        from nerif.reconstruction.voxels.levels import SMALLEST, resolved_voxels

        most = resolved_voxels(measurement)
        overlap = all(camera.lens is not None and camera.lens.window >= 1 for camera in measurement.cameras)
        if self.voxels <= most or overlap:
            return self, ""
        return replace(self, voxels=most), (
            f"solved on {most} voxels along the longest edge instead of {self.voxels}: voxels below {SMALLEST:g} of a "
            "pixel would have steps between the lines of sight (docs/pixels.md)"
        )

    @property
    def weight(self) -> float | None:
        """Regularisation weight; None: to be determined."""
        return 0.0

    @property
    def patience(self) -> int:
        """Iterations over which the decrease of the objective is averaged."""
        return 3

    @abstractmethod
    def iterate(self, problem: Problem, x: Tensor, weight: float) -> Iterator[Iterate]:
        """Yield iterates from x on, without end."""

    def begin(self, problem: Problem, x: Tensor) -> Tensor:
        """Return the first iterate of an initial field: the field clipped to its bounds."""
        return problem.clip(x)

    @property
    def itemsize(self) -> int:
        """Bytes of a number."""
        return 4 if self.precision == "float32" else 8

    def operator_bytes(self, measurement: Measurement, grid: Grid) -> int:
        """Return the memory of the operators of all techniques."""
        from nerif.reconstruction.voxels.operator import operator_bytes

        return operator_bytes(measurement, grid, self.basis, self.precision, self.step)

    def memory_bytes(self, measurement: Measurement, grid: Grid, device: str = "cpu") -> int:
        """Return the peak memory of a run, in addition to that of the process."""
        from nerif.reconstruction.voxels import kernels_torch
        from nerif.reconstruction.voxels.operator import lens_rays, ray_counts

        counts = ray_counts(measurement, grid)
        rays, numbers = sum(n for n, _ in counts), sum(n * channels for n, channels in counts)
        volumes, data = VOLUME_ARRAYS * math.prod(grid.shape) * self.itemsize, DATA_ARRAYS * numbers * self.itemsize
        per_pixel = lens_rays(measurement, grid)
        preparing = 40 * 8 * rays * per_pixel  # rays in double precision, while the operator is set up
        overhead = kernels_torch.CHUNK_BYTES if device != "cpu" else COMPILER_BYTES
        return self.operator_bytes(measurement, grid) + volumes + data + preparing + overhead

    def iteration_seconds(self, measurement: Measurement, grid: Grid, cores: int) -> float:
        """Return about the time of an iteration on cores of a usual CPU, s."""
        from nerif.reconstruction.voxels.operator import lens_rays, ray_counts

        rays = sum(count for count, _ in ray_counts(measurement, grid)) * lens_rays(measurement, grid)
        return RAY_SECONDS * rays * max(grid.shape) / cores
