"""Settings of the velocity of a film."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Lt

from nerif.common.settings import Checked, Count, Natural, NonNegative, Positive

__all__ = ["MIN_VOXELS", "PHYSICS", "VelocitySettings"]

PHYSICS = ("boussinesq", "low-mach", "transport")
MIN_VOXELS = 8  # along the longest edge of the velocity


@dataclass(frozen=True)
class VelocitySettings(Checked):
    """Settings of the velocity of a film."""

    physics: Literal[*PHYSICS] = "boussinesq"  # type: ignore[valid-type]
    """Equations: boussinesq (nearly uniform density), low-mach (hot gas), or transport (no equation of momentum)."""
    viscosity: Positive = 15.0
    """Kinematic viscosity, mm^2/s."""
    diffusivity: Positive = 20.0
    """Diffusivity of density (heat or species), mm^2/s."""
    gravity: tuple[float, float, float] = (0.0, 0.0, -9810.0)
    """Acceleration of gravity along x, y, z, mm/s^2."""
    resolution: Annotated[int, Ge(MIN_VOXELS)] = 30
    """Voxels of the velocity along the longest edge of the box."""
    time_limit: NonNegative = 600.0
    """Limit on the duration, s (0: none)."""
    max_iterations: Count = 300
    """Iterations of each stage at most."""
    density_noise: Annotated[float, Ge(0), Lt(math.inf)] = 0.0
    """Standard deviation of density / reference density, averaged over a voxel of the velocity (0: from the film)."""
    forcing: Annotated[float, Gt(0), Lt(1)] = 0.05
    """Change of vorticity per interval that the equations do not explain, relative to its largest value."""
    correlation: Positive = 20.0
    """Wavelength below which the vorticity is expected to be smaller, mm."""
    samples: Natural = 6
    """Samples of the flow, from which standard deviations are computed (0: none)."""
    sample_iterations: Count = 40
    """Iterations of each sample."""
