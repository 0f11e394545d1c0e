"""Rays: all that a path integral needs to know of a measurement, and nothing about cameras.

A ray is back-traced from a pixel. Where it ends on a background, refraction by dn at path length s moves the point it
ends on by (s_b - s) dn / n, and the sensitivity S (2 x 3, px/mm) turns that movement into pixels:

    d = integral (s_b - s) S grad(n) / n ds
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int16
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.transfer import constant, sent
from nerif.geometry.grid import Box
from nerif.geometry.lens import Columns, LensDiscs, spread_points

__all__ = ["BackgroundPoints", "Rays"]


@dataclass(frozen=True)
class BackgroundPoints(Columns):
    """Where rays end on a background, and how a movement there is seen.

    Parameters
    ----------
    sensitivity : (n, 2, 3) S = -d project / d X at the background point, px/mm; S . direction = 0
    distance : (n,) path length s_b from the ray's origin to the background, mm
    """

    sensitivity: Float[Tensor, "n 2 3"]
    distance: Float[Tensor, " n"]


@dataclass(frozen=True)
class Rays(Columns):
    """Back-traced rays, in the world frame.

    Parameters
    ----------
    origin : (n, 3) camera centre, mm; of a telecentric camera the point of its plane z_cam = 0 that the ray starts from
    direction : (n, 3) unit vector, away from the camera
    near, far : (n,) path lengths between which the ray is inside the box, mm; far <= near where it misses
    pixel : (n, 2) the pixel (column, row) that sees it, px
    view : (n,) number of the view
    begin : (n,) path length before which there is no ray, mm: 0, or -inf for a camera that sees along parallel lines
    background : what they see on a background, or None
    lens : the lens that each passes in the middle, and the window it stands for; None where a pixel sees a thin ray
    """

    origin: Float[Tensor, "n 3"]
    direction: Float[Tensor, "n 3"]
    near: Float[Tensor, " n"]
    far: Float[Tensor, " n"]
    pixel: Float[Tensor, "n 2"]
    view: Int16[Tensor, " n"]
    begin: Float[Tensor, " n"]
    background: BackgroundPoints | None = None
    lens: LensDiscs | None = None

    def __len__(self) -> int:
        return self.origin.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Rays:
        return self.each(lambda x: x[index])

    @staticmethod
    def concatenate(parts: Sequence[Rays]) -> Rays:
        """Join rays end to end."""
        return parts[0].each(lambda *columns: torch.cat(columns), *parts[1:])

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
                whole = part.each(lambda x: torch.empty(most, *x.shape[1:], dtype=x.dtype))
            whole.each(put, part)
            count += len(part)
        assert whole is not None, "there is a part at least"
        return whole[:count]

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Rays:
        """Return the rays on another device or in another precision."""
        return self.each(lambda x: x.to(device=device, dtype=dtype if x.is_floating_point() else None))

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
            raise InputError(
                "expected cameras that look at a background, got some without; name its plane", field="background"
            )
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
        lower, upper = constant(box.lower, self.origin), constant(box.upper, self.origin)
        # a ray along a face divides 0 by 0: nudge the direction, not the answer
        direction = torch.where(self.direction.abs() < 1e-12, torch.full_like(self.direction, 1e-12), self.direction)
        a, b = (lower - self.origin) / direction, (upper - self.origin) / direction
        near = torch.minimum(a, b).amax(dim=-1).maximum(self.begin)
        far = torch.maximum(a, b).amin(dim=-1)
        lens = None if self.lens is None else replace(self.lens, box=box)
        return replace(self, near=near, far=torch.maximum(far, near), lens=lens)

    def through(self, points: Float[Tensor, "n k 4"]) -> Rays:
        """Return the n k rays through points of the lens, each for a pixel of the window to what it has in focus.

        They are clipped to the same box.

        A movement of the background point is seen as S has it, whatever ray it was that moved it in its plane:

            s_b' = n . (X_0' - L) / n . t',      S' = S - S t' n^T / (n . t')

        Parameters
        ----------
        points : of the lens, in shares of its radius, and of the window, in shares of half its edge (`spread_points`)

        Raises
        ------
        InputError
            If the rays pass no lens.
        """
        if self.lens is None:
            raise InputError("expected rays through a lens, got thin ones", field="aperture_diameter")
        each, ends, shift = points.shape[1], self.background, self.lens.points(points[..., :2])
        start, toward, reach = self._of_window(points[..., 2:])
        # of either sign: a telecentric camera's z_cam = 0 may be behind what is in focus
        direction = torch.nn.functional.normalize(toward - shift / (self.lens.focus[:, None, None] * reach), dim=-1)
        whole = replace(self, lens=None, background=None).each(lambda x: x.repeat_interleave(each, dim=0))
        if ends is not None:
            normal = self.lens.normal[:, None]
            along = (direction * normal).sum(-1)
            to_plane = ends.distance[:, None, None] * reach * toward - shift
            # written out, since a matrix product may be of reduced precision
            seen = (direction[:, :, None] * ends.sensitivity[:, None]).sum(-1)
            sensitivity = ends.sensitivity[:, None] - seen[..., None] * (normal / along[..., None])[:, :, None]
            distance = (to_plane * normal).sum(-1) / along
            ends = BackgroundPoints(sensitivity.flatten(0, 1), distance.flatten(0, 1))
        origin = (self.origin[:, None] + start + shift).flatten(0, 1)
        whole = replace(whole, origin=origin, direction=direction.flatten(0, 1), background=ends)
        return whole if self.lens.box is None else whole.clip(self.lens.box)

    def spread(self, each: int, generator: torch.Generator | None = None) -> Rays:
        """Return so many rays for each, evenly through its lens and over its window (`through`).

        Parameters
        ----------
        generator : of where they are; None for the same places every time
        """
        points = spread_points(len(self), each, generator).to(self.near.dtype)
        return self.through(sent(points, self.near.device))

    def _of_window(
        self, square: Float[Tensor, "n k 2"]
    ) -> tuple[
        Float[
            Tensor,
            (
                n  # k 3
            ),
        ],
        Float[
            Tensor,
            (
                n  # k 3
            ),
        ],
        Float[
            Tensor,
            (
                n  # k 1
            ),
        ],
    ]:
        """Where thin rays of other pixels start, mm from the origin, their directions, and how far off they end.

        The last is a share of the path length of the ray in the middle.
        """
        toward, nowhere = self.direction[:, None], torch.zeros_like(self.direction[:, None])
        if self.lens is None or self.background is None or not bool(self.lens.window.any()):
            return nowhere, toward, torch.ones_like(toward[..., :1])
        ends, parallel = self.background, self.lens.parallel[:, None, None]
        aside = self.lens.shifts(square, ends.sensitivity, self.direction)
        along, length = (aside * toward).sum(-1, keepdim=True), ends.distance[:, None, None]
        end = length * toward + aside
        reach = torch.where(parallel, length + along, end.norm(dim=-1, keepdim=True))
        start = torch.where(parallel, aside - along * toward, 0.0)
        return start, torch.where(parallel, toward, end / reach), reach / length

    def half_width(self, s: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Return half the width (mm) of what the pixels of rays gather light from at path lengths s, mm."""
        if self.lens is None:
            return torch.zeros_like(s)
        cone = self.lens.radius * (1 - s / self.lens.focus)
        if self.background is None:
            return cone.abs()
        share = torch.where(self.lens.parallel, 1.0, s / self.background.distance)
        window = self.lens.window / torch.linalg.matrix_norm(self.background.sensitivity, 2).clamp_min(1e-12) * share
        return torch.hypot(cone, window)

    def mean_of(self, each: int, seen: Float[Tensor, "m c"]) -> Float[Tensor, "n c"]:
        """Return the mean of what the rays of a pixel see; one that a background ends before the box carries no light.

        Parameters
        ----------
        each : rays of a pixel, which follow one another (`through`)
        seen : of all of them
        """
        return (seen * self.shares(each)[:, None]).unflatten(0, (-1, each)).sum(dim=1)

    def shares(self, each: int) -> Float[Tensor, " m"]:
        """Return the share that each ray has in the mean of its pixel, which has so many."""
        if self.background is None:
            return torch.full_like(self.near, 1 / each)
        carries = (~self.crosses | self.unobstructed).to(self.near).unflatten(0, (-1, each))
        return (carries / carries.sum(dim=1, keepdim=True).clamp_min(1)).flatten()

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
