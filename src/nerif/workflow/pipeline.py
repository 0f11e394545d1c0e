"""From a measurement to a result directory: nerif reconstruct as a Python call."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from contextlib import nullcontext
from typing import Any

import torch

from nerif.common.interruption import if_interrupted
from nerif.data.measurement import Measurement
from nerif.reconstruction.device import Cores
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.progress import QUIET, Monitor
from nerif.reconstruction.reconstructor import OnStep, Reconstruction, Reconstructor
from nerif.results.directory import ResultDirectory
from nerif.workflow.job import Job, remedy
from nerif.workflow.run_settings import Run
from nerif.workflow.steps import CLOSING, STEPS, Fit, the_result

__all__ = ["reconstruct_into"]


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
    since: float | None = None,
) -> Reconstruction:
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
    out, jobs, run = ResultDirectory(directory, monitor.say), list[Job](), run or Run()
    alone = out.locked() if Ranks.from_environment().is_first else nullcontext()  # the others do not write
    own_files = lambda: resume or any(job.begun for job in jobs)  # noqa: E731
    with Cores(torch.device("cpu"), run.threads), alone, if_interrupted(lambda: remedy(out, own_files())):
        job = Job(
            out, measurement, reconstructor, run, voxels=voxels, resume=resume, force=force, keep=keep,
            on_step=on_step, monitor=monitor, live=live, since=since,
        )  # fmt: skip
        jobs.append(job)
        run_steps(job)
    return the_result(job)


def run_steps(job: Job) -> None:
    """Run the steps of a job that are wanted; under torchrun only the first process does more than the fit."""
    if not job.ranks.is_first:
        Fit.run(job)
        return
    try:
        for step in STEPS:
            if step.wanted(job):
                step.run(job)
    finally:
        for step in CLOSING:
            if step.wanted(job):
                step.run(job)
    result, volume = the_result(job), job.out / "volume.vti"
    fit, whole = f"{result.seconds:.0f} s for the fit on {result.device}", f"{time.time() - job.budget.start:.0f} s"
    since = "since it was resumed" if job.resume else "in all"
    job.monitor.say(f"{job.out.path}: {fit}, {whole} {since}; open {volume} in ParaView")
