"""Rays: the input of a path integral, without reference to cameras.

A ray is traced back from a pixel to a background at path length s_b. Refraction by dn at path length s shifts its end
by (s_b - s) dn / n, and the sensitivity S (2 x 3, px/mm) converts this shift into pixels:

    d = integral (s_b - s) S grad(n) / n ds
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int16
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.transfer import constant, to_device
from nerif.geometry.grid import Box
from nerif.geometry.lens import Columns, LensDiscs, spread_points

__all__ = ["BackgroundPoints", "Rays"]


@dataclass(frozen=True)
class BackgroundPoints(Columns):
    """Ends of rays on a background, and the sensitivity of the image to shifts there."""

    sensitivity: Float[Tensor, "n 2 3"]  #: S = -d project / d X at the background point, px/mm; S . direction = 0
    distance: Float[Tensor, " n"]  #: path length s_b from the ray's origin to the background, mm


@dataclass(frozen=True)
class Rays(Columns):
    """Back-traced rays, in the world frame."""

    origin: Float[Tensor, "n 3"]  #: camera centre, mm; of a telecentric camera the ray's point on the plane z_cam = 0
    direction: Float[Tensor, "n 3"]  #: unit vector, away from the camera
    near: Float[Tensor, " n"]  #: path length at which the ray enters the box, mm
    far: Float[Tensor, " n"]  #: at which it leaves the box; far <= near for a ray that misses it
    pixel: Float[Tensor, "n 2"]  #: column and row, px
    view: Int16[Tensor, " n"]  #: index of the view
    begin: Float[Tensor, " n"]  #: path length at which the ray begins, mm: 0, or -inf for a telecentric camera
    background: BackgroundPoints | None = None  #: its ends on the background, or None
    lens: LensDiscs | None = None  #: the lens about each ray, and the window of its pixel; None for thin rays

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
        """Join one or more parts, at most `most` rays, in single precision, with at most one part in memory twice."""
        whole, count = None, 0

        def put(target: Tensor, column: Tensor) -> Tensor:
            target[count : count + len(column)] = column
            return target

        for part in parts:
            part = part.to(dtype=torch.float32)
            if whole is None:
                whole = part.each(lambda x: torch.empty(most, *x.shape[1:], dtype=x.dtype))
            whole.each(put, part)
            count += len(part)
        assert whole is not None, "expected at least one part"
        return whole[:count]

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Rays:
        """Return the rays on another device or in another precision."""
        return self.each(lambda x: x.to(device=device, dtype=dtype if x.is_floating_point() else None))

    @property
    def crosses(self) -> Bool[Tensor, " n"]:
        """Whether rays cross the box to which they were clipped."""
        return self.far > self.near

    @property
    def unobstructed(self) -> Bool[Tensor, " n"]:
        """Whether rays cross the box, entirely in front of their background if they have one."""
        return self.crosses if self.background is None else self.crosses & (self.background.distance > self.far)

    @property
    def ends(self) -> BackgroundPoints:
        """Ends on the background, which has to be there."""
        if self.background is None:
            raise InputError("expected cameras with a background, got some without; name its plane", field="background")
        return self.background

    @property
    def end_points(self) -> Float[Tensor, "n 3"]:
        """Points of the background at which the straight rays end, mm."""
        return self.origin + self.ends.distance[:, None] * self.direction

    def at(self, s: Float[Tensor, "n m"]) -> Float[Tensor, "n m 3"]:
        """Return points at path lengths s (mm), mm."""
        return self.origin[:, None, :] + s[..., None] * self.direction[:, None, :]

    def clip(self, box: Box) -> Rays:
        """Return the rays with near and far at their intersections with the box (slab method)."""
        lower, upper = constant(box.lower, self.origin), constant(box.upper, self.origin)
        # a ray along a face divides 0 by 0: perturb the direction, not the result
        direction = torch.where(self.direction.abs() < 1e-12, torch.full_like(self.direction, 1e-12), self.direction)
        a, b = (lower - self.origin) / direction, (upper - self.origin) / direction
        near = torch.minimum(a, b).amax(dim=-1).maximum(self.begin)
        far = torch.maximum(a, b).amin(dim=-1)
        lens = None if self.lens is None else replace(self.lens, box=box)
        return replace(self, near=near, far=torch.maximum(far, near), lens=lens)

    def through(self, points: Float[Tensor, "n k 4"]) -> Rays:
        """Return the n k rays through points of the lens, each towards the plane in focus of a pixel of the window.

        They are clipped to the same box. With the origin L, direction t', end X_0' and the background's normal n,

            s_b' = n . (X_0' - L) / n . t',      S' = S - S t' n^T / (n . t')

        Parameters
        ----------
        points : of the lens over its radius, and of the window over half its edge (`spread_points`)
        """
        if self.lens is None:
            raise InputError("expected rays through a lens, got thin ones", field="aperture_diameter")
        each, ends, shift = points.shape[1], self.background, self.lens.points(points[..., :2])
        start, toward, reach = self._of_window(points[..., 2:])
        # of either sign: a telecentric camera's z_cam = 0 may be behind the plane in focus
        direction = torch.nn.functional.normalize(toward - shift / (self.lens.focus[:, None, None] * reach), dim=-1)
        whole = replace(self, lens=None, background=None).each(lambda x: x.repeat_interleave(each, dim=0))
        if ends is not None:
            normal = self.lens.normal[:, None]
            along = (direction * normal).sum(-1)
            to_plane = ends.distance[:, None, None] * reach * toward - shift
            # written out, since a matrix product may be of reduced precision
            along_ray = (direction[:, :, None] * ends.sensitivity[:, None]).sum(-1)
            sensitivity = ends.sensitivity[:, None] - along_ray[..., None] * (normal / along[..., None])[:, :, None]
            distance = (to_plane * normal).sum(-1) / along
            ends = BackgroundPoints(sensitivity.flatten(0, 1), distance.flatten(0, 1))
        origin = (self.origin[:, None] + start + shift).flatten(0, 1)
        whole = replace(whole, origin=origin, direction=direction.flatten(0, 1), background=ends)
        return whole if self.lens.box is None else whole.clip(self.lens.box)

    def spread(self, each: int, generator: torch.Generator | None = None) -> Rays:
        """Return `each` rays per ray, evenly over its lens and its window (`through`).

        Parameters
        ----------
        generator : of their places; None: the same places in each call
        """
        points = spread_points(len(self), each, generator).to(self.near.dtype)
        return self.through(to_device(points, self.near.device))

    def _of_window(
        self, square: Float[Tensor, "n k 2"]
    ) -> tuple[Float[Tensor, "n _ 3"], Float[Tensor, "n _ 3"], Float[Tensor, "n _ 1"]]:
        """Starts of the thin rays of other pixels, mm from the origin, their directions and their relative lengths."""
        toward, zero = self.direction[:, None], torch.zeros_like(self.direction[:, None])
        if self.lens is None or self.background is None or not bool(self.lens.window.any()):
            return zero, toward, torch.ones_like(toward[..., :1])
        ends, parallel = self.background, self.lens.parallel[:, None, None]
        aside = self.lens.shifts(square, ends.sensitivity, self.direction)
        along, length = (aside * toward).sum(-1, keepdim=True), ends.distance[:, None, None]
        end = length * toward + aside
        reach = torch.where(parallel, length + along, end.norm(dim=-1, keepdim=True))
        start = torch.where(parallel, aside - along * toward, 0.0)
        return start, torch.where(parallel, toward, end / reach), reach / length

    def half_width(self, s: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Return half the width (mm) of the ray bundles of pixels at path lengths s, mm."""
        if self.lens is None:
            return torch.zeros_like(s)
        cone = self.lens.radius * (1 - s / self.lens.focus)
        if self.background is None:
            return cone.abs()
        share = torch.where(self.lens.parallel, 1.0, s / self.background.distance)
        window = self.lens.window / torch.linalg.matrix_norm(self.background.sensitivity, 2).clamp_min(1e-12) * share
        return torch.hypot(cone, window)

    def mean_of(self, each: int, values: Float[Tensor, "m c"]) -> Float[Tensor, "n c"]:
        """Return the mean over each pixel of the values of its `each` consecutive rays (`through`)."""
        return (values * self.shares(each)[:, None]).unflatten(0, (-1, each)).sum(dim=1)

    def shares(self, each: int) -> Float[Tensor, " m"]:
        """Return the weight of each ray in the mean of its pixel: 0 if the background ends it before the box."""
        if self.background is None:
            return torch.full_like(self.near, 1 / each)
        carries = (~self.crosses | self.unobstructed).to(self.near).unflatten(0, (-1, each))
        return (carries / carries.sum(dim=1, keepdim=True).clamp_min(1)).flatten()

    def exit_faces(self, box: Box, faces: Sequence[str]) -> Bool[Tensor, " n"]:
        """Return which rays enter or leave the box through one of the named faces."""
        hit = torch.zeros(len(self), dtype=torch.bool, device=self.origin.device)
        tolerance = 1e-4 * min(box.edges)
        for s in (self.near, self.far):
            point = self.origin + s[:, None] * self.direction
            for face in faces:
                axis, corner = "xyz".index(face[0]), (box.lower if face[1] == "-" else box.upper)
                hit |= (point[:, axis] - corner[axis]).abs() < tolerance
        return hit & self.crosses
