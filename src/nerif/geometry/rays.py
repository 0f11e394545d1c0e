"""Rays: all that the path integral needs to know of a measurement, and nothing about cameras.

A ray is back-traced from a pixel. Refraction by dn at path length s moves the background point it ends on by
(s_b - s) dn / n, and the sensitivity S (2 x 3, px/mm) turns that movement into pixels:

    d = integral (s_b - s) S grad(n) / n ds
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.geometry.grid import Box

__all__ = ["Rays"]


@dataclass(frozen=True)
class Rays:
    """Back-traced rays, in the world frame.

    Parameters
    ----------
    origin : (n, 3) camera centre, mm
    direction : (n, 3) unit vector, from the camera to the background
    sensitivity : (n, 2, 3) S = -d project / d X at the background point, px/mm; S . direction = 0
    background : (n,) path length s_b from origin to background, mm
    near, far : (n,) path lengths between which the ray is inside the box, mm; far <= near where it misses
    """

    origin: Float[Tensor, "n 3"]
    direction: Float[Tensor, "n 3"]
    sensitivity: Float[Tensor, "n 2 3"]
    background: Float[Tensor, " n"]
    near: Float[Tensor, " n"]
    far: Float[Tensor, " n"]

    def __len__(self) -> int:
        return self.origin.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Rays:
        return Rays(*(getattr(self, f.name)[index] for f in fields(self)))

    @staticmethod
    def concatenate(parts: Sequence[Rays]) -> Rays:
        """Join rays end to end."""
        return Rays(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Rays)))

    @staticmethod
    def collect(parts: Iterable[Rays], most: int) -> Rays:
        """Join at most so many rays end to end, in single precision, holding no more than one part twice."""
        whole = Rays(*(torch.empty(most, *shape) for shape in ((3,), (3,), (2, 3), (), (), ())))
        count = 0
        for part in parts:
            for f in fields(Rays):
                getattr(whole, f.name)[count : count + len(part)] = getattr(part, f.name)
            count += len(part)
        return whole[:count]

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Rays:
        """Return the rays on another device or in another precision."""
        return Rays(*(getattr(self, f.name).to(device=device, dtype=dtype) for f in fields(self)))

    @property
    def crosses(self) -> Bool[Tensor, " n"]:
        """Which rays pass through the box they were clipped to."""
        return self.far > self.near

    def at(self, s: Float[Tensor, "n m"]) -> Float[Tensor, "n m 3"]:
        """Points at path lengths s (mm), mm."""
        return self.origin[:, None, :] + s[..., None] * self.direction[:, None, :]

    def clip(self, box: Box) -> Rays:
        """Return the rays with near and far set to where they enter and leave the box (slab method)."""
        lower, upper = self.origin.new_tensor(box.lower), self.origin.new_tensor(box.upper)
        # a ray along a face divides 0 by 0: nudge the direction, not the answer
        direction = torch.where(self.direction.abs() < 1e-12, torch.full_like(self.direction, 1e-12), self.direction)
        a, b = (lower - self.origin) / direction, (upper - self.origin) / direction
        near = torch.minimum(a, b).amax(dim=-1).clamp_min(0)
        far = torch.maximum(a, b).amin(dim=-1)
        return replace(self, near=near, far=torch.maximum(far, near))

    def exit_faces(self, box: Box, faces: Sequence[str]) -> Bool[Tensor, " n"]:
        """Which rays enter or leave the box through one of the named faces."""
        hit = torch.zeros(len(self), dtype=torch.bool, device=self.origin.device)
        tolerance = 1e-4 * min(box.edges)
        for s in (self.near, self.far):
            point = self.origin + s[:, None] * self.direction
            for face in faces:
                axis, corner = "xyz".index(face[0]), (box.lower if face[1] == "-" else box.upper)
                hit |= (point[:, axis] - corner[axis]).abs() < tolerance
        return hit & self.crosses
