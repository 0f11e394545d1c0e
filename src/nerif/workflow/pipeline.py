"""From a measurement to a result directory: all that `nerif reconstruct` does, as a Python call."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from nerif.analysis.asymmetry import asymmetry, asymmetry_sentence, halved
from nerif.analysis.evaluation import evaluate_views, score_lines
from nerif.analysis.gains import fit_gains, with_gains
from nerif.analysis.prediction import check_sees, reproject
from nerif.analysis.verdict import verdict
from nerif.common.conventions import InputError
from nerif.common.interruption import if_interrupted
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
from nerif.workflow.cross_validation import AUTO, FEWEST, FirstLook, kept_apart
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
    """What is asked of a reconstruction into a directory, beside the settings of the method."""

    withhold: tuple[str, ...] = AUTO
    """Views kept out of the reconstruction and re-projected from it, or left or right, a half of each image of an
    axisymmetric flow; auto: one is kept out of a short run first, from which the run with all goes on; none."""
    start_from: Path | None = None
    """Result directory of another reconstruction in the same box, of any method, to start from."""
    fit_gains: bool = False
    """Of emission: fit how bright each camera sees, beside the field; views held out are taken as they are."""
    uncertainty: str = "off"
    """Reconstruct the field that was found twice (fast) or eight times (full) more, as it would be measured again, for
    standard deviations of every quantity."""
    report: bool = True
    """Write report.html at the end."""
    checkpoint_every: float = 60.0
    """Seconds between checkpoints."""
    gas: GasSettings = field(default_factory=GasSettings)
    """What the density is computed for."""


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
    """Reconstruct, and write the result directory that docs/formats.md lists.

    Field, history and volumes are written as soon as the method ends, then the re-projection into the views and the
    report.

    Parameters
    ----------
    directory : of the result
    measurement : or the file it is in, whose path is kept in run.toml
    reconstructor : settings of the method
    run : what else is asked
    voxels : of the written volume along the longest edge of the box; None for those of the method, else 100
    resume : go on with the checkpoint in the directory
    force : replace the result in the directory
    keep : further entries of run.toml
    on_step : told every step of the main reconstruction, and may stop it
    monitor : told how the work goes
    live : write live.json and live.npz meanwhile, for whoever looks on (live.py)

    Raises
    ------
    InputError
        If anything asked cannot be; a result that is there stays as it is.
    """
    out, begun = ResultDirectory(directory, monitor.say), [resume]
    with Cores(torch.device("cpu")), if_interrupted(lambda: _left_behind(out, begun[0])):
        return _reconstruct_into(
            out, measurement, reconstructor, run or Run(), voxels, resume, force, keep, on_step, monitor, live, begun
        )


def _left_behind(out: ResultDirectory, begun: bool) -> str:
    """What an interrupted run has saved, and how to go on; an older result is not its own before it has begun."""
    resume = f"nerif reconstruct --resume --out {out.path}"
    if begun and out.has(FIELD):
        return f"{out.path} holds the field, not yet all that is written of it; {resume} completes it"
    if begun and (out.has(CHECKPOINT) or out.cross_validation.has(CHECKPOINT) or out.cross_validation.has(FIELD)):
        return f"{out.path} holds the last checkpoint; {resume} goes on from there"
    return "nothing was saved yet; the same command starts again"


def _reconstruct_into(
    out: ResultDirectory, measurement: Measurement | str | os.PathLike[str], reconstructor: Reconstructor, run: Run,
    voxels: int | None, resume: bool, force: bool, keep: Mapping[str, Any] | None, on_step: OnStep | None,
    monitor: Monitor, live: bool, begun: list[bool],
) -> Reconstruction:  # fmt: skip
    """Do it; `begun` becomes [True] when the directory is the run's own."""
    path = None
    if not isinstance(measurement, Measurement):
        path = Path(measurement)
        measurement = Measurement.read(path)
    measurement = seen_through(measurement, reconstructor.aperture)
    check_source(reconstructor.source, measurement)  # before any view is kept out
    if voxels is None:
        voxels = reconstructor.voxels if isinstance(reconstructor, VoxelReconstructor) else 100
    if voxels < 1:
        raise InputError(f"expected at least 1, got {voxels}", field="voxels")
    whole = measurement
    measurement, reconstructor, unseen = kept_apart(run.withhold, whole, reconstructor)
    training = measurement.without(unseen)
    gains = fit_gains(training) if run.fit_gains else {}
    if gains:
        monitor.say("gains: " + ", ".join(f"{name} {gain:.4f}" for name, gain in gains.items()))
        measurement, training = with_gains(measurement, gains), with_gains(training, gains)
    trials = _trials(run)
    run = replace(run, gas=run.gas.for_measurement(measurement))
    if measurement.bad_pixels:
        where = "the measurement" if path is None else path
        seen = " or ".join(o.technique.measured for o in measurement.observations)
        what = f"pixels left out whose {seen} or sigma is NaN, infinite or impossible"
        monitor.say(f"{where}: {measurement.bad_pixels} {what}")
    for camera in measurement.cameras:
        if camera.unseen:
            monitor.say(
                f"view '{camera.name}': {camera.unseen:.1%} of its pixels left out, for which its distortion cannot be "
                "inverted; calibrate it with images of a target that reaches into its corners"
            )
    slow = SlowRun(reconstructor, monitor.say)
    look = _cross_validation(out, run, reconstructor, training, not resume, monitor.telling(slow))
    state = out.state() if resume and (look is None or out.has(CHECKPOINT) or not look.begun) else None
    start = _start(run, measurement) if trials is not None or not resume else None
    if not resume:
        out.check_free(force)
    ranks = Ranks.from_environment()
    if ranks.size > 1:
        _check_parallel(run, reconstructor)
    if not ranks.is_first:  # under torchrun the first process tells, and writes
        with monitor.training("training") as told:
            return reconstructor(training, told, state, start if state is None else None)
    monitor = monitor.telling(slow)
    settings = _settings(run, path, reconstructor, voxels, keep or {})
    if "density" not in quantities_of(measurement.quantity):
        del settings["gas"]
    run, begin = replace(run, withhold=unseen), _begin(out, settings, resume, begun)
    data = measurement if look is None else look.data
    looked = Live(out.path, data, reconstructor, next(iter(unseen), ""), lambda: slow.line) if live else None
    if looked is not None and look is not None:
        look = replace(look, monitor=looked.watching(monitor, withheld=True))
    watched = monitor if looked is None else looked.watching(monitor, withheld=bool(unseen))
    first, method, origin = look(begin) if look is not None and state is None else None, reconstructor, start
    if first is not None:
        origin, method = first.field, reconstructor.in_two()[1]
    if look is not None and first is not None and first.outcome.reason == "interrupted":
        result, run, measurement = replace(first, state=None), replace(run, withhold=(look.view,)), look.data
    else:
        with watched.training("training" if isinstance(reconstructor, NeRIF) else "solving") as told:
            callbacks = [begin, told, checkpoints(out.path, run.checkpoint_every), *([on_step] if on_step else [])]
            result = method(training, compose(*callbacks), state, origin if state is None else None)
    begin(None)
    scores = {} if look is None else look.scores()
    _write(
        out, measurement, result, run, settings, gains, voxels, monitor, {"cross_validation": scores} if scores else {}
    )
    _tell_axis(out, result, whole, monitor)
    try:
        if trials is not None and result.outcome.failed:
            monitor.say(f"uncertainty: none of a run that {result.outcome.reason}")
        elif trials is not None and result.outcome.reason != "interrupted":
            made_of = {"start_from": str(run.start_from)}
            known = with_corrections(training, result.rig)  # a refined rig is what there is to repeat
            watched = monitor if looked is None else looked.watching(monitor, withheld=False, looks=False)
            members = Members(out, trials, reconstructor, known, start, made_of, run.checkpoint_every, watched)
            members.add_to(result, run.gas, voxels)
    finally:  # the verdict and the page of the main result, whatever becomes of the members
        made = out.read()
        if (meridian := made.meridian) is not None:
            out.write_meridian(meridian)
        judged = verdict(made)
        out.add_metrics({"verdict": asdict(judged)})
        if run.report:
            write_report(out.path, monitor=monitor)
        monitor.say(judged.sentence)
    return result


