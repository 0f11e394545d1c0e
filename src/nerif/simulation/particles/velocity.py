"""Velocity of particles between two volumes, by window correlation in 3-D (imaging/displacement/correlation.py)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.volume import Volume
from nerif.imaging.displacement.correlation import correlate

__all__ = ["Velocity", "velocity_between"]


@dataclass(frozen=True)
class Velocity:
    """Displacement of particles at the nodes of a grid over a time.

    Parameters
    ----------
    points : nodes, the centres of the windows, mm
    displacement : along x, y, z, mm; NaN where not valid
    seconds : between the two instants
    """

    points: Float[Tensor, "z y x 3"]
    displacement: Float[Tensor, "z y x 3"]
    seconds: float

    @property
    def values(self) -> Float[Tensor, "z y x 3"]:
        """Velocity along x, y, z, mm/s; NaN where not valid."""
        return self.displacement / self.seconds

    @property
    def valid(self) -> Bool[Tensor, "z y x"]:
        """Nodes with a vector."""
        return self.displacement.isfinite().all(dim=-1)

    def rms_error(self, truth: Float[Tensor, "z y x 3"]) -> float:
        """Return the rms error of the displacement, mm, over components of valid vectors; truth in mm/s."""
        difference = (self.displacement - truth.to(self.displacement) * self.seconds)[self.valid]
        return float(difference.square().mean().sqrt())


def velocity_between(first: Volume, second: Volume, seconds: float, window: int = 32, passes: int = 4) -> Velocity:
    """Return the velocity of particles in two volumes halfway between their instants, to second order in time.

    Parameters
    ----------
    first, second : on one grid of cubic voxels
    seconds : between them
    window : edge of the windows, voxels; they overlap by three quarters
    passes : number of passes, in each of which both volumes are warped by half of the displacement so far

    Source: Elsinga, Scarano, Wieneke & van Oudheusden, Exp. Fluids 41 (2006) 933, Sec. 2.4; Scarano & Riethmuller, Exp.
    Fluids 29 (2000) S51, for the central scheme.
    """
    grid = first.grid
    if grid != second.grid:
        raise InputError(f"expected the grid of the first volume, {grid}, got {second.grid}", field="second")
    if not seconds > 0:
        raise InputError(f"expected a time above 0, got {seconds}", field="seconds")
    spacing = torch.tensor(grid.spacing, dtype=torch.float64)
    if not float(spacing.max()) < 1.05 * float(spacing.min()):
        raise InputError(f"expected cubic voxels, got edges of {grid.spacing} mm", field="grid")
    start, end = (volume.values.float().cpu().numpy() for volume in (first, second))
    vectors = correlate(start, end, window, passes, central=True)
    movement = torch.from_numpy(vectors.movement).double()
    movement[~torch.from_numpy(vectors.valid)] = torch.nan
    axes = torch.meshgrid(*(torch.from_numpy(a) for a in vectors.axes), indexing="ij")
    lower = torch.tensor(grid.box.lower, dtype=torch.float64)
    points = lower + (torch.stack(axes[::-1], dim=-1) + 0.5) * spacing
    return Velocity(points, movement * spacing, float(seconds))
