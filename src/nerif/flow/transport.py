"""The residual of the transport equation of a scalar, for a given velocity.

    r = theta_(k+1)(x + u dt / 2) - theta_k(x - u dt / 2) - dt (Dtheta/Dt)

on the voxels of the film, then averaged over those of the velocity: an equation holds for averages where waves shorter
than a few voxels are not resolved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerif.fields.voxel_field import VoxelField
from nerif.flow.frame_resampling import along_axes, averages, interpolations, smooth
from nerif.flow.interpolation import fixed_splines
from nerif.flow.periodic_box import PeriodicBox
from nerif.geometry import Grid

__all__ = ["Path", "Transport"]

LEAST = 0.01  # of the largest theta: below, nothing visible is carried
VISIBLE = 2.0  # standard deviations of the noise: below, the scalar is not visible
STRONG = 0.05  # of the largest theta
REACH = 5  # voxels around the scalar at which the residual is evaluated
MODEL_ERROR = 0.03  # of the local change of theta per interval, that velocities on a grid leave
ROUNDING = 3.5e-4  # of the largest theta
BISECTIONS = 20


@dataclass(frozen=True)
class Path:
    """Paths of fluid over an interval that begin and end in the box."""

    place: Int[Tensor, n]  #: voxel halfway, of all in the volume
    inside: Bool[Tensor, m]  #: which of the points of the interval have such a path
    start: Float[Tensor, "n 3"]  #: x, y, z in voxels from the second layer beyond the faces
    end: Float[Tensor, "n 3"]  #: in the same unit


class Transport:
    """The residual of transport between the instants of a film.

    Parameters
    ----------
    theta : scalar at the instants
    grid : its voxels
    times : s
    rate : change of theta along the path of the fluid at the instants, 1/s
    box : grid of the velocity
    noise : standard deviation of theta, averaged over voxels of the velocity
    """

    def __init__(
        self, theta: Float[Tensor, "t z y x"], grid: Grid, times: Sequence[float], rate: Float[Tensor, "t z y x"],
        box: PeriodicBox, noise: float = 0.0,
    ) -> None:  # fmt: skip
        self.grid, self.box = grid, box
        self.intervals = torch.tensor(times, dtype=torch.float64).diff().float()
        self._down = averages(grid, box.grid)
        self._up = interpolations(box.grid, grid, box.shape, box.first)
        self.fields = [VoxelField.through(volume, grid) for volume in theta]
        gain = self.intervals[:, None, None, None] * 0.5 * (rate[1:] + rate[:-1])
        centres, largest = grid.points().reshape(-1, 3), float(theta.abs().max())
        self.places, self.points, self.gains = [], [], []
        pool = torch.nn.functional.max_pool3d
        for k in range(len(self.intervals)):
            strength = torch.maximum(theta[k].abs(), theta[k + 1].abs())[None]
            near = pool(strength, 2 * REACH + 1, stride=1, padding=REACH)[0] > LEAST * largest
            place = near.reshape(-1).nonzero()[:, 0]
            self.places.append(place)
            self.points.append(centres[place])
            self.gains.append(gain[k].reshape(-1)[place])
        strength = self.coarse(theta).abs()
        self._carried = smooth(strength, (1.0, 1.0, 1.0)) > max(LEAST * largest, VISIBLE * noise)
        strong = strength > STRONG * largest
        self.core = strong[1:] | strong[:-1]
        """Voxels of the velocity in which much of the scalar is, of each interval: those of the misfit."""
        self.change, self._largest = theta[1:] - theta[:-1], largest
        self._local = smooth(self.coarse(self.change).square(), (2.0, 2.0, 2.0)).clamp_min(0)
        self._least = torch.tensor(2 * noise**2 + (ROUNDING * largest) ** 2)  # a difference of two frames
        self._noise = self._least
        """Variance of the residual by the noise of the densities."""

    def coarse(self, values: Float[Tensor, "*t z y x"]) -> Float[Tensor, "*t z2 y2 x2"]:
        """Return averages over the voxels of the velocity."""
        return along_axes(values, self._down)

    @property
    def deviation(self) -> Float[Tensor, "t z y x"]:
        """Standard deviation of the residual."""
        return (self._noise + MODEL_ERROR**2 * self._local).sqrt()

    def weigh(self, residual: Float[Tensor, "t z y x"]) -> None:
        """Estimate the noise of the densities from a residual.

        An error of one frame enters the residuals before and after it with opposite signs, so that their covariance is
        minus its variance; what the velocity does not explain yet has the same sign in both. Noise above that of the
        ambient fluid, or that of the place, is taken to grow with the local change of density: by as much as makes the
        misfit of noise alone 1.
        """
        variance = -2 * residual[1:] * residual[:-1]
        by_place = self.box.noise_by_place(variance.mean(dim=0)).maximum(self._least)
        core = self.core[1:] & self.core[:-1]
        local = 0.5 * (self._local[1:] + self._local[:-1])
        low, high = 0.0, float(variance[core].abs().sum() / local[core].sum().clamp_min(1e-30))
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            if float((variance / (by_place + middle * local))[core].mean()) > 1:
                low = middle
            else:
                high = middle
        self._noise = by_place + low * self._local

    def sample(self, generator: torch.Generator) -> Float[Tensor, "t z y x"]:
        """Return a residual of noise: that of the frames, white on their voxels, and that of the equations."""
        white = self.box.white((2 * len(self.intervals) + 1, *self.grid.shape), False, generator)
        averages = self.coarse(white)
        averages = averages / averages.square().mean().sqrt()
        frames, equations = averages.tensor_split([len(self.intervals) + 1])
        return (0.5 * self._noise).sqrt() * frames.diff(dim=0) + MODEL_ERROR * self._local.sqrt() * equations

    @cached_property
    def region(self) -> Bool[Tensor, "t z y x"]:
        """Voxels of the velocity in which the scalar is carried, of each interval: it is there, above its noise."""
        return self._carried[1:] | self._carried[:-1]

    def residual(self, splines: Float[Tensor, "t 3 zp yp xp"]) -> Float[Tensor, "t z y x"]:
        """Return the residual of every interval for spline coefficients of the velocity at the instants, mm/s."""
        after, before, inside = self._ends(splines)
        values = fixed_splines([*self.fields[1:], *self.fields[:-1]], [*after, *before])
        residuals, count = [], len(after)
        for k, (place, gain) in enumerate(zip(self.places, self.gains, strict=True)):
            residual = torch.zeros(self.grid.shape).reshape(-1)
            change = (values[k] - values[count + k] - gain) * inside[k]
            residuals.append(residual.index_put((place,), change).reshape(self.grid.shape))
        return self.coarse(torch.stack(residuals))

    def paths(self, splines: Float[Tensor, "t 3 zp yp xp"]) -> list[Path]:
        """Return the paths of every interval, of velocities as for `residual`."""
        lower, spacing = torch.tensor(self.grid.box.lower), torch.tensor(self.grid.spacing)
        paths = []
        for place, after, before, inside in zip(self.places, *self._ends(splines), strict=True):
            start, end = ((points[inside] - lower) / spacing + 1.5 for points in (before, after))
            paths.append(Path(place[inside], inside, start.contiguous(), end.contiguous()))
        return paths

    def unresolved(self, share: float, least: float) -> Float[Tensor, "t z y x"]:
        """Return a standard deviation of the residual on single voxels, of every interval.

        Parameters
        ----------
        share : of the local change of theta
        least : of the largest theta
        """
        local = smooth(self.change.square(), (2.0, 2.0, 2.0)).clamp_min(0)
        return (share**2 * local + (least * self._largest) ** 2).sqrt()

    def _ends(self, splines: Tensor) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        """Points of each interval half of it later and earlier, mm, and whether both are in the box."""
        velocity = along_axes(0.5 * (splines[1:] + splines[:-1]), self._up)
        lower, upper = (torch.tensor(corner) for corner in (self.grid.box.lower, self.grid.box.upper))
        halves = 0.5 * self.intervals
        steps = [h * u.reshape(3, -1)[:, at].T for h, u, at in zip(halves, velocity.unbind(), self.places, strict=True)]
        after = [points + step for points, step in zip(self.points, steps, strict=True)]
        before = [points - step for points, step in zip(self.points, steps, strict=True)]
        inside = [
            ((a > lower) & (a < upper) & (b > lower) & (b < upper)).all(dim=1)
            for a, b in zip(after, before, strict=True)
        ]
        return after, before, inside
