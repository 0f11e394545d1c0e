"""What the classical methods share: a voxel grid, coarse to fine, and a loop that watches over the iterations.

A method is a generator of iterates (tikhonov.py, landweber.py, total_variation.py); everything else is here.
"""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from nerif.conventions import InputError, parse_faces
from nerif.fields.base import Field
from nerif.fields.grid import DEGREES, Boundary, VoxelField
from nerif.geometry import Grid
from nerif.measurement import Measurement
from nerif.reconstruction import kernels_torch
from nerif.reconstruction.base import OnStep, Outcome, Reconstruction, Reconstructor, State, Step
from nerif.reconstruction.bounds import check_bounds, field_bounds
from nerif.reconstruction.device import available_memory, peak_memory, resolve_device
from nerif.reconstruction.fingerprint import check_fingerprint, fingerprint
from nerif.reconstruction.gauge import ambient_faces, check_gauge, visual_hull
from nerif.reconstruction.levels import coarser, levels
from nerif.reconstruction.operator import VoxelOperator
from nerif.reconstruction.problem import Iterate, Problem
from nerif.reconstruction.target import Target
from nerif.reconstruction.weight import FIRST, choose_weight
from nerif.techniques.registry import AUTO, check_model

__all__ = ["VoxelReconstructor", "WeightedVoxelReconstructor"]

VOLUMES = 22  # arrays the size of the grid that the hungriest method holds at once (tests/reconstruction)
DATA = 8  # arrays the size of the data
COMPILER_BYTES = 1 << 28  # of Numba, whatever the grid (benchmarks/results/voxel-cost-cpu.md)


