"""From a measurement to a result directory: nerif reconstruct as a Python call."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch

from nerif.analysis.asymmetry import asymmetry, asymmetry_sentence, halved
from nerif.analysis.evaluation import evaluate_views, score_lines
from nerif.analysis.gains import fit_gains, with_gains
from nerif.analysis.prediction import check_sees, reproject
from nerif.analysis.verdict import verdict
from nerif.common.conventions import InputError
from nerif.common.interruption import if_interrupted
from nerif.common.settings import check_settings
from nerif.data.measurement import Measurement
from nerif.data.volume import quantities_of
from nerif.data.volume_sequence import VolumeSequence
from nerif.fields.base import Field
from nerif.imaging.calibration.cameras_file import CalibratedCamera, write_cameras
from nerif.physics.quantities import NOT_UNIFORM, GasSettings, masked_lines
from nerif.reconstruction.aperture import seen_through
from nerif.reconstruction.base import OnStep, Reconstruction, Reconstructor, Step, compose
from nerif.reconstruction.device import Cores
from nerif.reconstruction.files import CHECKPOINT, FIELD, checkpoints
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.schedule import SlowRun
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.reconstruction.rig.parameters import moved_lines, with_corrections
from nerif.reconstruction.rig.posterior import with_posterior
from nerif.reconstruction.rig.refinement import refit
from nerif.reconstruction.shared_settings import SharedSettings
from nerif.reconstruction.sources import check_source
from nerif.reconstruction.symmetry import axis_of, with_axis
from nerif.reconstruction.uncertainty.bootstrap import Trials
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.multiplicative import MART, MLEM
from nerif.reconstruction.voxels.settings import VoxelReconstructor
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.report import html
from nerif.report.sequence_page import render_sequence
from nerif.results.directory import CALIBRATION, REPORT, ResultDirectory, versions
from nerif.results.live import Live
from nerif.workflow.cross_validation import AUTO, MIN_VIEWS, CrossValidation, with_halves
from nerif.workflow.repeats import Members, all_quantities

__all__ = ["METHODS", "Run", "reconstruct_into", "write_report", "write_sequence_report"]

METHODS: dict[str, type[Reconstructor]] = {
    "nerif": NeRIF,
    "tikhonov": Tikhonov,
    "landweber": Landweber,
    "tv": TotalVariation,
    "mlem": MLEM,
    "mart": MART,
}


@dataclass(frozen=True)
class Run:
    """Settings of a reconstruction into a directory, in addition to those of the method."""

    withhold: tuple[str, ...] = AUTO
    """Withheld views for cross-validation: names; left or right (half of each image of an axisymmetric flow); auto (one
    view, in a short run from which the run with all views starts); or none."""
    start_from: Path | None = None
    """Result directory with the initial field: a reconstruction by any method in the same box."""
    fit_gains: bool = False
    """For emission: fit the intensity gain of each camera (not of withheld views)."""
    uncertainty: Literal["off", "fast", "full"] = "off"
    """Standard deviations of every quantity by bootstrap: off, fast (2 trials) or full (8 trials)."""
    report: bool = True
    """Write report.html at the end."""
    checkpoint_every: float = 60.0
    """Interval between checkpoints in seconds."""
    gas: GasSettings = field(default_factory=GasSettings)
    """Gas for density and temperature."""

    def __post_init__(self) -> None:
        check_settings(self)


def reconstruct_into(
    directory: str | os.PathLike[str],
    measurement: Measurement | str | os.PathLike[str],
    reconstructor: Reconstructor,
    run: Run | None = None,
    *,
    voxels: int | None = None,
    resume: bool = False,
    force: bool = False,
    keep: Mapping[str, Any] | None = None,
    on_step: OnStep | None = None,
    monitor: Monitor = QUIET,
    live: bool = False,
) -> Reconstruction:
    """Reconstruct, and write the result directory of docs/formats.md.

    Field, history and volumes are written first, then the re-projection into the views and the report. An earlier
    result is left as it is if any input is invalid.

    Parameters
    ----------
    directory : of the result
    measurement : or its file, whose path is stored in run.toml
    reconstructor : settings of the method
    run : further settings
    voxels : of the written volume along the longest edge of the box (default: those of the method, else 100)
    resume : continue from the checkpoint in the directory
    force : replace the result in the directory
    keep : further entries of run.toml
    on_step : called after each step of the main reconstruction, and may stop it
    monitor : of the progress
    live : write live.json and live.npz during the run (results/live.py)
    """
    out, begun = ResultDirectory(directory, monitor.say), [resume]
    with Cores(torch.device("cpu")), if_interrupted(lambda: _remedy(out, begun[0])):
        return _reconstruct_into(
            out, measurement, reconstructor, run or Run(), voxels, resume, force, keep, on_step, monitor, live, begun
        )


def _remedy(out: ResultDirectory, begun: bool) -> str:
    """Return what an interrupted run has saved, and how to continue; `begun`: the directory is that of the run."""
    resume = f"nerif reconstruct --resume --out {out.path}"
    if begun and out.has(FIELD):
        return f"{out.path} holds the field, but not all other files; complete it with {resume}"
    if begun and (out.has(CHECKPOINT) or out.cross_validation.has(CHECKPOINT) or out.cross_validation.has(FIELD)):
        return f"{out.path} holds the last checkpoint; continue with {resume}"
    return "nothing was saved yet; run the same command again"


def _reconstruct_into(
    out: ResultDirectory, measurement: Measurement | str | os.PathLike[str], reconstructor: Reconstructor, run: Run,
    voxels: int | None, resume: bool, force: bool, keep: Mapping[str, Any] | None, on_step: OnStep | None,
    monitor: Monitor, live: bool, begun: list[bool],
) -> Reconstruction:  # fmt: skip
    """Run all steps; `begun` becomes [True] when the directory is that of this run."""
    path = None
    if not isinstance(measurement, Measurement):
        path = Path(measurement)
        measurement = Measurement.read(path)
    measurement = seen_through(measurement, reconstructor.aperture)
    check_source(reconstructor.source, measurement)  # before any view is withheld
    if voxels is None:
        voxels = reconstructor.voxels if isinstance(reconstructor, VoxelReconstructor) else 100
    if voxels < 1:
        raise InputError(f"expected 1 or more, got {voxels}", field="voxels")
    all_views = measurement
    measurement, reconstructor, withheld = with_halves(run.withhold, all_views, reconstructor)
    training = measurement.without(withheld)
    gains = fit_gains(training) if run.fit_gains else {}
    if gains:
        monitor.say("gains: " + ", ".join(f"{name} {gain:.4f}" for name, gain in gains.items()))
        measurement, training = with_gains(measurement, gains), with_gains(training, gains)
    trials = Trials(run.uncertainty)
    run = replace(run, gas=run.gas.for_measurement(measurement))
    _report_unusable(measurement, "the measurement" if path is None else path, monitor)
    slow = SlowRun(reconstructor, monitor.say)
    validation = _cross_validation(out, run, reconstructor, training, not resume, monitor.telling(slow))
    state = out.state() if resume and (validation is None or out.has(CHECKPOINT) or not validation.resumable) else None
    start = _start(run, measurement) if trials.members or not resume else None
    if not resume:
        out.check_free(force)
    ranks = Ranks.from_environment()
    if ranks.size > 1:
        _check_parallel(run, reconstructor)
    if not ranks.is_first:  # under torchrun only the first process reports and writes
        with monitor.training("training") as progress:
            return reconstructor(training, progress, state, start if state is None else None)
    monitor = monitor.telling(slow)
    settings = _settings(run, path, reconstructor, voxels, keep or {})
    if "density" not in quantities_of(measurement.quantity):
        del settings["gas"]
    run, begin = replace(run, withhold=withheld), _begin(out, settings, resume, begun)
    data = measurement if validation is None else validation.data
    view = Live(out.path, data, reconstructor, next(iter(withheld), ""), lambda: slow.line) if live else None
    if view is not None and validation is not None:
        validation = replace(validation, monitor=view.watching(monitor, withheld=True))
    watching = monitor if view is None else view.watching(monitor, withheld=bool(withheld))
    short = validation(begin) if validation is not None and state is None else None
    method, initial = (reconstructor, start) if short is None else (reconstructor.in_two()[1], short.field)
    if validation is not None and short is not None and short.outcome.reason == "interrupted":
        result, run = replace(short, state=None), replace(run, withhold=(validation.view,))
        measurement = validation.data
    else:
        with watching.training("training" if isinstance(reconstructor, NeRIF) else "solving") as progress:
            callbacks = [begin, progress, checkpoints(out.path, run.checkpoint_every), *([on_step] if on_step else [])]
            result = method(training, compose(*callbacks), state, initial if state is None else None)
    begin(None)
    scores = {} if validation is None else validation.scores()
    metrics = {"cross_validation": scores} if scores else {}
    _write(out, measurement, result, run, settings, gains, voxels, monitor, metrics)
    _write_axis(out, result, all_views, monitor)
    try:
        if trials.members and result.outcome.failed:
            monitor.say(f"uncertainty: skipped: the main run {result.outcome.reason}")
        elif trials.members and result.outcome.reason != "interrupted":
            dependencies = {"start_from": str(run.start_from)}
            corrected = with_corrections(training, result.rig)  # trials do not refine the rig again
            watching = monitor if view is None else view.watching(monitor, withheld=False, looks=False)
            members = Members(
                out, trials, reconstructor, corrected, start, dependencies, run.checkpoint_every, watching
            )
            members.add_to(result, run.gas, voxels)
    finally:  # verdict and report of the main result, also after an interruption of the trials
        written = out.read()
        if (meridian := written.meridian) is not None:
            out.write_meridian(meridian)
        assessment = verdict(written)
        out.add_metrics({"verdict": asdict(assessment)})
        if run.report:
            write_report(out.path, monitor=monitor)
        monitor.say(assessment.sentence)
    return result


def write_report(directory: str | os.PathLike[str], path: Path | None = None, monitor: Monitor = QUIET) -> Path:
    """Write the report of a result directory, and return its path."""
    out = ResultDirectory(directory, monitor.say)
    path = path or out / REPORT
    with monitor.counting("writing the report"):
        result = out.read()
        page = html.render(result)
    if path == out / REPORT:
        with out.writing(REPORT):
            html.write(page, path)
    else:
        html.write(page, path)
    for gap in result.missing:
        monitor.say(f"missing: {gap.sentence}")
    _say_size(path, monitor)
    return path


def write_sequence_report(store: str | os.PathLike[str], path: Path | None = None, monitor: Monitor = QUIET) -> Path:
    """Write the report of a store of nerif sequence, complete or not, and return its path."""
    path = path or Path(store).with_suffix(".html")
    html.write(render_sequence(VolumeSequence(store)), path)
    _say_size(path, monitor)
    return path


def _say_size(path: Path, monitor: Monitor) -> None:
    size = path.stat().st_size
    monitor.say(f"{path}: {f'{size / 1e6:.1f} MB' if size > 1e6 else f'{size / 1e3:.0f} kB'}; open it in a browser")


def _report_unusable(measurement: Measurement, source: str | Path, monitor: Monitor) -> None:
    if measurement.bad_pixels:
        names = " or ".join(kind.measured for kind in measurement.techniques)
        reason = f"pixels left out: {names} or sigma is NaN, infinite or impossible"
        monitor.say(f"{source}: {measurement.bad_pixels} {reason}")
    for camera in measurement.cameras:
        if camera.unseen:
            monitor.say(
                f"view '{camera.name}': {camera.unseen:.1%} of the pixels left out, where its distortion is not "
                "invertible; calibrate it with target images that cover its corners"
            )


def _write(
    out: ResultDirectory,
    measurement: Measurement,
    result: Reconstruction,
    run: Run,
    settings: dict[str, Any],
    gains: dict[str, float],
    voxels: int,
    monitor: Monitor,
    metrics: dict[str, Any],
) -> None:
    """Write the result, the most expensive files first."""
    out.write_field(result)
    out.write_history(result.history)
    monitor.say(f"{result.outcome.reason}: {result.outcome.message}")
    with monitor.counting("sampling the field"):
        volumes = all_quantities(result, run.gas, voxels)
        out.write_volumes(volumes)
    for line in masked_lines(volumes):
        monitor.say(line)
    if "temperature" in quantities_of(measurement.quantity) and all(v.quantity != "temperature" for v in volumes):
        monitor.say(f"temperature: not computed: {NOT_UNIFORM}")
    metrics = {
        **metrics,
        "seconds": result.seconds,
        "peak_memory_bytes": result.peak_memory_bytes,
        "device": result.device,
        "outcome": result.outcome.reason,
        "message": result.outcome.message,
        "measurement": settings.get("measurement"),
    }
    out.write_metrics(metrics)
    about = {**versions(), "outcome": result.outcome.reason, "seconds": round(result.seconds, 3)}
    out.write_settings(settings, about | ({"gains": gains} if gains else {}))
    if result.rig:
        measurement, entries = _write_rig(out, measurement, result, run, monitor)
        metrics |= entries
    with monitor.counting("re-projecting") as bar:
        reprojection = reproject(result.field, measurement, run.withhold, result.device, bar, result.model)
    with monitor.counting("scoring the views"):
        views = evaluate_views(reprojection)
        out.write_metrics({"views": views, "reprojection": [a.entries for a in reprojection.accuracies], **metrics})
        out.write_reprojection(reprojection)
    for line in score_lines(views):
        monitor.say(line)
    for line in score_lines(metrics.get("views_refitted", [])):
        monitor.say(f"{line}, its camera refined against the field")
    for accuracy in reprojection.accuracies:
        monitor.say(accuracy.sentence)
    monitor.say(
        f"{out.path}: result of {result.seconds:.0f} s on {result.device}; open {out / 'volume.vti'} in ParaView"
    )


def _write_rig(
    out: ResultDirectory, measurement: Measurement, result: Reconstruction, run: Run, monitor: Monitor
) -> tuple[Measurement, dict[str, Any]]:
    """Write the refined calibration; return the measurement with the corrections, and the entries of metrics.json."""
    with monitor.counting("uncertainty of the rig") as bar:
        training = measurement.without(run.withhold)
        rig = with_posterior(result.rig, training, result.field, result.settings, bar)
    corrected, entries = with_corrections(measurement, rig), {"rig": rig}
    with out.writing(CALIBRATION) as path:
        write_cameras(path, [CalibratedCamera.from_camera(c) for c in corrected.cameras])
    for line in moved_lines(rig):
        monitor.say(line)
    if run.withhold:
        withheld = measurement.select(run.withhold)
        with monitor.counting("refining the withheld views"):
            table = refit(result.field, withheld, result.settings, result.device)
            refitted = reproject(result.field, with_corrections(withheld, table), run.withhold, result.device)
        entries |= {"rig_withheld": table, "views_refitted": evaluate_views(refitted) if table else []}
    return corrected, entries


def _write_axis(out: ResultDirectory, result: Reconstruction, measurement: Measurement, monitor: Monitor) -> None:
    """Write and report the axis of a symmetric flow, and the asymmetry of the measurement."""
    if result.axis is None:
        return
    departures = asymmetry(measurement, result.axis.symmetry) if result.axis.symmetry.axial else []
    out.add_metrics({"axis": result.axis.record, "asymmetry": departures})
    for line in (*result.axis.sentences, *(asymmetry_sentence(d) for d in departures)):
        monitor.say(line)


def _cross_validation(
    out: ResultDirectory, run: Run, reconstructor: Reconstructor, training: Measurement, restart: bool,
    monitor: Monitor,
) -> CrossValidation | None:  # fmt: skip
    """Return the cross-validation, if possible: not with an initial field, which may depend on all views."""
    if run.withhold != AUTO or AUTO[0] in training.names or run.start_from is not None:
        return None
    if Ranks.from_environment().size > 1:
        return None
    if len(training.cameras) < MIN_VIEWS:
        axis = axis_of(reconstructor, training) if isinstance(reconstructor, SharedSettings) else None
        if axis is None or not axis.symmetry.axial:
            return None
        assert isinstance(reconstructor, SharedSettings)
        reconstructor, training = with_axis(reconstructor, axis.symmetry), halved(training, axis.symmetry)
    return CrossValidation(out, reconstructor, training, run.checkpoint_every, monitor, restart)


def _check_parallel(run: Run, reconstructor: Reconstructor) -> None:
    """Check that the run can be distributed by torchrun."""
    if not isinstance(reconstructor, NeRIF):
        method = _method(reconstructor)
        raise InputError(f"expected nerif under torchrun, got '{method}', which runs in one process", field="method")
    if run.uncertainty != "off":
        raise InputError("expected off under torchrun; run it in one process", field="uncertainty")


def _start(run: Run, measurement: Measurement) -> Field | None:
    """Return the initial field, if any."""
    if run.start_from is None:
        return None
    directory = ResultDirectory(run.start_from)
    start, box, _ = directory.field()
    check_sees(measurement.techniques, directory.quantity(), f"start_from {run.start_from}")
    if box != measurement.box:
        raise InputError(
            f"expected a reconstruction in the box of the measurement, "
            f"{measurement.box.lower} to {measurement.box.upper} mm, got {box.lower} to {box.upper}",
            field=run.start_from,
        )
    return start


def _method(reconstructor: Reconstructor) -> str:
    return next(name for name, kind in METHODS.items() if isinstance(reconstructor, kind))


def _settings(
    run: Run, path: Path | None, reconstructor: Reconstructor, voxels: int, keep: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the settings that repeat the run, by the names of the options."""
    settings: dict[str, Any] = {**keep, **asdict(run), **asdict(reconstructor)}  # type: ignore[call-overload]
    if run.start_from is not None:
        settings["start_from"] = run.start_from.resolve()
    measurement = None if path is None else str(path.resolve())
    return {"measurement": measurement, "method": _method(reconstructor), "voxels": voxels, **settings}


def _begin(
    out: ResultDirectory, settings: Mapping[str, Any], resume: bool, begun: list[bool]
) -> Callable[[Step | None], None]:
    """Return a callback that prepares the directory at the first step: invalid input leaves an old result alone."""
    pending = True

    def prepare(step: Step | None) -> None:
        nonlocal pending
        if pending:
            out.begin(settings, resume)
            pending, begun[0] = False, True

    return prepare
