"""Cross-validation: a short run without one view gives its prediction error; the main run starts from its field."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from nerif.analysis.asymmetry import HALVES, withhold_half
from nerif.analysis.evaluation import evaluate_views, rms_with_unit
from nerif.analysis.prediction import VALIDATION_VOXELS, reproject, splines_for_views
from nerif.common.conventions import InputError
from nerif.common.files import read_json, write_json
from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.reconstruction.field_files import FIELD
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.reconstruction.reconstructor import OnStep, Reconstruction, Reconstructor
from nerif.reconstruction.rig_refinement import with_rig
from nerif.reconstruction.shared_settings import SharedSettings
from nerif.reconstruction.uncertainty.bootstrap import best_covered
from nerif.reconstruction.voxels.symmetry_axis import axis_of, check_views, with_axis
from nerif.results.directory import ResultDirectory
from nerif.results.metrics_file import WithheldRun
from nerif.workflow.checkpointed import CheckpointedRun
from nerif.workflow.run_settings import AUTO, NONE

__all__ = ["MIN_VIEWS", "CrossValidation", "ShortFit", "with_halves", "withheld_views"]

MIN_VIEWS = 4  # with three, the other two constrain the field too little
LIMITS = ("epochs", "max_steps", "iterations")
SCORES = "views.json"


def withheld_views(withhold: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the views that the main run withholds; `names`: of all views."""
    words = tuple(withhold)
    return () if words in (AUTO, NONE) and words[0] not in names else words


def with_halves(
    withhold: Sequence[str], measurement: Measurement, reconstructor: Reconstructor
) -> tuple[Measurement, Reconstructor, tuple[str, ...]]:
    """Return measurement and settings, split into halves of images if one is withheld, and the withheld views.

    Parameters
    ----------
    withhold : names of views, one of HALVES, AUTO or NONE
    """
    axis = None
    if isinstance(reconstructor, SharedSettings):
        check_views(reconstructor, measurement)
        if tuple(withhold) in [(half,) for half in HALVES]:
            axis = axis_of(reconstructor, measurement)  # from both halves: one does not determine it
    parts, names = withhold_half(measurement, withhold, None if axis is None else axis.symmetry)
    if axis is not None and parts is not measurement:
        assert isinstance(reconstructor, SharedSettings)
        reconstructor = with_axis(reconstructor, axis.symmetry)
    return parts, reconstructor, withheld_views(names, parts.names)


@dataclass(frozen=True)
class ShortFit:
    """The field of the cross-validation run, and its data with the cameras that it refined."""

    field: Field  #: reconstructed
    training: Measurement  #: data of the views that it used
    withheld: Measurement  #: data of the withheld view, its camera refined against the field if the run refined cameras


@dataclass(frozen=True)
class CrossValidation:
    """The cross-validation run, without a view, in the result directory."""

    out: ResultDirectory  #: the result directory
    reconstructor: Reconstructor  #: settings of the main run
    data: Measurement  #: of the main run
    checkpoint_every: float = 60.0  #: s
    monitor: Monitor = QUIET  #: of the progress
    restart: bool = False  #: whether to ignore the content of the directory

    @property
    def view(self) -> str:
        """The withheld view: the one best covered by the others."""
        return best_covered(self.data.cameras)[0]

    @property
    def resumable(self) -> bool:
        """Whether there is a field or a checkpoint of it."""
        return self._run.resumable

    def __call__(self, begin: OnStep) -> Reconstruction | None:
        """Reconstruct without the view, or read the result; None if that yields no field.

        Parameters
        ----------
        begin : called after each step
        """
        start, name, say = time.monotonic(), self.view, self.monitor.say
        try:
            result = self._run(f"cross-validation without {name}", begin)
        except InputError as error:
            say(f"cross-validation skipped: without {name}, {error}")
            return None
        if result.outcome.reason == "interrupted" or self.scores():
            return result
        if result.outcome.failed:
            say(f"cross-validation without {name}: {result.outcome.reason}; the main run starts from the ambient field")
            return None
        other = best_covered(self.data.cameras)[1]
        with self.monitor.counting(f"predicting {name}"):
            pair = with_rig(self.data.select([name, other]), result)
            splines = splines_for_views(result.field, pair, result.device, VALIDATION_VOXELS)
            predicted = reproject(result.field, pair, [name], result.device, model=result.model, splines=splines)
            scores = evaluate_views(predicted)
        views, fitted = ([v for v in scores if v["withheld"] is flag] for flag in (True, False))
        entries = {"views": views, "fitted_views": fitted, "seconds": time.monotonic() - start}
        with self._directory.writing(SCORES) as path:
            write_json(path, entries)
        for v in views:
            scores_of = f"CC {v['cc']:.4f}, rms residual {rms_with_unit(v)}"
            say(f"cross-validation: withheld view {name} predicted with {scores_of}")
        return result

    def scores(self) -> WithheldRun | None:
        """Return prediction errors and duration, None if there are none yet."""
        path = self._directory / SCORES
        return read_json(path) if path.is_file() else None

    @property
    def fit(self) -> ShortFit | None:
        """The field of the cross-validation run with its data; None if there is none."""
        if not self._directory.has(FIELD):
            return None
        result = self._run.read()
        data = with_rig(self.data, result)
        return ShortFit(result.field, data.without([self.view]), data.select([self.view]))

    @property
    def _directory(self) -> ResultDirectory:
        return self.out.cross_validation

    @property
    def _run(self) -> CheckpointedRun:
        short, _ = self.reconstructor.split_for_cross_validation()
        return CheckpointedRun(
            self._directory, short, self.data.without([self.view]), checkpoint_every=self.checkpoint_every,
            monitor=self.monitor, restart=self.restart, limits=LIMITS,
        )  # fmt: skip
