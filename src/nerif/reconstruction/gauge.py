"""The gauge: where the field is known to be ambient, 0. Displacements fix n only up to a constant.

By default the side faces of the box; where flow masks are given, all that lies outside the visual hull as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.geometry import Box, Grid

__all__ = ["AmbientRegion", "ambient_faces", "check_gauge", "is_open", "visual_hull"]


def is_open(measurement: Measurement) -> bool:
    """Return whether what was measured leaves a constant of the field open."""
    return all(kind.gauge for kind in measurement.techniques)


def ambient_faces(measurement: Measurement, asked: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Return the faces on which the field is ambient: those asked for, else those of the file, if any is needed."""
    needed = any(kind.gauge for kind in measurement.techniques)
    return asked or (measurement.ambient_faces if needed else ())


def check_gauge(measurement: Measurement, faces: tuple[str, ...], hull: bool = True) -> None:
    """Refuse a reconstruction that leaves a constant open, and of which nothing is known to be ambient."""
    if is_open(measurement) and not faces and not (hull and measurement.flow_mask is not None):
        raise InputError(
            "expected at least one face (x- x+ y- y+ z- z+) or flow masks, got none; displacements "
            "fix the index only up to a constant",
            field="ambient_faces",
        )


def visual_hull(measurement: Measurement, grid: Grid) -> Bool[Tensor, "z y x"]:
    """Return the voxels that every view which sees them sees inside its flow mask.

    Raises
    ------
    InputError
        If the measurement has no flow mask, or no voxel is left.
    """
    if measurement.flow_mask is None:
        raise InputError("expected masks in the measurement to carve the visual hull, got none", field="flow_mask")
    inside = _in_hull(measurement, measurement.flow_mask, grid)
    if not bool(inside.any()):
        raise InputError(
            "the masks leave no voxel of the box; are they inverted, or of other views?", field="flow_mask"
        )
    return inside


def _in_hull(
    measurement: Measurement, masks: Bool[Tensor, "view row column"], grid: Grid
) -> Bool[Tensor, "z y x"]:  # fmt: skip
    """Which points of a grid all views that see them see inside their masks."""
    points = grid.points(torch.float64).reshape(-1, 3)
    inside = torch.ones(len(points), dtype=torch.bool)
    for camera, mask in zip(measurement.cameras, masks, strict=True):
        column, row = camera.project(points).round().long().unbind(-1)
        height, width = camera.image_size
        seen = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        inside &= ~seen | mask[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    return inside.reshape(grid.shape)


def _outside(measurement: Measurement, masks: Bool[Tensor, "view row column"], grid: Grid) -> Bool[Tensor, "z y x"]:
    """Which voxels of a grid are outside the hull as a whole: their centres and their corners."""
    (x0, y0, z0), (x1, y1, z1), (hx, hy, hz) = grid.box.lower, grid.box.upper, (edge / 2 for edge in grid.spacing)
    around = Box((x0 - hx, y0 - hy, z0 - hz), (x1 + hx, y1 + hy, z1 + hz))  # voxels about the corners of those of grid
    nz, ny, nx = grid.shape
    corners = _in_hull(measurement, masks, Grid(around, (nz + 1, ny + 1, nx + 1)))
    near = torch.nn.functional.max_pool3d(corners[None, None].float(), 2, 1)[0, 0] > 0
    return ~(near | visual_hull(measurement, grid))


@dataclass(frozen=True)
class AmbientRegion:
    """Faces of the box, and voxels outside the visual hull, in which the index excess is 0.

    Parameters
    ----------
    box : Box, mm
    faces : names such as "x-"
    empty : (m, 3) centres of voxels that are outside the hull with all their corners, mm; may be of length 0
    voxel : edges of those voxels, mm
    """

    box: Box
    faces: tuple[str, ...]
    empty: Float[Tensor, "m 3"]
    voxel: tuple[float, float, float]

    @classmethod
    def of(cls, measurement: Measurement, asked: tuple[str, ...], resolution: int = 48) -> AmbientRegion | None:
        """Find the ambient region of a measurement, with the faces asked for or its own.

        None where nothing is known to be ambient and nothing has to be; an error where something has.
        """
        faces = ambient_faces(measurement, asked)
        grid = Grid.of_resolution(measurement.box, resolution)
        empty = torch.zeros(0, 3)
        if measurement.flow_mask is not None:
            empty = grid.points()[_outside(measurement, measurement.flow_mask, grid)]
        check_gauge(measurement, faces, bool(len(empty)))
        if not faces and not len(empty):
            return None
        return cls(measurement.box, faces, empty, grid.spacing)

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
        """Draw about `count` random points, half of them outside the hull where there is one, mm."""
        points = []
        share = count // 2 if len(self.empty) and self.faces else count
        if self.faces:
            corner, edges = self._face_frames
            unit = torch.rand(len(self.faces), -(-share // len(self.faces)), 2, generator=generator)
            points.append((corner + unit @ edges).reshape(-1, 3))
        if len(self.empty):
            chosen = torch.randint(len(self.empty), (share,), generator=generator)
            shift = (torch.rand(share, 3, generator=generator) - 0.5) * torch.tensor(self.voxel)
            points.append(self.empty[chosen] + shift)
        return torch.cat(points)

    @cached_property
    def _face_frames(self) -> tuple[Float[Tensor, "face 1 3"], Float[Tensor, "face 2 3"]]:
        """A corner of each face, and the two edges that leave it, mm."""
        unit = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        found = torch.stack([self.box.face_points(face, unit) for face in self.faces])
        return found[:, :1], found[:, 1:] - found[:, :1]
