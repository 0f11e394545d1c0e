"""The plan of a reconstruction into a result directory, made of checked input, and what its steps put out."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from nerif.analysis.asymmetry import halved
from nerif.analysis.gains import fit_gains, with_gains
from nerif.analysis.prediction import check_sees
from nerif.common.conventions import InputError, percent
from nerif.common.memory import free_memory
from nerif.common.settings import with_present_names
from nerif.data.measurement import Measurement
from nerif.data.quantity_names import INDEX
from nerif.data.reprojection import Reprojection
from nerif.data.volume import Volume
from nerif.fields.field import Field
from nerif.fields.symmetric import SymmetricVoxels
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid
from nerif.physics.media import MEDIA
from nerif.reconstruction.aperture import apply_aperture
from nerif.reconstruction.detail.detail import DetailChoice, Posterior, check_sigma
from nerif.reconstruction.field_files import CHECKPOINT
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
from nerif.workflow.run_settings import AUTO, RunSettings

__all__ = ["Inputs", "ReconstructionRun", "StepOutputs", "grown"]

VOLUMES = 4  # written quantities, in double precision while they are derived


@dataclass(frozen=True)
class Inputs:
    """Data of a reconstruction."""

    all_views: Measurement  #: as measured, through the lenses that the settings ask for
    measurement: Measurement  #: split into halves of images if one is withheld, divided by the intensity gains
    training: Measurement  #: the part that is fitted
    withheld: tuple[str, ...]  #: names of the other views
    gains: dict[str, float]  #: intensity gains by view
    path: Path | None  #: of the measurement; None for one in memory
    box: Box  #: of the result; that of the data may be larger (extend_open_faces)
    notes: tuple[str, ...] = ()  #: lines on settings that the data limit

    @classmethod
    def of(
        cls, measurement: Measurement | str | os.PathLike[str], reconstructor: Reconstructor, settings: RunSettings
    ) -> tuple[Inputs, Reconstructor]:
        """Read and split the data; return them with settings for them: voxels no smaller, the axis of the flow."""
        path = None if isinstance(measurement, Measurement) else Path(measurement)
        if not isinstance(measurement, Measurement):
            measurement = Measurement.read(measurement)
        box = measurement.box
        if settings.extend_open_faces:
            measurement, reconstructor = grown(measurement, reconstructor, settings.extend_open_faces)
        all_views = apply_aperture(measurement, reconstructor.aperture)
        check_source(reconstructor.source, all_views)  # before any view is withheld
        measurement, reconstructor, withheld = with_halves(settings.withhold, all_views, reconstructor)
        training = measurement.without(withheld)
        gains = fit_gains(training) if settings.fit_gains else {}
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


@dataclass(frozen=True)
class ReconstructionRun:
    """The plan of a reconstruction into a directory. All input has been checked, and nothing has been written."""

    out: ResultDirectory
    inputs: Inputs
    requested: Reconstructor  #: settings of the method as given
    reconstructor: Reconstructor  #: the same for these data
    settings: RunSettings
    voxels: int  #: of the written volumes along the longest edge of the box
    trials: Trials  #: of the bootstrap
    budget: Budget
    validation: CrossValidation | None
    state: State | None  #: the checkpoint from which the main run continues, or None
    start: Field | None  #: initial field, or None
    resume: bool  #: continue from what is in the directory
    ranks: Ranks  #: processes of torchrun
    pace: Pace  #: callback that announces how long the fit takes
    monitor: Monitor
    keep: Mapping[str, Any] = field(default_factory=dict)  #: further entries of run.toml
    on_step: OnStep | None = None  #: called after each step of the main run, and may stop it
    view: Live | None = None  #: writes the status of the run, or None

    @classmethod
    def plan(
        cls, out: ResultDirectory, measurement: Measurement | str | os.PathLike[str], requested: Reconstructor,
        settings: RunSettings, voxels: int | None = None, resume: bool = False, force: bool = False,
        monitor: Monitor = QUIET, since: float | None = None,
    ) -> ReconstructionRun:  # fmt: skip
        """Read and check all input; parameters as in `reconstruct_into`."""
        inputs, reconstructor = Inputs.of(measurement, requested, settings)
        if voxels is None:
            voxels = getattr(requested, "voxels", VOXELS)
        check_written(Grid.of_resolution(inputs.box, voxels))
        trials, budget = Trials(settings.uncertainty), Budget.of(reconstructor, inputs.training, voxels, since)
        settings = settings.with_substance(settings.substance.for_measurement(inputs.measurement))
        settings.check_around(inputs.measurement)
        for line in inputs.remarks:
            monitor.say(line)
        if settings.detail == "on":
            check_sigma(inputs.training)
        ranks = Ranks.from_environment()
        validation = None if ranks.size > 1 else _cross_validation(out, inputs, reconstructor, settings, resume)
        continued = validation is None or out.has(CHECKPOINT) or not validation.resumable
        state = out.state() if resume and continued else None
        start = _initial_field(inputs, settings) if trials.members or not resume else None
        if not resume:
            out.check_free(force)
        if ranks.size > 1:
            _check_parallel(reconstructor, settings)
        shortage = "" if resume else budget.shortage(trials.members, validation is not None)
        if shortage:
            monitor.say(shortage)
        pace = Pace(budget.limited(reconstructor, 1 / (1 + trials.members)), monitor.say, shortage)
        return cls(
            out, inputs, requested, reconstructor, settings, voxels, trials, budget, validation, state, start, resume,
            ranks, pace, monitor.with_callback(pace),
        )  # fmt: skip

    def with_live_view(self) -> ReconstructionRun:
        """Return the run with the status written for nerif app; by the first process only."""
        if not self.ranks.is_first:
            return self
        data = self.inputs.measurement if self.validation is None else self.validation.data
        withheld = next(iter(self.inputs.withheld), "")
        return replace(self, view=Live(self.out.path, data, self.reconstructor, withheld, lambda: self.pace.warning))

    def watching(self, withheld: bool, snapshots: bool = True) -> Monitor:
        """Return the monitor, with the live view if there is one."""
        return self.monitor if self.view is None else self.view.watching(self.monitor, withheld, snapshots)

    def begin(self, step: Step | None = None) -> None:
        """Prepare the directory, at the first step: invalid input leaves an older result as it is."""
        if not self.out.begun:
            self.out.begin(self.entries, self.resume)

    @property
    def entries(self) -> dict[str, Any]:
        """Settings that repeat the run, by the names of the options."""
        settings, path = self.settings, self.inputs.path
        entries: dict[str, Any] = {**self.keep, **asdict(settings), **asdict(self.reconstructor)}  # type: ignore[call-overload]
        requested = asdict(self.requested)  # type: ignore[call-overload]
        entries |= {name: requested[name] for name in ("open_faces", "voxels") if name in requested}
        if settings.start_from is not None:
            entries["start_from"] = settings.start_from.resolve()
        entries = {name: value for name, value in entries.items() if name not in ("medium", *MEDIA)}
        if self.inputs.measurement.quantity == INDEX:
            entries |= settings.medium_entries
        file = None if path is None else str(path.resolve())
        head = {"measurement": file, "method": method_name(self.reconstructor), "voxels": self.voxels}
        return with_present_names({**head, **entries})


@dataclass(frozen=True)
class StepOutputs:
    """What the steps of a run have put out so far."""

    measurement: Measurement  #: with which predictions are compared; of the cross-validation if that was interrupted
    withheld: tuple[str, ...]  #: views of it
    method: Reconstructor  #: settings of the main run
    initial: Field | None  #: from which it starts
    budget: Budget  #: time limit, with a reserve for detail
    detail: DetailChoice | None = None  #: how detail is to be added, if it is
    result: Reconstruction | None = None  #: of the main run
    posterior: Posterior | None = None  #: of the field, once detail has been added
    detail_entries: DetailEntries | None = None  #: of metrics.json
    quantities: tuple[Volume, ...] = ()  #: of the result, as volumes
    splines: VoxelField | SymmetricVoxels | None = None  #: through the network, if its views follow from them
    views: Reprojection | None = None  #: prediction of the views
    rig: RigPosterior | None = None  #: the refined rig with its uncertainty

    @classmethod
    def before(cls, run: ReconstructionRun) -> StepOutputs:
        """Return the outputs before the first step."""
        return cls(run.inputs.measurement, run.inputs.withheld, run.reconstructor, run.start, run.budget)

    @property
    def the_result(self) -> Reconstruction:
        """The result of the main run, which a step before has produced."""
        assert self.result is not None
        return self.result

    @property
    def ended(self) -> bool:
        """Whether the main run ended with a field, uninterrupted."""
        return not self.the_result.outcome.failed and self.the_result.outcome.reason != "interrupted"

    @property
    def has_error_draws(self) -> bool:
        """Whether standard deviations are drawn from the posterior of the detail."""
        return self.posterior is not None and self.posterior.blurred


def _cross_validation(
    out: ResultDirectory, inputs: Inputs, reconstructor: Reconstructor, settings: RunSettings, resume: bool
) -> CrossValidation | None:
    """Return the cross-validation, if possible: not with an initial field, which may depend on all views."""
    training = inputs.training
    if settings.withhold != AUTO or AUTO[0] in training.names or settings.start_from is not None:
        return None
    if len(training.cameras) < MIN_VIEWS:
        axis = axis_of(reconstructor, training) if isinstance(reconstructor, SharedSettings) else None
        if axis is None or not axis.symmetry.axial:
            return None
        assert isinstance(reconstructor, SharedSettings)
        reconstructor, training = with_axis(reconstructor, axis.symmetry), halved(training, axis.symmetry)
    return CrossValidation(out, reconstructor, training, settings.checkpoint_every, restart=not resume)


def _check_parallel(reconstructor: Reconstructor, settings: RunSettings) -> None:
    """Check that a run can be distributed by torchrun."""
    if not isinstance(reconstructor, NeRIF):
        name = method_name(reconstructor)
        raise InputError(f"expected nerif under torchrun, got '{name}', which runs in one process", field="method")
    if settings.uncertainty != "off":
        raise InputError("expected off under torchrun; run it in one process", field="uncertainty")


def _initial_field(inputs: Inputs, settings: RunSettings) -> Field | None:
    """Return the initial field, if any."""
    path, expected = settings.start_from, inputs.box
    if path is None:
        return None
    directory = ResultDirectory(path)
    start, box, _ = directory.field()
    check_sees(inputs.measurement.techniques, directory.quantity(), f"start_from {path}")
    if box != expected:
        raise InputError(
            f"expected a reconstruction in the box of the measurement, "
            f"{expected.lower} to {expected.upper} mm, got {box.lower} to {box.upper}",
            field=path,
        )
    return start
