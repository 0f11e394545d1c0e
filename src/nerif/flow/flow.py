"""Velocity and pressure of a film."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from nerif.geometry import Grid

__all__ = ["Flow", "FlowDeviations"]


@dataclass(frozen=True)
class FlowDeviations:
    """Standard deviations of velocity and pressure, on a grid of their own."""

    grid: Grid  #: voxels, mm
    velocity: Float[Tensor, "t 3 z y x"]  #: of the components, mm/s
    pressure: Float[Tensor, "t z y x"] | None  #: mm^2/s^2; None: not determined by the physics


@dataclass(frozen=True)
class Flow:
    """Velocity and pressure on a grid at the instants of a film."""

    grid: Grid  #: voxels, mm
    velocity: Float[Tensor, "t 3 z y x"]  #: along x, y, z, mm/s
    pressure: Float[Tensor, "t z y x"] | None
    """Over the reference density, up to a constant, mm^2/s^2; None: not determined by the physics."""
    transport: Float[Tensor, "k z y x"]  #: residual of the transport of theta in each interval, 1/s
    momentum: Float[Tensor, "k 3 z y x"] | None
    """Change of momentum that the equations do not explain in each interval, mm/s^2; None as above."""
    determined: Bool[Tensor, "t z y x"]  #: voxels in which the density is carried, so that the velocity is known
    misfit: float  #: rms of residual / sigma
    unexplained: float | None = None
    """Rms of `momentum` over that of the acceleration of the fluid, in `determined`; None as above."""
    theta: Float[Tensor, "t z y x"] | None = None  #: of the film, if it was improved
    deviations: FlowDeviations | None = None  #: of velocity and pressure, if computed
    falling: bool = False  #: whether the residual was still falling when the fit ended
    iterations: int = 0  #: of the fit
    seconds: float = 0.0  #: of the fit
