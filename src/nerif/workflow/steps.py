"""The steps of a reconstruction into a result directory.

Each says whether it is wanted, and writes its own files and its own section of metrics.json. A run that is resumed
passes through all of them again: what is expensive (cross-validation, fit, trials) continues from its own checkpoint or
is read, the rest is written again.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from dataclasses import asdict, replace
from typing import Any, ClassVar

import numpy as np

from nerif.analysis.asymmetry import asymmetry, asymmetry_sentence
from nerif.analysis.evaluation import evaluate_views, score_lines
from nerif.analysis.prediction import reproject
from nerif.analysis.verdict import verdict
from nerif.analysis.wall_values import surface_map
from nerif.common.conventions import unit_shown
from nerif.common.installation import word_of
from nerif.data.cameras_file import CalibratedCamera, write_cameras
from nerif.data.measurement import Measurement
from nerif.data.quantity_names import describe
from nerif.geometry import Grid
from nerif.physics.quantities import masked_lines
from nerif.reconstruction.detail.detail import COARSE, EARLY, ITERATIONS, SIGNIFICANT, Detail, DetailChoice, choose
from nerif.reconstruction.field_files import FIELD, checkpoints
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import Reconstruction, compose
from nerif.reconstruction.rig_parameters import refinement_lines, with_corrections
from nerif.reconstruction.rig_refinement import refit, with_rig
from nerif.reconstruction.shared_settings import SHORT_RUN, SharedSettings
from nerif.reconstruction.uncertainty.deviations import VOXELS, Deviations
from nerif.reconstruction.uncertainty.rig_posterior import RigPosterior
from nerif.reconstruction.voxels.symmetry_axis import axis_of, better_direction
from nerif.results.directory import CALIBRATION, versions
from nerif.results.metrics_file import Metrics
from nerif.workflow.bootstrap_runs import Members, all_quantities, write_deviations
from nerif.workflow.job import Job
from nerif.workflow.reports import write_report

__all__ = ["CLOSING", "STEPS", "PipelineStep"]

EXPLAINED = 0.6  # of the signal by the first run, above which a blurred field may take most of the time
MOST_DETAIL, MOST_BLURRED = 0.35, 0.7  # of the time that is left; where the field is blurred, its training matters less


class PipelineStep(ABC):
    """A step of the pipeline."""

    sections: ClassVar[tuple[str, ...]] = ()
    """Entries of metrics.json that it writes."""

    @staticmethod
    def wanted(job: Job) -> bool:
        """Return whether the step has anything to do."""
        return True

    @staticmethod
    @abstractmethod
    def run(job: Job) -> None:
        """Run the step and store its results in the job."""


class CrossValidate(PipelineStep):
    """Predict a view from a short run without it; the main run starts from the field of that run.

    Writes and resumes from cross_validation/. If it is interrupted, its field is the result.
    """

    sections = ("cross_validation",)

    @staticmethod
    def wanted(job: Job) -> bool:
        return job.validation is not None and job.state is None

    @staticmethod
    def run(job: Job) -> None:
        assert job.validation is not None
        settings = job.budget.allot(job.validation.reconstructor, 1 / (1 + SHORT_RUN + job.trials.members))
        job.validation = replace(job.validation, reconstructor=settings)
        short = job.validation(job.begin)
        if short is None:
            return
        job.initial, job.method = short.field, job.reconstructor.split_for_cross_validation()[1]
        if short.outcome.reason == "interrupted":
            job.result = replace(short, state=None, box=job.inputs.box)
            job.measurement, job.withheld = job.validation.data, (job.validation.view,)


class ChooseDetail(PipelineStep):
    """Find out how detail is added, and whether it pays, from the cross-validation; hold back time for it."""

    @staticmethod
    def wanted(job: Job) -> bool:
        wanted = job.run.detail == "on" or (job.run.detail == "auto" and job.reconstructor.detailed)
        return wanted and job.result is None and all(o.sigma is not None for o in job.inputs.training.observations)

    @staticmethod
    def run(job: Job) -> None:
        left = job.budget.left
        choice = ChooseDetail.choice(job, left)
        if choice is not None:
            most = share(job, choice) * left
            each = choice.seconds or (most if math.isfinite(most) else 0.0)
            draws = job.trials.members if choice.blurred else 0
            job.budget = job.budget.holding(min(each * (1 + draws), most))
        job.detail = choice

    @staticmethod
    def coarse(job: Job) -> tuple[Detail, Measurement] | None:
        """Return the detail of the field of the cross-validation, on a coarse grid, and the data of its withheld view.

        None without that field.
        """
        validation = job.validation
        if validation is None or (fit := validation.fit) is None:
            return None
        settings = validation.reconstructor
        assert isinstance(settings, SharedSettings)
        axis = axis_of(settings, validation.data.without([validation.view]))  # as for the field
        return Detail(fit.field, fit.training, settings, axis, COARSE), fit.withheld

    @staticmethod
    def choice(job: Job, left: float) -> DetailChoice | None:
        """Return how detail is added, or None; `left`: seconds until the limit."""
        on, fit = job.run.detail == "on", ChooseDetail.coarse(job)
        if fit is None:
            return DetailChoice() if on else None
        coarse, withheld = fit
        if coarse.residual < EARLY and not on:
            return None
        with job.monitor.counting("choosing the detail") as bar:
            choice = choose(coarse, withheld, math.inf if on else MOST_BLURRED * left, bar)
        errors = f"{choice.before:.2f} sigma without it, {choice.after:.2f} with it"
        job.monitor.say(f"detail: residual of the withheld view, on pixels by which nothing was chosen, {errors}")
        if choice.seconds > share(job, choice) * left and not on:
            job.monitor.say(f"detail left out: it takes about {choice.seconds:.0f} s; give a longer --time-limit")
            return None
        return choice if choice.pays or on else None


class Fit(PipelineStep):
    """Reconstruct the field from all views that are not withheld; resumes from checkpoint.safetensors."""

    @staticmethod
    def wanted(job: Job) -> bool:
        return job.result is None

    @staticmethod
    def run(job: Job) -> None:
        title = "training" if isinstance(job.reconstructor, NeRIF) else "solving"
        with job.watching(withheld=bool(job.withheld)).training(title) as progress:
            callbacks = [progress]
            if job.ranks.is_first:  # under torchrun only the first process writes
                callbacks = [job.begin, progress, checkpoints(job.out.path, job.run.checkpoint_every)]
            if job.on_step is not None:
                callbacks.append(job.on_step)
            initial = job.initial if job.state is None else None
            trials = 0 if job.detail is not None and job.detail.blurred else job.trials.members
            method = job.budget.allot(job.method, 1 / (1 + trials))
            result = method(job.inputs.training, compose(*callbacks), job.state, initial)
            job.result = replace(result, box=job.inputs.box)


class AddDetail(PipelineStep):
    """Add the detail that the field leaves in its data; repeated when a run is resumed."""

    sections = ("detail",)

    @staticmethod
    def wanted(job: Job) -> bool:
        outcome = the_result(job).outcome
        return job.detail is not None and not outcome.failed and outcome.reason != "interrupted"

    @staticmethod
    def run(job: Job) -> None:
        result, choice, settings, begin = the_result(job), job.detail, job.reconstructor, time.monotonic()
        assert choice is not None
        assert isinstance(settings, SharedSettings)
        data = with_rig(job.inputs.training, result)
        coarse, fine = (Detail(result.field, data, settings, result.axis, size) for size in (COARSE, 1))
        before = fine.residual
        if before < SIGNIFICANT and job.run.detail == "auto":
            job.monitor.say(f"detail left out: the residual is {before:.2f} sigma")
            return
        job.begin()
        job.out.write_field(result)  # an interruption loses nothing of the fit
        with job.monitor.counting("adding detail") as bar:
            posterior = choice.solve(fine, coarse, lambda p: bar(p.count, ITERATIONS) or job.budget.over)
        job.posterior = posterior
        job.detail_entries = {
            "residual_before": before, "residual_after": posterior.residual, "withheld_before": choice.before,
            "withheld_after": choice.after, "blurred": posterior.blurred, "voxels": max(fine.grid.shape),
            "iterations": posterior.count, "seconds": time.monotonic() - begin,
        }  # fmt: skip
        text = f"detail on {max(fine.grid.shape)} voxels, residual {before:.2f} to {posterior.residual:.2f} sigma"
        outcome = replace(result.outcome, message=f"{result.outcome.message}; then {text}")
        job.result = replace(result, field=posterior.field.to("cpu"), outcome=outcome)


class WriteField(PipelineStep):
    """Write field, history, volumes, run.toml and the figures of the run, the most expensive first."""

    sections = ("seconds", "peak_memory_bytes", "device", "outcome", "message", "measurement")

    @staticmethod
    def run(job: Job) -> None:
        out, result, say = job.out, the_result(job), job.monitor.say
        job.begin()
        out.write_field(result)
        out.write_history(result.history)
        say(result.outcome.sentence)
        with job.monitor.counting("sampling the field"):
            volumes = job.quantities = all_quantities(result, job.run.gas, job.voxels)
            out.write_volumes(volumes)
        for line in (*masked_lines(volumes), *job.run.gas.remarks(volumes[0])):
            say(line)
        out.write_metrics(  # without the sections of an earlier field
            Metrics(
                measurement=job.settings["measurement"], seconds=result.seconds, device=result.device,
                peak_memory_bytes=result.peak_memory_bytes, outcome=result.outcome.reason,
                message=result.outcome.message,
                cross_validation=None if job.validation is None else job.validation.scores(), detail=job.detail_entries,
            )
        )  # fmt: skip
        about = {**versions(), "outcome": result.outcome.reason, "seconds": round(result.seconds, 3)}
        out.write_settings(job.settings, about | ({"gains": job.inputs.gains} if job.inputs.gains else {}))


class WriteSurface(PipelineStep):
    """Write the quantities on the surface of bodies, in triangles of the size of a voxel."""

    @staticmethod
    def wanted(job: Job) -> bool:
        return bool(the_result(job).bodies)

    @staticmethod
    def run(job: Job) -> None:
        result = the_result(job)
        gas = job.run.gas if any(v.quantity == "density" for v in job.quantities) else None
        edge = max(result.box.edges) / job.voxels
        surface = surface_map(result.field, result.bodies, result.box, result.n_ambient, edge, result.quantity, gas)
        job.out.write_surface(surface)
        for name, values in surface.quantities.items():
            present = values[values.isfinite()]
            if len(present):
                low, high = np.quantile(present, [0.001, 0.999])
                unit = unit_shown(describe(name)[0])
                job.monitor.say(f"surface of the bodies: {name} {low:.4g} to {high:.4g} {unit} (0.1 to 99.9 %)")


class WriteRig(PipelineStep):
    """Write the refined calibration with its uncertainty; predictions use it from here on."""

    sections = ("rig", "withheld_rig", "withheld_views")

    @staticmethod
    def wanted(job: Job) -> bool:
        return bool(the_result(job).rig)

    @staticmethod
    def run(job: Job) -> None:
        out, result, monitor, measurement = job.out, the_result(job), job.monitor, job.measurement
        with monitor.counting("uncertainty of the rig") as bar:
            training = measurement.without(job.withheld)
            job.rig = RigPosterior.of(result.rig, training, result.field, result.settings, bar)
        job.measurement = with_corrections(measurement, job.rig.table)
        out.add_metrics(rig=job.rig.table)
        with out.writing(CALIBRATION) as path:
            write_cameras(path, [CalibratedCamera.from_camera(c) for c in job.measurement.cameras])
        for line in refinement_lines(job.rig.table):
            monitor.say(line)
        if not job.withheld:
            return
        withheld = measurement.select(job.withheld)
        with monitor.counting("refining the withheld views"):
            table = refit(result.field, withheld, result.settings, result.device)
            refitted = reproject(result.field, with_corrections(withheld, table), job.withheld, result.device)
        views = evaluate_views(refitted) if table else []
        out.add_metrics(withheld_rig=table, withheld_views=views)
        for line in score_lines(views):
            monitor.say(f"{line}, its camera refined against the field")


class Reproject(PipelineStep):
    """Write the prediction of every view, and its scores."""

    sections = ("views", "reprojection")

    @staticmethod
    def run(job: Job) -> None:
        out, result, monitor = job.out, the_result(job), job.monitor
        with monitor.counting("re-projecting") as bar:
            reprojection = reproject(result.field, job.measurement, job.withheld, result.device, bar, result.model)
        with monitor.counting("scoring the views"):
            views = evaluate_views(reprojection)
            out.add_metrics(views=views, reprojection=[a.entries for a in reprojection.accuracies])
            out.write_reprojection(reprojection)
        for line in (*score_lines(views), *(accuracy.sentence for accuracy in reprojection.accuracies)):
            monitor.say(line)


class WriteAxis(PipelineStep):
    """Write the axis of a symmetric flow, and the asymmetry of the measurement."""

    sections = ("axis", "asymmetry")

    @staticmethod
    def wanted(job: Job) -> bool:
        return the_result(job).axis is not None

    @staticmethod
    def run(job: Job) -> None:
        result = the_result(job)
        axis, views = result.axis, with_corrections(job.inputs.all_views, result.rig)
        assert axis is not None
        halves = asymmetry(views, axis.symmetry) if axis.symmetry.axial else []
        assert isinstance(job.reconstructor, SharedSettings)
        better = better_direction(job.reconstructor, job.measurement, axis)
        job.out.add_metrics(axis=axis.record | ({"better_direction": list(better)} if better else {}), asymmetry=halves)
        for line in (*axis.sentences, *(asymmetry_sentence(d) for d in halves)):
            job.monitor.say(line)


class DrawErrors(PipelineStep):
    """Add standard deviations to the volumes, from draws of the posterior of the detail.

    They are scaled by the errors of the prediction of the withheld view. About a field that is not blurred they do not
    contain the errors of the field itself: the bootstrap does.
    """

    sections = ("uncertainty",)

    @staticmethod
    def wanted(job: Job) -> bool:
        return bool(job.trials.members) and has_error_draws(job)

    @staticmethod
    def run(job: Job) -> None:
        assert job.posterior is not None
        begin = time.monotonic()
        deviations = Deviations(job.quantities[0], job.run.gas, the_result(job).bodies)
        grid, ratio = Grid.of_resolution(job.measurement.box, VOXELS), 1.0
        if job.detail is not None and (fit := ChooseDetail.coarse(job)) is not None:
            with job.monitor.counting("errors of the withheld view"):
                ratio = job.detail.error_ratio(*fit)
        for number in range(1, job.trials.members + 1):
            with job.monitor.counting(f"draw {number} of {job.trials.members}") as bar:
                deviations.add(ratio * job.posterior.error(number, bar).sample(grid), grid)
        about: dict[str, Any] = {"kind": job.run.uncertainty, "source": "posterior", "diverged_trials": []}
        about["seconds"] = time.monotonic() - begin
        write_deviations(job.out, job.monitor, job.quantities, deviations, about)


class Bootstrap(PipelineStep):
    """Add standard deviations to the volumes, from trials; writes and resumes from trials/."""

    sections = ("uncertainty",)

    @staticmethod
    def wanted(job: Job) -> bool:
        interrupted = the_result(job).outcome.reason == "interrupted"
        return bool(job.trials.members) and not has_error_draws(job) and not interrupted

    @staticmethod
    def run(job: Job) -> None:
        result = the_result(job)
        if result.outcome.failed:
            job.monitor.say(f"uncertainty: skipped: the main run {result.outcome.reason}")
            return
        monitor = job.watching(withheld=False, looks=False)
        members = Members(
            job.out, job.trials, job.reconstructor, job.inputs.training, job.rig, job.start, job.run.checkpoint_every,
            monitor, job.budget,
        )  # fmt: skip
        members.add_to(result, job.quantities, job.run.gas)


class Judge(PipelineStep):
    """Write the verdict on the result, and the meridian plane of a symmetric flow."""

    sections = ("verdict",)

    @staticmethod
    def wanted(job: Job) -> bool:
        return job.result is not None and job.begun and job.out.has(FIELD)

    @staticmethod
    def run(job: Job) -> None:
        result = job.out.read()
        if (meridian := result.meridian) is not None:
            job.out.write_meridian(meridian)
        assessment = verdict(result)
        job.out.add_metrics(verdict=asdict(assessment))
        job.monitor.say(assessment.sentence)


class WriteReport(PipelineStep):
    """Write report.html."""

    @staticmethod
    def wanted(job: Job) -> bool:
        return job.run.report and Judge.wanted(job)

    @staticmethod
    def run(job: Job) -> None:
        try:
            write_report(job.out.path, monitor=job.monitor)
        except Exception as error:  # of a figure, or of a full disk: the result is complete without it
            reason = f"{type(error).__name__}: {error}"
            job.monitor.say(f"report: not written ({reason}); write it by nerif report {word_of(job.out.path)}")


STEPS: tuple[type[PipelineStep], ...] = (
    CrossValidate, ChooseDetail, Fit, AddDetail, WriteField, WriteSurface, WriteRig, Reproject, WriteAxis, DrawErrors,
    Bootstrap,
)  # fmt: skip
CLOSING: tuple[type[PipelineStep], ...] = (Judge, WriteReport)
"""Run whatever became of the others, if there is a field."""


def share(job: Job, choice: DetailChoice) -> float:
    """Return the largest share of the time left that detail may take.

    A first run that explains little of its data does not show what a longer one would leave: training comes first.
    """
    return MOST_BLURRED if choice.blurred and _explained(job) > EXPLAINED else MOST_DETAIL


def _explained(job: Job) -> float:
    """Return the share of the squared signal that the first run explains of data that it fitted."""
    scores = job.validation.scores() if job.validation is not None else None
    views = [v for v in scores["fitted_views"] if "rms_measured" in v] if scores else []
    signal = sum(v["rms_measured"] ** 2 for v in views)
    return 1 - sum(v["rms"] ** 2 for v in views) / signal if signal > 0 else 0.0


def has_error_draws(job: Job) -> bool:
    """Whether standard deviations are drawn from the posterior of the detail."""
    return job.posterior is not None and job.posterior.blurred


def the_result(job: Job) -> Reconstruction:
    """Return the result of the main run, which a step before has produced."""
    assert job.result is not None
    return job.result
