"""The Boussinesq equations of a known density, solved forwards in time.

    du/dt + u . grad u = -grad p + nu lap u - theta g,      div u = 0,      theta = -(rho - rho_0) / rho_0

Semi-Lagrangian, of second order: the fluid that arrives at a node brings its velocity, and half of the force on it,
from where it was, found by the midpoint rule on cubic splines of the velocity halfway in time. Viscosity, exactly in
Fourier space, acts on what is brought; the half of the force at arrival follows. Pressure by projection.

The mean velocity of the periodic box is given: what follows from vorticity has none, and the mean of the buoyancy is
balanced by a mean gradient of pressure, as in a closed vessel. In the open, where the air flows back far away, the
margins hold the return flow (decision 061).

Source: Staniforth & Cote, Mon. Weather Rev. 119 (1991) 2206; Chorin, Math. Comput. 22 (1968) 745.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from nerif.flow.interpolation import periodic_spline
from nerif.flow.periodic_box import PeriodicBox
from nerif.geometry import Grid

__all__ = ["Boussinesq", "Spectrum"]

Spectrum = Complex[Tensor, "3 z y xr"]


class Boussinesq:
    """The equations on a periodic box.

    Parameters
    ----------
    box : of the velocity
    viscosity : kinematic, mm^2/s
    diffusivity : of theta, mm^2/s
    gravity : g along x, y, z, mm/s^2
    """

    def __init__(
        self, box: PeriodicBox, viscosity: float, diffusivity: float, gravity: tuple[float, float, float]
    ) -> None:
        self.box, self.viscosity, self.diffusivity = box, viscosity, diffusivity
        self.gravity = torch.tensor(gravity)[:, None, None, None]

    def rate(self, theta: Float[Tensor, "t z y x"], grid: Grid) -> Float[Tensor, "t z y x"]:
        """Return the change of theta along the path of the fluid, 1/s, on the grid of a film: kappa lap theta."""
        return self.diffusivity * self.box.laplacian(theta, grid)

    def solve(
        self, start: Spectrum, theta: Float[Tensor, "t z y x"], intervals: Sequence[float],
        changes: Sequence[Spectrum] | None = None, mean: Float[Tensor, "t 3"] | None = None,
    ) -> list[Spectrum]:  # fmt: skip
        """Return the spectra of the velocity at all instants, mm/s.

        Parameters
        ----------
        start : without divergence, at the first instant
        theta : at all instants
        intervals : between them, s
        changes : of the velocity at each later instant, which the equations do not explain
        mean : velocity at all instants, mm/s; 0 by default
        """
        means = [self.box.uniform(u) for u in (torch.zeros(len(theta), 3) if mean is None else mean)]
        box, velocities = self.box, [start + means[0] + self._expansion(theta[0])]
        pressed = self._pressed(velocities[0], theta[0], (theta[1] - theta[0]) / intervals[0])
        of_buoyancy = box.spectrum(self._buoyancy(theta))
        splines = box.spline(of_buoyancy)
        for k, seconds in enumerate(intervals):
            halfway = velocities[-1]
            if k > 0:
                halfway = halfway + 0.5 * seconds / intervals[k - 1] * (velocities[-1] - velocities[-2])
            brought = box.spline(velocities[-1] - 0.5 * seconds * pressed)
            moved = self._from_before(halfway, torch.cat([brought, splines[k, None]]), seconds)
            half = 0.5 * seconds * self.gravity
            brought = self._diffused(box.spectrum(moved[:3] - half * moved[3]), theta[k + 1], seconds)
            velocity, pressed = self._projected(
                brought - half * of_buoyancy[k + 1], theta[k], theta[k + 1], seconds, pressed
            )
            velocity = velocity + means[k + 1]
            if changes is not None:
                velocity = velocity + changes[k]
            velocities.append(velocity)
        return velocities

    def pressures(
        self, velocities: Sequence[Spectrum], theta: Float[Tensor, "t z y x"], intervals: Sequence[float]
    ) -> Float[Tensor, "t z y x"]:
        """Return the pressure over the reference density at all instants, mm^2/s^2, of mean 0.

        Parameters
        ----------
        velocities, theta : at all instants
        intervals : between them, s
        """
        times = torch.tensor([0.0, *intervals]).cumsum(dim=0)
        rates = torch.gradient(theta, spacing=(times,), dim=0)[0]
        accelerations = [self._pressed(*of_frame) for of_frame in zip(velocities, theta, rates, strict=True)]
        gradients = [self._gradient(a, now) for a, now in zip(accelerations, theta, strict=True)]
        return torch.stack([self.box.values(self.box.potential(g)) for g in gradients])

    def _buoyancy(self, theta: Tensor) -> Tensor:
        """Buoyant acceleration over -g."""
        return theta

    def _expansion(self, theta: Float[Tensor, "z y x"]) -> Spectrum | float:
        """Velocity of the fluid that expands or contracts, a gradient."""
        return 0.0

    def _pressed(self, velocity: Spectrum, theta: Float[Tensor, "z y x"], rate: Float[Tensor, "z y x"]) -> Spectrum:
        """Spectrum of -(acceleration by pressure) at an instant; `rate` of theta at fixed points, 1/s."""
        force = self.box.spectrum(self._force(velocity, theta))
        return force - self.box.solenoidal(force)

    def _gradient(self, pressed: Spectrum, theta: Float[Tensor, "z y x"]) -> Spectrum:
        """Spectrum of grad p / rho_0 of -(acceleration by pressure)."""
        return pressed

    def _projected(
        self, pushed: Spectrum, before: Float[Tensor, "z y x"], now: Float[Tensor, "z y x"], seconds: float,
        pressed: Spectrum,
    ) -> tuple[Spectrum, Spectrum]:  # fmt: skip
        """Velocity after pressure, and -(acceleration by pressure), before which it was `pressed`.

        `pushed` is the velocity of the fluid that arrives, with all other forces, `before` and `now` are theta.
        """
        velocity = self.box.solenoidal(pushed)
        return velocity, (pushed - velocity) / (0.5 * seconds)

    def _diffused(self, velocity: Spectrum, now: Float[Tensor, "z y x"], seconds: float) -> Spectrum:
        """Velocity after viscosity, at the place of arrival; `now` is theta there."""
        amount = self.viscosity * seconds
        return self.box.filtered(velocity, lambda k2: torch.exp(-amount * k2))

    def _force(self, velocity: Spectrum, theta: Float[Tensor, "z y x"]) -> Float[Tensor, "3 z y x"]:
        """-u . grad u, and buoyancy."""
        box, u = self.box, self.box.values(velocity)
        advection = torch.stack([(u * box.gradient(component)).sum(dim=0) for component in velocity.unbind()])
        return -advection - self._buoyancy(theta) * self.gravity

    def _from_before(
        self, halfway: Spectrum, fields: Float[Tensor, "c z y x"], seconds: float
    ) -> Float[Tensor, "c z y x"]:
        """Fields (coefficients of splines) where the fluid comes from, by the velocity halfway in time."""
        box = self.box
        voxels = seconds / torch.tensor(box.spacing[::-1])
        middle = box.nodes - 0.5 * voxels * box.values(halfway).flatten(1).T
        start = box.nodes - voxels * periodic_spline(box.spline(halfway), middle).T
        return periodic_spline(fields, start).reshape(-1, *box.shape)
