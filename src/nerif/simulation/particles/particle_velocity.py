"""Velocity of particles between two volumes, by window correlation in 3-D (imaging/displacement/correlation.py)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.files import atomic
from nerif.data.velocity_sequence import VelocitySequence
from nerif.data.volume import COMPONENTS, Volume
from nerif.geometry import Box, Grid
from nerif.imaging.displacement.correlation import correlate

__all__ = ["VelocityVectors", "velocity_between", "write_velocities"]


@dataclass(frozen=True)
class VelocityVectors:
    """Displacement of particles at the nodes of a grid over a time."""

    points: Float[Tensor, "z y x 3"]  #: nodes, the centres of the windows, mm
    displacement: Float[Tensor, "z y x 3"]  #: along x, y, z, mm; NaN where not valid
    seconds: float  #: between the two instants

    @property
    def values(self) -> Float[Tensor, "z y x 3"]:
        """Velocity along x, y, z, mm/s; NaN where not valid."""
        return self.displacement / self.seconds

    @property
    def grid(self) -> Grid:
        """Voxels about the nodes."""
        nz, ny, nx = self.points.shape[:3]
        if min(nz, ny, nx) < 2:
            raise InputError(
                f"expected two nodes or more along each axis, got {(nz, ny, nx)} (z, y, x)", field="window"
            )
        first, last = self.points[0, 0, 0].double(), self.points[-1, -1, -1].double()
        half = 0.5 * (last - first) / torch.tensor([nx - 1.0, ny - 1.0, nz - 1.0], dtype=torch.float64)
        lower, upper = (first - half).tolist(), (last + half).tolist()
        return Grid(Box(tuple(lower), tuple(upper)), (nz, ny, nx))

    @property
    def valid(self) -> Bool[Tensor, "z y x"]:
        """Nodes with a vector."""
        return self.displacement.isfinite().all(dim=-1)

    def rms_error(self, truth: Float[Tensor, "z y x 3"]) -> float:
        """Return the rms error of the displacement, mm, over components of valid vectors; truth in mm/s."""
        difference = (self.displacement - truth.to(self.displacement) * self.seconds)[self.valid]
        return float(difference.square().mean().sqrt())


def velocity_between(
    first: Volume, second: Volume, seconds: float, window: int = 32, passes: int = 4
) -> VelocityVectors:
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
    return VelocityVectors(points, movement * spacing, float(seconds))


def write_velocities(
    path: str | os.PathLike[str], velocities: Sequence[VelocityVectors], times: Sequence[float], force: bool = False
) -> VelocitySequence:
    """Write velocities over time to a store (.zarr), which movies, exports and the app show.

    Parameters
    ----------
    velocities : on the same nodes
    times : of each, s
    force : overwrite `path`
    """
    path = Path(path)
    if path.exists() and not force:
        raise InputError("exists already and was left as it is; give another path, or force", field=path)
    if len(velocities) != len(times) or not times:
        raise InputError(
            f"expected as many instants as velocities, got {len(times)} and {len(velocities)}", field="times"
        )
    grid = velocities[0].grid
    if any(v.points.shape != velocities[0].points.shape or v.grid != grid for v in velocities):
        raise InputError("expected the same nodes at all instants, got others", field="velocities")
    with atomic(path) as part:
        store = VelocitySequence.begin(part, times, grid, (), {"source": "window correlation of particles"})
        for k, velocity in enumerate(velocities):
            vectors = 1e-3 * velocity.values.movedim(-1, 0)
            store.write_frame(k, dict(zip(COMPONENTS, vectors, strict=True)))
    return VelocitySequence(path)
