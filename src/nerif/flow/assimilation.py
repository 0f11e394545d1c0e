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
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement_sequence import check_instants
from nerif.flow.flow import Flow
from nerif.flow.frame_resampling import laplacian, smooth, squared_slope
from nerif.flow.low_mach import LARGEST
from nerif.flow.periodic_box import PeriodicBox
from nerif.flow.transport import Transport
from nerif.flow.velocity_deviations import deviations_of
from nerif.flow.velocity_problem import VelocityProblem, minimise, resampled
from nerif.flow.velocity_settings import MIN_VOXELS, VelocitySettings
from nerif.geometry import Grid

__all__ = ["FitIterate", "FitState", "Improvement", "VelocityFit"]

LARGEST_DENSITY_CHANGE = {"boussinesq": 0.3, "low-mach": LARGEST}  # of averages over SMOOTH voxels
SMOOTH = (1.2, 1.2, 1.2)
STAGES = ((0.67, 0.1), (1.0, 0.8))
"""Voxels along an edge, relative to the finest grid, and the share of the time at which the stage ends."""
REPEATED_STAGES = ((0.67, 0.08), (0.67, 0.22), (1.0, 0.48), (1.0, 0.8))
"""The same where the density is improved between stages, or the noise estimated from a velocity on the same grid."""
SPREAD = 1.0  # change of the density by diffusion between two frames, relative to it
FASTEST = 1.5e5  # mm/s
ENOUGH = 0.7  # rms of residual / sigma (1 at the true velocity) at which a stage ends: half of the noise is fitted
IMPROVEMENT = 0.4  # of the time left to a stage, for better densities before it
SAMPLED = 0.5  # voxels along an edge of the grid of standard deviations, relative to the finest


class Improvement(Protocol):
    """Returns theta of a film, given the transport of its present densities and the splines of the velocity."""

    def __call__(
        self, transport: Transport, splines: Tensor, on_iterate: Callable[[int, float], bool]
    ) -> Float[Tensor, "t z y x"]: ...


@dataclass(frozen=True)
class FitState:
    """Where a fit is: its stage, the controls, theta if it was improved, iterations and seconds so far."""

    stage: int = 0
    controls: Float[Tensor, "t 3 z y x"] | None = None
    theta: Float[Tensor, "t z y x"] | None = None
    iterations: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class FitIterate:
    """Figures of an iteration."""

    what: str  #: velocity, density, or deviations
    stage: int  #: its number, from 0
    stages: int  #: their count
    iterations: int  #: so far
    seconds: float  #: so far
    misfit: float  #: rms of residual / sigma, of density that of the displacements


