"""Velocity and pressure from a film of densities, by variational assimilation.

The equations of motion are solved from an initial velocity, with small changes of vorticity on the way; both are found
by minimising

    1/2 sum (r / sigma)^2 + 1/2 |z|^2

r is the residual of the transport of the density (transport.py), z the controls of the vorticity (prior.py). Gradients
by automatic differentiation through the solver; L-BFGS from coarse to fine grids.

Source: Le Dimet & Talagrand, Tellus 38A (1986) 97; Tremolet, Q. J. R. Meteorol. Soc. 132 (2006) 2483 (weak constraint).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Ge, Gt, Lt
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.settings import Count, Positive, check_settings
from nerif.geometry import Grid
from nerif.reconstruction.velocity.boussinesq import Boussinesq
from nerif.reconstruction.velocity.periodic_box import PeriodicBox
from nerif.reconstruction.velocity.prior import VorticityPrior
from nerif.reconstruction.velocity.resampling import along_axes, averages
from nerif.reconstruction.velocity.transport import Transport

__all__ = ["PHYSICS", "Flow", "Iterate", "State", "VelocityFit"]

PHYSICS = ("boussinesq", "transport")
LARGEST_DENSITY_CHANGE = 0.3  # of the Boussinesq equations
LEVELS = (0.67, 1.0)  # voxels along an edge, relative to the finest grid; noise is estimated before each
SHARES = (0.1, 0.9)  # of the time
MIN_VOXELS = 8
HISTORY = 60  # steps that L-BFGS remembers
ENOUGH = 0.7  # rms of residual / sigma at which a level ends
GAINS = 2.0  # vorticity, relative to that of a flow which changes the density at the rate in the film


@dataclass(frozen=True)
class State:
    """Where a fit is: its level, the controls, and iterations and seconds so far."""

    level: int
    controls: Float[Tensor, "t 3 z y x"]
    iterations: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Iterate:
    """Figures of an iteration: level and their number, iterations and seconds so far, rms of residual / sigma."""

    level: int
    levels: int
    iterations: int
    seconds: float
    misfit: float


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
    state : of the fit
    """

    grid: Grid
    velocity: Float[Tensor, "t 3 z y x"]
    pressure: Float[Tensor, "t z y x"] | None
    transport: Float[Tensor, "k z y x"]
    momentum: Float[Tensor, "k 3 z y x"] | None
    determined: Bool[Tensor, "t z y x"]
    misfit: float
    state: State


class _End(Exception):
    """A limit is reached."""


