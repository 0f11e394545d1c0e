"""Gaussian process tomography: the posterior mean of a field whose detail has the spectrum of turbulence."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

from nerif.common.settings import Count
from nerif.forward.model_names import AUTO, MODEL_NAMES
from nerif.reconstruction.reconstructor import OnStep, Outcome, Reconstruction, State, Step
from nerif.reconstruction.shared_settings import SHORT_RUN, SharedSettings, Source
from nerif.reconstruction.voxels.tikhonov import Tikhonov

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement
    from nerif.fields.field import Field
    from nerif.reconstruction.detail.detail import Posterior

__all__ = ["GaussianProcess"]

FIRST_VOXELS = 48  # along the longest edge, at most, of the first solution


@dataclass(frozen=True)
class GaussianProcess(SharedSettings):
    """Gaussian process on voxels: the posterior mean of detail (detail.py) about a smooth solution.

    The first solution is Tikhonov's. Blurred, it is the mean; the local rms of its gradient is the size of detail. The
    posterior mean on a coarse grid takes its place, and that on the fine grid is the result.

    Sources: Svensson, Non-parametric tomography using Gaussian processes, EFDA-JET-PR(11)24 (2011); von Karman, PNAS 34
    (1948) 530, for the spectrum.
    """

    title: ClassVar[str] = "Gaussian process"
    voxels: Count = 100
    """Voxels along the longest edge of the box, in the reconstruction and in the written volume."""
    model: Literal[*MODEL_NAMES] = AUTO  # type: ignore[valid-type]
    """Linear forward model of displacements: lever_arm (auto) or paraxial."""
    source: Source = "auto"
    """Data to fit: displacements, images (pixel by pixel, linearised about the displacements), both, or
    auto (displacements where available)."""
    hull: bool = True
    """Fix voxels outside the visual hull of the flow masks at the ambient index."""
    iterations: Count = 30
    """Iterations of conjugate gradients on each grid, at most."""

    def split_for_cross_validation(self) -> tuple[GaussianProcess, GaussianProcess]:
        short = replace(self, voxels=max(8, self.voxels // 2), time_limit=SHORT_RUN * self.time_limit)
        return short, self

    @property
    def first(self) -> Tikhonov:
        """Settings of the first solution."""
        shared = {f.name: getattr(self, f.name) for f in dataclasses.fields(SharedSettings)}
        voxels = min(FIRST_VOXELS, self.voxels)
        return Tikhonov(**shared, voxels=voxels, model=self.model, source=self.source, hull=self.hull)

    def __call__(
        self, measurement: Measurement, on_step: OnStep | None = None, resume: State | None = None,
        start: Field | None = None,
    ) -> Reconstruction:  # fmt: skip
        from nerif.reconstruction.detail.detail import COARSE, Detail, check_sigma
        from nerif.reconstruction.device import peak_memory
        from nerif.reconstruction.rig_parameters import with_corrections

        begin = time.perf_counter()
        check_sigma(measurement)

        def watch_first(step: Step) -> bool | None:
            return None if on_step is None else on_step(replace(step, progress=step.progress / 3))

        first = self.first(measurement, watch_first, resume, start)
        seconds = max(0.0, first.seconds - (time.perf_counter() - begin))  # of earlier parts of a resumed run
        history, stopped = list(first.history), ""

        def watch(posterior: Posterior) -> bool:
            """Record an iteration and report it; return whether to stop."""
            nonlocal stopped
            now = seconds + time.perf_counter() - begin
            size = float(max(posterior.detail.grid.shape))
            record = {"residual_over_sigma": posterior.residual, "objective": posterior.objective, "voxels": size}
            history.append({"step": history[-1]["step"] + 1, "seconds": now, **record})
            on_this = sum(record["voxels"] == size for record in history[len(first.history) :])
            done = (1 + min(1.0, on_this / (2 * self.iterations)) + (posterior.detail.coarse == 1)) / 3
            rays = len(posterior.problem.target) * posterior.count / max(now, 1e-9)
            count, state = int(history[-1]["step"]), first.state
            assert state is not None
            field, rig = lambda: posterior.splines, lambda: first.rig
            step = Step(count, count, now, done, record, rays, lambda: state, field, rig=rig)
            if on_step is not None and on_step(step):
                stopped = "interrupted"
            elif self.time_limit and now >= self.time_limit:
                stopped = "time_limit"
            return bool(stopped)

        if first.outcome.failed or first.outcome.reason in ("interrupted", "time_limit"):
            return replace(first, settings=asdict(self))
        corrected, field = with_corrections(measurement, first.rig), first.field
        for coarse in (COARSE, 1):
            detail = Detail(field, corrected, self, first.axis, coarse, self.voxels)
            posterior = detail.posterior(detail.first(blurred=True), watch, self.iterations)
            field = posterior.splines
            if stopped:
                break
        messages = {
            "interrupted": "stopped on request; continue with --resume",
            "time_limit": f"stopped at the time limit, after {history[-1]['seconds']:.0f} s",
            "": f"{posterior.count} iterations on {max(detail.grid.shape)} voxels; "
            f"the residual is {posterior.residual:.2f} sigma",
        }
        outcome = Outcome(stopped or "iterations", messages[stopped])
        return replace(
            first, field=field.to("cpu"), history=history, outcome=outcome, settings=asdict(self),
            seconds=history[-1]["seconds"], peak_memory_bytes=peak_memory(detail.device),
        )  # fmt: skip
