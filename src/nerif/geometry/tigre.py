"""Cameras and grid in the cone-beam geometry of TIGRE.

In the frame of a view the source lies at (DSO, 0, 0) and the middle of the detector at (DSO - DSD, offU, offV). Its
columns count along y and its rows along z, turned about its middle by Q. The frame is turned by A about the origin,

    A = Rz(alpha) Ry(theta) Rz(psi),     Q = Rz(rot_3) Ry(rot_2) Rx(rot_1)
    u = dU A Q e_y,    v = dV A Q e_z,   with source and detector rotated by A; angles in rad

All pixels of all views have one size, dDetector = (dV, dU). TIGRE's origin is the middle of the volume; `origin_mm` is
its position in the world.

Arrays in TIGRE: projections (view, row, column), volumes (z, y, x); so are nDetector (v, u) and nVoxel (z, y, x).

Source: Biguri et al., TIGRE, Biomed. Phys. Eng. Express 2 (2016) 055010; its documentation and its projector.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.arrays import Matrix3
from nerif.common.conventions import InputError, whole
from nerif.geometry.astra import check_vectors, depth_behind, vectors_of
from nerif.geometry.camera import Camera
from nerif.geometry.grid import Grid
from nerif.geometry.projection import PERSPECTIVE

__all__ = ["from_tigre", "tigre_of"]

MOST = 0.1  # px, by which a common pixel size may move a pixel
TURN = 2 * math.pi * (1 + 1e-6)  # rad, beyond which angles are likely in degrees
LEAST = 1e-6  # px, below which pixels count as exact


def tigre_of(
    cameras: Sequence[Camera], size: tuple[int, int], grid: Grid, say: Callable[[str], None] = lambda line: None
) -> dict[str, Any]:
    """Return the attributes of tigre.geometry and the angles (view, 3) of its projector.

    Parameters
    ----------
    size : rows and columns of all detectors, px; smaller images lie in their upper left corner
    say : called with the error of the common pixel size
    """
    check_vectors(cameras)
    for camera in cameras:
        if camera.projection != PERSPECTIVE or float(camera.intrinsics[0, 1]) != 0 or bool(camera.tilt.any()):
            got = "skew or tilt" if camera.projection == PERSPECTIVE else camera.projection.name
            raise InputError(
                f"expected perspective cameras without skew and tilt, got {got}; ASTRA has a geometry for them",
                field=f"view '{camera.name}'",
            )
    origin = torch.tensor(grid.box.centre, dtype=torch.float64)
    fx, fy = (torch.stack([c.intrinsics[i, i] for c in cameras]) for i in (0, 1))
    width = max(depth_behind(c, grid.box) / float(c.intrinsics[0, 0]) for c in cameras)
    height = width * float((fx / fy).mean())
    _check_pixels(cameras, fx / fy * width / height, say)
    angles, sources, detectors, offsets, turns = [], [], [], [], []
    for camera in cameras:
        intrinsics = camera.intrinsics.clone()
        intrinsics[1, 1] = intrinsics[0, 0] * width / height
        row = vectors_of(replace(camera, intrinsics=intrinsics), size, width * float(intrinsics[0, 0]))
        source, middle = row[:3] - origin, row[3:6] - origin
        distance = float(source.norm())
        if not distance > 0:
            raise InputError("expected a camera outside the middle of the box", field=f"view '{camera.name}'")
        alpha, theta = math.atan2(source[1], source[0]), -math.atan2(source[2], math.hypot(source[0], source[1]))
        frame = _turn("z", alpha) @ _turn("y", theta)
        x, y, z = (frame.T @ middle).tolist()
        u, v = row[6:9] / width, row[9:] / height
        turn = frame.T @ torch.stack([torch.linalg.cross(u, v), u, v], dim=1)
        angles.append((alpha, theta, 0.0))
        sources.append(distance)
        detectors.append(distance - x)
        offsets.append((z, y))
        turns.append(_angles(turn))
    pixel, voxel = np.array([height, width]), np.array(grid.spacing[::-1])
    return {
        "mode": "cone",
        "angles": np.array(angles),
        "DSO": np.array(sources),
        "DSD": np.array(detectors),
        "nDetector": np.array(size),
        "dDetector": pixel,
        "sDetector": pixel * size,
        "offDetector": np.array(offsets),
        "rotDetector": np.array(turns),
        "nVoxel": np.array(grid.shape),
        "dVoxel": voxel,
        "sVoxel": voxel * grid.shape,
        "offOrigin": np.zeros(3),
        "origin_mm": origin.numpy(),
    }


def _check_pixels(cameras: Sequence[Camera], ratios: Float[Tensor, " view"], say: Callable[[str], None]) -> None:
    """Refuse cameras whose pixels have too different proportions; report the error of similar ones, px."""
    errors = [
        abs(float(ratio) - 1) * max(float(c.intrinsics[1, 2]), c.image_size[0] - float(c.intrinsics[1, 2]))
        for c, ratio in zip(cameras, ratios, strict=True)
    ]
    worst = int(np.argmax(errors))
    if errors[worst] > MOST:
        raise InputError(
            f"expected one fx/fy for all views, since TIGRE has one pixel size, got a deviation of {errors[worst]:.2g} "
            "px; ASTRA has a geometry for each view",
            field=f"intrinsics of view '{cameras[worst].name}'",
        )
    if errors[worst] > LEAST:
        say(f"TIGRE has one pixel size for all views: rows are off by up to {errors[worst]:.2g} px")


def from_tigre(geometry: Mapping[str, Any]) -> tuple[Float[Tensor, "view 12"], tuple[int, int]]:
    """Return the rows of cone_vec (mm, world) and the detector size of a geometry of TIGRE with its angles."""

    def values(key: str, width: int, default: float | None = None) -> Float[Tensor, "view width"]:
        """One row per view."""
        array = np.asarray(geometry.get(key, default), dtype=np.float64)
        if array.size not in (1, width, len(angles) * width):
            raise InputError(f"expected {width} numbers, or {width} per view, got {array.size}", field=key)
        array = array.reshape(len(angles), -1) if array.size == len(angles) * width else array.reshape(1, -1)
        return torch.from_numpy(np.broadcast_to(array, (len(angles), width)).copy())

    angles = np.asarray(geometry["angles"], dtype=np.float64)
    angles = np.pad(angles.reshape(-1, 1), ((0, 0), (0, 2))) if angles.ndim < 2 else angles
    if angles.shape[1:] != (3,):
        raise InputError(f"expected (views,) or (views, 3) numbers in rad, got {angles.shape}", field="angles")
    if str(geometry.get("mode", "cone")) not in ("cone", "None"):
        raise InputError(f"expected cone, got {geometry['mode']}; give its ASTRA vectors", field="mode")
    if bool(values("COR", 1, 0.0).any()):
        raise InputError("expected a centre of rotation of 0, got another; put it into offDetector", field="COR")
    source, detector = values("DSO", 1), values("DSD", 1)
    if not bool(((source > 0) & (detector > source)).all()):
        got = f"{source.flatten().tolist()[:3]} and {detector.flatten().tolist()[:3]}"
        raise InputError(f"expected 0 < DSO (source to origin) < DSD (source to detector), mm, got {got}", field="DSD")
    (dv, du), (rows, columns) = (np.asarray(geometry[key]).ravel()[:2].tolist() for key in ("dDetector", "nDetector"))
    off, turns, origin = values("offDetector", 2, 0.0), values("rotDetector", 3, 0.0), values("origin_mm", 3, 0.0)
    for key, array in (("angles", angles), ("rotDetector", turns.numpy())):
        if not (np.abs(array) <= TURN).all():
            raise InputError(
                f"expected rad, within one turn, got up to {np.abs(array).max():g}; if they are in degrees, take "
                "numpy.deg2rad of them, else their remainder by 2 pi",
                field=key,
            )
    vectors = []
    for i, (alpha, theta, psi) in enumerate(angles.tolist()):
        frame = _turn("z", alpha) @ _turn("y", theta) @ _turn("z", psi)
        x, y, z = turns[i].tolist()
        turn = frame @ _turn("z", z) @ _turn("y", y) @ _turn("x", x)
        middle = torch.stack([source[i, 0] - detector[i, 0], off[i, 1], off[i, 0]])
        from_origin = frame[:, 0] * source[i, 0]
        parts = [origin[i] + from_origin, origin[i] + frame @ middle, du * turn[:, 1], dv * turn[:, 2]]
        vectors.append(torch.cat(parts))
    return torch.stack(vectors), (whole(rows, "nDetector"), whole(columns, "nDetector"))


def _turn(axis: str, angle: float) -> Matrix3:
    """Rotation about an axis by an angle, rad."""
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = torch.eye(3, dtype=torch.float64)
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[i, j], matrix[j, i] = -math.sin(angle), math.sin(angle)
    return matrix


def _angles(turn: Matrix3) -> tuple[float, float, float]:
    """Rotations about x, y and z, rad, of Rz Ry Rx; the detector is never edge-on, so |rotation about y| < pi/2."""
    t = turn.tolist()
    return (
        math.atan2(t[2][1], t[2][2]),
        math.atan2(-t[2][0], math.hypot(t[0][0], t[1][0])),
        math.atan2(t[1][0], t[0][0]),
    )
