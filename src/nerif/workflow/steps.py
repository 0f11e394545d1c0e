"""The steps of a reconstruction into a result directory.

Each is a function of the run and of what the steps before it have put out; it returns this with its own part added, and
writes its own files and sections of metrics.json. A run that is resumed passes through all of them again: what is
expensive (cross-validation, fit, trials) continues from its own checkpoint or is read, the rest is written again.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from nerif.analysis.asymmetry import asymmetry, asymmetry_sentence
from nerif.analysis.evaluation import evaluate_views, score_lines
from nerif.analysis.prediction import on_grid, reproject, spline_voxels, splines_for_views
from nerif.analysis.verdict import verdict
from nerif.analysis.wall_values import surface_map
from nerif.common.conventions import unit_shown
from nerif.common.installation import word_of
from nerif.data.cameras_file import CalibratedCamera, write_cameras
from nerif.data.measurement import Measurement
from nerif.data.quantity_names import describe
from nerif.geometry import Grid
from nerif.physics.medium import masked_lines
from nerif.reconstruction.detail.detail import COARSE, EARLY, ITERATIONS, SIGNIFICANT, Detail, DetailChoice, choose
from nerif.reconstruction.field_files import checkpoints
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import compose
from nerif.reconstruction.rig_parameters import refinement_lines, with_corrections
from nerif.reconstruction.rig_refinement import refit, with_rig
from nerif.reconstruction.shared_settings import SHORT_RUN, SharedSettings
from nerif.reconstruction.uncertainty.deviations import VOXELS, Deviations
from nerif.reconstruction.uncertainty.rig_posterior import RigPosterior
from nerif.reconstruction.voxels.symmetry_axis import axis_of, better_direction
from nerif.results.directory import CALIBRATION, Result, versions
from nerif.results.metrics_file import DetailEntries, Metrics
from nerif.workflow.bootstrap_runs import all_quantities, bootstrap, write_deviations
from nerif.workflow.reconstruction_run import ReconstructionRun, StepOutputs
from nerif.workflow.reports import write_report

__all__ = ["STEPS", "fit", "judge", "write_page"]

EXPLAINED = 0.6  # of the signal by the cross-validation run, above which a blurred field may take most of the time
MOST_DETAIL, MOST_BLURRED = 0.35, 0.7  # of the time that is left; where the field is blurred, its training matters less


def cross_validate(run: ReconstructionRun, so_far: StepOutputs) -> StepOutputs:
    """Predict a view from the cross-validation run, without it; the main run starts from the field of that run.

    Writes and resumes from cross_validation/. If it is interrupted, its field is the result.
    """
    validation = run.validation
    if validation is None or run.state is not None:
        return so_far
    settings = so_far.budget.limited(validation.reconstructor, 1 / (1 + SHORT_RUN + run.trials.members))
    monitor = run.watching(withheld=True)
    short = replace(validation, reconstructor=settings, monitor=monitor)(run.begin)
    if short is None:
        return so_far
    so_far = replace(so_far, initial=short.field, method=run.reconstructor.split_for_cross_validation()[1])
    if short.outcome.reason != "interrupted":
        return so_far
    result = replace(short, state=None, box=run.inputs.box)
    return replace(so_far, result=result, measurement=validation.data, withheld=(validation.view,))


def choose_detail(run: ReconstructionRun, so_far: StepOutputs) -> StepOutputs:
    """Find out how detail is added, and whether it pays, from the cross-validation; hold back time for it."""
    wanted = run.settings.detail == "on" or (run.settings.detail == "auto" and run.reconstructor.detailed)
    sigma_known = all(o.sigma is not None for o in run.inputs.training.observations)
    if not wanted or so_far.result is not None or not sigma_known:
        return so_far
    left = so_far.budget.left
    choice = _detail(run, left)
    if choice is None:
        return so_far
    most = detail_share(run, choice) * left
    each = choice.seconds or (most if math.isfinite(most) else 0.0)
    draws = run.trials.members if choice.blurred else 0
    return replace(so_far, detail=choice, budget=so_far.budget.with_reserve(min(each * (1 + draws), most)))


def _detail(run: ReconstructionRun, left: float) -> DetailChoice | None:
    """Return how detail is added, or None; `left`: seconds until the limit."""
    on, fit, say = run.settings.detail == "on", coarse_detail(run), run.monitor.say
    if fit is None:
        return DetailChoice() if on else None
    coarse, withheld = fit
    if coarse.residual < EARLY and not on:
        return None
    with run.monitor.counting("choosing the detail") as bar:
        choice = choose(coarse, withheld, math.inf if on else MOST_BLURRED * left, bar)
    if not math.isnan(choice.before):
        errors = f"{choice.before:.2f} sigma without it, {choice.after:.2f} with it"
        say(f"detail: residual of the withheld view, on pixels without part in this choice, {errors}")
    if choice.seconds > detail_share(run, choice) * left and not on:
        say(f"detail left out: it takes about {choice.seconds:.0f} s; give a longer --time-limit")
        return None
    return choice if choice.pays or on else None


def coarse_detail(run: ReconstructionRun) -> tuple[Detail, Measurement] | None:
    """Return the detail of the field of the cross-validation, on a coarse grid, and the data of its withheld view.

    None without that field.
    """
    validation = run.validation
    if validation is None or (fit := validation.fit) is None:
        return None
    settings = validation.reconstructor
    assert isinstance(settings, SharedSettings)
    axis = axis_of(settings, validation.data.without([validation.view]))  # as for the field
    return Detail(fit.field, fit.training, settings, axis, COARSE), fit.withheld


def detail_share(run: ReconstructionRun, choice: DetailChoice) -> float:
    """Return the largest share of the time left that detail may take.

    If the cross-validation explains little of its data, it does not show what a longer run would leave: training first.
    """
    scores = run.validation.scores() if run.validation is not None else None
    views = [v for v in scores["fitted_views"] if "rms_measured" in v] if scores else []
    signal = sum(v["rms_measured"] ** 2 for v in views)
    explained = 1 - sum(v["rms"] ** 2 for v in views) / signal if signal > 0 else 0.0  # of the squared signal
    return MOST_BLURRED if choice.blurred and explained > EXPLAINED else MOST_DETAIL


def fit(run: ReconstructionRun, so_far: StepOutputs) -> StepOutputs:
    """Reconstruct the field from all views that are not withheld; resumes from checkpoint.safetensors."""
    if so_far.result is not None:
        return so_far
    title = "training" if isinstance(run.reconstructor, NeRIF) else "solving"
    with run.watching(withheld=bool(so_far.withheld)).training(title) as progress:
        callbacks = [progress]
        if run.ranks.is_first:  # under torchrun only the first process writes
            callbacks = [run.begin, progress, checkpoints(run.out.path, run.settings.checkpoint_every)]
        if run.on_step is not None:
            callbacks.append(run.on_step)
        trials = 0 if so_far.detail is not None and so_far.detail.blurred else run.trials.members
        method = so_far.budget.limited(so_far.method, 1 / (1 + trials))
        initial = so_far.initial if run.state is None else None
        result = method(run.inputs.training, compose(*callbacks), run.state, initial)
    return replace(so_far, result=replace(result, box=run.inputs.box))


def add_detail(run: ReconstructionRun, so_far: StepOutputs) -> StepOutputs:
    """Add the detail that the field leaves in its data; repeated when a run is resumed."""
    result, choice, settings, begin = so_far.the_result, so_far.detail, run.reconstructor, time.monotonic()
    if choice is None or not so_far.ended:
        return so_far
    assert isinstance(settings, SharedSettings)
    data = with_rig(run.inputs.training, result)
    coarse, fine = (Detail(result.field, data, settings, result.axis, size) for size in (COARSE, 1))
    before = fine.residual
    if before < SIGNIFICANT and run.settings.detail == "auto":
        run.monitor.say(f"detail left out: the residual is {before:.2f} sigma")
        return so_far
    run.begin()
    run.out.write_field(result)  # an interruption loses nothing of the fit
    with run.monitor.counting("adding detail") as bar:
        posterior = choice.solve(fine, coarse, lambda p: bar(p.count, ITERATIONS) or so_far.budget.over)
    entries: DetailEntries = {
        "residual_before": before, "residual_after": posterior.residual, "withheld_before": choice.before,
        "withheld_after": choice.after, "blurred": posterior.blurred, "voxels": max(fine.grid.shape),
        "iterations": posterior.count, "seconds": time.monotonic() - begin,
    }  # fmt: skip
    text = f"detail on {max(fine.grid.shape)} voxels, residual {before:.2f} to {posterior.residual:.2f} sigma"
    outcome = replace(result.outcome, message=f"{result.outcome.message}; then {text}")
    result = replace(result, field=posterior.field.to("cpu"), outcome=outcome)
    return replace(so_far, result=result, posterior=posterior, detail_entries=entries)


def write_field(run: ReconstructionRun, so_far: StepOutputs) -> StepOutputs:
    """Write field, history, volumes, run.toml and the figures of the run, the most expensive first."""
    out, result, say, entries = run.out, so_far.the_result, run.monitor.say, run.entries
    run.begin()
    out.write_field(result)
    out.write_history(result.history)
    say(result.outcome.sentence)
    with run.monitor.counting("sampling the field"):
        splines = splines_for_views(result.field, so_far.measurement, result.device, spline_voxels(run.voxels))
        field = on_grid(result.field, splines, Grid.of_resolution(result.box, run.voxels))
        volumes = all_quantities(replace(result, field=field), run.settings.substance, run.voxels)
        out.write_volumes(volumes)
    medium = run.settings.substance
    for line in (*medium.assumed([v.quantity for v in volumes]), *masked_lines(volumes), *medium.remarks(volumes[0])):
        say(line)
    out.write_metrics(  # without the sections of an earlier field
        Metrics(
            measurement=entries["measurement"], seconds=result.seconds, device=result.device,
            peak_memory_bytes=result.peak_memory_bytes, outcome=result.outcome.reason,
            message=result.outcome.message,
            cross_validation=None if run.validation is None else run.validation.scores(), detail=so_far.detail_entries,
        )
    )  # fmt: skip
    about = {**versions(), "outcome": result.outcome.reason, "seconds": round(result.seconds, 3)}
    out.write_settings(entries, about | ({"gains": run.inputs.gains} if run.inputs.gains else {}))
    return replace(so_far, quantities=tuple(volumes), splines=splines)


def write_surface(run: ReconstructionRun, so_far: StepOutputs) -> StepOutputs:
    """Write the quantities on the surface of bodies, in triangles of the size of a voxel."""
    result = so_far.the_result
    if not result.bodies:
        return so_far
    names, medium = {v.quantity for v in so_far.quantities}, run.settings.substance
    follows = not names.isdisjoint(medium.surface_names)
    edge = max(result.box.edges) / run.voxels
    surface = surface_map(
        result.field, result.bodies, result.box, result.n_ambient, edge, result.quantity, medium if follows else None
    )
    run.out.write_surface(surface)
    for name, values in surface.quantities.items():
        finite = values[values.isfinite()]
        if len(finite):
            low, high = np.quantile(finite, [0.001, 0.999])
            unit = unit_shown(describe(name)[0])
            run.monitor.say(f"surface of the bodies: {name} {low:.4g} to {high:.4g} {unit} (0.1 to 99.9 %)")
    return so_far


def write_rig(run: ReconstructionRun, so_far: StepOutputs) -> StepOutputs:
    """Write the refined calibration with its uncertainty; predictions use it from here on."""
    out, result, monitor, measurement = run.out, so_far.the_result, run.monitor, so_far.measurement
    if not result.rig:
        return so_far
    with monitor.counting("uncertainty of the rig") as bar:
        rig = RigPosterior.of(result.rig, measurement.without(so_far.withheld), result.field, result.settings, bar)
    so_far = replace(so_far, rig=rig, measurement=with_corrections(measurement, rig.table))
    out.add_metrics(rig=rig.table)
    with out.writing(CALIBRATION) as path:
        write_cameras(path, [CalibratedCamera.from_camera(c) for c in so_far.measurement.cameras])
    for line in refinement_lines(rig.table):
        monitor.say(line)
    if so_far.withheld:
        withheld = measurement.select(so_far.withheld)
        with monitor.counting("refining the withheld views"):
            table = refit(result.field, withheld, result.settings, result.device)
            refitted = reproject(result.field, with_corrections(withheld, table), so_far.withheld, result.device)
        views = evaluate_views(refitted) if table else []
        out.add_metrics(withheld_rig=table, withheld_views=views)
        for line in score_lines(views):
            monitor.say(f"{line}, its camera refined against the field")
    return so_far


def write_reprojection(run: ReconstructionRun, so_far: StepOutputs) -> StepOutputs:
    """Write the prediction of every view, and its scores."""
    out, result, monitor = run.out, so_far.the_result, run.monitor
    with monitor.counting("re-projecting") as bar:
        views = reproject(
            result.field, so_far.measurement, so_far.withheld, result.device, bar, result.model, so_far.splines
        )
    with monitor.counting("scoring the views"):
        scores = evaluate_views(views)
        out.add_metrics(views=scores, reprojection=[a.entries for a in views.accuracies])
        out.write_reprojection(views)
    for line in (*score_lines(scores), *(accuracy.sentence for accuracy in views.accuracies)):
        monitor.say(line)
    return replace(so_far, views=views)


def write_axis(run: ReconstructionRun, so_far: StepOutputs) -> StepOutputs:
    """Write the axis of a symmetric flow, and the asymmetry of the measurement."""
    axis, views = so_far.the_result.axis, with_corrections(run.inputs.all_views, so_far.the_result.rig)
    if axis is None:
        return so_far
    halves = asymmetry(views, axis.symmetry) if axis.symmetry.axial else []
    assert isinstance(run.reconstructor, SharedSettings)
    better = better_direction(run.reconstructor, so_far.measurement, axis)
    run.out.add_metrics(axis=axis.record | ({"better_direction": list(better)} if better else {}), asymmetry=halves)
    for line in (*axis.sentences, *(asymmetry_sentence(d) for d in halves)):
        run.monitor.say(line)
    return so_far


def draw_errors(run: ReconstructionRun, so_far: StepOutputs) -> StepOutputs:
    """Add standard deviations to the volumes, from draws of the posterior of the detail.

    They are scaled by the errors of the prediction of the withheld view. About a field that is not blurred they do not
    contain the errors of the field itself: the bootstrap does.
    """
    if not run.trials.members or not so_far.has_error_draws:
        return so_far
    assert so_far.posterior is not None
    begin = time.monotonic()
    deviations = Deviations(so_far.quantities[0], run.settings.substance, so_far.the_result.bodies)
    grid, ratio = Grid.of_resolution(so_far.measurement.box, VOXELS), 1.0
    if so_far.detail is not None and (coarse := coarse_detail(run)) is not None:
        with run.monitor.counting("errors of the withheld view"):
            ratio = so_far.detail.error_ratio(*coarse)
    for number in range(1, run.trials.members + 1):
        with run.monitor.counting(f"draw {number} of {run.trials.members}") as bar:
            deviations.add(ratio * so_far.posterior.error(number, bar).sample(grid), grid)
    about: dict[str, Any] = {"kind": run.settings.uncertainty, "source": "posterior", "diverged_trials": []}
    about["seconds"] = time.monotonic() - begin
    write_deviations(run.out, run.monitor, so_far.quantities, deviations, about)
    return so_far


STEPS: tuple[Callable[[ReconstructionRun, StepOutputs], StepOutputs], ...] = (
    cross_validate, choose_detail, fit, add_detail, write_field, write_surface, write_rig, write_reprojection,
    write_axis, draw_errors, bootstrap,
)  # fmt: skip


def judge(run: ReconstructionRun, so_far: StepOutputs) -> Result:
    """Write the verdict on the result, and the meridian plane of a symmetric flow; return the result."""
    result = run.out.read(reprojection=so_far.views)
    if (meridian := result.meridian) is not None:
        run.out.write_meridian(meridian)
    assessment = verdict(result)
    run.out.add_metrics(verdict=asdict(assessment))
    run.monitor.say(assessment.sentence)
    return replace(result, metrics=run.out.metrics())


def write_page(run: ReconstructionRun, result: Result) -> None:
    """Write report.html."""
    try:
        write_report(run.out.path, monitor=run.monitor, result=result)
    except Exception as error:  # of a figure, or of a full disk: the result is complete without it
        reason = f"{type(error).__name__}: {error}"
        run.monitor.say(f"report: not written ({reason}); write it by nerif report {word_of(run.out.path)}")
