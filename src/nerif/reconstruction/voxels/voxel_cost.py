"""Rays and memory of a voxel method, before it runs."""

from __future__ import annotations

import torch

from nerif.data.measurement import Measurement
from nerif.geometry import Grid
from nerif.reconstruction.voxels.levels import FINE_BIN, bins_of
from nerif.reconstruction.voxels.operator import VoxelOperator, rays_through

__all__ = ["lens_rays", "operator_bytes", "ray_counts"]


def operator_bytes(measurement: Measurement, grid: Grid, basis: str, precision: str, step: float | None) -> int:
    """Return the memory of the operators of all techniques."""
    dtype, per_pixel = getattr(torch, precision), lens_rays(measurement, grid)
    return sum(
        VoxelOperator.memory_bytes(per_pixel * rays, grid, basis, dtype, channels, step)
        for rays, channels in ray_counts(measurement, grid)
    )


def ray_counts(measurement: Measurement, grid: Grid) -> list[tuple[int, int]]:
    """Return the numbers of rays, of bins where pixels are averaged, and of channels of each technique."""
    pixels, counts = bins_of(measurement, grid, FINE_BIN) ** 2, []
    for o in measurement.observations:
        rays = int(measurement.usable_for(o).sum()) // (1 if o.technique.derived else pixels)
        counts.append((rays + 1, len(o.technique.channels)))
    return counts


def lens_rays(measurement: Measurement, grid: Grid) -> int:
    """Return the largest number of rays per pixel, from a lattice of pixels of each image."""
    most = 1
    for camera in measurement.cameras:
        lattice = [torch.linspace(0, n - 1, min(n, 9), dtype=camera.intrinsics.dtype) for n in camera.image_size[::-1]]
        rays = camera.rays(torch.cartesian_prod(*lattice).reshape(-1, 2)).clip(measurement.box)
        most = max(most, rays_through(rays, min(grid.spacing)))
    return most
