"""The velocity of a film on one grid, as a minimisation: from vorticity variables to flow, residuals and objective."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.flow.boussinesq import Boussinesq
from nerif.flow.flow import Flow
from nerif.flow.frame_resampling import (
    along_axes,
    averages,
    periodic_averages,
    periodic_splines,
    smooth,
    squared_slope,
)
from nerif.flow.low_mach import LowMach
from nerif.flow.periodic_box import PeriodicBox
from nerif.flow.transport import Transport
from nerif.flow.uniform_velocity import common_velocity
from nerif.flow.velocity_prior import VorticityPrior
from nerif.flow.velocity_settings import VelocitySettings
from nerif.geometry import Grid

__all__ = ["NoiseSample", "VelocityProblem", "minimise", "resampled"]

HISTORY = 60  # steps that L-BFGS remembers
CALM = (2.0, 2.0, 2.0)  # voxels of the velocity over which the scalar is compared
FREE_FORCING = 0.5  # change of vorticity per interval, relative to its largest value, without an equation of momentum
MOST = 0.1  # of the squared residual at rest: a flow moves as a whole if that leaves less (a plume: 0.2)
RECENT, FALLING = 10, 0.02  # evaluations, and the share by which the objective falls in them before the minimum
GAINS = 2.0  # vorticity, relative to that of a flow which changes the density at the rate in the film


@dataclass(frozen=True)
class NoiseSample:
    """Noise of residual / sigma, and white controls."""

    residual: Float[Tensor, "k z y x"]
    controls: Float[Tensor, "t 3 zp yp xp"]


class _End(Exception):
    """A limit is reached."""


class VelocityProblem:
    """The fit on one grid; the mean velocity is free, about `common` (mm/s), if that is not 0."""

    def __init__(
        self, settings: VelocitySettings, theta: Tensor, grid: Grid, times: Sequence[float], box: PeriodicBox,
        common: Float[Tensor, 3] | None = None,
    ) -> None:  # fmt: skip
        self.settings, self.box = settings, box
        noise = settings.density_noise or noise_of(theta, grid, box.grid)
        equations = LowMach if settings.physics == "low-mach" else Boussinesq
        forces = settings.physics != "transport"
        gravity = settings.gravity if forces else (0.0, 0.0, 0.0)
        self.equations = equations(box, settings.viscosity, settings.diffusivity, gravity)
        self.transport = Transport(theta, grid, times, self.equations.rate(theta, grid), box, noise)
        self.average = average = self.transport.coarse(theta)
        rate = (theta[1:] - theta[:-1]).square().mean().sqrt() / float(self.transport.intervals.mean())
        slope = squared_slope(theta, grid.spacing[::-1])
        speed = float(rate / slope.mean().sqrt())
        steepness = float(slope.max().sqrt() / theta.abs().max())
        forcing = settings.forcing if forces else FREE_FORCING
        amplitude = GAINS * speed * steepness
        self.prior = VorticityPrior(box, average, amplitude, forcing, settings.correlation, gravity, common)
        self.extended = box.extended(average)

    @torch.no_grad()
    def common_velocity(self) -> Float[Tensor, 3]:
        """Return the velocity of a flow that moves as a whole, mm/s: 0 unless it explains most of the film."""
        velocity = common_velocity(self.average, self.box.spacing, self.transport.intervals.tolist())
        squares = []
        for uniform in (0 * velocity, velocity):
            residual = self.residual([self.box.uniform(uniform)] * len(self.average))
            squares.append(float(residual[self.transport.core].square().mean()) - 1)  # beyond the noise
        return velocity if squares[1] < MOST * squares[0] else 0 * velocity

    def spectra(self, controls: Tensor) -> list[Tensor]:
        """Return the spectra of the velocity at all instants."""
        vorticity = self.prior.vorticity(controls).unbind()  # unbound, derivatives of slices stay small
        start, *changes = (self.box.velocity(w) for w in vorticity)
        mean = self.prior.mean(controls)
        return self.equations.solve(start, self.extended, self.transport.intervals.tolist(), changes, mean)

    @torch.no_grad()
    def weigh(self, controls: Tensor) -> None:
        """Set the standard deviation of the residual by the noise that it shows."""
        residual = self.residual(self.spectra(controls)) * self.transport.deviation
        self.transport.weigh(residual)

    def residual(self, velocities: list[Tensor]) -> Tensor:
        """Return residual / sigma of every interval."""
        return self.transport.residual(self.splines(velocities)) / self.transport.deviation

    def splines(self, velocities: list[Tensor]) -> Tensor:
        """Return the coefficients of velocities at all instants."""
        return torch.stack([self.box.spline(v) for v in velocities])

    def loss(self, controls: Tensor, noise: NoiseSample | None = None) -> tuple[Tensor, float]:
        """Return the objective, and the rms of residual / sigma where much of the scalar is.

        `noise` is added to residual / sigma and to the controls expected a priori.
        """
        residual = self.residual(self.spectra(controls))
        misfit = float(residual.detach()[self.transport.core].square().mean().sqrt())
        if noise is not None:
            residual, controls = residual - noise.residual, controls - noise.controls
        return 0.5 * residual.square().sum() + 0.5 * controls.square().sum(), misfit

    def sample(self, generator: torch.Generator) -> NoiseSample:
        """Return a sample of the noise of the residual, and of the controls a priori."""
        residual = self.transport.sample(generator)
        controls = self.box.white((len(residual) + 1, 3, *self.box.shape), True, generator)
        return NoiseSample(residual / self.transport.deviation, controls)

    @torch.no_grad()
    def flow(self, controls: Tensor, falling: bool = False) -> Flow:
        """Return the flow of controls, on the grid of the velocity."""
        box, intervals = self.box, self.transport.intervals[:, None, None, None]
        spectra = self.spectra(controls)
        residual = self.residual(spectra)
        misfit = float(residual[self.transport.core].square().mean().sqrt())
        pressure = momentum = unexplained = None
        if self.settings.physics != "transport":
            forcing = self.prior.vorticity(controls)[1:] * (1 - box.margins())  # there it stands for the flow outside
            change = torch.stack([box.inside(box.values(box.velocity(w))) for w in forcing])
            momentum = change / intervals[:, None]
            unexplained = self._unexplained(momentum, spectra)
            pressure = self.pressure(spectra)
        region = self.transport.region
        determined = torch.cat([region[:1], region[1:] | region[:-1], region[-1:]])
        return Flow(
            box.grid, torch.stack([box.inside(box.values(u)) for u in spectra]), pressure,
            residual * self.transport.deviation / intervals, momentum, determined, misfit, unexplained,
            falling=falling,
        )  # fmt: skip

    def _unexplained(self, momentum: Tensor, spectra: list[Tensor]) -> float:
        """Return the rms of the acceleration that the equations do not explain over that of the fluid."""
        box, squares = self.box, [0.0, 0.0]
        for seconds, part, region, a, b in zip(
            self.transport.intervals.tolist(), momentum, self.transport.region, spectra[:-1], spectra[1:], strict=True
        ):
            u = box.values(0.5 * (a + b))
            advection = torch.stack([(u * box.gradient(component)).sum(dim=0) for component in 0.5 * (a + b)])
            acceleration = box.inside(box.values(b - a) / seconds + advection)
            for k, vectors in enumerate((part, acceleration)):
                squares[k] += float(vectors[:, region].square().sum())
        return math.sqrt(squares[0] / squares[1]) if squares[1] > 0 else 0.0

    def pressure(self, spectra: list[Tensor]) -> Tensor:
        """Return the pressure at the instants, mm^2/s^2, of mean 0 in the box."""
        inside = self.box.inside(self.equations.pressures(spectra, self.extended, self.transport.intervals.tolist()))
        return inside - inside.mean(dim=(1, 2, 3), keepdim=True)


def minimise(
    problem: VelocityProblem, controls: Tensor, max_iterations: int, before: int, limit: float,
    report: Callable[[float, Tensor, int], float], noise: NoiseSample | None = None, enough: float = 0.0,
) -> tuple[Tensor, int, bool]:  # fmt: skip
    """Return the best controls, the number of evaluations, and whether the objective was still falling at the end.

    It ends at a limit, or at a residual small enough.

    Parameters
    ----------
    before : evaluations so far
    limit : of the figure that report returns
    report : called with the misfit, the best controls and the number of evaluations
    enough : rms of residual / sigma
    """
    prior = problem.prior
    x = prior.variables(controls).requires_grad_()
    optimiser = torch.optim.LBFGS(
        [x], max_iter=max_iterations, max_eval=10 * max_iterations, history_size=HISTORY,
        tolerance_grad=0, tolerance_change=0, line_search_fn="strong_wolfe",
    )  # fmt: skip
    best, lowest, done, falling = controls, math.inf, before, True
    recent: deque[float] = deque(maxlen=RECENT)

    def closure() -> Tensor:
        nonlocal best, lowest, done, falling
        optimiser.zero_grad()
        z = prior.controls(x)
        loss, misfit = problem.loss(z, noise)
        loss.backward()
        done += 1
        if loss.item() < lowest:
            best, lowest = z.detach(), loss.item()
        recent.append(lowest)
        falling = misfit >= enough and (len(recent) < RECENT or lowest < (1 - FALLING) * recent[0])
        if report(misfit, best, done) > limit or misfit < enough:
            raise _End
        return loss

    with suppress(_End):
        optimiser.step(closure)
    if not math.isfinite(lowest):
        raise InputError(
            "the residual of the first velocity is not a number; expected densities that are", field="film"
        )
    return best, done, falling


def resampled(
    controls: Float[Tensor, "t 3 z y x"], before: PeriodicBox, after: PeriodicBox
) -> Float[Tensor, "t 3 z2 y2 x2"]:
    """Return controls on another grid: splines on a finer one, averages on a coarser one.

    Their amplitude is that of white noise with the same spectral density.
    """
    scale = math.prod(after.spacing) / math.prod(before.spacing)
    coarser, matrices = scale > 1, []
    for axis, count in enumerate(before.shape):
        ratio = after.spacing[axis] / before.spacing[axis]
        nodes = torch.arange(float(after.shape[axis])) - after.first[axis] + 0.5
        positions = nodes * ratio - 0.5 + before.first[axis]
        if coarser:
            matrices.append(periodic_averages(positions, count, max(0.5, 0.5 * ratio)))
        else:
            matrices.append(periodic_splines(positions, count))
    values = controls if coarser else before.spline(before.spectrum(controls))
    return along_axes(values, matrices) * math.sqrt(scale)


def noise_of(theta: Float[Tensor, "t z y x"], grid: Grid, coarse: Grid) -> float:
    """Return the standard deviation of a film's averages where the fluid is ambient: where the scalar is smallest.

    From differences of consecutive frames, so that errors which last do not count. The scalar is compared over
    several voxels: chosen one by one, those of the least noise would be taken for ambient.
    """
    matrices = averages(grid, coarse)
    average = along_axes(theta, matrices)
    strength = smooth(average.square().mean(dim=0), CALM)
    calm = strength <= strength.quantile(0.5)
    size = along_axes(torch.ones(grid.shape), [m.square() for m in matrices])  # at the faces, of fewer voxels
    variance = 0.5 * average.diff(dim=0).square().mean(dim=0) * (size.median() / size)
    return float(variance[calm].mean().sqrt())
