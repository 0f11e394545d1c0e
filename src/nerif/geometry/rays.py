"""Rays: all that a path integral needs to know of a measurement, and nothing about cameras.

A ray is back-traced from a pixel. Where it ends on a background, refraction by dn at path length s moves the point it
ends on by (s_b - s) dn / n, and the sensitivity S (2 x 3, px/mm) turns that movement into pixels:

    d = integral (s_b - s) S grad(n) / n ds
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int16
from torch import Tensor

from nerif.conventions import InputError
from nerif.geometry.grid import Box

__all__ = ["BackgroundPoints", "Rays"]


C = TypeVar("C", bound="_Columns")


class _Columns:
    """A record of arrays with one entry a ray, or of such records; None where there is nothing."""

    def _each(self: C, change: Callable[..., Tensor], *others: C) -> C:
        """Return the record of what `change` makes of every array and those of the others in its place."""
        made: dict[str, Any] = {}
        for f in fields(self):  # type: ignore[arg-type]
            first, *more = (getattr(part, f.name) for part in (self, *others))
            if isinstance(first, _Columns):
                first = first._each(change, *more)
            made[f.name] = change(first, *more) if isinstance(first, Tensor) else first
        return type(self)(**made)


@dataclass(frozen=True)
class BackgroundPoints(_Columns):
    """Where rays end on a background, and how a movement there is seen.

    Parameters
    ----------
    sensitivity : (n, 2, 3) S = -d project / d X at the background point, px/mm; S . direction = 0
    distance : (n,) path length s_b from the ray's origin to the background, mm
    """

    sensitivity: Float[Tensor, "n 2 3"]
    distance: Float[Tensor, " n"]


@dataclass(frozen=True)
class Rays(_Columns):
    """Back-traced rays, in the world frame.

    Parameters
    ----------
    origin : (n, 3) camera centre, mm; of a telecentric camera the point of its plane z_cam = 0 that the ray starts from
    direction : (n, 3) unit vector, away from the camera
    near, far : (n,) path lengths between which the ray is inside the box, mm; far <= near where it misses
    pixel : (n, 2) the pixel (column, row) that sees it, px
    view : (n,) number of the view
    background : what they see on a background, or None
    begin : path length before which there is no ray, mm: 0, or -inf for a camera that sees along parallel lines
    """

    origin: Float[Tensor, "n 3"]
    direction: Float[Tensor, "n 3"]
    near: Float[Tensor, " n"]
    far: Float[Tensor, " n"]
    pixel: Float[Tensor, "n 2"]
    view: Int16[Tensor, " n"]
    background: BackgroundPoints | None = None
    begin: float = 0.0

    def __len__(self) -> int:
        return self.origin.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Rays:
        return self._each(lambda x: x[index])

    @staticmethod
    def concatenate(parts: Sequence[Rays]) -> Rays:
        """Join rays end to end."""
        return parts[0]._each(lambda *columns: torch.cat(columns), *parts[1:])

    @staticmethod
    def collect(parts: Iterable[Rays], most: int) -> Rays:
        """Join one part or more, at most so many rays, in single precision, holding no more than one part twice."""
        whole, count = None, 0

        def put(place: Tensor, given: Tensor) -> Tensor:
            place[count : count + len(given)] = given
            return place

        for part in parts:
            part = part.to(dtype=torch.float32)
            if whole is None:
                whole = part._each(lambda x: torch.empty(most, *x.shape[1:], dtype=x.dtype))
            whole._each(put, part)
            count += len(part)
        assert whole is not None, "there is a part at least"
        return whole[:count]

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Rays:
        """Return the rays on another device or in another precision."""
        return self._each(lambda x: x.to(device=device, dtype=dtype if x.is_floating_point() else None))

    @property
    def crosses(self) -> Bool[Tensor, " n"]:
        """Which rays pass through the box they were clipped to."""
        return self.far > self.near

    @property
    def unobstructed(self) -> Bool[Tensor, " n"]:
        """Which rays pass through the box before they end on their background, if they have one."""
        return self.crosses if self.background is None else self.crosses & (self.background.distance > self.far)

    @property
    def ends(self) -> BackgroundPoints:
        """Where the rays end on their background.

        Raises
        ------
        InputError
            If they have none.
        """
        if self.background is None:
            raise InputError("background: expected cameras that look at a background, got some without; name its plane")
        return self.background

    @property
    def end_points(self) -> Float[Tensor, "n 3"]:
        """The points of the background that the straight rays end on, mm."""
        return self.origin + self.ends.distance[:, None] * self.direction

    def at(self, s: Float[Tensor, "n m"]) -> Float[Tensor, "n m 3"]:
        """Points at path lengths s (mm), mm."""
        return self.origin[:, None, :] + s[..., None] * self.direction[:, None, :]

    def clip(self, box: Box) -> Rays:
        """Return the rays with near and far set to where they enter and leave the box (slab method)."""
        lower, upper = self.origin.new_tensor(box.lower), self.origin.new_tensor(box.upper)
        # a ray along a face divides 0 by 0: nudge the direction, not the answer
        direction = torch.where(self.direction.abs() < 1e-12, torch.full_like(self.direction, 1e-12), self.direction)
        a, b = (lower - self.origin) / direction, (upper - self.origin) / direction
        near = torch.minimum(a, b).amax(dim=-1).clamp_min(self.begin)
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