@dataclass(frozen=True)
class VelocityFit:
    """Settings of the velocity of a film; called with densities, returns the Flow."""

    physics: Literal[*PHYSICS] = "boussinesq"  # type: ignore[valid-type]
    """Equations: boussinesq (buoyant flow of nearly uniform density), or transport (no equation of momentum)."""
    viscosity: Positive = 15.0
    """Kinematic viscosity, mm^2/s."""
    diffusivity: Positive = 20.0
    """Diffusivity of density (heat or species), mm^2/s."""
    gravity: tuple[float, float, float] = (0.0, 0.0, -9810.0)
    """Acceleration of gravity along x, y, z, mm/s^2."""
    resolution: Annotated[int, Ge(MIN_VOXELS)] = 30
    """Voxels of the velocity along the longest edge of the box."""
    time_limit: Annotated[float, Ge(0)] = 600.0
    """Limit on the duration, s (0: none)."""
    max_iterations: Count = 300
    """Iterations on each grid at most."""
    density_noise: Annotated[float, Ge(0), Lt(math.inf)] = 0.0
    """Standard deviation of density / reference density, averaged over a voxel of the velocity (0: from the film)."""
    forcing: Annotated[float, Gt(0), Lt(1)] = 0.05
    """Change of vorticity per interval that the equations do not explain, relative to its largest value."""
    correlation: Positive = 20.0
    """Wavelength below which the vorticity is expected to be smaller, mm."""

    def __post_init__(self) -> None:
        check_settings(self)

    def __call__(
        self, theta: Float[Tensor, "t z y x"], grid: Grid, times: Sequence[float],
        on_iterate: Callable[[Iterate, State], None] = lambda iterate, state: None, resume: State | None = None,
    ) -> Flow:  # fmt: skip
        """Return velocity and pressure of a film.

        Parameters
        ----------
        theta : -(rho - rho_0) / rho_0
        grid : its voxels
        times : s
        on_iterate : called after every evaluation, with the best state so far
        resume : state of an earlier run with the same input and settings
        """
        theta = theta.float()
        self._check(theta, grid, times)
        levels = self._levels(grid)
        noise = self.density_noise or noise_of(theta, grid, levels[-1])
        begin = time.monotonic() - (resume.seconds if resume else 0.0)
        first = resume.level if resume else 0
        controls = resume.controls if resume else None
        iterations = resume.iterations if resume else 0
        before: _Problem | None = None
        for level in range(first, len(levels)):
            problem = _Problem(self, theta, grid, times, levels[level], noise)
            if controls is None:
                controls = torch.zeros(len(times), 3, *problem.box.shape)
            else:
                if before is not None:
                    controls = _finer(controls, before.box, problem.box)
                problem.weigh(controls)
            limit = self.time_limit * sum(SHARES[: level + 1]) if self.time_limit else math.inf

            def report(misfit: float, best: Tensor, done: int, level: int = level) -> float:
                seconds = time.monotonic() - begin
                on_iterate(Iterate(level, len(levels), done, seconds, misfit), State(level, best, done, seconds))
                return seconds

            controls, iterations = _minimise(problem, controls, self.max_iterations, iterations, limit, report)
            before = problem
        assert before is not None
        assert controls is not None
        state = State(len(levels) - 1, controls, iterations, time.monotonic() - begin)
        return before.flow(controls, state)

    def _check(self, theta: Tensor, grid: Grid, times: Sequence[float]) -> None:
        if len(times) < 3:
            raise InputError(f"expected three frames or more, got {len(times)}", field="film")
        if tuple(theta.shape) != (len(times), *grid.shape):
            raise InputError(f"expected densities of shape {(len(times), *grid.shape)}, got {tuple(theta.shape)}")
        if not bool(torch.isfinite(theta).all()):
            raise InputError(
                "expected densities everywhere, got NaN: these equations have no bodies in the flow", field="film"
            )
        largest = float(theta.abs().max())
        if not largest > 0:
            raise InputError("the density is the same everywhere, so that nothing shows the velocity", field="film")
        if self.physics == "boussinesq" and largest > LARGEST_DENSITY_CHANGE:
            raise InputError(
                f"expected density changes below {LARGEST_DENSITY_CHANGE:.0%} for boussinesq, got {largest:.0%}: heat "
                "release or a hot gas, whose expansion these equations lack; give --physics transport for an estimate",
                field="physics",
            )

    def _levels(self, grid: Grid) -> list[Grid]:
        counts = [max(MIN_VOXELS, round(self.resolution * share)) for share in LEVELS]
        return [Grid.of_resolution(grid.box, min(n, max(grid.shape))) for n in counts]


def noise_of(theta: Float[Tensor, "t z y x"], grid: Grid, coarse: Grid) -> float:
    """Return the standard deviation of a film's averages where the fluid is ambient: where the scalar is smallest."""
    average = along_axes(theta, averages(grid, coarse))
    strength = average.abs().amax(dim=0)
    calm = strength <= strength.quantile(0.5)
    return float(average[:, calm].square().mean().sqrt())


