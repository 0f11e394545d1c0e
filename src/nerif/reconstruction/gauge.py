"""The gauge: regions where the field is ambient, 0, which fix the constant that displacements leave undetermined.

By default the side faces of the box and, with flow masks, the space outside the visual hull; never within a body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.geometry import Box, Grid
from nerif.geometry.body import Body, contained

__all__ = ["AmbientRegion", "ambient_faces", "check_gauge", "is_open", "visual_hull"]

FEW = 1024  # points that show whether a region has any outside bodies


def is_open(measurement: Measurement) -> bool:
    """Return whether the data leave a constant of the field undetermined."""
    return all(kind.gauge for kind in measurement.techniques)


def ambient_faces(measurement: Measurement, faces: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Return the ambient faces: those of the settings, else those of the measurement if a technique needs a gauge."""
    return faces or (measurement.ambient_faces if any(kind.gauge for kind in measurement.techniques) else ())


def check_gauge(measurement: Measurement, faces: tuple[str, ...], hull: bool = True) -> None:
    """Raise InputError if a constant of the field is undetermined and no region is ambient."""
    if is_open(measurement) and not faces and not (hull and measurement.flow_mask is not None):
        raise InputError(
            "expected at least one face (x- x+ y- y+ z- z+) or flow masks, got none; displacements "
            "determine the index only up to a constant",
            field="ambient_faces",
        )


def visual_hull(measurement: Measurement, grid: Grid) -> Bool[Tensor, "z y x"]:
    """Return the voxels whose centres lie inside the flow mask of every view that has them in its image.

    A pixel that sees a body says nothing about the flow behind it.
    """
    if measurement.flow_mask is None:
        raise InputError("expected masks in the measurement for the visual hull, got none", field="flow_mask")
    inside = _in_hull(measurement, _flow(measurement), grid)
    if not bool(inside.any()):
        raise InputError(
            "the masks leave no voxel of the box; are they inverted, or of other views?", field="flow_mask"
        )
    return inside


def _flow(measurement: Measurement) -> Bool[Tensor, "view row column"]:
    """The pixels that may show flow: the masks, and pixels that see a body."""
    masks, hidden = measurement.flow_mask, measurement.hidden
    assert masks is not None
    return masks if hidden is None else masks | hidden


def _in_hull(measurement: Measurement, masks: Tensor, grid: Grid) -> Bool[Tensor, "z y x"]:
    """The points of a grid inside the masks of all views that have them in their image."""
    points = grid.points(torch.float64).reshape(-1, 3)
    inside = torch.ones(len(points), dtype=torch.bool)
    for camera, mask in zip(measurement.cameras, masks, strict=True):
        column, row = camera.project(points).round().long().unbind(-1)
        height, width = camera.image_size
        in_image = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        inside &= ~in_image | mask[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    return inside.reshape(grid.shape)


def _outside(measurement: Measurement, masks: Tensor, grid: Grid) -> Bool[Tensor, "z y x"]:
    """The voxels of a grid that are outside the hull with their centres and all corners."""
    (x0, y0, z0), (x1, y1, z1), (hx, hy, hz) = grid.box.lower, grid.box.upper, (edge / 2 for edge in grid.spacing)
    # a grid whose voxel centres are the corners of the voxels
    larger = Box((x0 - hx, y0 - hy, z0 - hz), (x1 + hx, y1 + hy, z1 + hz))
    nz, ny, nx = grid.shape
    corners = _in_hull(measurement, masks, Grid(larger, (nz + 1, ny + 1, nx + 1)))
    near = torch.nn.functional.max_pool3d(corners[None, None].float(), 2, 1)[0, 0] > 0
    return ~(near | visual_hull(measurement, grid))


@dataclass(frozen=True)
class AmbientRegion:
    """Faces of the box, and voxels outside the visual hull, where the index excess is 0."""

    box: Box
    faces: tuple[str, ...]
    empty: Float[Tensor, "m 3"]  # centres of voxels that are outside the hull with all their corners, mm
    voxel: tuple[float, float, float]  # their edges, mm
    bodies: Sequence[Body] = ()

    @classmethod
    def of(cls, measurement: Measurement, faces: tuple[str, ...], resolution: int = 48) -> AmbientRegion | None:
        """Return the ambient region of a measurement, with the faces of the settings or its own; None if not needed."""
        faces = ambient_faces(measurement, faces)
        grid = Grid.of_resolution(measurement.box, resolution)
        empty = torch.zeros(0, 3)
        if measurement.flow_mask is not None:
            empty = grid.points()[_outside(measurement, _flow(measurement), grid)]
        check_gauge(measurement, faces, bool(len(empty)))
        if not faces and not len(empty):
            return None
        region = cls(measurement.box, faces, empty, grid.spacing, measurement.bodies)
        if not len(region.sample(FEW, torch.Generator().manual_seed(0))):
            raise InputError("expected a region outside the bodies, got none; name other faces", field="ambient_faces")
        return region

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
        """Draw about `count` random points (mm) outside bodies, half of them outside the hull if there is one."""
        points = []
        share = count // 2 if len(self.empty) and self.faces else count
        if self.faces:
            corner, edges = self._face_frames
            unit = torch.rand(len(self.faces), -(-share // len(self.faces)), 2, generator=generator)
            points.append((corner + unit @ edges).reshape(-1, 3))
        if len(self.empty):
            index = torch.randint(len(self.empty), (share,), generator=generator)
            shift = (torch.rand(share, 3, generator=generator) - 0.5) * torch.tensor(self.voxel)
            points.append(self.empty[index] + shift)
        sample = torch.cat(points)
        return sample[~contained(self.bodies, sample)] if self.bodies else sample

    @cached_property
    def _face_frames(self) -> tuple[Float[Tensor, "face 1 3"], Float[Tensor, "face 2 3"]]:
        """A corner of each face, and the two edges from it, mm."""
        unit = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        points = torch.stack([self.box.face_points(face, unit) for face in self.faces])
        return points[:, :1], points[:, 1:] - points[:, :1]
