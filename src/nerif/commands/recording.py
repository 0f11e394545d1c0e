"""nerif displacement --frames: many flow pictures to a measurement sequence, several frames at once.

What the reference pictures say is worked out once. The same command again does the frames that are missing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from nerif.commands.output import counting_bar, say
from nerif.conventions import InputError
from nerif.geometry import Camera
from nerif.imaging.assembly import World, join_views
from nerif.imaging.displacement import AtRest, measure_against
from nerif.imaging.masks import flow_mask
from nerif.imaging.views import View
from nerif.measurement import Measurement
from nerif.measurement_sequence import MeasurementSequence

__all__ = ["FrameJob", "RestingView", "frame_numbers", "instants_of", "measure_frames"]


@dataclass(frozen=True)
class RestingView:
    """A view whose reference is known.

    Parameters
    ----------
    view : where its pictures are
    camera : of its pictures
    rest : what the reference says
    region : (row, column) where the background is seen, or None
    mask : (row, column) drawn mask of the flow, or None
    """

    view: View
    camera: Camera
    rest: AtRest
    region: np.ndarray | None = None
    mask: np.ndarray | None = None


@dataclass(frozen=True)
class FrameJob:
    """All that a process needs to measure a frame.

    Parameters
    ----------
    views : with their references
    world : box and surroundings
    threshold : of the flow mask, in sigma; 0 for none
    """

    views: Sequence[RestingView]
    world: World
    threshold: float = 0.0

    def measure(self, index: int) -> tuple[Measurement, list[str]]:
        """Return the measurement of one frame, and what is wrong with the views it had to do without.

        Raises
        ------
        InputError
            If no view is left.
        """
        cameras, maps, masks, lost = [], [], [], []
        for v in self.views:
            try:
                frames = v.view.open("flow")
                picture = v.view.cropped(frames[index], frames.name(index))
                found = measure_against(v.rest, [picture], v.region)
                if not found.valid.any():
                    raise InputError(f"{frames.name(index)}: no pixel holds")
            except InputError as error:
                lost.append(f"view '{v.view.name}': {error}")
                continue
            mask = v.mask
            if mask is None and self.threshold:
                mask = flow_mask(found.displacement, found.sigma, self.threshold)
            cameras.append(v.camera)
            maps.append(found)
            masks.append(mask)
        if not maps:
            raise InputError(lost[0])
        return join_views(cameras, maps, masks, self.world), lost


def frame_numbers(text: str, views: Sequence[View]) -> range:
    """Return the flow pictures that "all" or FIRST:LAST (LAST not included) stands for.

    Raises
    ------
    InputError
        If that is not within the pictures of every view.
    """
    counts = {view.name: len(view.open("flow")) for view in views}
    least = min(counts, key=lambda name: counts[name])
    if text == "all":
        return range(counts[least])
    try:
        first, last = (int(word) for word in text.split(":"))
        if not 0 <= first < last:
            raise ValueError
    except ValueError:
        raise InputError(f"frames: expected all, or FIRST:LAST such as 0:400, got '{text}'") from None
    if last > counts[least]:
        raise InputError(f"frames: expected numbers within the {counts[least]} of view '{least}', got '{text}'")
    return range(first, last)


def instants_of(numbers: range, view: View, frame_rate: float) -> tuple[float, ...]:
    """Return when the frames were taken, s: by the frame rate (1/s), else as the recording says.

    Raises
    ------
    InputError
        If neither is known.
    """
    if frame_rate > 0:
        return tuple(i / frame_rate for i in numbers)
    recorded = view.open("flow").times
    if recorded is None:
        raise InputError("frame_rate: expected frames per second, as the pictures do not tell their times; got none")
    return tuple(float(recorded[i]) for i in numbers)


def measure_frames(
    job: FrameJob, numbers: range, times: Sequence[float], out: Path, settings: dict[str, Any], force: bool = False
) -> MeasurementSequence:
    """Measure the frames that a store lacks, on all cores, and say what could not be measured.

    Parameters
    ----------
    numbers : of the flow pictures
    settings : kept in the store; a store begun with others is refused
    """
    sequence = _store(job, numbers, times, out, settings, force)
    todo = [i for i in range(len(numbers)) if not sequence.is_written(i)]
    done, wrong = len(numbers) - len(todo), 0
    if done:
        say(f"{out}: {done} of {len(numbers)} frames are there already")
    processes = max(1, min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1, len(todo)))
    with (
        counting_bar("finding displacements", len(numbers)) as bar,
        ProcessPoolExecutor(processes, get_context("forkserver"), _begin, (job, sequence, numbers)) as pool,
    ):
        try:
            futures = {pool.submit(_frame, i): i for i in todo}
            for future in as_completed(futures):
                done += 1
                bar(done)
                lines = future.result()
                wrong += bool(lines)
                for line in lines:
                    say(f"frame {numbers[futures[future]]}: left out: {line}")
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    say(f"{out}: {len(numbers)} frames of {len(job.views)} views, {wrong} of them with something left out")
    return sequence


def _store(
    job: FrameJob, numbers: range, times: Sequence[float], out: Path, settings: dict[str, Any], force: bool
) -> MeasurementSequence:
    """The store to go on with, or a new one."""
    import zarr

    wanted = json.loads(json.dumps({**settings, "frames": [numbers.start, numbers.stop]}, default=str))
    if out.exists() and not force:
        sequence = MeasurementSequence.read(out)
        if zarr.open_group(out, mode="r").attrs.get("displacement") != wanted:
            raise InputError(f"{out}: exists already, made with other settings; give another --out, or --force")
        return sequence
    wrong = None
    for number in numbers:
        try:
            like, lost = job.measure(number)
        except InputError as error:
            wrong, lost = wrong or error, [str(error)]
        if not lost:
            sequence = MeasurementSequence.create(out, times, like, force)
            zarr.open_group(out, mode="r+").attrs["displacement"] = wanted
            return sequence
        wrong = wrong or InputError(lost[0])
    raise InputError(f"no frame in which every view could be used; {wrong}; choose --views")


_worker: tuple[FrameJob, MeasurementSequence, range]


def _begin(job: FrameJob, sequence: MeasurementSequence, numbers: range) -> None:
    """Give a process what all its frames have in common."""
    global _worker
    import signal

    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the command alone hears Ctrl-C
    cv2.setNumThreads(1)
    _worker = job, sequence, numbers


def _frame(index: int) -> list[str]:
    """Measure and write one frame; what was left out."""
    job, sequence, numbers = _worker
    try:
        measurement, lost = job.measure(numbers[index])
        sequence.write_frame(index, measurement)
    except InputError as error:
        return [str(error)]
    return lost
