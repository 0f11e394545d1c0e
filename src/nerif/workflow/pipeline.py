"""From a measurement to a result directory: nerif reconstruct as a Python call."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import torch

from nerif.common.installation import command_line, word_of
from nerif.common.interruption import if_interrupted
from nerif.data.measurement import Measurement
from nerif.reconstruction.device import Cores
from nerif.reconstruction.field_files import CHECKPOINT, FIELD
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.reconstruction.reconstructor import OnStep, Reconstruction, Reconstructor
from nerif.results.directory import VOLUME_VTI, ResultDirectory
from nerif.workflow.reconstruction_run import ReconstructionRun, StepOutputs
from nerif.workflow.run_settings import RunSettings
from nerif.workflow.steps import STEPS, fit, judge, write_page

__all__ = ["reconstruct_into"]


def reconstruct_into(
    directory: str | os.PathLike[str], measurement: Measurement | str | os.PathLike[str], reconstructor: Reconstructor,
    run: RunSettings | None = None, *, voxels: int | None = None, resume: bool = False, force: bool = False,
    keep: Mapping[str, Any] | None = None, on_step: OnStep | None = None, monitor: Monitor = QUIET, live: bool = False,
    since: float | None = None,
) -> Reconstruction:  # fmt: skip
    """Reconstruct, and write the result directory of docs/formats.md.

    Field, history and volumes are written first, then the re-projection into the views and the report. An earlier
    result is left as it is if any input is invalid, or another run writes to the directory.

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
    since : time from which the time limit counts, s since the epoch; None for now
    """
    out, settings = ResultDirectory(directory, monitor.say), run or RunSettings()
    alone = out.locked() if Ranks.from_environment().is_first else nullcontext()  # the others do not write
    remedy = lambda: _remedy(out, resume or out.begun)  # noqa: E731
    with Cores(torch.device("cpu"), settings.threads), alone, if_interrupted(remedy):
        plan = ReconstructionRun.plan(out, measurement, reconstructor, settings, voxels, resume, force, monitor, since)
        plan = replace(plan, keep=keep or {}, on_step=on_step)
        return run_steps(plan.with_live_view() if live else plan)


def _remedy(out: ResultDirectory, own_files: bool) -> str:
    """Return what an interrupted run (with own files in the directory or not) has saved, and how to continue."""
    resume = command_line(["reconstruct", "--resume", "--out", word_of(out.path)])
    if own_files and out.has(FIELD):
        return f"{out.path} holds the field, but not all other files; complete it with {resume}"
    if own_files and (out.has(CHECKPOINT) or out.cross_validation.has(CHECKPOINT) or out.cross_validation.has(FIELD)):
        return f"{out.path} holds the last checkpoint; continue with {resume}"
    return "nothing was saved yet; run the same command again"


def run_steps(run: ReconstructionRun) -> Reconstruction:
    """Run the steps, and whatever became of them judge the field; under torchrun only the first process does it all."""
    so_far = StepOutputs.before(run)
    if not run.ranks.is_first:
        return fit(run, so_far).the_result
    try:
        for step in STEPS:
            so_far = step(run, so_far)
    finally:
        if so_far.result is not None and run.out.begun and run.out.has(FIELD):
            judged = judge(run, so_far)
            if run.settings.report:
                write_page(run, judged)
    result, volume = so_far.the_result, run.out / VOLUME_VTI
    times = f"{result.seconds:.0f} s for the fit on {result.device}, {time.time() - run.budget.start:.0f} s"
    since = "since it was resumed" if run.resume else "in all"
    run.monitor.say(f"{run.out.path}: {times} {since}; open {volume} in ParaView")
    return result
