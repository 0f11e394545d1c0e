"""Velocity and pressure of a film."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from nerif.geometry import Grid

__all__ = ["Flow", "FlowDeviations"]


@dataclass(frozen=True)
class FlowDeviations:
    """Standard deviations of velocity and pressure, on a grid of their own.

    Parameters
    ----------
    grid : voxels, mm
    velocity : of the components, mm/s
    pressure : mm^2/s^2; None: not determined by the physics
    """

    grid: Grid
    velocity: Float[Tensor, "t 3 z y x"]
    pressure: Float[Tensor, "t z y x"] | None


@dataclass(frozen=True)
class Flow:
    """Velocity and pressure on a grid at the instants of a film.

    Parameters
    ----------
    grid : voxels, mm
    velocity : along x, y, z, mm/s
    pressure : over the reference density, up to a constant, mm^2/s^2; None: not determined by the physics
    transport : residual of the transport of theta in each interval, 1/s
    momentum : change of momentum that the equations do not explain in each interval, mm/s^2; None as above
    determined : voxels in which the density is carried, so that the velocity is known
    misfit : rms of residual / sigma
    unexplained : rms of `momentum` over that of the acceleration of the fluid, in `determined`; None as above
    theta : of the film, if it was improved
    deviations : of velocity and pressure, if computed
    falling : whether the residual was still falling when the fit ended
    iterations, seconds : of the fit
    """

    grid: Grid
    velocity: Float[Tensor, "t 3 z y x"]
    pressure: Float[Tensor, "t z y x"] | None
    transport: Float[Tensor, "k z y x"]
    momentum: Float[Tensor, "k 3 z y x"] | None
    determined: Bool[Tensor, "t z y x"]
    misfit: float
    unexplained: float | None = None
    theta: Float[Tensor, "t z y x"] | None = None
    deviations: FlowDeviations | None = None
    falling: bool = False
    iterations: int = 0
    seconds: float = 0.0
