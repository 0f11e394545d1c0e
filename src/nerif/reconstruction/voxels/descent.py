"""The run of a voxel method: levels from coarse grids and large bins to fine ones, and the loop over iterations.

The residual that ends a run is always that of single pixels: noise may be correlated between neighbours, and bins then
have more of it than their sigma states.

A rig is refined between solutions: on each level ROUNDS times, with a few iterations of the field after each.

A checkpoint holds the run as it was at the start of the level, or of the round of refinement, that is under way: a run
that is killed repeats this level, and gives the same field as one that was not.

A method without a penalty is regularised by stopping early. On coarse grids its residual never reaches the noise, so it
moves on as soon as progress is slow.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.pauses import pause
from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.geometry import Grid
from nerif.reconstruction.aperture import apply_aperture
from nerif.reconstruction.bins import pixel_subset
from nerif.reconstruction.bounds import field_bounds
from nerif.reconstruction.device import Cores, available_memory, peak_memory, remark_on, resolve_device
from nerif.reconstruction.field_files import check_fingerprint, fingerprint
from nerif.reconstruction.gauge import Gauge, check_gauge, is_open, with_gauge
from nerif.reconstruction.reconstructor import OnStep, Outcome, Reconstruction, State, Step
from nerif.reconstruction.rig_parameters import RefinedView
from nerif.reconstruction.rig_refinement import MOMENTUM, Refinement, load_rig, random_pixels, rig_state
from nerif.reconstruction.sources import of_source
from nerif.reconstruction.target import Target
from nerif.reconstruction.voxels.layout import layout_of
from nerif.reconstruction.voxels.levels import Level, coarser, levels
from nerif.reconstruction.voxels.symmetry_axis import axis_of
from nerif.reconstruction.voxels.voxel_problem import Iterate, Problem
from nerif.reconstruction.voxels.voxel_settings import VoxelSettings
from nerif.reconstruction.voxels.weight import COARSE_WEIGHT, DISCREPANCY, choose_weight

__all__ = ["VoxelRun"]

PIXELS = 1 << 16  # about as many, whose residual is computed where a level has bins: to half a per cent
COARSE_TOLERANCE = 10  # times the tolerance, for weights of a search
SEARCH = 8  # solutions of a search for the weight on one grid, about
REFINEMENT_WEIGHT = 0.1 * COARSE_WEIGHT  # while a rig is refined and no weight is chosen yet
ROUNDS = 20  # refinements of a rig on a level
ROUNDS_WITHOUT_MOMENTUM = 5  # at the end of them
ROUND_ITERATIONS = 8  # of the field after each refinement
GAUGE_POINTS = 1 << 12  # for the constant of a field that is not pinned to the ambient index
STATE = {
    "level": "level", "round": "round", "done": "iteration", "total": "iterations", "weight": "weight",
    "guess": "guess", "chosen": "reason", "choosing": "search_levels",
}  # fmt: skip
"""Attributes of a run by their names in a checkpoint."""


class _Stop(Exception):
    """The end of a run, with the arguments of its Outcome."""


class VoxelRun:
    """One run of a voxel method."""

    def __init__(
        self, settings: VoxelSettings, measurement: Measurement, on_step: OnStep | None, resume: State | None,
        start: Field | None,
    ) -> None:  # fmt: skip
        measurement = of_source(measurement, settings.source, preferred="displacements")
        measurement = with_gauge(apply_aperture(measurement, settings.aperture), settings)
        settings, _ = settings.resolved(measurement)
        self.settings, self.measurement, self.on_step, self.start = settings, measurement, on_step, start
        check_gauge(measurement, bool(settings.probes), settings.hull)
        self.axis = axis_of(settings, measurement)
        dtype = getattr(torch, settings.precision)
        device = resolve_device(settings.device, dtype)
        self.layout = layout_of(measurement, self.axis, settings.basis, settings.step, device, dtype)
        self.device = self.layout.device
        self.cores = Cores(self.device)
        grids = self.layout.grids(settings.voxels, settings.coarse_to_fine)
        self.levels = levels(measurement, grids, settings.coarse_to_fine)
        finest = grids[-1]
        self._check_memory(finest.shape, settings.memory_bytes(measurement, finest, self.device.type))
        self.free = self.layout.free(measurement, finest, settings.hull)
        bounds = field_bounds(measurement, settings.lower, settings.upper)
        self.bounds = bounds if any(map(math.isfinite, bounds)) else None
        self.gauge = self._gauge()
        self.finest_target = self._target(self.levels[-1].edge)
        self.scale = self.finest_target.scale
        self.history: list[dict[str, float]] = []
        first = grids.index(finest)
        self.level = 0 if start is None else first  # a field to start from replaces the coarse grids
        self.round, self.iteration, self.iterations = 0, 0, 0
        self.rig = None
        if settings.refine:
            sigma = (settings.pose_sigma_mm, settings.pose_sigma_deg, settings.shift_sigma_px)
            self.rig = Refinement.for_measurement(measurement, settings.refine, *sigma)
        # the weight is searched for on the last grid but one and corrected on the last; or else searched for at the end
        self.search_levels = [first - 1, first if first else len(self.levels) - 1]
        self.weight = settings.weight
        self.guess: float | None = None
        self.reason = ""
        self.x: Tensor | None = None
        self.checkpoint: State
        self.ended: Outcome | None = None  # of the run that is resumed
        self.earlier_seconds, self.begin_time = 0.0, time.perf_counter()
        self.fingerprint = fingerprint(measurement, settings.open_faces, settings.refine)
        if resume is not None:
            self._restore(resume)

    def _check_memory(self, shape: tuple[int, ...], required: int) -> None:
        available = available_memory(self.device)
        if required > available:
            raise InputError(
                f"a grid of {' x '.join(map(str, shape))} needs {required / 2**30:.1f} GiB on {self.device}, "
                f"{available / 2**30:.1f} GiB are free; give fewer --voxels than {self.settings.voxels}",
                field="voxels",
            )

    def _gauge(self) -> Gauge | None:
        """Where the field is known, if that alone fixes its constant: the solution is shifted to it."""
        pinned = self.layout.faces or (self.free is not None and not bool(self.free.all()))
        if pinned and self.settings.probes:
            raise InputError(
                "expected no ambient faces, region or masks beside probes for a voxel method, which shifts its "
                "field to them; leave one of the two out, or take --method nerif",
                field="known",
            )
        if self.settings.probes and self.bounds is not None:
            raise InputError("expected no bounds beside probes for a voxel method, got some", field="known")
        if pinned or self.bounds is not None or not is_open(self.measurement):
            return None
        return Gauge.of(self.measurement, self.settings.probes, self.settings.hull)

    # -- levels ----------------------------------------------------------------------------------------------------

    def __call__(self) -> Reconstruction:
        """Solve on one level after the other; return the last field at the end or when the run is stopped."""
        with self.cores:
            if self.ended is not None:
                return self._result(self.ended)
            try:
                return self._result(self._outcome(self._descend()))
            except _Stop as stop:
                return self._result(Outcome(*stop.args))

    def _descend(self) -> bool:
        """Solve on all levels; return whether the last solution has converged."""
        last = len(self.levels) - 1
        for level in range(self.level, last + 1):
            if level > self.level:
                self.level, self.round, self.iteration = level, 0, 0
            while self.rig is not None and self.round < ROUNDS:
                self._refine(self.rig)
            problem = self._problem(self.here)
            self.x = x = self._begin(problem)
            self.checkpoint = self._capture()
            if self.weight is None and level in self.search_levels:
                x = self._choose(problem, x)
            factor = 1 if level == last else self.settings.coarse
            _, converged = self._solve(problem, x, self._weight_or(COARSE_WEIGHT), factor)
        return converged

    @property
    def here(self) -> Level:
        return self.levels[self.level]

    def _weight_or(self, other: float) -> float:
        """The weight, while it is open that of a coarser grid, and before that another."""
        return next((weight for weight in (self.weight, self.guess) if weight is not None), other)

    def _choose(self, problem: Problem, x: Tensor) -> Tensor:
        """Choose the weight from the data; return the field to continue from."""

        def solve(weight: float, x: Tensor) -> Iterate:
            self.iteration = 0
            iterate, _ = self._solve(problem, x, weight, COARSE_TOLERANCE)
            return replace(iterate, residual=problem.pixel_residual(iterate))

        choice = choose_weight(solve, x, problem.noise, self.guess)
        self.guess, self.reason, self.iteration = choice.weight, choice.reason, 0
        if problem.noise is None or self.level == self.search_levels[-1]:
            self.weight = choice.weight
        return choice.x

    def _refine(self, rig: Refinement) -> None:
        """Iterate the field for the present rig, then refine the rig by a step."""
        problem = self._problem(self.here)
        self.x = x = self._begin(problem)
        self.checkpoint = self._capture()
        if not self.iteration:
            self.iteration = max(0, self.settings.iterations - ROUND_ITERATIONS * (1 + 2 * (self.round == 0)))
        iterate, _ = self._solve(problem, x, self._weight_or(REFINEMENT_WEIGHT), COARSE_TOLERANCE)
        momentum = MOMENTUM if self.round < ROUNDS - ROUNDS_WITHOUT_MOMENTUM else 0.0
        parts = random_pixels(self.finest_target, len(self.measurement.names), self.round)
        sigma_known = self.finest_target.sigma_known
        rig.step(parts, lambda part, rays: problem.predict(part, rays, iterate.x), sigma_known, momentum)
        self.round, self.iteration = self.round + 1, 0

    def _begin(self, problem: Problem) -> Tensor:
        """The start on a grid: a checkpoint, a given field, the solution on the grid before, or the ambient field."""
        shape, device, dtype = problem.operator.domain_shape, problem.operator.device, problem.operator.dtype
        if self.x is not None and tuple(self.x.shape) == shape:
            return self.x.to(device, dtype)
        field = self.start if self.x is None else self._field(self.levels[self.level - 1])
        if field is None:
            return self.settings.begin(problem, problem.zero())
        values = self.layout.sample(field, problem.operator.grid)
        return self.settings.begin(problem, values.to(device, dtype) / self.scale)

    def _field(self, level: Level) -> Field:
        """The field of the present solution, on the grid of the level."""
        assert self.x is not None
        coefficients = self.x * self.scale
        if self.gauge is not None:
            points, values = self.gauge.sample(GAUGE_POINTS, torch.Generator().manual_seed(0))
            field = self.layout.field(coefficients.cpu(), level.grid)
            coefficients = coefficients + float((values - field(points)).mean())
        return self.layout.field(coefficients, level.grid)

    def _target(self, edge: int, measurement: Measurement | None = None) -> Target:
        settings, measurement = self.settings, measurement or self.measurement
        return Target.of(measurement, settings.open_faces, edge, settings.model, linear=True).to(self.device)

    @cached_property
    def pixel_target(self) -> Target:
        """A random sample of pixels, for the residual on levels with bins."""
        return replace(self._target(1, pixel_subset(self.measurement, PIXELS)), scale=self.scale)

    def _problem(self, level: Level) -> Problem:
        """The problem of a level, with that of single pixels where it has bins."""
        same = level.edge == self.levels[-1].edge
        target = self.finest_target if same else replace(self._target(level.edge), scale=self.scale)
        pixels = None if level.edge == 1 else self._problem_on(level.grid, self.pixel_target)
        return self._problem_on(level.grid, target, pixels)

    def _problem_on(self, grid: Grid, target: Target, pixels: Problem | None = None) -> Problem:
        if self.rig is not None:
            target = replace(target, parts=tuple(self.rig.of(part) for part in target.parts))
        operators = [self.layout.operator(part.rays, grid, part.model) for part in target.parts]
        return Problem(operators, target, None if self.free is None else coarser(self.free, grid), self.bounds, pixels)

    # -- iterations ------------------------------------------------------------------------------------------------

    def _solve(self, problem: Problem, x: Tensor, weight: float, factor: float) -> tuple[Iterate, bool]:
        """Iterate to a factor times the tolerance, or as often as given; return the iterate, and whether converged."""
        settings, past = self.settings, [math.inf] * self.settings.patience
        tolerance, noise = factor * settings.tolerance, problem.noise if settings.weight == 0.0 else None
        if settings.weight is not None:
            self.reason = ""
        self.x = x
        for iterate in settings.iterate(problem, x, weight):
            objective = iterate.objective(weight)
            if not math.isfinite(objective):
                message = "the objective became non-finite; the last finite field is returned"
                raise _Stop("diverged", f"{message}. Check the measurement for extreme values, and its sigma")
            pause()
            self.x, self.iteration, self.iterations = iterate.x, self.iteration + 1, self.iterations + 1
            before, past = past[0], [*past[1:], objective]
            self._report(problem, iterate, weight)
            converged = 0 <= before - objective < tolerance * settings.patience * objective
            if noise is not None and problem.pixel_residual(iterate) <= noise:
                self.reason, converged = DISCREPANCY, True
            if converged or self.iteration >= settings.iterations:
                return iterate, converged
        raise AssertionError("a method iterates without end")

    def _report(self, problem: Problem, iterate: Iterate, weight: float) -> None:
        """Record the iteration and call on_step; stop the run if that requests it, or at the time limit."""
        voxels = float(max(self.here.grid.shape))
        record = {
            "step": float(self.iterations), "seconds": self.seconds, "voxels": voxels,
            "bin_edge": float(self.here.edge), "weight": weight, "residual": math.sqrt(iterate.residual),
            "penalty": iterate.penalty, "objective": iterate.objective(weight),
        }  # fmt: skip
        if problem.pixels is None and problem.noise is not None:
            record["residual_over_sigma"] = math.sqrt(iterate.residual / problem.noise)
        self.history.append(record)
        losses = {k: v for k, v in record.items() if k in ("voxels", "weight", "residual", "residual_over_sigma")}
        speed = len(problem.target) * self.iterations / max(self.seconds, 1e-9)
        limit = self.settings.time_limit
        step = Step(
            self.iterations, float(self.iterations), self.seconds, self._progress(), losses, speed,
            lambda: self.checkpoint, lambda: self._field(self.here), rig=self._table,
        )  # fmt: skip
        if self.on_step is not None and self.on_step(step):
            raise _Stop("interrupted", f"stopped on request at {voxels:.0f} voxels; continue with --resume")
        if limit and self.seconds >= limit:
            message = f"stopped at the time limit, after {self.seconds:.0f} s, at {voxels:.0f} voxels"
            raise _Stop("time_limit", f"{message}; a longer run may reduce the error")

    def _progress(self) -> float:
        """Share of the work done if all iterations are used; the cost of a level is that of rays times their voxels."""
        counts, costs = [], []
        for i, level in enumerate(self.levels):
            solutions = SEARCH if i in self.search_levels and self.settings.weight is None else 1
            counts.append(solutions * self.settings.iterations)
            costs.append(max(level.grid.shape) / level.edge**2)
        work = [m * c for m, c in zip(counts, costs, strict=True)]
        here = (float(max(self.here.grid.shape)), float(self.here.edge))
        on_this = sum(1 for record in self.history if (record["voxels"], record["bin_edge"]) == here)
        past = sum(work[: self.level]) + costs[self.level] * min(on_this, counts[self.level])
        limit = self.settings.time_limit
        return min(1.0, max(past / sum(work), self.seconds / limit if limit else 0.0))

    @property
    def seconds(self) -> float:
        """Time of the run, earlier parts of a resumed one included."""
        return self.earlier_seconds + time.perf_counter() - self.begin_time

    # -- results ---------------------------------------------------------------------------------------------------

    def _table(self) -> list[RefinedView]:
        return [] if self.rig is None else self.rig.table()

    def _capture(self) -> State:
        assert self.x is not None
        scalars: dict[str, Any] = {name: getattr(self, attribute) for name, attribute in STATE.items()}
        scalars |= {"method": type(self.settings).__name__, "seconds": self.seconds, "history": list(self.history)}
        scalars["fingerprint"] = self.fingerprint
        return State({"x": self.x.detach().clone(), **rig_state(self.rig)}, scalars)

    def _restore(self, state: State) -> None:
        scalars, shapes = state.scalars, [level.grid.shape for level in self.levels]
        check_fingerprint(scalars.get("fingerprint"), self.fingerprint)
        level = scalars.get("level", -1)
        same = scalars.get("method") == type(self.settings).__name__ and 0 <= level < len(shapes)
        if not same or tuple(state.tensors["x"].shape) != shapes[level]:
            raise InputError("the checkpoint is of another method or grid; give the same settings", field="resume")
        self.x = state.tensors["x"].clone()
        load_rig(self.rig, state.tensors)
        self.earlier_seconds, self.begin_time = scalars["seconds"], time.perf_counter()
        self.history = list(scalars["history"])
        for name, attribute in STATE.items():
            setattr(self, attribute, scalars[name])
        ended = Outcome(*scalars.get("outcome", ("", "")))
        same = scalars.get("tolerance") == self.settings.tolerance and self.settings.weight in (None, self.weight)
        complete = ended.reason == "iterations" and self.settings.iterations <= self.iteration
        if same and (complete or ended.reason in ("converged", "discrepancy")):
            self.ended = ended
        if self.settings.weight is not None:
            self.weight = self.settings.weight
        elif self.level > self.search_levels[-1] and self.weight is None:
            self.weight = self.guess

    def _outcome(self, converged: bool) -> Outcome:
        settings = self.settings
        weight = f"; weight {self.weight:.3g}: {self.reason}" if settings.weight is None else ""
        if converged and self.reason and settings.weight is not None:
            return Outcome("discrepancy", self.reason)
        if converged:
            text = f"the objective falls by less than {settings.tolerance:g} per iteration"
            return Outcome("converged", text + weight)
        text = f"stopped after {settings.iterations} iterations; more --iterations may reduce the error"
        return Outcome("iterations", text + weight)

    def _result(self, outcome: Outcome) -> Reconstruction:
        assert self.x is not None
        state = self._capture()
        state.scalars["outcome"] = [outcome.reason, outcome.message]
        state.scalars["tolerance"] = self.settings.tolerance
        remark = remark_on(resolve_device(self.settings.device), self.layout.dtype)
        return Reconstruction(
            field=self._field(self.here).to("cpu"), box=self.measurement.box, n_ambient=self.measurement.n_ambient,
            history=self.history, outcome=Outcome(outcome.reason, outcome.message + remark),
            settings=asdict(self.settings), seconds=self.seconds,
            peak_memory_bytes=peak_memory(self.device), device=str(self.device), state=state,
            quantity=self.measurement.quantity, rig=self._table(), axis=self.axis, bodies=self.measurement.bodies,
        )  # fmt: skip
