"""Fine detail added to a smooth reconstruction: the posterior mean of a Gaussian field, given the residuals.

    x = m + a h

h is a homogeneous field with the spectrum of von Karman (detail_prior.py). m is the reconstruction q, or q blurred
where its own detail is wrong. a is the local rms of grad q, as detail lies where the field varies, or in a second pass
the local rms of a h from a solution on a coarse grid. Its size explains what the residual has above the noise.

Blurred or not, and one pass or two: whichever predicts the withheld view of the cross-validation best (`choose`);
without one (`--detail on`), q is not blurred, and the second pass is made if its objective is lower.

The voxels are smaller than the pixels: detail that they cannot represent would appear elsewhere, as artefacts
(docs/decisions/057).
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.pauses import pause
from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.fields.sum import SumField
from nerif.forward.model_names import AUTO
from nerif.forward.path_integral import PathIntegral, project
from nerif.forward.registry import forward_models
from nerif.geometry import Grid
from nerif.geometry.symmetry import Axis
from nerif.reconstruction.aperture import apply_aperture
from nerif.reconstruction.bounds import field_bounds
from nerif.reconstruction.detail.detail_prior import Prior, WhiteProblem, von_karman
from nerif.reconstruction.device import resolve_device
from nerif.reconstruction.gauge import with_gauge
from nerif.reconstruction.shared_settings import SharedSettings
from nerif.reconstruction.sources import of_source
from nerif.reconstruction.target import Target
from nerif.reconstruction.voxels.face_gradients import gradient_square
from nerif.reconstruction.voxels.layout import layout_of
from nerif.reconstruction.voxels.levels import bins_of, resolved_voxels
from nerif.reconstruction.voxels.voxel_problem import Iterate, Problem

__all__ = ["Detail", "DetailChoice", "Posterior", "check_sigma", "choose"]

MOST_VOXELS = 160  # along the longest edge of the box
COARSE = 2  # fine voxels, and pixels, in a coarse one
OUTER_SCALE = 0.1  # L; this and the widths are shares of the longest edge of the box
MEAN_WIDTH = 0.04  # standard deviation of the Gaussian that blurs the reconstruction
SLOPE_WIDTH, DETAIL_WIDTH = 0.07, 0.04  # of the Gaussians for the local rms of grad q and of a h
FLOOR = 0.05  # of the largest a
ITERATIONS, CONVERGED = 30, 0.03
"""Most iterations of conjugate gradients, and the relative fall of the objective at their end (docs/decisions/057)."""
TRIAL_ITERATIONS = 6
"""Iterations of a trial: the coarse grid predicts no better with more, which fit what it cannot represent."""
DRAW_ITERATIONS, DRAWS = 12, 3  # DRAWS: for the size of the error of a prediction
SIGNIFICANT, EARLY = 1.1, 3.0  # sigma: residual above which there is detail; in cross-validation, not yet converged
EXPLAINED = 0.7  # of the signal of the field's own detail
BETTER = 0.99  # of the error of a prediction, at most
TRIALS = 4  # blurred or not, in one pass or two
BANDS = 8  # of the withheld pixels, in their order, that choose, and as many between them
FINE_COST, BLURRED_COST = 28.0, 45.0  # seconds that detail takes over those of a trial; about a blurred field
TRIAL_COST = 13.0  # seconds of a trial over those of a projection and back-projection: measured 13.4 and 15.6

Watch = Callable[["Posterior"], bool | None]
"""Called after each iteration; returns True to stop."""


@dataclass(frozen=True)
class Posterior:
    """The posterior of a field given its data."""

    detail: Detail  #: that was solved
    problem: WhiteProblem  #: in white noise
    iterate: Iterate  #: towards the mean
    count: int  #: of iterations

    @property
    def coefficients(self) -> Float[Tensor, "z y x"]:
        """The posterior mean, scaled."""
        return self.problem.field(self.iterate.x)

    @property
    def residual(self) -> float:
        """Rms residual over sigma."""
        assert self.problem.target.noise is not None
        return math.sqrt(self.iterate.residual / self.problem.target.noise)

    @property
    def blurred(self) -> bool:
        """Whether its prior has the blurred field as mean."""
        return not torch.equal(self.problem.mean, self.detail.mean(blurred=False))

    @property
    def objective(self) -> float:
        return self.problem.objective(self.iterate)

    @property
    def field(self) -> SumField:
        """The reconstruction plus the splines that make it the posterior mean."""
        difference = self.coefficients * self.detail.problem.scale - self.detail.coefficients
        return SumField(self.detail.base, self.detail.layout.field(difference.cpu(), self.detail.grid))

    @property
    def splines(self) -> Field:
        """The posterior mean as splines alone."""
        return self._splines(self.coefficients)

    def error(self, seed: int, on_iteration: Callable[[int, int], None] = lambda done, total: None) -> Field:
        """Return a draw of the error: the difference between a draw from the posterior and its mean."""
        return self._splines(self._error(seed, on_iteration))

    def error_of(self, target: Target) -> float:
        """Return the rms residual of other views over sigma that draws predict."""
        squares = [self.detail.prediction_square(target, self._error(seed), measured=False) for seed in range(DRAWS)]
        return math.sqrt(sum(squares) / DRAWS)

    def _error(
        self, seed: int, on_iteration: Callable[[int, int], None] = lambda done, total: None
    ) -> Float[Tensor, "z y x"]:
        draw, draws = self.coefficients, self.problem.draw(self.iterate.x, torch.Generator().manual_seed(seed))
        for i in range(DRAW_ITERATIONS):
            draw = next(draws)
            on_iteration(i + 1, DRAW_ITERATIONS)
        return draw - self.coefficients

    def _splines(self, coefficients: Float[Tensor, "z y x"]) -> Field:
        scaled = coefficients * self.detail.problem.scale
        return self.detail.layout.field(scaled.cpu(), self.detail.grid)


class Detail:
    """The data of a field's detail, and the voxels that hold it.

    Parameters
    ----------
    field : reconstructed
    measurement : with sigma
    settings : of the reconstruction
    axis : of a symmetric flow
    coarse : fine voxels, and their bins of pixels, along an edge of one of the grid
    voxels : along the longest edge of the box, on the fine grid; None for somewhat smaller ones than the pixels
    """

    def __init__(
        self, field: Field, measurement: Measurement, settings: SharedSettings, axis: Axis | None = None,
        coarse: int = 1, voxels: int | None = None,
    ) -> None:  # fmt: skip
        check_sigma(measurement)
        measurement = with_gauge(apply_aperture(measurement, settings.aperture), settings)
        source = getattr(settings, "source", AUTO)
        self.measurement = of_source(measurement, source, preferred="displacements")
        self.base, self.settings, self.axis, self.coarse = field, settings, axis, coarse
        self.layout = layout_of(self.measurement, axis, device=resolve_device(settings.device))
        self.device = self.layout.device
        fine = self.layout.grid(voxels or voxels_of(self.measurement))
        self.bins = coarse * bins_of(self.measurement, fine, voxels=1.0)
        self.grid = self.layout.grid(max(1, max(fine.shape) // coarse))

    @cached_property
    def problem(self) -> Problem:
        """The linear problem of the whole field."""
        target = self.target(self.measurement)
        free = self.layout.free(self.measurement, self.grid, getattr(self.settings, "hull", True))
        bounds = field_bounds(self.measurement, self.settings.lower, self.settings.upper)
        limits = bounds if any(map(math.isfinite, bounds)) else None
        operators = [self.layout.operator(part.rays, self.grid, part.model) for part in target.parts]
        return Problem(operators, target, free, limits)

    def target(self, measurement: Measurement) -> Target:
        """Return data of a measurement, less the effect of the bending of rays."""
        target = Target.of(measurement, self.settings.open_faces, self.bins, linear=True).to(self.device)
        models = forward_models(measurement.techniques, measurement, getattr(self.settings, "model", AUTO))
        parts = []
        for part, model in zip(target.parts, models, strict=True):
            if not model.straight:
                splines = self.layout.field(self.coefficients.cpu(), self.grid)
                bent, straight = (project(PathIntegral(m), splines, part.rays) for m in (model, model.linear_twin))
                part = replace(part, offset=(bent - straight).to(part.measured))
            parts.append(part)
        return replace(target, parts=tuple(parts))

    @cached_property
    def coefficients(self) -> Float[Tensor, "z y x"]:
        """Those of splines through the field, in its own unit."""
        return self.layout.coefficients(self.base, self.grid).to(self.device)

    def mean(self, blurred: bool) -> Float[Tensor, "z y x"]:
        """Return the mean of the prior: the scaled coefficients of the field, or the same blurred."""
        scaled = self.coefficients / self.problem.scale
        return self.problem.pin(self._blurred(scaled, MEAN_WIDTH) if blurred else scaled)

    def prior(self, size: Float[Tensor, "z y x"], width: float) -> Prior:
        """Return the prior whose deviation is proportional to the local rms of a field, over a width."""
        deviation = self._blurred(size.square(), width).sqrt() if width else size.abs()
        deviation = self.problem.pin(deviation.clamp_min(FLOOR * float(deviation.max())))
        spectrum = von_karman(self.grid, OUTER_SCALE * max(self.grid.box.edges))
        return Prior(deviation, spectrum.to(deviation))

    def first(self, blurred: bool) -> WhiteProblem:
        """Return the problem whose prior follows the gradient of the field."""
        scaled = self.coefficients / self.problem.scale
        slope = gradient_square(self.problem.differences(scaled)).sqrt()
        return WhiteProblem(self.problem, self.prior(slope, SLOPE_WIDTH), self.mean(blurred)).fits()

    def next(self, posterior: Posterior) -> WhiteProblem:
        """Return the problem whose prior follows the detail of a solution."""
        detail = posterior.problem.prior(posterior.iterate.x)
        return WhiteProblem(self.problem, self.prior(detail, DETAIL_WIDTH), posterior.problem.mean).fits()

    def like(self, problem: WhiteProblem, blurred: bool) -> WhiteProblem:
        """Return the problem with the prior of one on another grid."""
        there = Grid(self.grid.box, problem.operator.domain_shape)
        deviation = self.layout.sample(self.layout.field(problem.prior.deviation.cpu(), there), self.grid)
        prior = self.prior(deviation.to(self.coefficients), 0.0)
        return WhiteProblem(self.problem, prior, self.mean(blurred)).fits()

    @property
    def projection_seconds(self) -> float:
        """Time of a projection and a back-projection, s; of the second, as the first compiles."""
        x = self.mean(blurred=False)
        for _ in range(2):
            start = time.perf_counter()
            self.problem.adjoint(self.problem.forward(x))
        return time.perf_counter() - start

    @property
    def residual(self) -> float:
        """Rms residual of the field over sigma."""
        assert self.problem.noise is not None
        return math.sqrt(self.problem.residual(self.mean(blurred=False)) / self.problem.noise)

    @property
    def explained(self) -> float:
        """The share of the signal of the field's own detail that it explains: 1 if nothing but noise remains."""
        noise = self.problem.noise
        assert noise is not None
        left, blurred = (self.problem.residual(self.mean(b)) / noise - 1 for b in (False, True))
        return 1 - left / blurred if blurred > 0 else 1.0

    def solve(self, problem: WhiteProblem, watch: Watch | None = None, iterations: int = ITERATIONS) -> Posterior:
        """Return the posterior after at most some iterations."""
        last = math.inf
        for i, iterate in zip(range(iterations), problem.solve(), strict=False):
            pause()
            posterior = Posterior(self, problem, iterate, i + 1)
            if (watch is not None and watch(posterior)) or posterior.objective > (1 - CONVERGED) * last:
                break
            last = posterior.objective
        return posterior

    def posterior(self, problem: WhiteProblem, watch: Watch | None = None, iterations: int = ITERATIONS) -> Posterior:
        """Return the posterior for data that err by as much as a first solution leaves of them.

        They err by more than their noise where the flow varies within a pixel or a voxel.

        Source: Birge, Phys. Rev. 40 (1932) 207.
        """
        stopped = False

        def watching(posterior: Posterior) -> bool:
            nonlocal stopped
            stopped = watch is not None and bool(watch(posterior))
            return stopped

        first = self.solve(problem, watching, iterations)
        if stopped or first.residual <= 1:
            return first
        return self.solve(problem.with_errors(first.residual), watching, iterations)

    def trial(self, problem: WhiteProblem, choosing: Target, scoring: Target) -> tuple[Posterior, float, float]:
        """Return a rough posterior, the lowest error of the prediction of data on the way to it, and that of others."""
        errors: list[tuple[float, float]] = []

        def watch(posterior: Posterior) -> None:
            coefficients = posterior.coefficients
            errors.append((self.prediction_error(choosing, coefficients), self.prediction_error(scoring, coefficients)))

        return self.solve(problem, watch, TRIAL_ITERATIONS), *min(errors)

    def others(self, measurement: Measurement) -> Target:
        """Return the data of other views, as those of this one."""
        measurement = apply_aperture(measurement, self.settings.aperture)
        return self.target(of_source(measurement, getattr(self.settings, "source", AUTO), preferred="displacements"))

    def prediction_error(self, target: Target, coefficients: Float[Tensor, "z y x"]) -> float:
        """Return the rms residual of other views over sigma."""
        return math.sqrt(self.prediction_square(target, coefficients))

    def prediction_square(
        self, target: Target, coefficients: Float[Tensor, "z y x"], measured: bool = True
    ) -> float:  # fmt: skip
        """Return the mean square of the residual of other views over sigma, or of the prediction itself."""
        total = 0.0
        for part in target.parts:
            predicted = self.problem.predict(part, part.rays, coefficients)
            residual = part.residual(predicted) if measured else predicted * part.inverse_scale
            total += float(residual.square().sum())
        return total * target.chi_square / target.numbers

    def _blurred(self, values: Float[Tensor, "z y x"], width: float) -> Float[Tensor, "z y x"]:
        from scipy.ndimage import gaussian_filter

        mm = width * max(self.measurement.box.edges)
        voxels = [mm / h if n > 1 else 0.0 for n, h in zip(values.shape, self.grid.spacing[::-1], strict=True)]
        return torch.from_numpy(gaussian_filter(values.cpu().numpy(), voxels, mode="nearest")).to(values)


