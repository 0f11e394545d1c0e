"""The positions of coefficients: voxels in space, or the (r, h) plane of a symmetric flow."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.fields.symmetric import SymmetricVoxels
from nerif.fields.voxel_field import DEGREES, Boundary, VoxelField, spline_coefficients
from nerif.forward.forward_model import ForwardModel
from nerif.geometry import Box, Grid, Rays
from nerif.geometry.symmetry import Axis, Symmetry
from nerif.reconstruction.gauge import free_voxels
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.symmetric_operator import SymmetricOperator

__all__ = ["InSpace", "Layout", "Symmetric", "layout_of"]

CPU = torch.device("cpu")
MIN_FIRST_VOXELS = 12  # along the longest edge of the first grid
MIN_HALVED_VOXELS = 4  # along an edge that is halved


@dataclass(frozen=True, kw_only=True)
class Layout(ABC):
    """Grids of coefficients, and the fields they define."""

    box: Box  # of the measurement, mm
    faces: tuple[str, ...]  # of it, on which the field is ambient
    basis: str  # of the spline
    step: float | None = None  # of operators: distance of planes in voxels
    device: torch.device = CPU  # of coefficients and operators
    dtype: torch.dtype = torch.float32

    @property
    def degree(self) -> int:
        return DEGREES[self.basis]

    @property
    @abstractmethod
    def boundary(self) -> Boundary: ...

    @abstractmethod
    def grid(self, voxels: int) -> Grid:
        """Return the grid of voxels whose edge is the longest edge of the box over `voxels`."""

    @abstractmethod
    def operator(self, rays: Rays, grid: Grid, model: ForwardModel) -> VoxelOperator: ...

    @abstractmethod
    def field(self, coefficients: Float[Tensor, "z y x"], grid: Grid) -> Field: ...

    @abstractmethod
    def sample(self, field: Field, grid: Grid) -> Float[Tensor, "z y x"]:
        """Return a field at the positions of the coefficients, as a first approximation of them."""

    def coefficients(self, field: Field, grid: Grid) -> Float[Tensor, "z y x"]:
        """Return the coefficients of the splines through the values of a field."""
        return spline_coefficients(self.sample(field, grid), self.degree, self.boundary, self.splined_axes)

    @property
    def splined_axes(self) -> tuple[int, ...]:
        """The axes of the coefficients along which the field is a spline."""
        return (0, 1, 2)

    @abstractmethod
    def free(self, measurement: Measurement, grid: Grid, hull: bool = True) -> Bool[Tensor, "z y x"] | None:
        """Return the coefficients outside the ambient region and, with `hull`, within the hull; None for all."""

    def grids(self, voxels: int, coarse_to_fine: bool) -> list[Grid]:
        """Return grids from coarse to fine, the voxels halved from each to the next, or the last alone."""
        last = self.grid(voxels)
        shape, grids = list(last.shape), [last]
        while coarse_to_fine and max(shape) >= 2 * MIN_FIRST_VOXELS:
            shape = [min(n, max(MIN_HALVED_VOXELS, n // 2)) for n in shape]
            grids.insert(0, Grid(last.box, (shape[0], shape[1], shape[2])))
        return grids


def layout_of(
    measurement: Measurement, axis: Axis | None, basis: str = "cubic", step: float | None = None,
    device: torch.device = CPU, dtype: torch.dtype = torch.float32,
) -> Layout:  # fmt: skip
    """Return the layout for a measurement with its gauge (with_gauge).

    A symmetric field is projected on the CPU; whatever is combined with its coefficients is on the layout's device.
    """
    common: dict[str, Any] = {"box": measurement.box, "faces": measurement.ambient_faces, "basis": basis, "step": step}
    common |= {"dtype": dtype}
    return Symmetric(symmetry=axis.symmetry, **common) if axis else InSpace(device=device, **common)


class InSpace(Layout):
    """Voxels that fill the box."""

    @property
    def boundary(self) -> Boundary:
        return Boundary(self.faces)

    def grid(self, voxels: int) -> Grid:
        layers = (self.degree + 1) // 2  # the least along any edge, even of a slice
        nz, ny, nx = (max(layers, n) for n in Grid.of_resolution(self.box, voxels).shape)
        return Grid(self.box, (nz, ny, nx))

    def operator(self, rays: Rays, grid: Grid, model: ForwardModel) -> VoxelOperator:
        return VoxelOperator(rays, grid, model, self.basis, self.boundary, self.step, self.device, self.dtype)

    def field(self, coefficients: Float[Tensor, "z y x"], grid: Grid) -> Field:
        return VoxelField.of(coefficients, grid, self.degree, self.boundary)

    def sample(self, field: Field, grid: Grid) -> Float[Tensor, "z y x"]:
        return field.sample(grid, self.device)

    def free(self, measurement: Measurement, grid: Grid, hull: bool = True) -> Bool[Tensor, "z y x"] | None:
        return free_voxels(measurement, grid, hull)


@dataclass(frozen=True, kw_only=True)
class Symmetric(Layout):
    """Splines of (r, h), one for each azimuth of the symmetry."""

    symmetry: Symmetry

    @property
    def splined_axes(self) -> tuple[int, ...]:
        return (0, 2)

    @property
    def boundary(self) -> Boundary:
        return Boundary(self.symmetry.faces(self.faces), around=True)

    def grid(self, voxels: int) -> Grid:
        layers, size = (self.degree + 1) // 2, max(self.box.edges) / voxels
        box = self.symmetry.reduced_box(self.box, self.faces)
        if self.symmetry.axial:  # differences between azimuths are taken halfway from the axis
            half = math.pi * box.edges[0] / 2
            box = Box((box.lower[0], -half, box.lower[2]), (box.upper[0], half, box.upper[2]))
        nx, nz = (max(layers, round(edge / size)) for edge in (box.edges[0], box.edges[2]))
        return Grid(box, (nz, self.symmetry.angles, nx))

    def grids(self, voxels: int, coarse_to_fine: bool) -> list[Grid]:
        angles, grids = self.symmetry.angles, super().grids(voxels, coarse_to_fine)
        return [Grid(grid.box, (grid.shape[0], angles, grid.shape[2])) for grid in grids]

    def operator(self, rays: Rays, grid: Grid, model: ForwardModel) -> SymmetricOperator:
        settings = self.basis, self.boundary, self.step, self.dtype
        return SymmetricOperator(self.symmetry, rays, grid, model, *settings)

    def field(self, coefficients: Float[Tensor, "z k x"], grid: Grid) -> Field:
        (nz, angles, nx), layers = grid.shape, (self.degree + 1) // 2
        flat = Grid(grid.box, (nz, layers, nx))
        planes = [coefficients[:, k : k + 1].expand(nz, layers, nx) for k in range(angles)]
        parts = [VoxelField.of(plane, flat, self.degree, self.boundary) for plane in planes]
        return SymmetricVoxels(parts, self.symmetry)

    def sample(self, field: Field, grid: Grid) -> Float[Tensor, "z k x"]:
        angle = 2 * math.pi * torch.arange(self.symmetry.angles, dtype=torch.float64) / self.symmetry.angles
        h, angle, r = torch.meshgrid(grid.axis("z"), angle, grid.axis("x"), indexing="ij")
        points = self.symmetry.places(r, angle, h).float()
        return field.to("cpu")(points.reshape(-1, 3)).detach().reshape(points.shape[:-1])

    def free(self, measurement: Measurement, grid: Grid, hull: bool = True) -> Bool[Tensor, "z k x"] | None:
        """Return the rings most of which is free, and those that the grid in space does not sample; None for all."""
        space = Grid.of_resolution(self.box, round(max(self.box.edges) / min(grid.spacing)))
        free_in_space = free_voxels(measurement, space, hull)
        if free_in_space is None:
            return None
        inside = free_in_space.flatten()
        place = self.symmetry.reduced(space.points(torch.float64).reshape(-1, 3))
        box, (nz, angles, nx) = grid.box, grid.shape
        r = ((place[:, 0] - box.lower[0]) / grid.spacing[0]).floor().long()
        h = ((place[:, 2] - box.lower[2]) / grid.spacing[2]).floor().long().clamp(0, nz - 1)
        on_grid = (r >= 0) & (r < nx)
        cell = (h * nx + r)[on_grid]
        total = torch.bincount(cell, minlength=nz * nx)
        free = (2 * torch.bincount(cell[inside[on_grid]], minlength=nz * nx) > total) | (total == 0)
        return free.reshape(nz, 1, nx).expand(nz, angles, nx).contiguous()