@dataclass(frozen=True)
class VelocityFit(VelocitySettings):
    """Velocity of a film: called with densities, returns the Flow."""

    def __call__(
        self, theta: Float[Tensor, "t z y x"], grid: Grid, times: Sequence[float],
        on_iterate: Callable[[FitIterate, FitState], None] = lambda iterate, state: None,
        resume: FitState | None = None, improve: Improvement | None = None, box_of: type[PeriodicBox] = PeriodicBox,
    ) -> Flow:  # fmt: skip
        """Return velocity and pressure of a film.

        Parameters
        ----------
        theta : -(rho - rho_0) / rho_0
        grid : its voxels
        times : s
        on_iterate : called after every evaluation, with the best state so far
        resume : state of an earlier run with the same input and settings
        improve : returns better densities, given the velocity; called between stages
        box_of : class of the periodic box in which the equations are solved
        """
        theta = theta.float()
        self.check(theta, grid, times, box_of)
        stages = STAGES if improve is None and box_of is PeriodicBox else REPEATED_STAGES
        state = resume or FitState()
        first, begin = state.stage, time.monotonic() - state.seconds
        limit = self.time_limit or math.inf

        def report(what: str, misfit: float, state: FitState) -> float:
            seconds = time.monotonic() - begin
            state = replace(state, seconds=seconds)
            on_iterate(FitIterate(what, state.stage, len(stages), state.iterations, seconds, misfit), state)
            return seconds

        first_box = box_of(self._grid(grid, stages[0][0], box_of))
        common = VelocityProblem(self, theta, grid, times, first_box).common_velocity()
        problem: VelocityProblem | None = None
        falling = True
        for stage in range(first, len(stages)):
            share, end = stages[stage]
            if improve is not None and problem is not None:
                spent = time.monotonic() - begin
                latest = spent + IMPROVEMENT * (end * limit - spent)

                def improved(iteration: int, misfit: float, state: FitState = state, latest: float = latest) -> bool:
                    return report("density", misfit, state) > latest

                with torch.no_grad():
                    splines = problem.splines(problem.spectra(_controls(state)))
                state = replace(state, theta=improve(problem.transport, splines, improved))
            before, density = problem, theta if state.theta is None else state.theta
            problem = VelocityProblem(self, density, grid, times, box_of(self._grid(grid, share, box_of)), common)
            if state.controls is None:
                controls = problem.prior.start()
            else:
                controls = state.controls if before is None else resampled(state.controls, before.box, problem.box)
                problem.weigh(controls)
            state = replace(state, stage=stage, controls=controls)

            def progress(misfit: float, best: Tensor, done: int, state: FitState = state) -> float:
                return report("velocity", misfit, replace(state, controls=best, iterations=done))

            controls, done, falling = minimise(
                problem, controls, self.max_iterations, state.iterations, end * limit, progress, enough=ENOUGH
            )
            state = replace(state, controls=controls, iterations=done)
        assert problem is not None
        flow = problem.flow(_controls(state), falling)
        deviations = None
        if self.samples:
            coarse = VelocityProblem(self, density, grid, times, box_of(self._grid(grid, SAMPLED, box_of)), common)
            around = resampled(_controls(state), problem.box, coarse.box)
            deviations = deviations_of(
                coarse, around, self.samples, self.sample_iterations,
                lambda misfit: report("deviations", misfit, state), limit,
            )  # fmt: skip
        seconds = time.monotonic() - begin
        return replace(flow, theta=state.theta, deviations=deviations, iterations=state.iterations, seconds=seconds)

    def check(self, theta: Tensor, grid: Grid, times: Sequence[float], box_of: type[PeriodicBox] = PeriodicBox) -> None:
        """Check the densities of a film, as for a call.

        Raises
        ------
        InputError
            For less than three frames, instants that do not increase, thin boxes, NaN, densities that do not vary,
            those outside the physics, and motion that shows wrong units.
        """
        if len(times) < 3:
            raise InputError(f"expected three frames or more, got {len(times)}", field="film")
        check_instants(times, "film")
        if tuple(theta.shape) != (len(times), *grid.shape):
            raise InputError(f"expected densities of shape {(len(times), *grid.shape)}, got {tuple(theta.shape)}")
        if any(n < fewest for n, fewest in zip(grid.shape, box_of.fewest, strict=True)):
            raise InputError(
                f"expected {box_of.fewest} voxels or more (z, y, x), got {grid.shape}; run nerif sequence with more "
                "--voxels", field="film",
            )  # fmt: skip
        if not bool(torch.isfinite(theta).all()):
            raise InputError(
                "expected densities everywhere, got NaN: these equations have no bodies in the flow", field="film"
            )
        if not float(theta.abs().max()) > 0:
            raise InputError("the density is the same everywhere, so that nothing shows the velocity", field="film")
        changes = {"boussinesq": smooth(theta, SMOOTH).abs().max(), "low-mach": smooth(theta, SMOOTH).max()}
        refused = {name: float(change) for name, change in changes.items() if change > LARGEST_DENSITY_CHANGE[name]}
        if self.physics in refused:
            remedy = (
                "transport" if "low-mach" in refused else "low-mach for a hot gas without heat release, or transport"
            )
            raise InputError(
                f"expected density changes below {LARGEST_DENSITY_CHANGE[self.physics]:.0%} for {self.physics}, got "
                f"{refused[self.physics]:.0%}; give --physics {remedy}", field="physics",
            )  # fmt: skip
        if not float((theta[1:] - theta[:-1]).abs().max()) > 0:
            raise InputError("the density does not change in time, so that nothing shows the velocity", field="film")
        if reason := self._beyond(smooth(theta, SMOOTH), grid, float(torch.tensor(times).double().diff().median())):
            raise InputError(
                f"{reason}; expected instants in s and lengths in mm, and frames that show the flow in motion",
                field="film",
            )

    def _beyond(self, theta: Tensor, grid: Grid, interval: float) -> str:
        """Return what no film shows between two frames; empty if there is none."""
        size = theta.square().mean().sqrt()
        spread = self.diffusivity * interval * float(laplacian(theta, grid.spacing[::-1]).square().mean().sqrt() / size)
        fall = 0.5 * float(theta.abs().max() * torch.tensor(self.gravity).norm()) * interval**2
        slope = squared_slope(theta, grid.spacing[::-1]).mean().sqrt()
        speed = float(theta.diff(dim=0).square().mean().sqrt() / slope) / interval
        begin = f"in {interval:g} s, from one frame to the next,"
        if spread > SPREAD:
            return f"{begin} diffusion would change the density by {spread:.2g} times its rms"
        if self.physics != "transport" and fall > max(grid.box.edges):
            return f"{begin} buoyancy would move the fluid by {fall:.3g} mm, beyond the box"
        if speed > FASTEST:
            return f"the density moves with about {speed / 1e3:.3g} m/s, faster than in an incompressible flow"
        return ""

    def _grid(self, grid: Grid, share: float, box_of: type[PeriodicBox]) -> Grid:
        count = max(MIN_VOXELS, round(self.resolution * share))
        shape = Grid.of_resolution(grid.box, min(count, max(grid.shape))).shape
        nz, ny, nx = (max(n, fewest) for n, fewest in zip(shape, box_of.fewest, strict=True))
        return Grid(grid.box, (nz, ny, nx))


def _controls(state: FitState) -> Tensor:
    assert state.controls is not None
    return state.controls
