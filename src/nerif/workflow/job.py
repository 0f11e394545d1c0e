"""A reconstruction into a result directory: its settings, its inputs, and what its steps have produced so far."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from nerif.analysis.asymmetry import halved
from nerif.analysis.gains import fit_gains, with_gains
from nerif.analysis.prediction import check_sees
from nerif.common.conventions import InputError, percent
from nerif.common.installation import command_line, word_of
from nerif.common.memory import free_memory
from nerif.common.settings import with_present_names
from nerif.data.measurement import Measurement
from nerif.data.quantity_names import quantities_of
from nerif.data.volume import Volume
from nerif.fields.field import Field
from nerif.geometry import Box, Grid
from nerif.reconstruction.aperture import apply_aperture
from nerif.reconstruction.detail.detail import DetailChoice, Posterior, check_sigma
from nerif.reconstruction.field_files import CHECKPOINT, FIELD
from nerif.reconstruction.methods import method_name
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.schedule import Pace
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.reconstruction.reconstructor import VOXELS, OnStep, Reconstruction, Reconstructor, State, Step
from nerif.reconstruction.shared_settings import SharedSettings
from nerif.reconstruction.sources import check_source
from nerif.reconstruction.uncertainty.bootstrap import Trials
from nerif.reconstruction.uncertainty.rig_posterior import RigPosterior
from nerif.reconstruction.voxels.symmetry_axis import axis_of, too_few_views, with_axis
from nerif.results.directory import ResultDirectory
from nerif.results.live import Live
from nerif.results.metrics_file import DetailEntries
from nerif.workflow.budget import Budget
from nerif.workflow.cross_validation import MIN_VIEWS, CrossValidation, with_halves
from nerif.workflow.run_settings import AUTO, Run

__all__ = ["Inputs", "Job", "remedy"]

VOLUMES = 4  # written quantities, in double precision while they are derived


def remedy(out: ResultDirectory, own_files: bool) -> str:
    """Return what an interrupted run (with own files in the directory or not) has saved, and how to continue."""
    resume = command_line(["reconstruct", "--resume", "--out", word_of(out.path)])
    if own_files and out.has(FIELD):
        return f"{out.path} holds the field, but not all other files; complete it with {resume}"
    if own_files and (out.has(CHECKPOINT) or out.cross_validation.has(CHECKPOINT) or out.cross_validation.has(FIELD)):
        return f"{out.path} holds the last checkpoint; continue with {resume}"
    return "nothing was saved yet; run the same command again"


@dataclass(frozen=True)
class Inputs:
    """Data of a reconstruction.

    Parameters
    ----------
    all_views : as measured, through the lenses that the settings ask for
    measurement : split into halves of images if one is withheld, divided by the intensity gains
    training : the part that is fitted
    withheld : names of the other views
    gains : intensity gains by view
    path : of the measurement; None for one in memory
    box : of the result; that of the data may be larger (extend_open_faces)
    notes : lines on settings that the data limit
    """

    all_views: Measurement
    measurement: Measurement
    training: Measurement
    withheld: tuple[str, ...]
    gains: dict[str, float]
    path: Path | None
    box: Box
    notes: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, measurement: Measurement | str | os.PathLike[str], reconstructor: Reconstructor, run: Run
    ) -> tuple[Inputs, Reconstructor]:
        """Read and split the data; return them with settings for them: voxels no smaller, the axis of the flow."""
        path = None if isinstance(measurement, Measurement) else Path(measurement)
        if not isinstance(measurement, Measurement):
            measurement = Measurement.read(measurement)
        box = measurement.box
        if run.extend_open_faces:
            measurement, reconstructor = grown(measurement, reconstructor, run.extend_open_faces)
        all_views = apply_aperture(measurement, reconstructor.aperture)
        check_source(reconstructor.source, all_views)  # before any view is withheld
        measurement, reconstructor, withheld = with_halves(run.withhold, all_views, reconstructor)
        training = measurement.without(withheld)
        gains = fit_gains(training) if run.fit_gains else {}
        if gains:
            measurement, training = with_gains(measurement, gains), with_gains(training, gains)
        reconstructor, note = reconstructor.resolved(training)
        few = too_few_views(reconstructor, training) if isinstance(reconstructor, SharedSettings) else ""
        notes = tuple(line for line in (note, few) if line)
        return cls(all_views, measurement, training, withheld, gains, path, box, notes), reconstructor

    @property
    def remarks(self) -> list[str]:
        """Lines on changed settings, intensity gains and pixels that are left out."""
        lines = [*self.notes]
        if self.gains:
            lines.append("intensity gains: " + ", ".join(f"{name} {gain:.4f}" for name, gain in self.gains.items()))
        if self.measurement.bad_pixels:
            names = " or ".join(kind.measured for kind in self.measurement.techniques)
            reason = f"pixels left out: {names} or sigma is NaN, infinite or impossible"
            lines.append(f"{self.path or 'the measurement'}: {self.measurement.bad_pixels} {reason}")
        for camera in self.measurement.cameras:
            if camera.unseen:
                lines.append(
                    f"view '{camera.name}': {percent(camera.unseen)} of the pixels left out, where its distortion is "
                    "not invertible; calibrate it with target images that cover its corners"
                )
        return lines


def grown(measurement: Measurement, reconstructor: Reconstructor, length: float) -> tuple[Measurement, Reconstructor]:
    """Return a measurement whose box has grown through the open faces of settings (mm), and settings without them."""
    faces = reconstructor.open_faces if isinstance(reconstructor, SharedSettings) else ()
    if not faces:
        text = "expected open faces through which the box grows (--open-faces), got none"
        raise InputError(text, field="extend_open_faces")
    box = measurement.box.grown(faces, length)
    changes: dict[str, Any] = {"open_faces": ()}
    if hasattr(reconstructor, "voxels"):  # of the same size
        changes["voxels"] = round(reconstructor.voxels * max(box.edges) / max(measurement.box.edges))
    ambient = tuple(face for face in measurement.ambient_faces if face not in faces)
    measurement = replace(measurement, box=box, ambient_faces=ambient)
    return measurement, replace(reconstructor, **changes)  # type: ignore[type-var]


def check_written(grid: Grid) -> None:
    """Refuse a grid whose volumes do not fit into the memory."""
    required = VOLUMES * 8 * math.prod(grid.shape)
    if required > (free := free_memory()):
        raise InputError(
            f"volumes of {' x '.join(map(str, grid.shape))} need {required / 2**30:.1f} GiB, {free / 2**30:.1f} GiB "
            "are free; give fewer --voxels",
            field="voxels",
        )


class Job:
    """A reconstruction under way. All input is checked when it is made; nothing is written before the first step.

    Attributes
    ----------
    measurement, withheld : that predictions are compared with; those of the cross-validation if it was interrupted
    validation : the cross-validation, or None
    method, initial, state : settings of the main run, and the field or state it starts from
    detail : how detail is to be added, if it is
    result : of the main run, once there is one
    rig : the refined rig of the result, once its uncertainty is known
    posterior, detail_entries : of the field, once detail has been added; for metrics.json
    quantities : of the result, as volumes, once they are sampled
    """

    detail: DetailChoice | None = None
    result: Reconstruction | None = None
    rig: RigPosterior | None = None
    posterior: Posterior | None = None
    detail_entries: DetailEntries | None = None
    quantities: list[Volume]

    def __init__(
        self, out: ResultDirectory, measurement: Measurement | str | os.PathLike[str], reconstructor: Reconstructor,
        run: Run, *, voxels: int | None = None, resume: bool = False, force: bool = False,
        keep: Mapping[str, Any] | None = None, on_step: OnStep | None = None, monitor: Monitor = QUIET,
        live: bool = False, since: float | None = None,
    ) -> None:  # fmt: skip
        self.out, self.resume, self.on_step = out, resume, on_step
        self.stated = reconstructor
        self.inputs, self.reconstructor = Inputs.of(measurement, reconstructor, run)
        if voxels is None:
            voxels = getattr(self.stated, "voxels", VOXELS)
        check_written(Grid.of_resolution(self.inputs.box, voxels))
        self.voxels, self.trials = voxels, Trials(run.uncertainty)
        self.budget = Budget.of(self.reconstructor, self.inputs.training, voxels, since)
        self.run = replace(run, gas=run.gas.for_measurement(self.inputs.measurement))
        for line in self.inputs.remarks:
            monitor.say(line)
        self.monitor = monitor
        if run.detail == "on":
            check_sigma(self.inputs.training)
        self.validation = self._cross_validation()
        continued = self.validation is None or out.has(CHECKPOINT) or not self.validation.resumable
        self.state: State | None = out.state() if resume and continued else None
        self.start = self._start() if self.trials.members or not resume else None
        if not resume:
            out.check_free(force)
        self.ranks = Ranks.from_environment()
        if self.ranks.size > 1:
            self._check_parallel()
        shortage = "" if resume else self.budget.shortage(self.trials.members, self.validation is not None)
        if shortage:
            monitor.say(shortage)
        pace = Pace(self.budget.allot(self.reconstructor, 1 / (1 + self.trials.members)), monitor.say, shortage)
        self.monitor = monitor.with_callback(pace)
        self.method, self.initial = self.reconstructor, self.start
        self.measurement, self.withheld = self.inputs.measurement, self.inputs.withheld
        self.settings = self._settings(keep or {})
        self.begun = False
        self.view: Live | None = None
        if live and self.ranks.is_first:
            data = self.measurement if self.validation is None else self.validation.data
            self.view = Live(out.path, data, self.reconstructor, next(iter(self.withheld), ""), lambda: pace.warning)
        if self.validation is not None:
            self.validation = replace(self.validation, monitor=self.watching(withheld=True))

    def watching(self, withheld: bool, looks: bool = True) -> Monitor:
        """Return the monitor, with the live view if there is one."""
        return self.monitor if self.view is None else self.view.watching(self.monitor, withheld=withheld, looks=looks)

    def begin(self, step: Step | None = None) -> None:
        """Prepare the directory at the first step: input that is refused before leaves an older result alone."""
        if not self.begun:
            self.out.begin(self.settings, self.resume)
            self.begun = True

    def _cross_validation(self) -> CrossValidation | None:
        """Return the cross-validation, if possible: not with an initial field, which may depend on all views."""
        run, reconstructor, training = self.run, self.reconstructor, self.inputs.training
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
        return CrossValidation(
            self.out, reconstructor, training, run.checkpoint_every, self.monitor, restart=not self.resume
        )

    def _check_parallel(self) -> None:
        """Check that the run can be distributed by torchrun."""
        if not isinstance(self.reconstructor, NeRIF):
            name = method_name(self.reconstructor)
            raise InputError(f"expected nerif under torchrun, got '{name}', which runs in one process", field="method")
        if self.run.uncertainty != "off":
            raise InputError("expected off under torchrun; run it in one process", field="uncertainty")

    def _start(self) -> Field | None:
        """Return the initial field, if any."""
        path, measurement = self.run.start_from, self.inputs.measurement
        if path is None:
            return None
        directory = ResultDirectory(path)
        start, box, _ = directory.field()
        check_sees(measurement.techniques, directory.quantity(), f"start_from {path}")
        expected = self.inputs.box
        if box != expected:
            raise InputError(
                f"expected a reconstruction in the box of the measurement, "
                f"{expected.lower} to {expected.upper} mm, got {box.lower} to {box.upper}",
                field=path,
            )
        return start

    def _settings(self, keep: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings that repeat the run, by the names of the options."""
        run, reconstructor, path = self.run, self.reconstructor, self.inputs.path
        settings: dict[str, Any] = {**keep, **asdict(run), **asdict(reconstructor)}  # type: ignore[call-overload]
        stated = asdict(self.stated)  # type: ignore[call-overload]
        settings |= {name: stated[name] for name in ("open_faces", "voxels") if name in stated}
        if run.start_from is not None:
            settings["start_from"] = run.start_from.resolve()
        if "density" not in quantities_of(self.measurement.quantity):
            del settings["gas"]
        file = None if path is None else str(path.resolve())
        whole = {"measurement": file, "method": method_name(reconstructor), "voxels": self.voxels, **settings}
        return with_present_names(whole)
