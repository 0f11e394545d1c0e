"""Cameras and grid in the geometry of the ASTRA toolbox: cone_vec (perspective) or parallel3d_vec (telecentric).

A row of twelve numbers holds the source (cone_vec) or the direction of the rays (parallel3d_vec), the middle d of the
detector, and its steps u from column to column and v from row to row. A pixel lies at

    d + (column - (columns - 1)/2) u + (row - (rows - 1)/2) v

Its ray runs from the source, or along the direction, through that point. With M = R^T E K^-1 and a perspective camera,

    u = D M e_1,    v = D M e_2,    d = source + D M ((columns - 1)/2, (rows - 1)/2, 1),    D: depth of the detector

for any D > 0; E holds the axes of a tilted sensor (distortion.py). The inverse is the QR decomposition of M, a camera
without tilt. Skew of K is part of u and v; distortion and lenses are not.

Arrays in ASTRA: projections (row, view, column), volumes (z, y, x). Lengths are mm.

Source: ASTRA Toolbox documentation, 3D geometries.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError, whole
from nerif.geometry.camera import Camera
from nerif.geometry.distortion import sensor_axes
from nerif.geometry.grid import Box, Grid
from nerif.geometry.projection import PERSPECTIVE, TELECENTRIC, Projection

__all__ = [
    "PROJECTIONS_OF", "astra_of", "camera_of", "check_vectors", "depth_behind", "from_astra", "vectors_of",
]  # fmt: skip

PROJECTIONS_OF: dict[str, Projection] = {"cone_vec": PERSPECTIVE, "parallel3d_vec": TELECENTRIC}
"""Projection of each kind of geometry."""


def astra_of(cameras: Sequence[Camera], size: tuple[int, int], grid: Grid) -> dict[str, Any]:
    """Return the arguments of astra.create_proj_geom and create_vol_geom.

    create_proj_geom(type, DetectorRowCount, DetectorColCount, Vectors); create_vol_geom(*voxels, *window)

    Parameters
    ----------
    size : rows and columns of all detectors, px; smaller images lie in their upper left corner
    """
    check_vectors(cameras)
    kinds = {camera.projection for camera in cameras}
    if len(kinds) > 1:
        raise InputError("expected cameras of one projection, got perspective and telecentric ones", field="projection")
    (kind,) = (name for name, projection in PROJECTIONS_OF.items() if projection in kinds)
    (x0, y0, z0), (x1, y1, z1), (nz, ny, nx) = grid.box.lower, grid.box.upper, grid.shape
    return {
        "type": kind,
        "DetectorRowCount": size[0],
        "DetectorColCount": size[1],
        "Vectors": np.stack([vectors_of(c, size, depth_behind(c, grid.box)).numpy() for c in cameras]),
        "voxels": np.array([ny, nx, nz]),
        "window": np.array([x0, x1, y0, y1, z0, z1]),
    }


def check_vectors(cameras: Sequence[Camera]) -> None:
    """Refuse cameras with distortion or interfaces, whose pixels do not lie on a plane in equal steps."""
    for camera in cameras:
        if camera.interfaces:
            raise InputError("expected none, which vectors cannot hold", field=f"interfaces of view '{camera.name}'")
        if bool(camera.distortion.any()):
            raise InputError(
                f"expected none, which vectors cannot hold, got {camera.distortion.tolist()}; undistort the images and "
                "calibrate them with zero distortion first",
                field=f"distortion of view '{camera.name}'",
            )


def depth_behind(camera: Camera, box: Box) -> float:
    """Return the depth of the plane behind a box across the optical axis, mm from z_cam = 0."""
    corners = torch.cartesian_prod(*(torch.tensor(pair) for pair in zip(box.lower, box.upper, strict=True)))
    depth = float(camera.local(corners.to(camera.rotation))[:, 2].max())
    if camera.projection.shows_depth and not depth > 0:
        raise InputError("expected the box in front of the camera, got it behind", field=f"view '{camera.name}'")
    return depth


def vectors_of(camera: Camera, size: tuple[int, int], depth: float) -> Float[Tensor, 12]:
    """Return the row of a camera, of a detector with rows and columns `size` at a depth in mm."""
    m = camera.rotation.T @ sensor_axes(camera.tilt) @ torch.linalg.inv(camera.intrinsics)
    middle = m @ _middle(size)
    if camera.projection.shows_depth:
        return torch.cat([camera.centre, camera.centre + depth * middle, depth * m[:, 0], depth * m[:, 1]])
    axis = camera.rotation[2]
    return torch.cat([axis, camera.centre + middle + (depth - 1) * axis, m[:, 0], m[:, 1]])


def camera_of(kind: str, row: Float[Tensor, 12], size: tuple[int, int], name: str) -> tuple[Camera, bool]:
    """Return the camera of a row, and whether it shows the images upside down.

    A camera sees x to the right and y down. Where u x v points to the source, as in most computed tomographs, the
    detector is a mirror image; its rows in reverse order are those of the camera.

    Parameters
    ----------
    kind : cone_vec or parallel3d_vec
    """
    if kind not in PROJECTIONS_OF:
        raise InputError(
            f"expected {' or '.join(PROJECTIONS_OF)}, got '{kind}'; convert it by astra.geom_2vec", field="type"
        )
    projection = PROJECTIONS_OF[kind]
    first, middle, u, v = row.reshape(4, 3)
    towards = middle - first if projection.shows_depth else first / first.norm()
    reversed_rows = bool(torch.linalg.cross(u, v) @ towards < 0)
    if reversed_rows:
        v = -v
    if projection.shows_depth:
        a, b, _ = _middle(size)
        matrix = torch.stack([u, v, towards - a * u - b * v], dim=1)
    else:
        matrix = torch.stack([u - (u @ towards) * towards, v - (v @ towards) * towards, towards], dim=1)
    if not abs(float(torch.linalg.det(matrix))) > 1e-12 * float(matrix.norm(dim=0).prod()):
        raise InputError(f"expected u, v and the ray in three directions, got {row.tolist()}", field=f"view '{name}'")
    q, r = torch.linalg.qr(matrix)
    signs = r.diagonal().sign()
    rotation, k = (q * signs).T.contiguous(), torch.linalg.inv(signs[:, None] * r)
    if projection.shows_depth:
        intrinsics, translation = k / k[2, 2], -rotation @ first
    else:  # neither the position along the axis nor that of the middle of the detector is defined
        intrinsics, translation = k, -rotation @ middle
        intrinsics[:2, 2], translation[2] = _middle(size)[:2], 0.0
    intrinsics = intrinsics.triu()
    intrinsics[2] = torch.tensor([0.0, 0.0, 1.0])
    none = torch.zeros(5, dtype=torch.float64)
    return Camera(intrinsics, rotation, translation, size, None, none, name, projection), reversed_rows


def _middle(size: tuple[int, int]) -> Float[Tensor, 3]:
    """Pixel (column, row, 1) in the middle of a detector."""
    return torch.tensor([(size[1] - 1) / 2, (size[0] - 1) / 2, 1.0], dtype=torch.float64)


def from_astra(geometry: Mapping[str, Any]) -> tuple[str, Float[Tensor, "view 12"], tuple[int, int]]:
    """Return kind, rows and detector size of the entries of an ASTRA geometry."""
    rows = torch.as_tensor(np.asarray(geometry["Vectors"], dtype=np.float64))
    if rows.ndim != 2 or rows.shape[1] != 12:
        raise InputError(f"expected (views, 12) numbers, got {tuple(rows.shape)}", field="Vectors")
    height, width = (whole(geometry[key], key) for key in ("DetectorRowCount", "DetectorColCount"))
    return str(geometry["type"]), rows, (height, width)