@dataclass(frozen=True)
class DetailChoice:
    """Which mean and prior predict a withheld view best."""

    blurred: bool = False  #: whether the mean is the blurred reconstruction
    passes: int | None = None  #: 1 or 2; None: two, if the objective is lower then
    before: float = math.nan
    """Rms residual of the withheld view over sigma without detail, over the bands of its pixels by which nothing was
    chosen; NaN without such a view."""
    after: float = math.nan  #: the same with detail
    seconds: float = 0.0  #: that the detail is expected to take

    @property
    def pays(self) -> bool:
        """Whether the withheld view is predicted better with detail."""
        return not self.after > BETTER * self.before

    def solve(self, fine: Detail, coarse: Detail, watch: Watch | None = None) -> Posterior:
        """Return the posterior on the fine grid.

        The cross-validation ends early: a field that explains most of its detail by now is not blurred.
        """
        if self.blurred and fine.explained > EXPLAINED:
            return DetailChoice().solve(fine, coarse, watch)
        problem = None
        if self.passes != 1:
            first = coarse.solve(coarse.first(self.blurred))
            second = coarse.solve(coarse.next(first))
            if self.passes or second.objective < first.objective:
                problem = fine.like(second.problem, self.blurred)
        return fine.posterior(problem or fine.first(self.blurred), watch)

    def error_ratio(self, coarse: Detail, withheld: Measurement) -> float:
        """Return the error of the prediction of the withheld views over the one that draws predict, at least 1."""
        target, problem = coarse.others(withheld), coarse.first(self.blurred)
        if self.passes == 2:
            problem = coarse.next(coarse.solve(problem))
        posterior = coarse.posterior(problem)
        square = coarse.prediction_square(target, posterior.coefficients) - 1
        return max(1.0, math.sqrt(max(square, 0.0)) / posterior.error_of(target))