@dataclass(frozen=True)
class VoxelReconstructor(Reconstructor):
    """Settings of every classical method."""

    voxels: int = 100
    """Voxels along the longest edge of the box, of the reconstruction and of the written volume."""
    basis: Literal["linear", "cubic"] = "cubic"
    """Between voxel centres: cubic B-splines, or trilinear (two to three times faster, less accurate)."""
    model: str = AUTO
    """Forward model, a linear one: of displacements lever_arm (auto) or paraxial."""
    step: float | None = None
    """Longest distance between samples along a ray, in voxels; by default 1 (cubic) or 0.5 (linear)."""
    coarse_to_fine: bool = True
    """Start on a coarse grid and halve the voxels from solution to solution."""
    tolerance: float = 1e-4
    """Converged when the objective falls by less than this share an iteration, on the mean of a few."""
    time_limit: float = 0.0
    """Stop after so many seconds; 0 for no limit."""
    lower: float | None = None
    """Lowest value that the field can have (of the index excess of hot gas: -2.7e-4); else that of the technique."""
    upper: float | None = None
    """Highest value that the field can have (of the index excess of hot gas in air: 0)."""
    hull: bool = True
    """Pin voxels outside the visual hull to the ambient index, where the measurement has flow masks."""
    ambient_faces: tuple[str, ...] = ()
    """Faces on which the index is ambient; empty: those of the measurement."""
    open_faces: tuple[str, ...] = ()
    """Faces through which flow leaves the box; rays that cross them are dropped."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, ..."""
    precision: Literal["float32", "float64"] = "float32"
    """Of voxels and data."""
    iterations: int = 50
    """Most iterations on each grid and with each weight."""

    def __post_init__(self) -> None:
        for name, allowed in (("basis", tuple(DEGREES)), ("precision", ("float32", "float64"))):
            if getattr(self, name) not in allowed:
                raise InputError(f"{name}: expected one of {', '.join(allowed)}, got '{getattr(self, name)}'")
        for name in ("voxels", "iterations"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if self.step is not None and not self.step > 0:
            raise InputError(f"step: expected above 0 voxels, got {self.step}")
        for name in ("tolerance", "time_limit"):
            if not getattr(self, name) >= 0:
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")
        check_model(self.model)
        check_bounds(self.lower, self.upper)
        parse_faces(self.ambient_faces)
        parse_faces(self.open_faces, "open_faces")

    @property
    def weight(self) -> float | None:
        """Weight of the penalty, or None where it is to be chosen."""
        return 0.0

    @property
    def patience(self) -> int:
        """Iterations over which the fall of the objective is averaged."""
        return 3

    @abstractmethod
    def iterate(self, problem: Problem, x: Tensor, weight: float) -> Iterator[Iterate]:
        """Yield one iterate after another, from x, without end."""

    def begin(self, problem: Problem, x: Tensor) -> Tensor:
        """Return what to iterate from, given a field to start from: that field within the bounds."""
        return problem.clip(x)

    @property
    def itemsize(self) -> int:
        """Bytes of a number."""
        return 4 if self.precision == "float32" else 8

    def operator_bytes(self, measurement: Measurement, grid: Grid) -> int:
        """Return what the operators of all techniques hold."""
        dtype = getattr(torch, self.precision)
        return sum(
            VoxelOperator.memory_bytes(rays, grid, self.basis, dtype, channels)
            for rays, channels in _seen(measurement)
        )

    def memory_bytes(self, measurement: Measurement, grid: Grid, device: str = "cpu") -> int:
        """Return what a run will need at most, beside what the process holds already."""
        seen = _seen(measurement)
        rays, numbers = sum(n for n, _ in seen), sum(n * channels for n, channels in seen)
        volumes, data = VOLUMES * math.prod(grid.shape) * self.itemsize, DATA * numbers * self.itemsize
        preparing = 40 * 8 * rays  # rays in double precision, while the operator is made
        around = kernels_torch.CHUNK_BYTES if device == "cuda" else COMPILER_BYTES
        return self.operator_bytes(measurement, grid) + volumes + data + preparing + around

    def __call__(
        self,
        measurement: Measurement,
        on_step: OnStep | None = None,
        resume: State | None = None,
        start: Field | None = None,
    ) -> Reconstruction:
        return _Run(self, measurement, on_step, resume, start)()


@dataclass(frozen=True)
class WeightedVoxelReconstructor(VoxelReconstructor):
    """Settings of a method with a penalty."""

    regularisation: Literal["auto"] | float = "auto"
    """Weight of the penalty, or auto: by the discrepancy principle where sigma is known, else by the L-curve."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.regularisation != "auto" and not (
            isinstance(self.regularisation, int | float) and 0 <= self.regularisation < math.inf
        ):
            raise InputError(f"regularisation: expected auto or a weight of 0 or more, got {self.regularisation}")

    @property
    def weight(self) -> float | None:
        return None if self.regularisation == "auto" else float(self.regularisation)


def _seen(measurement: Measurement) -> list[tuple[int, int]]:
    """Rays and channels of each technique."""
    return [(int(measurement.usable_for(o).sum()), len(o.technique.channels)) for o in measurement.observations]


class _Stop(Exception):
    """Asked to stop, or out of time."""


class _Run:
    """One run: the grids, the iterations, and what is told of them."""

    def __init__(
        self,
        settings: VoxelReconstructor,
        measurement: Measurement,
        on_step: OnStep | None,
        resume: State | None,
        start: Field | None,
    ) -> None:
        self.settings, self.measurement, self.on_step, self.field_before = settings, measurement, on_step, start
        self.device = resolve_device(settings.device)
        self.faces = ambient_faces(measurement, settings.ambient_faces)
        check_gauge(measurement, self.faces, settings.hull)
        self.grids = levels(measurement.box, settings.voxels, DEGREES[settings.basis], settings.coarse_to_fine)
        needed = settings.memory_bytes(measurement, self.grids[-1], self.device.type)
        there = available_memory(self.device)
        if needed > there:
            raise InputError(
                f"voxels: a grid of {' x '.join(map(str, self.grids[-1].shape))} would need "
                f"{needed / 2**30:.1f} GiB on {self.device}, which has {there / 2**30:.1f} GiB free; "
                f"give fewer --voxels than {settings.voxels}"
            )
        self.free = (
            visual_hull(measurement, self.grids[-1]) if settings.hull and measurement.flow_mask is not None else None
        )
        bounds = field_bounds(measurement, settings.lower, settings.upper)
        self.bounds = bounds if math.isfinite(bounds[0]) or math.isfinite(bounds[1]) else None
        self.target = Target.of(measurement, settings.open_faces, model=settings.model, linear=True).to(self.device)
        self.noise = self.target.noise
        self.history: list[dict[str, float]] = []
        # a field to start from makes the coarse grids needless
        self.level, self.done, self.total = 0 if start is None else len(self.grids) - 1, 0, 0
        self.weight = settings.weight
        self.chosen = ""
        self.x: Tensor | None = None
        self.spent, self.started = 0.0, time.perf_counter()
        self.fingerprint = fingerprint(measurement, settings.open_faces)
        if resume is not None:
            self._restore(resume)

    # -- the way from coarse to fine -------------------------------------------------------------------------------

    def __call__(self) -> Reconstruction:
        """Solve on one grid after the other, and return what there is when something says stop."""
        outcome = None
        try:
            while True:
                problem = self._problem(self.grids[self.level])
                x = self._begin(problem)
                if self.level < len(self.grids) - 1:
                    self._solve(problem, x, FIRST if self.weight is None else self.weight)
                    self.level, self.done = self.level + 1, 0
                    continue
                converged = self._finest(problem, x)
                break
        except _Stop as stop:
            outcome = Outcome(*stop.args)
        return self._result(outcome or self._outcome(converged))

    def _finest(self, problem: Problem, x: Tensor) -> bool:
        """Solve on the last grid, with the weight that the data ask for; whether it converged."""
        if self.weight is None:

            def solve(weight: float, x: Tensor) -> Iterate:
                self.done = 0
                return self._solve(problem, x, weight, 10 * self.settings.tolerance)[0]

            choice = choose_weight(solve, x, self.noise)
            self.weight, self.chosen, x, self.done = choice.weight, choice.reason, choice.x, 0
        return self._solve(problem, x, self.weight)[1]

    def _begin(self, problem: Problem) -> Tensor:
        """Where to start on a grid: a checkpoint, a given field, the solution on the grid before, or nothing."""
        shape = problem.operator.domain_shape
        if self.x is not None and tuple(self.x.shape) == shape:
            return self.x.to(problem.operator.device, problem.operator.dtype)
        if self.x is not None:
            field: Field = self._field(self.grids[self.level - 1])
        elif self.field_before is not None:
            field = self.field_before
        else:
            return self.settings.begin(problem, problem.zero())
        values = field.sample(problem.operator.grid, self.device).to(problem.operator.device, problem.operator.dtype)
        return self.settings.begin(problem, values / self.target.scale)

    def _field(self, grid: Grid) -> VoxelField:
        """The field of the present solution, which is on that grid."""
        assert self.x is not None
        return VoxelField.of(self.x * self.target.scale, grid, DEGREES[self.settings.basis], Boundary(self.faces))

    def _problem(self, grid: Grid) -> Problem:
        settings, boundary = self.settings, Boundary(self.faces)
        dtype = getattr(torch, settings.precision)
        operators = [
            VoxelOperator(part.rays, grid, part.model, settings.basis, boundary, settings.step, self.device, dtype)
            for part in self.target.parts
        ]
        return Problem(operators, self.target, None if self.free is None else coarser(self.free, grid), self.bounds)

    # -- the loop ------------------------------------------------------------------------------------------------

    def _solve(
        self, problem: Problem, x: Tensor, weight: float, tolerance: float | None = None
    ) -> tuple[Iterate, bool]:
        """Iterate until it converges or the iterations are used up; which, is told."""
        settings, past = self.settings, [math.inf] * self.settings.patience
        tolerance = settings.tolerance if tolerance is None else tolerance
        if settings.weight is not None:
            self.chosen = ""
        self.x = x
        for iterate in settings.iterate(problem, x, weight):
            objective = iterate.objective(weight)
            if not math.isfinite(objective):
                message = "the objective turned non-finite, the field before that was kept"
                raise _Stop("diverged", f"{message}; look for extreme values or sigma in the measurement")
            self.x, self.done, self.total = iterate.x, self.done + 1, self.total + 1
            before, past = past[0], [*past[1:], objective]
            self._tell(problem, iterate, weight, objective)
            converged = 0 <= before - objective < tolerance * settings.patience * objective
            if settings.weight == 0.0 and self.noise is not None and iterate.residual <= self.noise:
                self.chosen, converged = "residual is the noise (discrepancy principle)", True
            if converged or self.done >= settings.iterations:
                return iterate, converged
        raise AssertionError("a method iterates without end")

    def _tell(self, problem: Problem, iterate: Iterate, weight: float, objective: float) -> None:
        """Record the iteration, tell the callback, and stop where that or the clock asks for it."""
        voxels = float(max(problem.operator.domain_shape))
        record = {
            "step": float(self.total),
            "seconds": self.seconds,
            "voxels": voxels,
            "weight": weight,
            "residual": math.sqrt(iterate.residual),
            "penalty": iterate.penalty,
            "objective": objective,
        }
        if self.noise is not None:
            record["residual_over_sigma"] = math.sqrt(iterate.residual / self.noise)
        self.history.append(record)
        losses = {k: v for k, v in record.items() if k in ("voxels", "weight", "residual", "residual_over_sigma")}
        speed = len(self.target) * self.total / max(self.seconds, 1e-9)
        limit = self.settings.time_limit
        progress = self._progress()
        step = Step(self.total, float(self.total), self.seconds, progress, losses, speed, self._capture)
        if self.on_step is not None and self.on_step(step):
            raise _Stop("interrupted", f"stopped on request at {voxels:.0f} voxels; --resume goes on from here")
        if limit and self.seconds >= limit:
            raise _Stop(
                "time_limit", f"time limit of {limit:g} s reached at {voxels:.0f} voxels; more time may give more"
            )

    def _progress(self) -> float:
        """Share of the work done, at worst: the cost of a grid goes with its voxels along an edge."""
        work = [max(g.shape) * self.settings.iterations for g in self.grids]
        trials = 8 if self.settings.weight is None else 1
        work[-1] *= trials
        here = max(self.grids[self.level].shape)
        done = sum(work[: self.level]) + here * min(self._on_this_grid(), work[self.level] // here)
        share = done / sum(work)
        limit = self.settings.time_limit
        return min(1.0, max(share, self.seconds / limit if limit else 0.0))

    def _on_this_grid(self) -> int:
        voxels = float(max(self.grids[self.level].shape))
        return sum(1 for record in self.history if record["voxels"] == voxels)

    @property
    def seconds(self) -> float:
        """Spent, earlier parts of a resumed run included."""
        return self.spent + time.perf_counter() - self.started

    # -- what is kept --------------------------------------------------------------------------------------------

    def _capture(self) -> State:
        assert self.x is not None
        scalars: dict[str, Any] = {name: getattr(self, name) for name in ("level", "done", "total", "weight", "chosen")}
        scalars |= {"method": type(self.settings).__name__, "seconds": self.seconds, "history": list(self.history)}
        scalars["fingerprint"] = self.fingerprint
        return State({"x": self.x.detach().clone()}, scalars)

    def _restore(self, state: State) -> None:
        scalars, shapes = dict(state.scalars), [g.shape for g in self.grids]
        check_fingerprint(scalars.pop("fingerprint", None), self.fingerprint)
        level = scalars.get("level", -1)
        if (
            scalars.pop("method", None) != type(self.settings).__name__
            or not 0 <= level < len(shapes)
            or tuple(state.tensors["x"].shape) != shapes[level]
        ):
            raise InputError("resume: the checkpoint is of another method or grid; give the same settings")
        self.x = state.tensors["x"].clone()
        self.spent, self.started = scalars.pop("seconds"), time.perf_counter()
        self.history = list(scalars.pop("history"))
        for name, value in scalars.items():
            setattr(self, name, value)
        if self.settings.weight is not None:
            self.weight = self.settings.weight

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
            field=self._field(self.grids[self.level]).to("cpu"),
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
        )
