"""Pose corrections: how a rig differs from its calibration.

    R' = exp([w]x) R        rotation by w about the camera's own axes
    C' = C + R^T c          its centre shifted by c along them
    x' = x / (1 + k)        focal length larger by the factor 1 + k
    plane: offset' = offset + b, away from the camera

A ray moves with its camera: X' = C' + R'^T R (X - C). So rays are corrected without tracing them again, except those
through interfaces, which stay in place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from nerif.geometry.camera import Camera, Plane
from nerif.geometry.distortion import POWERS
from nerif.geometry.grid import Box
from nerif.geometry.rays import BackgroundPoints, Rays

__all__ = ["GEOMETRY", "Corrections", "rotation_matrix"]

GEOMETRY = ("turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z", "zoom", "background")
"""Corrections of a camera in the order of the columns: w (rad), c (mm), k, b (mm)."""


@dataclass(frozen=True)
class Corrections:
    """Corrections (view, 8) of GEOMETRY to the cameras of a calibration."""

    cameras: Sequence[Camera]
    values: Float[Tensor, "view 8"]

    @property
    def corrected(self) -> tuple[Camera, ...]:
        """The corrected cameras."""
        return tuple(_corrected_camera(c, v) for c, v in zip(self.cameras, self.values.cpu().double(), strict=True))

    @cached_property
    def _views(self) -> dict[str, Tensor]:
        """Columns of each view, in double precision on the CPU."""
        old, new = self.cameras, self.corrected
        rotation = torch.stack([c.rotation.double() for c in old])
        planes = [c.background for c in new]
        focus = [None if c.lens is None else c.lens.focus for c in new]
        nan = torch.full((3,), torch.nan, dtype=torch.float64)
        return {
            "motion": torch.stack([c.rotation.double() for c in new]).mT @ rotation,
            "axis": rotation[:, 2],
            "centre": torch.stack([c.centre.double() for c in old]),
            "new_centre": torch.stack([c.centre.double() for c in new]),
            "zoom": 1 + self.values[:, 6].cpu().double(),
            "depth": torch.tensor([c.projection.shows_depth for c in old]),
            "normal": torch.stack([nan if p is None else p.normal.double() for p in planes]),
            "offset": torch.tensor([torch.nan if p is None else p.offset for p in planes], dtype=torch.float64),
            "focus": torch.tensor([torch.nan if f is None else f for f in focus], dtype=torch.float64),
        }

    def apply(self, rays: Rays, box: Box) -> Rays:
        """Return rays of the calibrated cameras as those of the corrected ones, clipped to the box."""
        like, views = rays.origin, rays.view.long()
        of = {n: x.to(like if x.is_floating_point() else like.device)[views] for n, x in self._views.items()}

        def narrow(x: Tensor) -> Tensor:
            along = (x * of["axis"]).sum(-1, keepdim=True) * of["axis"]
            return along + (x - along) / of["zoom"][:, None]

        def turn(x: Tensor) -> Tensor:
            # written out here and below, since a matrix product may be of reduced precision
            return (of["motion"] * x[:, None]).sum(-1)

        narrowed = narrow(rays.direction)
        direction = turn(narrowed / narrowed.norm(dim=-1, keepdim=True))
        origin = of["new_centre"] + turn(narrow(rays.origin - of["centre"]))
        axis, ends, lens = turn(of["axis"]), rays.background, rays.lens
        if ends is not None:
            distance = (of["offset"] - (origin * of["normal"]).sum(-1)) / (direction * of["normal"]).sum(-1)
            depth = ends.distance * (rays.direction * of["axis"]).sum(-1)
            nearer = torch.where(of["depth"], depth / (distance * (direction * axis).sum(-1)), 1.0)
            along = (ends.sensitivity * of["axis"][:, None]).sum(-1, keepdim=True) * of["axis"][:, None]
            sensitivity = along + (ends.sensitivity - along) * of["zoom"][:, None, None]
            sensitivity = (sensitivity[:, :, None] * of["motion"][:, None]).sum(-1) * nearer[:, None, None]
            ends = BackgroundPoints(sensitivity, distance)
        if lens is not None:
            sharp = of["focus"] / (direction * axis).sum(-1)
            focus = torch.where(of["focus"].isnan(), lens.focus if ends is None else ends.distance, sharp)
            lens = replace(lens, axis=axis, focus=focus, normal=axis if ends is None else lens.normal)
        corrected = replace(rays, origin=origin, direction=direction, background=ends, lens=lens)
        return self._through_interfaces(corrected, views).clip(box)

    def _through_interfaces(self, rays: Rays, views: Int64[Tensor, " n"]) -> Rays:
        """Rays with those of cameras behind interfaces traced again from their pixels."""
        for v, camera in enumerate(self.corrected if any(c.interfaces for c in self.cameras) else ()):
            where = (views == v).nonzero()[:, 0]
            if not camera.interfaces or not len(where):
                continue
            traced = camera.rays(rays.pixel[where].cpu().double(), rays.background is not None)
            lens = None if rays.lens is None or traced.lens is None else replace(traced.lens, box=rays.lens.box)
            traced = replace(traced, view=rays.view[where], lens=lens)
            rays = rays.each(lambda old, new, i=where: old.index_copy(0, i, new.to(old)), traced)
        return rays


def rotation_matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return exp([w]x), the rotation by |w| (rad) about w."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(cross)


def _corrected_camera(camera: Camera, values: Float[Tensor, 8]) -> Camera:
    turn, shift, zoom, away = values[:3], values[3:6], 1 + values[6], float(values[7])
    kind = camera.rotation.dtype
    rotation = rotation_matrix(turn) @ camera.rotation.double()
    centre = camera.centre.double() + camera.rotation.double().T @ shift
    scale = torch.ones(3, 3, dtype=torch.float64)
    tilt, cosines = _zoomed(camera.tilt.double(), zoom)
    scale[:2, :2] = zoom * cosines.flip(0)  # the principal point stays
    powers = torch.tensor(POWERS, dtype=torch.float64)
    plane = camera.background
    if plane is not None:
        sign = 1.0 if float(camera.rotation[2].double() @ plane.normal.double()) > 0 else -1.0
        plane = Plane(plane.normal, plane.offset + sign * away)
    return replace(
        camera,
        intrinsics=(camera.intrinsics.double() * scale).to(camera.intrinsics),
        distortion=(camera.distortion.double() * zoom**powers).to(camera.distortion),
        tilt=tilt.to(camera.tilt),
        rotation=rotation.to(kind),
        translation=(-rotation @ centre).to(kind),
        background=plane,
    )


def _zoomed(tilt: Float[Tensor, 2], zoom: Float[Tensor, ""]) -> tuple[Float[Tensor, 2], Float[Tensor, 2]]:
    """Tilt of a sensor that sees the image (x, y) / zoom as one of this tilt sees (x, y), and the ratio of the cosines.

    Exact for a tilt about one axis; of two a shear of 2 k tan(tau_x) tan(tau_y) is neglected.
    """
    first = torch.atan(zoom * tilt[0].tan())
    second = torch.atan(zoom * tilt[1].tan() * first.cos() / tilt[0].cos())
    result = torch.stack([first, second])
    return result, result.cos() / tilt.cos()
