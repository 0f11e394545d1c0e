"""From the flow images of a recording to a sequence of measurements, in parallel and resumable."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from nerif.common.conventions import InputError
from nerif.common.times import frame_range
from nerif.data.measurement import Measurement
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.imaging.readers.views import OFFSET, View, words_of_range
from nerif.imaging.recording import Recording, Scene, ViewReference, join_views, reported, silent
from nerif.imaging.workers import work

__all__ = ["frame_numbers", "instants_of", "measure_frame", "measure_recording", "references_of"]

NAME = "displacement"
"""Attribute of a store with the settings of its measurement."""


def references_of(
    recording: Recording, say: Callable[[str], None] = silent, on_view: Callable[[int], None] = lambda count: None,
    processes: int | None = None,
) -> tuple[ViewReference, ...]:  # fmt: skip
    """Evaluate the reference images of all views."""
    views, recording = recording.views, replace(recording, images=False)  # a sequence has no images
    if processes is None:
        processes = recording.processes(len(views), len(views))
    references: dict[int, ViewReference] = {}
    for i, reference in reported(ViewReference.of, recording, views, processes, say):
        if isinstance(reference, InputError):
            raise reference
        references[i] = reference
        on_view(len(references))
    return tuple(references[i] for i in sorted(references))


def measure_frame(
    references: Sequence[ViewReference], scene: Scene, number: int, say: Callable[[str], None] = silent
) -> tuple[Measurement, list[str]]:
    """Return the measurement of one instant, and the errors of the views that are left out; report few pixels."""
    results, errors = [], []
    for reference in references:
        try:
            results.append(reference.measure([number], say))
        except InputError as error:
            errors.append(f"view '{reference.view.name}': {error}")
    if not results:
        raise InputError(errors[0])
    return join_views(results, scene), errors


def frame_numbers(text: str, views: Sequence[View]) -> tuple[int, ...]:
    """Return the instants of "all" or FIRST:LAST (LAST excluded) of which some view has a flow image.

    The first and last one of every view must include them: those between that it lacks were dropped by its camera.
    """
    starts, stops = ([view.instants[k] for view in views if view.instants] for k in (0, -1))
    every = {i for view in views for i in view.instants}
    if text == "all":
        common = [i for i in sorted(every) if max(starts) <= i <= min(stops)] if len(starts) == len(views) else []
        if not any(all(i in view.instants for view in views) for i in common):
            ranges = ", ".join(f"{view.name} {words_of_range(view.instants)}" for view in views)
            raise InputError(
                f"expected instants of which every view has a flow image, got none in common ({ranges}); correct the "
                "frame offsets, or choose --views",
                field="frames",
            )
        return tuple(common)
    first, last = frame_range(text)
    for view in views:
        view.check_instants(range(first, last), "frames")
    return tuple(sorted(every & {*range(first, last)}))


def instants_of(numbers: Sequence[int], view: View, frame_rate: float) -> tuple[float, ...]:
    """Return the times of instants, s, by the frame rate (1/s) or, if it is 0, by the recording of a view."""
    if frame_rate > 0:
        return tuple(i / frame_rate for i in numbers)
    times = view.flow_times(numbers)
    if times is None:
        raise InputError("expected frames per second, as the images have no times; got none", field="frame_rate")
    return times


def measure_recording(
    recording: Recording, numbers: Sequence[int], times: Sequence[float], out: Path,
    settings: dict[str, Any] | None = None, force: bool = False, say: Callable[[str], None] = silent,
    on_step: Callable[[int], None] = lambda count: None, processes: int | None = None,
) -> MeasurementSequence:  # fmt: skip
    """Measure the frames that a store does not have yet, and report what could not be measured.

    Parameters
    ----------
    numbers : of the instants; a view's flow image is that number plus its frame offset
    times : of these, s
    out : Zarr store, created if it does not exist
    settings : written to the store; a store with other settings, frame offsets or cameras is not continued
    on_step : called with the number of views with evaluated references plus that of finished frames
    processes : 1 for this one only; by default one per core if the images are large
    """
    offsets = {view.name: view.offset for view in recording.views if view.offset}
    settings = {**(settings or {}), "frames": [numbers[0], numbers[-1] + 1], **({OFFSET: offsets} if offsets else {})}
    if len(numbers) < numbers[-1] + 1 - numbers[0]:
        settings["frames"] = list(numbers)
    settings = json.loads(json.dumps(settings, default=str))
    sequence = MeasurementSequence.resumed(out, NAME, settings) if out.exists() and not force else None
    for note in recording.notes:
        say(f"note: {note}")
    references = references_of(recording, say, on_step, processes)
    if sequence is not None:
        sequence.check_cameras([view.camera for view in references])
        count = sum(map(sequence.is_written, range(len(numbers))))
        say(f"{out}: {count} of {len(numbers)} frames exist already")
    else:
        sequence = _create(references, recording.scene, numbers, times, out, settings, force, say)
    todo = [i for i in range(len(numbers)) if not sequence.is_written(i)]
    count, incomplete = len(numbers) - len(todo), 0
    if processes is None:
        processes = recording.processes(len(todo), len(todo) * len(references))
    for i, lines in work(_write_frame, (references, recording.scene, sequence, numbers), todo, processes):
        count += 1
        on_step(len(references) + count)
        incomplete += bool(lines)
        for line in lines:
            say(f"frame {numbers[todo[i]]}: left out: {line}")
    say(f"{out}: {len(numbers)} frames of {len(references)} views, {incomplete} of them incomplete")
    return sequence


def _create(
    references: Sequence[ViewReference], scene: Scene, numbers: Sequence[int], times: Sequence[float], out: Path,
    settings: dict[str, Any], force: bool, say: Callable[[str], None],
) -> MeasurementSequence:  # fmt: skip
    """A new store with the first frame that has all views, whose notes stand for those of all frames."""
    reasons = []
    for index, number in enumerate(numbers):
        lines: list[str] = []
        try:
            measurement, errors = measure_frame(references, scene, number, lines.append)
        except InputError as error:
            errors = [str(error)]
        if not errors:
            for line in lines:
                say(f"frame {number}: {line}")
            sequence = MeasurementSequence.create(out, times, measurement, force)
            sequence.record(NAME, settings)
            sequence.write_frame(index, measurement)
            return sequence
        reasons += errors
    raise InputError(f"no frame in which every view could be used; {reasons[0]}; choose --views")


def _write_frame(
    common: tuple[Sequence[ViewReference], Scene, MeasurementSequence, Sequence[int]], index: int
) -> list[str]:
    """Measure and write one frame; return the errors of views that are left out."""
    references, scene, sequence, numbers = common
    try:
        measurement, errors = measure_frame(references, scene, numbers[index])
        sequence.write_frame(index, measurement)
    except InputError as error:
        return [str(error)]
    return errors
