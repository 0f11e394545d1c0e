"""How a rig differs from its calibration: cameras that stand, look and magnify otherwise, backgrounds further away.

    R' = exp([w]x) R        turned by w about the camera's own axes
    C' = C + R^T c          its centre shifted by c along them
    x' = x / (1 + k)        a focal length larger by k: what is seen at a pixel stands at smaller angles
    plane: offset' = offset + b, away from the camera

A ray moves with its camera: X' = C' + R'^T R (X - C). So rays are corrected without tracing them again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.geometry.camera import Camera, Plane
from nerif.geometry.grid import Box
from nerif.geometry.rays import BackgroundPoints, Rays

__all__ = ["GEOMETRY", "Corrections", "turned"]

GEOMETRY = ("turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z", "zoom", "background")
"""What is corrected of a camera, in the order of the columns: rad, mm about and along its own axes, 1, mm."""


@dataclass(frozen=True)
class Corrections:
    """Corrections of the cameras of a rig.

    Parameters
    ----------
    cameras : as they were calibrated
    values : (view, 8) of GEOMETRY
    """

    cameras: Sequence[Camera]
    values: Float[Tensor, "view 8"]

    @property
    def corrected(self) -> tuple[Camera, ...]:
        """The cameras as they are."""
        return tuple(_corrected(c, v) for c, v in zip(self.cameras, self.values.double().cpu(), strict=True))

    @cached_property
    def _views(self) -> dict[str, Tensor]:
        """What the rays of each view need to know, in double precision on the CPU."""
        old, new = self.cameras, self.corrected
        rotation = torch.stack([c.rotation.double() for c in old])
        found = {
            "motion": torch.stack([c.rotation.double() for c in new]).mT @ rotation,
            "axis": rotation[:, 2],
            "centre": torch.stack([c.centre.double() for c in old]),
            "new_centre": torch.stack([c.centre.double() for c in new]),
            "zoom": 1 + self.values[:, 6].double().cpu(),
            "depth": torch.tensor([c.projection.shows_depth for c in old]),
        }
        nowhere = torch.full((3,), torch.nan, dtype=torch.float64)
        planes = [c.background for c in new]
        found["normal"] = torch.stack([nowhere if p is None else p.normal.double() for p in planes])
        found["offset"] = torch.tensor([torch.nan if p is None else p.offset for p in planes], dtype=torch.float64)
        sharp = [None if c.lens is None else c.lens.focus for c in new]
        found["focus"] = torch.tensor([torch.nan if f is None else f for f in sharp], dtype=torch.float64)
        return found

    def moved(self, rays: Rays, box: Box) -> Rays:
        """Return rays of the calibrated cameras as the corrected cameras have them, clipped to the box anew.

        Parameters
        ----------
        rays : their views are those of the cameras
        """
        like, views = rays.origin, rays.view.long()
        of = {n: x.to(like if x.is_floating_point() else like.device)[views] for n, x in self._views.items()}

        def smaller(x: Tensor) -> Tensor:
            along = (x * of["axis"]).sum(-1, keepdim=True) * of["axis"]
            return along + (x - along) / of["zoom"][:, None]

        def turn(x: Tensor) -> Tensor:
            # written out here and below, since a matrix product may be of reduced precision
            return (of["motion"] * x[:, None]).sum(-1)

        narrowed = smaller(rays.direction)
        direction = turn(narrowed / narrowed.norm(dim=-1, keepdim=True))
        origin = of["new_centre"] + turn(smaller(rays.origin - of["centre"]))
        axis, ends, lens = turn(of["axis"]), rays.background, rays.lens
        if ends is not None:
            distance = (of["offset"] - (origin * of["normal"]).sum(-1)) / (direction * of["normal"]).sum(-1)
            depth = ends.distance * (rays.direction * of["axis"]).sum(-1)
            nearer = torch.where(of["depth"], depth / (distance * (direction * axis).sum(-1)), 1.0)
            along = (ends.sensitivity * of["axis"][:, None]).sum(-1, keepdim=True) * of["axis"][:, None]
            seen = along + (ends.sensitivity - along) * of["zoom"][:, None, None]
            seen = (seen[:, :, None] * of["motion"][:, None]).sum(-1) * nearer[:, None, None]
            ends = BackgroundPoints(seen, distance)
        if lens is not None:
            sharp = of["focus"] / (direction * axis).sum(-1)
            focus = torch.where(of["focus"].isnan(), lens.focus if ends is None else ends.distance, sharp)
            lens = replace(lens, axis=axis, focus=focus, normal=axis if ends is None else lens.normal)
        return replace(rays, origin=origin, direction=direction, background=ends, lens=lens).clip(box)


def turned(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return exp([w]x), the rotation by |w| (rad) about w."""
    x, y, z = vector.unbind(-1)
    nought = torch.zeros_like(x)
    cross = torch.stack([nought, -z, y, z, nought, -x, -y, x, nought], dim=-1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(cross)


def _corrected(camera: Camera, values: Float[Tensor, 8]) -> Camera:
    """One camera as it is."""
    turn, shift, larger, away = values[:3], values[3:6], 1 + values[6], float(values[7])
    kind = camera.rotation.dtype
    rotation = turned(turn) @ camera.rotation.double()
    centre = camera.centre.double() + camera.rotation.double().T @ shift
    scale = torch.ones(3, 3, dtype=torch.float64)
    scale[:2, :2] = larger  # of the principal point nothing
    powers = torch.tensor([2.0, 4.0, 1.0, 1.0, 6.0], dtype=torch.float64)
    plane = camera.background
    if plane is not None:
        sign = 1.0 if float(camera.rotation[2].double() @ plane.normal.double()) > 0 else -1.0
        plane = Plane(plane.normal, plane.offset + sign * away)
    return replace(
        camera,
        intrinsics=(camera.intrinsics.double() * scale).to(camera.intrinsics),
        distortion=(camera.distortion.double() * larger**powers).to(camera.distortion),
        rotation=rotation.to(kind),
        translation=(-rotation @ centre).to(kind),
        background=plane,
    )