def write_report(directory: str | os.PathLike[str], path: Path | None = None, monitor: Monitor = QUIET) -> Path:
    """Write the page of a result directory, say what could not be shown, and return where it is."""
    out = ResultDirectory(directory, monitor.say)
    path = path or out / REPORT
    with monitor.counting("writing the report"):
        result = out.read()
        page = html.render(result)
    if path == out / REPORT:
        with out.writing(REPORT):
            html.write(page, path)
    else:  # a file of its own, wherever it is asked for
        html.write(page, path)
    for gap in result.missing:
        monitor.say(f"missing: {gap.sentence}")
    _say_size(path, monitor)
    return path


def write_sequence_report(store: str | os.PathLike[str], path: Path | None = None, monitor: Monitor = QUIET) -> Path:
    """Write the page of a store of nerif sequence, finished or not, and return where it is."""
    path = path or Path(store).with_suffix(".html")
    html.write(render_sequence(VolumeSequence(store)), path)
    _say_size(path, monitor)
    return path


def _say_size(path: Path, monitor: Monitor) -> None:
    size = path.stat().st_size
    monitor.say(f"{path}: {f'{size / 1e6:.1f} MB' if size > 1e6 else f'{size / 1e3:.0f} kB'}; open it in a browser")


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
    """Write what came out: the field first, it is the costliest; what only looks at it comes last."""
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
    calibrated, held = measurement, []
    if result.rig:
        with monitor.counting("how well the rig is known") as bar:
            training = measurement.without(run.withhold)
            rig = with_posterior(result.rig, training, result.field, result.settings, bar)
        measurement = with_corrections(measurement, rig)
        metrics["rig"] = rig
        with out.writing(CALIBRATION) as written:
            write_cameras(written, [CalibratedCamera.from_camera(c) for c in measurement.cameras])
        for line in moved_lines(rig):
            monitor.say(line)
        if run.withhold:
            unseen = calibrated.select(run.withhold)
            with monitor.counting("refining the views held out"):
                held = refit(result.field, unseen, result.settings, result.device)
                mended = reproject(result.field, with_corrections(unseen, held), run.withhold, result.device)
            metrics |= {"rig_withheld": held, "views_refitted": evaluate_views(mended) if held else []}
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