def choose(
    coarse: Detail, withheld: Measurement, most: float = math.inf,
    on_done: Callable[[int, int], None] = lambda done, total: None,
) -> DetailChoice:  # fmt: skip
    """Return which mean and prior predict the withheld views of a field best, on a coarse grid.

    Every second band of their pixels chooses; the stated errors are those of the other bands. Once the detail is
    expected to take more than `most` seconds, no further trial is made, and none at all if that is known before.
    """
    seconds = FINE_COST * TRIAL_COST * coarse.projection_seconds
    if seconds > most:
        return DetailChoice(seconds=seconds)
    target, start = coarse.others(withheld), time.perf_counter()
    band = torch.arange(len(target)) * 2 * BANDS // max(len(target), 1)
    choosing, scoring = (target[(band % 2 == half).nonzero()[:, 0]] for half in (0, 1))
    best = DetailChoice(before=coarse.prediction_error(scoring, coarse.mean(blurred=False)), after=math.inf)
    lowest, posterior = math.inf, None
    for trial, (blurred, passes) in enumerate(itertools.product((False, True), (1, 2)), start=1):
        problem = coarse.next(posterior) if posterior and passes == 2 else coarse.first(blurred)
        posterior, error, after = coarse.trial(problem, choosing, scoring)
        if error < lowest:
            lowest, best = error, replace(best, blurred=blurred, passes=passes, after=after)
        cost = BLURRED_COST if best.blurred else FINE_COST
        best = replace(best, seconds=cost * (time.perf_counter() - start) / trial)
        on_done(trial, TRIALS)
        if trial > 1 and best.seconds > most:  # the first takes longer
            break
    return best


def check_sigma(measurement: Measurement) -> None:
    """Raise InputError for data without sigma: what is above the noise is not known without it."""
    for o in measurement.observations:
        if o.sigma is None:
            raise InputError(f"expected a measurement with {o.technique.sigma}, got none", field="measurement")


def voxels_of(measurement: Measurement) -> int:
    """Return the voxels along the longest edge of the box that are somewhat smaller than the pixels, at most MOST."""
    return max(COARSE * 8, min(MOST_VOXELS, resolved_voxels(measurement)))
