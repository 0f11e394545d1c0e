"""Many flow images to a measurement sequence, several instants at once; what is there already is not done again."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.measurement_file import from_dataset
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.geometry import Camera, Lens
from nerif.imaging.measuring import Recording, RestingView, Scene, join_views
from nerif.imaging.readers.views import View
from nerif.imaging.workers import work

__all__ = ["RestingRecording", "frame_numbers", "instants_of", "measure_recording"]

ROUNDING = 1e-9  # of the largest number of what is compared


@dataclass(frozen=True)
class RestingRecording:
    """All views, with what is known of them before the first flow image.

    Parameters
    ----------
    views : with their references
    scene : box and surroundings
    """

    views: tuple[RestingView, ...]
    scene: Scene

    @classmethod
    def of(
        cls,
        recording: Recording,
        say: Callable[[str], None] = lambda line: None,
        on_view: Callable[[int], None] = lambda done: None,
        processes: int | None = None,
    ) -> RestingRecording:
        """Look at the reference images of all views; see RestingView.of."""
        views, recording = recording.views, replace(recording, images=False)  # a store of frames has none
        if processes is None:
            processes = recording.processes(len(views), len(views))
        found: dict[int, RestingView] = {}
        for i, (resting, lines) in work(_rest, recording, views, processes):
            for line in lines:
                say(line)
            if isinstance(resting, InputError):
                raise resting
            found[i] = resting
            on_view(len(found))
        return cls(tuple(found[i] for i in sorted(found)), recording.scene)

    def measure(self, number: int) -> tuple[Measurement, list[str]]:
        """Return the measurement of one flow image, and what is wrong with the views it had to do without.

        Raises
        ------
        InputError
            If no view is left.
        """
        found, lost = [], []
        for resting in self.views:
            try:
                found.append((resting.camera, *resting.measure([number])))
            except InputError as error:
                lost.append(f"view '{resting.view.name}': {error}")
        if not found:
            raise InputError(lost[0])
        return join_views(found, self.scene), lost


def _rest(recording: Recording, view: View) -> tuple[RestingView | InputError, list[str]]:
    lines: list[str] = []
    try:
        return RestingView.of(recording, view, 1, lines.append), lines
    except InputError as error:
        return error, lines


def frame_numbers(text: str, views: Sequence[View]) -> range:
    """Return the flow images that "all" or FIRST:LAST (LAST not included) stands for.

    Raises
    ------
    InputError
        If that is not within the images of every view.
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
        raise InputError(f"expected all, or FIRST:LAST such as 0:400, got '{text}'", field="frames") from None
    if last > counts[least]:
        raise InputError(f"expected numbers within the {counts[least]} of view '{least}', got '{text}'", field="frames")
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
        raise InputError(
            "expected frames per second, as the images do not tell their times; got none", field="frame_rate"
        )
    return tuple(float(recorded[i]) for i in numbers)


def measure_recording(
    recording: Recording,
    numbers: range,
    times: Sequence[float],
    out: Path,
    settings: dict[str, Any] | None = None,
    force: bool = False,
    say: Callable[[str], None] = lambda line: None,
    on_step: Callable[[int], None] = lambda done: None,
    processes: int | None = None,
) -> MeasurementSequence:
    """Measure the frames that a store lacks, on all cores, and say what could not be measured.

    Parameters
    ----------
    numbers : of the flow images
    times : when they were taken, s
    out : Zarr store, made if it is not there
    settings : kept in the store; a store begun with others, or with other cameras, is refused
    force : begin anew
    say : is told what had to be left out, and why
    on_step : called with the number of views whose references were looked at, plus the frames done
    processes : 1 for none but this; by default as many as there are processors, if there is enough to do

    Raises
    ------
    InputError
        If the store was begun with other settings or cameras, a view has no reference, or no frame can be used in
        every view.
    """
    wanted = json.loads(json.dumps({**(settings or {}), "frames": [numbers.start, numbers.stop]}, default=str))
    sequence = _begun(out, wanted) if out.exists() and not force else None
    resting = RestingRecording.of(recording, say, on_step, processes)
    if sequence is not None:
        _check_cameras(out, [view.camera for view in resting.views])
        there = sum(map(sequence.is_written, range(len(numbers))))
        say(f"{out}: {there} of {len(numbers)} frames are there already")
    else:
        sequence = _begin(resting, numbers, times, out, wanted, force)
    todo = [i for i in range(len(numbers)) if not sequence.is_written(i)]
    done, wrong = len(numbers) - len(todo), 0
    if processes is None:
        processes = recording.processes(len(todo), len(todo) * len(resting.views))
    for i, lines in work(_frame, (resting, sequence, numbers), todo, processes):
        done += 1
        on_step(len(resting.views) + done)
        wrong += bool(lines)
        for line in lines:
            say(f"frame {numbers[todo[i]]}: left out: {line}")
    say(f"{out}: {len(numbers)} frames of {len(resting.views)} views, {wrong} of them with something left out")
    return sequence


