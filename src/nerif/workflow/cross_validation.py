"""A view is kept out first: a short run tells how well it is predicted, and the run with all goes on from there."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from nerif.analysis.asymmetry import HALVES, withhold_half
from nerif.analysis.evaluation import evaluate_views, rms_text
from nerif.analysis.prediction import reproject
from nerif.common.conventions import InputError
from nerif.common.files import write_json
from nerif.data.measurement import Measurement
from nerif.reconstruction.base import OnStep, Reconstruction, Reconstructor
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.reconstruction.shared_settings import SharedSettings
from nerif.reconstruction.symmetry import axis_of, check_views, with_axis
from nerif.reconstruction.uncertainty.bootstrap import best_covered
from nerif.results.directory import ResultDirectory
from nerif.workflow.checkpointed import KeptRun

__all__ = ["AUTO", "FEWEST", "NONE", "FirstLook", "kept_apart", "kept_out"]

AUTO: tuple[str, ...] = ("auto",)
NONE: tuple[str, ...] = ("none",)
"""May be asked for in place of the names of views: AUTO, one is kept out first, and NONE."""

FEWEST = 4
"""Views of which one is kept out first: of three, the other two would tell little."""

LIMITS = ("epochs", "max_steps", "time_limit", "longest", "iterations")
"""Settings that a run may be gone on with others of."""

SCORES = "views.json"


def kept_out(withhold: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the views that are kept out of the whole run, out of all names."""
    words = tuple(withhold)
    return () if words in (AUTO, NONE) and words[0] not in names else words


def kept_apart(
    withhold: Sequence[str], measurement: Measurement, reconstructor: Reconstructor
) -> tuple[Measurement, Reconstructor, tuple[str, ...]]:
    """Return the measurement, in halves if one of them is to be kept out, what reconstructs it, and what is kept out.

    Parameters
    ----------
    withhold : names of views, one of HALVES, AUTO or NONE
    measurement : with all views
    reconstructor : settings

    Raises
    ------
    InputError
        If a half is asked for without an axis, or more harmonics than the views could tell.
    """
    axis = None
    if isinstance(reconstructor, SharedSettings):
        check_views(reconstructor, measurement)
        if tuple(withhold) in [(half,) for half in HALVES]:
            axis = axis_of(reconstructor, measurement)  # by both halves: one does not tell
    parts, names = withhold_half(measurement, withhold, None if axis is None else axis.symmetry)
    if axis is not None and parts is not measurement:
        assert isinstance(reconstructor, SharedSettings)
        reconstructor = with_axis(reconstructor, axis.symmetry)
    return parts, reconstructor, kept_out(names, parts.names)


@dataclass(frozen=True)
class FirstLook:
    """The short run without a view, kept in the result directory.

    Parameters
    ----------
    out : the result directory
    reconstructor : settings of the whole run
    data : that the whole run reconstructs from
    checkpoint_every : seconds
    monitor : told how the work goes
    afresh : whatever is in the directory
    """

    out: ResultDirectory
    reconstructor: Reconstructor
    data: Measurement
    checkpoint_every: float = 60.0
    monitor: Monitor = QUIET
    afresh: bool = False

    @property
    def view(self) -> str:
        """Which is kept out: the one that the others cover best."""
        return best_covered(self.data.cameras)[0]

    @property
    def begun(self) -> bool:
        """Whether there is something of it to go on with."""
        return self._run.begun

    def __call__(self, begin: OnStep) -> Reconstruction | None:
        """Reconstruct without the view, or read what is there; None, which is told, where no field is found without it.

        Parameters
        ----------
        begin : told every step
        """
        started, name, say = time.monotonic(), self.view, self.monitor.say
        try:
            result = self._run(f"without {name} first", begin)
        except InputError as error:
            say(f"no view is kept out first: without {name}, {error}")
            return None
        if result.outcome.reason == "interrupted" or self.scores():
            return result
        if result.outcome.failed:
            say(f"without {name}: {result.outcome.reason}; all views begin from nothing")
            return None
        other = best_covered(self.data.cameras)[1]
        with self.monitor.counting(f"predicting {name}"):
            pair = reproject(result.field, self.data.select([name, other]), [name], result.device, model=result.model)
            scores = evaluate_views(pair)
        views, used = ([v for v in scores if v["withheld"] is held] for held in (True, False))
        taken = time.monotonic() - started
        with self._directory.writing(SCORES) as path:
            write_json(path, {"views": views, "fitted_views": used, "seconds": taken})
        for v in views:
            say(f"{name}, not seen so far, is predicted with CC {v['cc']:.4f}, rms error {rms_text(v)}")
        return result

    def scores(self) -> dict[str, Any]:
        """Return how well the views were predicted, and in which time; nothing where they were not."""
        path = self._directory / SCORES
        return json.loads(path.read_text()) if path.is_file() else {}

    @property
    def _directory(self) -> ResultDirectory:
        return self.out.cross_validation

    @property
    def _run(self) -> KeptRun:
        rest = self.data.without([self.view])
        first, _ = self.reconstructor.in_two()
        return KeptRun(
            self._directory, first, rest, None, {}, self.checkpoint_every, self.monitor, self.afresh, LIMITS
        )  # fmt: skip
