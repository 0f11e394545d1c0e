"""The way of a classical method: from coarse grids and large bins of pixels to fine ones, watched over step by step.

What is left of the measurement is always judged by single pixels, for the noise of neighbours may be alike: a bin of
them then has more than its share of it.

A rig is refined between solutions (refinement.py): on each level the field follows ROUNDS times.

A method without a penalty is kept from the noise by stopping alone, so on coarse grids, whose residual never comes down
to the noise, it goes on as soon as it gains little.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.common.pauses import pause
from nerif.data.measurement import Measurement
from nerif.fields.base import Field
from nerif.geometry import Rays
from nerif.reconstruction.aperture import seen_through
from nerif.reconstruction.base import OnStep, Outcome, Reconstruction, State, Step
from nerif.reconstruction.bounds import field_bounds
from nerif.reconstruction.device import Cores, available_memory, peak_memory, resolve_device
from nerif.reconstruction.files import check_fingerprint, fingerprint
from nerif.reconstruction.gauge import ambient_faces, check_gauge
from nerif.reconstruction.neural.bins import pixel_subset
from nerif.reconstruction.rig.refinement import MOMENTUM, Refinement, load_rig, random_pixels, rig_state
from nerif.reconstruction.sources import of_source
from nerif.reconstruction.symmetry import axis_of
from nerif.reconstruction.target import Part, Target
from nerif.reconstruction.voxels.layout import layout_of
from nerif.reconstruction.voxels.levels import Level, coarser, levels
from nerif.reconstruction.voxels.problem import Iterate, Problem
from nerif.reconstruction.voxels.weight import FIRST, choose_weight

if TYPE_CHECKING:
    from nerif.reconstruction.voxels.settings import VoxelReconstructor

__all__ = ["Descent"]

JUDGES = 1 << 16  # pixels, about, by whom the rest is judged: their mean square is known to half a per cent
ROUGHLY = 10  # times the tolerance, for trials and for what is there to start from
EARLY = 100  # times the tolerance, for what is there to start from, where nothing but an early end keeps the noise out
TRIALS = 8  # weights that are tried on a grid, about
WHILE_REFINED = 0.1  # of FIRST: the weight while a rig is refined and none is chosen yet
ROUNDS = 20  # times that a rig is refined on a level, the field following
CALM = 5  # of them at the end without momentum
FOLLOWING = 8  # iterations in which the field follows
KEPT = ("level", "round", "done", "total", "weight", "guess", "chosen", "choosing")  # of a run, in a checkpoint


class _Stop(Exception):
    """Asked to stop, or out of time."""


class Descent:
    """One run: the levels, the iterations, and what is told of them."""

    def __init__(
        self,
        settings: VoxelReconstructor,
        measurement: Measurement,
        on_step: OnStep | None,
        resume: State | None,
        start: Field | None,
    ) -> None:
        measurement = seen_through(
            of_source(measurement, settings.source, preferred="displacements"), settings.aperture
        )
        self.settings, self.measurement, self.on_step, self.field_before = settings, measurement, on_step, start
        self.device = resolve_device(settings.device)
        self.cores = Cores(self.device)
        self.faces = ambient_faces(measurement, settings.ambient_faces)
        check_gauge(measurement, self.faces, settings.hull)
        self.axis = axis_of(settings, measurement)
        symmetry = None if self.axis is None else self.axis.symmetry
        self.layout = layout_of(symmetry, measurement.box, self.faces, settings.basis)
        grids = self.layout.grids(settings.voxels, settings.coarse_to_fine)
        self.levels = levels(measurement, grids, settings.coarse_to_fine)
        finest = self.levels[-1].grid
        needed = settings.memory_bytes(measurement, finest, self.device.type)
        there = available_memory(self.device)
        if needed > there:
            raise InputError(
                f"a grid of {' x '.join(map(str, finest.shape))} would need "
                f"{needed / 2**30:.1f} GiB on {self.device}, which has {there / 2**30:.1f} GiB free; "
                f"give fewer --voxels than {settings.voxels}",
                field="voxels",
            )
        masked = settings.hull and measurement.flow_mask is not None
        self.free = self.layout.free(measurement, finest) if masked else None
        bounds = field_bounds(measurement, settings.lower, settings.upper)
        self.bounds = bounds if math.isfinite(bounds[0]) or math.isfinite(bounds[1]) else None
        self.last = self._target(self.levels[-1].edge)
        self.scale = self.last.scale
        self.history: list[dict[str, float]] = []
        # a field to start from makes the coarse grids needless
        first = [level.grid for level in self.levels].index(finest)
        self.level, self.round, self.done, self.total = 0 if start is None else first, 0, 0, 0
        self.rig = None
        if settings.refine:
            sigma = (settings.pose_sigma_mm, settings.pose_sigma_deg, settings.shift_sigma_px)
            self.rig = Refinement.for_measurement(measurement, settings.refine, *sigma)
        # a weight is sought on the last grid but one and mended on the last; where there is no other, sought at the end
        self.choosing = [first - 1, first if first and start is None else len(self.levels) - 1]
        self.weight = settings.weight
        self.guess: float | None = None
        self.chosen = ""
        self.x: Tensor | None = None
        self.spent, self.started = 0.0, time.perf_counter()
        self.fingerprint = fingerprint(measurement, settings.open_faces)
        if resume is not None:
            self._restore(resume)

    # -- the way from coarse to fine -------------------------------------------------------------------------------

    def __call__(self) -> Reconstruction:
        """Solve on one level after the other, and return what there is when something says stop."""
        with self.cores:
            return self._go()

    def _go(self) -> Reconstruction:
        try:
            while True:
                problem, judge = self._problems(self.here)
                x = self._begin(problem)
                if self.rig is not None and self.round < ROUNDS:
                    self._refine(self.rig, problem, judge, x)
                    continue
                if self.weight is None and self.level in self.choosing:
                    x = self._choose(problem, judge, x)
                weight = self.guess if self.weight is None else self.weight
                at_last = self.level == len(self.levels) - 1
                before = EARLY if self.settings.weight == 0.0 else ROUGHLY
                tolerance = self.settings.tolerance * (1 if at_last else before)
                _, converged = self._solve(problem, judge, x, FIRST if weight is None else weight, tolerance)
                if at_last:
                    return self._result(self._outcome(converged))
                self.level, self.round, self.done = self.level + 1, 0, 0
        except _Stop as stop:
            return self._result(Outcome(*stop.args))

    @property
    def here(self) -> Level:
        """The present level."""
        return self.levels[self.level]

    def _choose(self, problem: Problem, judge: Problem | None, x: Tensor) -> Tensor:
        """Choose the weight that the data ask for; return where to go on from."""

        def solve(weight: float, x: Tensor) -> Iterate:
            self.done = 0
            found = self._solve(problem, judge, x, weight, ROUGHLY * self.settings.tolerance)[0]
            return replace(found, residual=_left(judge, found))

        noise = _noise(problem, judge)
        choice = choose_weight(solve, x, noise, self.guess)
        self.guess, self.chosen, self.done = choice.weight, choice.reason, 0
        if noise is None or self.level == self.choosing[-1]:
            self.weight = choice.weight
        return choice.x

    def _refine(self, rig: Refinement, problem: Problem, judge: Problem | None, x: Tensor) -> None:
        """Let the field follow the rig for a while, then move the rig by a step."""
        weight = next((w for w in (self.weight, self.guess) if w is not None), FIRST * WHILE_REFINED)
        tolerance = ROUGHLY * self.settings.tolerance
        if not self.done:
            self.done = max(0, self.settings.iterations - FOLLOWING * (1 + 2 * (self.round == 0)))
        found, _ = self._solve(problem, judge, x, weight, tolerance)

        def predict(part: Part, rays: Rays) -> Tensor:
            operator = next(o for o, p in zip(problem.operators, self.last.parts, strict=True) if p.model is part.model)
            return operator.for_rays(rays, part.model)(found.x * self.scale)

        momentum = MOMENTUM if self.round < ROUNDS - CALM else 0.0
        parts = random_pixels(self.last, len(self.measurement.names), self.round)
        rig.step(parts, predict, self.last.sigma_known, momentum)
        self.round, self.done = self.round + 1, 0

    def _begin(self, problem: Problem) -> Tensor:
        """Where to start on a grid: a checkpoint, a given field, the solution on the grid before, or nothing."""
        shape = problem.operator.domain_shape
        if self.x is not None and tuple(self.x.shape) == shape:
            return self.x.to(problem.operator.device, problem.operator.dtype)
        if self.x is not None:
            field: Field = self._field(self.levels[self.level - 1])
        elif self.field_before is not None:
            field = self.field_before
        else:
            return self.settings.begin(problem, problem.zero())
        values = self.layout.sample(field, problem.operator.grid, self.device)
        values = values.to(problem.operator.device, problem.operator.dtype)
        return self.settings.begin(problem, values / self.scale)

    def _field(self, level: Level) -> Field:
        """The field of the present solution, which is on that level's grid."""
        assert self.x is not None
        return self.layout.field(self.x * self.scale, level.grid)

    def _target(self, edge: int, measurement: Measurement | None = None) -> Target:
        """What bins of so many pixels along an edge measured; of a measurement, or of all."""
        settings, measurement = self.settings, measurement or self.measurement
        return Target.of(measurement, settings.open_faces, edge, settings.model, linear=True).to(self.device)

    @cached_property
    def judges(self) -> Target:
        """The pixels that judge what bins leave."""
        return replace(self._target(1, pixel_subset(self.measurement, JUDGES)), scale=self.scale)

    def _problems(self, level: Level) -> tuple[Problem, Problem | None]:
        """The problem of a level and, where it has bins, that of the pixels that judge what they leave."""
        same = level.edge == self.levels[-1].edge
        target = self.last if same else replace(self._target(level.edge), scale=self.scale)
        return self._problem(level, target), None if level.edge == 1 else self._problem(level, self.judges)

    def _problem(self, level: Level, target: Target) -> Problem:
        settings, grid = self.settings, level.grid
        dtype = getattr(torch, settings.precision)
        if self.rig is not None:
            target = replace(target, parts=tuple(self.rig.of(part) for part in target.parts))
        operators = [
            self.layout.operator(part.rays, grid, part.model, settings.step, self.device, dtype)
            for part in target.parts
        ]
        return Problem(operators, target, None if self.free is None else coarser(self.free, grid), self.bounds)

    # -- the loop ------------------------------------------------------------------------------------------------

    def _solve(
        self, problem: Problem, judge: Problem | None, x: Tensor, weight: float, tolerance: float
    ) -> tuple[Iterate, bool]:
        """Iterate until it converges or the iterations are used up; which, is told."""
        settings, past, noise = self.settings, [math.inf] * self.settings.patience, _noise(problem, judge)
        if settings.weight is not None:
            self.chosen = ""
        self.x = x
        for iterate in settings.iterate(problem, x, weight):
            objective = iterate.objective(weight)
            if not math.isfinite(objective):
                message = "the objective turned non-finite, the field before that was kept"
                raise _Stop("diverged", f"{message}; look for extreme values or sigma in the measurement")
            pause()
            self.x, self.done, self.total = iterate.x, self.done + 1, self.total + 1
            before, past = past[0], [*past[1:], objective]
            self._tell(problem, judge, iterate, weight)
            converged = 0 <= before - objective < tolerance * settings.patience * objective
            if settings.weight == 0.0 and noise is not None and _left(judge, iterate) <= noise:
                self.chosen, converged = "residual is the noise (discrepancy principle)", True
            if converged or self.done >= settings.iterations:
                return iterate, converged
        raise AssertionError("a method iterates without end")

    def _tell(self, problem: Problem, judge: Problem | None, iterate: Iterate, weight: float) -> None:
        """Record the iteration, tell the callback, and stop where that or the clock asks for it."""
        voxels = float(max(self.here.grid.shape))
        record = {
            "step": float(self.total),
            "seconds": self.seconds,
            "voxels": voxels,
            "bin_edge": float(self.here.edge),
            "weight": weight,
            "residual": math.sqrt(iterate.residual),
            "penalty": iterate.penalty,
            "objective": iterate.objective(weight),
        }
        if judge is None and problem.target.noise is not None:
            record["residual_over_sigma"] = math.sqrt(iterate.residual / problem.target.noise)
        self.history.append(record)
        losses = {k: v for k, v in record.items() if k in ("voxels", "weight", "residual", "residual_over_sigma")}
        speed = len(problem.target) * self.total / max(self.seconds, 1e-9)
        limit = self.settings.time_limit
        step = Step(
            self.total, float(self.total), self.seconds, self._progress(), losses, speed, self._capture,
            lambda: self._field(self.here),
        )  # fmt: skip
        if self.on_step is not None and self.on_step(step):
            raise _Stop("interrupted", f"stopped on request at {voxels:.0f} voxels; --resume goes on from here")
        if limit and self.seconds >= limit:
            raise _Stop(
                "time_limit", f"time limit of {limit:g} s reached at {voxels:.0f} voxels; more time may give more"
            )

    def _progress(self) -> float:
        """Share of the work done, at worst: the cost of a level goes with its rays and the voxels along them."""
        most, costs = [], []
        for i, level in enumerate(self.levels):
            trials = TRIALS if i in self.choosing and self.settings.weight is None else 1
            most.append(trials * self.settings.iterations)
            costs.append(max(level.grid.shape) / level.edge**2)
        work = [m * c for m, c in zip(most, costs, strict=True)]
        here = (float(max(self.here.grid.shape)), float(self.here.edge))
        on_this = sum(1 for record in self.history if (record["voxels"], record["bin_edge"]) == here)
        done = sum(work[: self.level]) + costs[self.level] * min(on_this, most[self.level])
        limit = self.settings.time_limit
        return min(1.0, max(done / sum(work), self.seconds / limit if limit else 0.0))

    @property
    def seconds(self) -> float:
        """Spent, earlier parts of a resumed run included."""
        return self.spent + time.perf_counter() - self.started

    # -- what is kept --------------------------------------------------------------------------------------------

    def _capture(self) -> State:
        assert self.x is not None
        scalars: dict[str, Any] = {name: getattr(self, name) for name in KEPT}
        scalars |= {"method": type(self.settings).__name__, "seconds": self.seconds, "history": list(self.history)}
        scalars["fingerprint"] = self.fingerprint
        return State({"x": self.x.detach().clone(), **rig_state(self.rig)}, scalars)

    def _restore(self, state: State) -> None:
        scalars, shapes = dict(state.scalars), [level.grid.shape for level in self.levels]
        check_fingerprint(scalars.pop("fingerprint", None), self.fingerprint)
        level = scalars.get("level", -1)
        if (
            scalars.pop("method", None) != type(self.settings).__name__
            or not 0 <= level < len(shapes)
            or tuple(state.tensors["x"].shape) != shapes[level]
        ):
            raise InputError("the checkpoint is of another method or grid; give the same settings", field="resume")
        self.x = state.tensors["x"].clone()
        load_rig(self.rig, state.tensors)
        self.spent, self.started = scalars.pop("seconds"), time.perf_counter()
        self.history = list(scalars.pop("history"))
        for name, value in scalars.items():
            setattr(self, name, value)
        if self.settings.weight is not None:
            self.weight = self.settings.weight
        elif self.level > self.choosing[-1] and self.weight is None:
            self.weight = self.guess

    def _outcome(self, converged: bool) -> Outcome:
        chosen = f"; weight {self.weight:.3g}: {self.chosen}" if self.settings.weight is None else ""
        if converged and self.chosen and self.settings.weight is not None:
            return Outcome("discrepancy", self.chosen)
        if converged:
            text = f"the objective falls by less than {self.settings.tolerance:g} an iteration"
            return Outcome("converged", text + chosen)
        text = f"all {self.settings.iterations} iterations done; more --iterations may give more"
        return Outcome("iterations", text + chosen)

    def _result(self, outcome: Outcome) -> Reconstruction:
        assert self.x is not None
        return Reconstruction(
            field=self._field(self.here).to("cpu"),
            box=self.measurement.box,
            n_ambient=self.measurement.n_ambient,
            history=self.history,
            outcome=outcome,
            settings=asdict(self.settings),
            seconds=self.seconds,
            peak_memory_bytes=peak_memory(self.device),
            device=str(self.device),
            state=self._capture(),
            quantity=self.measurement.quantity,
            rig=[] if self.rig is None else self.rig.table(),
            axis=self.axis,
        )


def _left(judge: Problem | None, iterate: Iterate) -> float:
    """|F x - b|^2 of the pixels that judge, or of all where there are none."""
    return iterate.residual if judge is None else float((judge.data - judge.forward(iterate.x)).square().sum())


def _noise(problem: Problem, judge: Problem | None) -> float | None:
    """What the noise alone leaves of that; None where sigma is not known."""
    return (judge or problem).target.noise