def _begun(out: Path, wanted: dict[str, Any]) -> MeasurementSequence:
    """The store to go on with."""
    import zarr

    sequence = MeasurementSequence.read(out)
    if zarr.open_group(out, mode="r").attrs.get("displacement") != wanted:
        raise InputError("exists already, made with other settings; give another --out, or --force", field=out)
    return sequence


def _check_cameras(out: Path, cameras: Sequence[Camera]) -> None:
    """Refuse to go on with a store of other cameras."""
    import xarray as xr

    with xr.open_dataset(out, engine="zarr", chunks=None, consolidated=False, decode_times=False) as dataset:
        kept = {c.name: c for c in from_dataset(dataset.isel(time=0, row=slice(1), column=slice(1)))["cameras"]}
    names = [camera.name for camera in cameras]
    other = [f"views ({', '.join(kept)})"] if set(names) != set(kept) else []
    for camera in cameras if not other else ():
        there = _numbers(kept[camera.name])
        for what, value in _numbers(camera).items():
            near = ROUNDING * float(value.nan_to_num().abs().max())
            if not torch.allclose(value, there[what], rtol=0, atol=near, equal_nan=True):
                other.append(f"{what} of view '{camera.name}'")
    if other:
        raise InputError(
            f"expected the cameras that the store was begun with, got other {other[0]}; was the calibration "
            "made anew? Give another --out, or --force",
            field=out,
        )


def _numbers(camera: Camera) -> dict[str, Tensor]:
    """What a camera is, as a measurement keeps it."""
    lens = camera.lens if camera.lens is not None and camera.lens.wide else Lens()
    sigma = torch.full((6,), torch.nan) if camera.pose_sigma is None else camera.pose_sigma
    groups: dict[str, Any] = {
        "image size": camera.image_size,
        "projection": [camera.projection.shows_depth],
        "intrinsics": camera.intrinsics,
        "rotation": camera.rotation,
        "translation": camera.translation,
        "distortion": camera.distortion,
        "background": [*camera.plane.normal.tolist(), camera.plane.offset],
        "lens": [lens.diameter, torch.nan if lens.focus is None else lens.focus],
        "pose_sigma": sigma,
    }
    return {what: torch.as_tensor(value, dtype=torch.float64) for what, value in groups.items()}


def _begin(
    resting: RestingRecording, numbers: range, times: Sequence[float], out: Path, wanted: dict[str, Any], force: bool
) -> MeasurementSequence:
    """A new store, with the first frame in it that every view could measure."""
    import zarr

    wrong = None
    for index, number in enumerate(numbers):
        try:
            like, lost = resting.measure(number)
        except InputError as error:
            wrong, lost = wrong or error, [str(error)]
        if not lost:
            sequence = MeasurementSequence.create(out, times, like, force)
            zarr.open_group(out, mode="r+").attrs["displacement"] = wanted
            sequence.write_frame(index, like)
            return sequence
        wrong = wrong or InputError(lost[0])
    raise InputError(f"no frame in which every view could be used; {wrong}; choose --views")


def _frame(common: tuple[RestingRecording, MeasurementSequence, range], index: int) -> list[str]:
    """Measure and write one frame; what was left out."""
    resting, sequence, numbers = common
    try:
        measurement, lost = resting.measure(numbers[index])
        sequence.write_frame(index, measurement)
    except InputError as error:
        return [str(error)]
    return lost
