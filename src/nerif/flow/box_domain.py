"""The domain of a velocity computation: the whole box, or the meridional plane of an axisymmetric flow.

An axisymmetric flow without swirl is known from one plane through its axis, (r, z).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from typing import TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import FACES, InputError
from nerif.fields.voxel_field import VoxelField
from nerif.flow.axisymmetric_box import AxisymmetricBox
from nerif.flow.periodic_box import PeriodicBox
from nerif.flow.velocity_settings import VelocitySettings
from nerif.geometry import Box, Grid
from nerif.geometry.symmetry import Symmetry

__all__ = ["BoxDomain", "MeridionalPlane", "section_of"]

AZIMUTHS = 8  # over which densities are averaged
AnySettings = TypeVar("AnySettings", bound=VelocitySettings)

LARGEST_LEAN = 10.0  # degrees between the axis and gravity


class BoxDomain:
    """The whole box of a film."""

    box: type[PeriodicBox] = PeriodicBox
    """Class of the periodic box in which the equations are solved."""

    def __init__(self, film: Grid) -> None:
        self.film = self.grid = film

    def settings(self, settings: AnySettings) -> AnySettings:
        """Return settings in the coordinates of the section."""
        return settings

    def of(self, volumes: Float[Tensor, "t z y x"]) -> Float[Tensor, "t z2 y2 x2"]:
        """Return scalars in the section."""
        return volumes

    def scalar(self, values: Float[Tensor, "z2 y2 x2"], grid: Grid) -> Float[Tensor, "z y x"]:
        """Return a scalar on the grid of the film, from values on a grid of the section."""
        return VoxelField.through(values, grid).sample(self.film)

    def vector(self, values: Float[Tensor, "3 z2 y2 x2"], grid: Grid) -> Float[Tensor, "3 z y x"]:
        """Return vectors along x, y, z on the grid of the film."""
        return torch.stack([self.scalar(component, grid) for component in values])

    def deviation(self, values: Float[Tensor, "3 z2 y2 x2"], grid: Grid) -> Float[Tensor, "3 z y x"]:
        """Return standard deviations of vectors, of independent components."""
        return self.vector(values, grid)

    def mask(self, values: Bool[Tensor, "z2 y2 x2"], grid: Grid) -> Bool[Tensor, "z y x"]:
        """Return the mask of the nearest voxels; False beyond the section."""
        size = self.film.shape
        return torch.nn.functional.interpolate(values.float()[None, None], size, mode="nearest-exact")[0, 0] > 0.5


class MeridionalPlane(BoxDomain):
    """The plane through an axis of symmetry: x the distance from the axis, of either sign, z along it.

    It extends to the nearest face around the point of the axis, and as far as the axis itself is in the box. Values in
    space beyond it are NaN.
    """

    box = AxisymmetricBox

    def __init__(self, film: Grid, symmetry: Symmetry) -> None:
        super().__init__(film)
        self.symmetry = symmetry
        radius = symmetry.reduced_box(film.box, FACES).upper[0]
        low, high = self._ends()
        size = min(film.spacing)
        box = Box((-radius, -0.5 * size, low), (radius, 0.5 * size, high))
        self.grid = Grid(box, (max(1, round((high - low) / size)), 1, 2 * max(1, round(radius / size))))

    def settings(self, settings: AnySettings) -> AnySettings:
        gravity, axis = (torch.tensor(v, dtype=torch.float64) for v in (settings.gravity, self.symmetry.direction))
        along, size = float(gravity @ axis), float(gravity.norm())
        lean = math.degrees(math.acos(min(1.0, abs(along) / size))) if size > 0 else 0.0
        if settings.physics != "transport" and lean > LARGEST_LEAN:
            raise InputError(
                f"expected the axis of the flow along it, within {LARGEST_LEAN:.0f} degrees, got {lean:.0f}: such a "
                "flow is not axisymmetric; give the gravity of the experiment, or --physics transport",
                field="gravity",
            )
        return replace(settings, gravity=(0.0, 0.0, along))

    def of(self, volumes: Float[Tensor, "t z y x"]) -> Float[Tensor, "t z2 y2 x2"]:
        """Return means over the azimuths that are in the box."""
        r, _, h = self.grid.points(torch.float64)[:, :, self.grid.shape[2] // 2 :].unbind(-1)
        angle = (2 * math.pi / AZIMUTHS) * torch.arange(AZIMUTHS, dtype=torch.float64)[:, None, None, None]
        points = self.symmetry.places(r.expand(AZIMUTHS, *r.shape), angle, h.expand(AZIMUTHS, *r.shape)).float()
        lower, upper = (torch.tensor(corner) for corner in (self.film.box.lower, self.film.box.upper))
        weights = ((points >= lower) & (points <= upper)).all(dim=-1).float().clamp_min(1e-6)
        halves = []
        for volume in volumes:
            values = VoxelField.through(volume, self.film)(points.clamp(lower, upper))
            halves.append((weights * values).sum(dim=0) / weights.sum(dim=0))
        half = torch.stack(halves)
        return torch.cat([half.flip(-1), half], dim=-1)

    def scalar(self, values: Float[Tensor, "z2 y2 x2"], grid: Grid) -> Float[Tensor, "z y x"]:
        return VoxelField.through(values, grid)(self._places).masked_fill(~self._inside, math.nan)

    def vector(self, values: Float[Tensor, "3 z2 y2 x2"], grid: Grid) -> Float[Tensor, "3 z y x"]:
        radial, along = self._directions
        return radial * self.scalar(values[0], grid) + along * self.scalar(values[2], grid)

    def deviation(self, values: Float[Tensor, "3 z2 y2 x2"], grid: Grid) -> Float[Tensor, "3 z y x"]:
        radial, along = self._directions
        parts = (radial * self.scalar(values[0], grid)).square() + (along * self.scalar(values[2], grid)).square()
        return parts.sqrt()

    def mask(self, values: Bool[Tensor, "z2 y2 x2"], grid: Grid) -> Bool[Tensor, "z y x"]:
        cell = ((self._places - torch.tensor(grid.box.lower)) / torch.tensor(grid.spacing)).floor().long()
        x, y, z = cell.clamp_min(0).minimum(torch.tensor(grid.shape[::-1]) - 1).unbind(-1)
        return values[z, y, x] & self._inside

    def _ends(self) -> tuple[float, float]:
        """Where the axis enters and leaves the box, mm from its point."""
        ends = [-math.inf, math.inf]
        for p, e, a, b in zip(
            self.symmetry.point, self.symmetry.direction, self.film.box.lower, self.film.box.upper, strict=True
        ):
            if abs(e) > 1e-9:
                low, high = sorted(((a - p) / e, (b - p) / e))
                ends = [max(ends[0], low), min(ends[1], high)]
        return ends[0], ends[1]

    @cached_property
    def _places(self) -> Float[Tensor, "z y x 3"]:
        """(r, 0, h) of the voxels of the film."""
        return self.symmetry.reduced(self.film.points())

    @cached_property
    def _inside(self) -> Bool[Tensor, "z y x"]:
        """Voxels of the film in the section."""
        r, _, h = self._places.unbind(-1)
        box = self.grid.box
        return (r <= box.upper[0]) & (h >= box.lower[2]) & (h <= box.upper[2])

    @cached_property
    def _directions(self) -> tuple[Float[Tensor, "3 z y x"], Float[Tensor, "3 1 1 1"]]:
        """Unit vectors away from the axis, and along it."""
        w = self.symmetry.local(self.film.points(torch.float64))
        frame = self.symmetry.matrix
        away = w[..., :2] @ frame[:2]
        radial = away / away.norm(dim=-1, keepdim=True).clamp_min(self.symmetry.rounding)
        return radial.movedim(-1, 0).float(), frame[2].float()[:, None, None, None]


def section_of(film: Grid, symmetry: Symmetry | None) -> BoxDomain:
    """Return the plane of an axisymmetric flow, the whole box of others."""
    if symmetry is not None and symmetry.axial and symmetry.harmonics == 0:
        return MeridionalPlane(film, symmetry)
    return BoxDomain(film)
