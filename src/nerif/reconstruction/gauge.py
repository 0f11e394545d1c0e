"""The gauge: a region of ambient index, which fixes the constant that displacements leave undetermined.

By default the field is ambient, 0, on the side faces of the box and, with flow masks, outside the visual hull; never
within a body. A region of the box may be ambient as well, and the index may be known at single points, by probes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.quantity_names import INDEX
from nerif.geometry import Box, Grid
from nerif.geometry.body import Body, contained
from nerif.geometry.region import Region

if TYPE_CHECKING:
    from nerif.reconstruction.shared_settings import SharedSettings

__all__ = ["Gauge", "ambient_faces", "check_gauge", "free_voxels", "is_open", "visual_hull", "with_gauge"]

FEW = 1024  # points that show whether a region has any outside bodies


def is_open(measurement: Measurement) -> bool:
    """Return whether the data leave a constant of the field undetermined."""
    return all(kind.gauge for kind in measurement.techniques)


def with_gauge(measurement: Measurement, settings: SharedSettings) -> Measurement:
    """Return a measurement with the ambient faces and the ambient region of settings in place of its own.

    Settings that state any of the two, or probes, replace both. The faces of the measurement itself count only if a
    technique needs them.
    """
    if not (settings.ambient_faces or settings.ambient_region or settings.probes):
        faces = ambient_faces(measurement)
        return measurement if faces == measurement.ambient_faces else replace(measurement, ambient_faces=faces)
    if settings.probes and measurement.quantity != INDEX:
        raise InputError(f"expected none for {measurement.quantity}, got points with an index", field="known")
    return replace(measurement, ambient_faces=settings.ambient_faces, ambient_region=settings.ambient_region)


def ambient_faces(measurement: Measurement) -> tuple[str, ...]:
    """Return the ambient faces of a measurement; none if no technique needs a gauge and it has a field of its own."""
    return measurement.ambient_faces if any(kind.gauge for kind in measurement.techniques) else ()


def check_gauge(measurement: Measurement, probes: bool = False, hull: bool = True) -> None:
    """Raise InputError if a constant of the field is undetermined and it is known nowhere.

    Parameters
    ----------
    probes : whether it is known at points
    hull : whether it is ambient outside the flow masks
    """
    faces, region = measurement.ambient_faces, measurement.ambient_region is not None
    masks = hull and measurement.flow_mask is not None
    if is_open(measurement) and not (faces or region or probes or masks):
        raise InputError(
            "expected at least one face (x- x+ y- y+ z- z+), a region, a probe or flow masks, got none; "
            "displacements determine the index only up to a constant",
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


def free_voxels(measurement: Measurement, grid: Grid, hull: bool = True) -> Bool[Tensor, "z y x"] | None:
    """Return the voxels whose centres are neither outside the visual hull nor in the ambient region; None for all."""
    free = visual_hull(measurement, grid) if hull and measurement.flow_mask is not None else None
    if measurement.ambient_region is None:
        return free
    lower, upper = _corners(measurement.ambient_region)
    points = grid.points(torch.float64)
    outside = ((points < lower) | (points > upper)).any(dim=-1)
    return outside if free is None else free & outside


def _corners(region: Region) -> tuple[Float[Tensor, 3], Float[Tensor, 3]]:
    """Lower and upper corner of a region x0 x1 y0 y1 z0 z1, mm."""
    lower, upper = torch.tensor(region, dtype=torch.float64).reshape(3, 2).unbind(dim=1)
    return lower, upper


@dataclass(frozen=True)
class Gauge:
    """Where the index excess is known: 0 on faces, outside the visual hull and in a region; at points."""

    box: Box
    faces: tuple[str, ...]
    empty: Float[Tensor, "m 3"]  # centres of voxels that are outside the hull with all their corners, mm
    voxel: tuple[float, float, float]  # their edges, mm
    region: Region | None = None
    points: Float[Tensor, "k 3"] = field(default_factory=lambda: torch.zeros(0, 3))  # mm
    values: Float[Tensor, " k"] = field(default_factory=lambda: torch.zeros(0))  # at the points
    bodies: Sequence[Body] = ()

    @classmethod
    def of(
        cls, measurement: Measurement, probes: Sequence[tuple[float, float, float, float]] = (), hull: bool = True,
        resolution: int = 48,
    ) -> Gauge | None:  # fmt: skip
        """Return the gauge of a measurement, and of probes x y z (mm) with the index there; None if not needed."""
        faces, grid = measurement.ambient_faces, Grid.of_resolution(measurement.box, resolution)
        empty = torch.zeros(0, 3)
        if hull and measurement.flow_mask is not None:
            empty = grid.points()[_outside(measurement, _flow(measurement), grid)]
        check_gauge(measurement, bool(probes), bool(len(empty)))
        table = torch.tensor(probes, dtype=torch.float64).reshape(-1, 4)
        points, values = table[:, :3].float(), (table[:, 3] - measurement.n_ambient).float()
        _check_points(measurement, points)
        region = measurement.ambient_region
        if not (faces or len(empty) or region or probes):
            return None
        gauge = cls(measurement.box, faces, empty, grid.spacing, region, points, values, measurement.bodies)
        if not len(gauge.sample(FEW, torch.Generator().manual_seed(0))[0]):
            raise InputError("expected a region outside the bodies, got none; name other faces", field="ambient_faces")
        return gauge

    def sample(self, count: int, generator: torch.Generator) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
        """Draw about `count` points (mm) outside bodies, as many of each kind, and return the index excess at them."""
        kinds = sum((bool(self.faces), len(self.empty) > 0, self.region is not None, len(self.points) > 0))
        points, share = [], count // max(kinds, 1)
        if self.faces:
            corner, edges = self._face_frames
            unit = torch.rand(len(self.faces), -(-share // len(self.faces)), 2, generator=generator)
            points.append((corner + unit @ edges).reshape(-1, 3))
        if len(self.empty):
            index = torch.randint(len(self.empty), (share,), generator=generator)
            shift = (torch.rand(share, 3, generator=generator) - 0.5) * torch.tensor(self.voxel)
            points.append(self.empty[index] + shift)
        if self.region is not None:
            lower, upper = (corner.float() for corner in _corners(self.region))
            points.append(lower + torch.rand(share, 3, generator=generator) * (upper - lower))
        ambient = torch.cat(points) if points else torch.zeros(0, 3)
        if self.bodies:
            ambient = ambient[~contained(self.bodies, ambient)]
        index = torch.arange(share if len(self.points) else 0) % max(len(self.points), 1)
        values = self.values[index]
        return torch.cat([ambient, self.points[index]]), torch.cat([torch.zeros(len(ambient)), values])

    @cached_property
    def _face_frames(self) -> tuple[Float[Tensor, "face 1 3"], Float[Tensor, "face 2 3"]]:
        """A corner of each face, and the two edges from it, mm."""
        unit = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        points = torch.stack([self.box.face_points(face, unit) for face in self.faces])
        return points[:, :1], points[:, 1:] - points[:, :1]


def _check_points(measurement: Measurement, points: Float[Tensor, "k 3"]) -> None:
    """Raise InputError for a probe that is outside the box or within a body."""
    lower, upper = measurement.box.lower, measurement.box.upper
    outside = ~((points >= points.new_tensor(lower)) & (points <= points.new_tensor(upper))).all(dim=-1)  # or NaN
    within = contained(measurement.bodies, points)
    for wrong, where in ((outside, f"outside the box {lower} to {upper} mm"), (within, "within a body")):
        if bool(wrong.any()):
            got = " ".join(f"{x:g}" for x in points[wrong][0].tolist())
            raise InputError(f"expected points of the flow, got {got}, {where}", field="known")