class _Problem:
    """The fit on one grid."""

    def __init__(
        self, settings: VelocityFit, theta: Tensor, grid: Grid, times: Sequence[float], coarse: Grid, noise: float
    ) -> None:
        self.settings = settings
        self.box = box = PeriodicBox(coarse)
        self.transport = Transport(theta, grid, times, settings.diffusivity, box, noise)
        average = self.transport.coarse(theta)
        buoyant = settings.physics == "boussinesq"
        gravity = settings.gravity if buoyant else (0.0, 0.0, 0.0)
        self.equations = Boussinesq(box, settings.viscosity, gravity)
        rate = (theta[1:] - theta[:-1]).square().mean().sqrt() / float(self.transport.intervals.mean())
        slope = torch.stack(torch.gradient(theta, spacing=grid.spacing[::-1], dim=(1, 2, 3))).square().sum(dim=0)
        speed = float(rate / slope.mean().sqrt())
        steepness = float(slope.max().sqrt() / theta.abs().max())
        forcing = settings.forcing if buoyant else 0.5
        amplitude = GAINS * speed * steepness
        self.prior = VorticityPrior(box, average, amplitude, forcing, settings.correlation, gravity)
        self.extended = box.extended(average)

    def spectra(self, controls: Tensor) -> list[Tensor]:
        """Return the spectra of the velocity at all instants."""
        vorticity = self.prior.vorticity(controls).unbind()  # unbound, derivatives of slices stay small
        start, *changes = (self.box.velocity(w) for w in vorticity)
        return self.equations.solve(start, self.extended, self.transport.intervals.tolist(), changes)

    @torch.no_grad()
    def weigh(self, controls: Tensor) -> None:
        """Set the standard deviation of the residual by the noise that it shows."""
        residual = self.residual(self.spectra(controls)) * self.transport.deviation
        self.transport.weigh(residual)

    def residual(self, velocities: list[Tensor]) -> Tensor:
        """Return residual / sigma of every interval."""
        splines = torch.stack([self.box.spline(v) for v in velocities])
        return self.transport.residual(splines) / self.transport.deviation

    def loss(self, controls: Tensor) -> tuple[Tensor, float]:
        """Return the objective, and the rms of residual / sigma where much of the scalar is."""
        residual = self.residual(self.spectra(controls))
        misfit = float(residual.detach()[self.transport.core].square().mean().sqrt())
        return 0.5 * residual.square().sum() + 0.5 * controls.square().sum(), misfit

    @torch.no_grad()
    def flow(self, controls: Tensor, state: State) -> Flow:
        """Return the flow of controls, on the grid of the velocity."""
        box, intervals = self.box, self.transport.intervals[:, None, None, None]
        spectra = self.spectra(controls)
        residual = self.residual(spectra)
        misfit = float(residual[self.transport.core].square().mean().sqrt())
        pressure = momentum = None
        if self.settings.physics == "boussinesq":
            vorticity = self.prior.vorticity(controls)
            change = torch.stack([box.inside(box.values(box.velocity(w))) for w in vorticity[1:]])
            momentum = change / intervals[:, None]
            pressure = self._pressure(spectra)
        region = self.transport.region
        determined = torch.cat([region[:1], region[1:] | region[:-1], region[-1:]])
        return Flow(
            box.grid, torch.stack([box.inside(box.values(u)) for u in spectra]), pressure,
            residual * self.transport.deviation / intervals, momentum, determined, misfit, state,
        )  # fmt: skip

    def _pressure(self, spectra: list[Tensor]) -> Tensor:
        """Return the pressure at the instants, mm^2/s^2, of mean 0 in the box."""
        pressures = [self.equations.pressure(u, theta) for u, theta in zip(spectra, self.extended, strict=True)]
        inside = self.box.inside(torch.stack(pressures))
        return inside - inside.mean(dim=(1, 2, 3), keepdim=True)


def _minimise(
    problem: _Problem, controls: Tensor, max_iterations: int, before: int, limit: float,
    report: Callable[[float, Tensor, int], float],
) -> tuple[Tensor, int]:  # fmt: skip
    """Return the best controls, and the number of evaluations, until a limit or a residual of the size of sigma."""
    x = controls.clone().requires_grad_()
    optimiser = torch.optim.LBFGS(
        [x], max_iter=max_iterations, max_eval=10 * max_iterations, history_size=HISTORY,
        tolerance_grad=0, tolerance_change=0, line_search_fn="strong_wolfe",
    )  # fmt: skip
    best, lowest, done = controls, math.inf, before

    def closure() -> Tensor:
        nonlocal best, lowest, done
        optimiser.zero_grad()
        loss, misfit = problem.loss(x)
        loss.backward()
        done += 1
        if loss.item() < lowest:
            best, lowest = x.detach().clone(), loss.item()
        if report(misfit, best, done) > limit or misfit < ENOUGH:
            raise _End
        return loss

    with suppress(_End):
        optimiser.step(closure)
    return best, done


def _finer(controls: Tensor, coarse: PeriodicBox, fine: PeriodicBox) -> Tensor:
    """Return controls on a finer grid, whose waves beyond those of the coarse one are 0."""
    spectrum = coarse.spectrum(controls)
    result = torch.zeros(*spectrum.shape[:2], *fine.shape[:2], fine.shape[2] // 2 + 1, dtype=spectrum.dtype)
    places = []
    for axis, (m, n) in enumerate(zip(coarse.shape, fine.shape, strict=True)):
        half = (min(m, n) + 1) // 2
        negative = [] if axis == 2 else list(range(-half + 1, 0))
        places.append(
            (
                torch.tensor([*range(half), *(m + k for k in negative)]),
                torch.tensor([*range(half), *(n + k for k in negative)]),
            )
        )
    (z0, z1), (y0, y1), (x0, x1) = places
    part = spectrum[:, :, z0][:, :, :, y0][..., x0]
    result[:, :, z1[:, None, None], y1[:, None], x1] = part
    return fine.values(result) * math.sqrt(math.prod(fine.shape) / math.prod(coarse.shape))
