"""The Boussinesq equations of a known density, solved forwards in time.

    du/dt + u . grad u = -grad p + nu lap u - theta g,      div u = 0,      theta = -(rho - rho_0) / rho_0

Semi-Lagrangian, of second order: the fluid that arrives at a node brings its velocity, and half of the force on it,
from where it was, found by the midpoint rule on cubic splines of the velocity halfway in time. Pressure by projection,
viscosity exactly in Fourier space.

Source: Staniforth & Cote, Mon. Weather Rev. 119 (1991) 2206; Chorin, Math. Comput. 22 (1968) 745.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from nerif.reconstruction.velocity.interpolation import periodic_spline
from nerif.reconstruction.velocity.periodic_box import PeriodicBox

__all__ = ["Boussinesq"]

Spectrum = Complex[Tensor, "3 z y xr"]


class Boussinesq:
    """The equations on a periodic box.

    Parameters
    ----------
    box : of the velocity
    viscosity : kinematic, mm^2/s
    gravity : g along x, y, z, mm/s^2
    """

    def __init__(self, box: PeriodicBox, viscosity: float, gravity: tuple[float, float, float]) -> None:
        self.box, self.viscosity = box, viscosity
        self.gravity = torch.tensor(gravity)[:, None, None, None]

    def solve(
        self, start: Spectrum, theta: Float[Tensor, "t z y x"], intervals: Sequence[float],
        changes: Sequence[Spectrum] | None = None,
    ) -> list[Spectrum]:  # fmt: skip
        """Return the spectra of the velocity at all instants, mm/s.

        Parameters
        ----------
        start : at the first instant
        theta : at all instants
        intervals : between them, s
        changes : of the velocity at each later instant, which the equations do not explain
        """
        box, velocities = self.box, [start]
        pressed = self._pressed(start, theta[0])
        buoyancy = box.spline(box.spectrum(theta))
        for k, seconds in enumerate(intervals):
            halfway = velocities[-1]
            if k > 0:
                halfway = halfway + 0.5 * seconds / intervals[k - 1] * (velocities[-1] - velocities[-2])
            brought = box.spline(velocities[-1] - 0.5 * seconds * pressed)
            moved = self._from_before(halfway, torch.cat([brought, buoyancy[k, None]]), seconds)
            force = 0.5 * (moved[3] + theta[k + 1])
            pushed = box.spectrum(moved[:3] - seconds * self.gravity * force)
            velocity = box.solenoidal(pushed)
            pressed = (pushed - velocity) / (0.5 * seconds)
            velocity = velocity * torch.exp(-self.viscosity * seconds * box.wave_square)
            if changes is not None:
                velocity = velocity + changes[k]
            velocities.append(velocity)
        return velocities

    def pressure(self, velocity: Spectrum, theta: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """Return the pressure over the reference density, mm^2/s^2, of mean 0: lap p = -div (u . grad u + theta g)."""
        box = self.box
        force = box.spectrum(self._force(velocity, theta))
        return box.values((box.wave * force).sum(dim=0) * (-1j * box.inverse_square))

    def _pressed(self, velocity: Spectrum, theta: Float[Tensor, "z y x"]) -> Spectrum:
        """Spectrum of the gradient of pressure."""
        force = self.box.spectrum(self._force(velocity, theta))
        return force - self.box.solenoidal(force)

    def _force(self, velocity: Spectrum, theta: Float[Tensor, "z y x"]) -> Float[Tensor, "3 z y x"]:
        """-u . grad u - theta g."""
        box, u = self.box, self.box.values(velocity)
        advection = torch.stack([(u * box.gradient(component)).sum(dim=0) for component in velocity.unbind()])
        return -advection - theta * self.gravity

    def _from_before(
        self, halfway: Spectrum, fields: Float[Tensor, "c z y x"], seconds: float
    ) -> Float[Tensor, "c z y x"]:
        """Return fields (coefficients of splines) at the places from which the fluid comes.

        Parameters
        ----------
        halfway : velocity halfway in time
        """
        box = self.box
        voxels = seconds / torch.tensor(box.spacing[::-1])
        middle = box.nodes - 0.5 * voxels * box.values(halfway).flatten(1).T
        start = box.nodes - voxels * periodic_spline(box.spline(halfway), middle).T
        return periodic_spline(fields, start).reshape(-1, *box.shape)