def _tell_axis(out: ResultDirectory, result: Reconstruction, whole: Measurement, monitor: Monitor) -> None:
    """Keep and say where the axis of a symmetric flow was found, and how far the measurement departs from it."""
    if result.axis is None:
        return
    apart = asymmetry(whole, result.axis.symmetry) if result.axis.symmetry.axial else []
    out.add_metrics({"axis": result.axis.record, "asymmetry": apart})
    for line in (*result.axis.sentences, *(asymmetry_sentence(d) for d in apart)):
        monitor.say(line)


def _trials(run: Run) -> Trials | None:
    """The trials of the bootstrap, if any; a kind that does not exist is refused before the work."""
    trials = Trials(run.uncertainty)
    return trials if trials.members else None


def _cross_validation(
    out: ResultDirectory, run: Run, reconstructor: Reconstructor, training: Measurement, afresh: bool,
    monitor: Monitor,
) -> FirstLook | None:  # fmt: skip
    """The short run without a view, unless the field to start from has seen all views."""
    if run.withhold != AUTO or AUTO[0] in training.names or run.start_from is not None:
        return None
    if Ranks.from_environment().size > 1:
        return None
    if len(training.cameras) < FEWEST:
        axis = axis_of(reconstructor, training) if isinstance(reconstructor, SharedSettings) else None
        if axis is None or not axis.symmetry.axial:
            return None
        assert isinstance(reconstructor, SharedSettings)
        reconstructor, training = with_axis(reconstructor, axis.symmetry), halved(training, axis.symmetry)
    return FirstLook(out, reconstructor, training, run.checkpoint_every, monitor, afresh)


def _check_parallel(run: Run, reconstructor: Reconstructor) -> None:
    """Refuse what does not split its rays over the processes of torchrun."""
    if not isinstance(reconstructor, NeRIF):
        method = _method(reconstructor)
        raise InputError(f"expected nerif under torchrun, got '{method}', which runs in one process", field="method")
    if run.uncertainty != "off":
        raise InputError("expected off under torchrun; run it in one process", field="uncertainty")


def _start(run: Run, measurement: Measurement) -> Field | None:
    """The field to start from, if one is named."""
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
    """Settings that repeat the run, under the names of the flags."""
    asked: dict[str, Any] = {**keep, **asdict(run), **asdict(reconstructor)}  # type: ignore[call-overload]
    if run.start_from is not None:
        asked["start_from"] = run.start_from.resolve()
    found = None if path is None else str(path.resolve())
    return {"measurement": found, "method": _method(reconstructor), "voxels": voxels, **asked}


def _begin(
    out: ResultDirectory, settings: Mapping[str, Any], resume: bool, begun: list[bool]
) -> Callable[[Step | None], None]:
    """Make the directory ready once the first step is done: input that is refused before leaves an old result alone."""
    done: list[bool] = []

    def prepare(step: Step | None) -> None:
        if not done:
            out.begin(settings, resume)
            done.append(True)
            begun[0] = True

    return prepare
