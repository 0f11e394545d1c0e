"""Calibration targets in the images of a view."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from nerif.common.conventions import InputError
from nerif.imaging.calibration.target_diagnosis import explain
from nerif.imaging.calibration.targets import CalibrationTarget, Detection, TargetDetections
from nerif.imaging.readers.exposure import full_scale
from nerif.imaging.readers.frame_numbers import words_of_names
from nerif.imaging.readers.frames import Frames, read_each
from nerif.imaging.readers.views import View

__all__ = ["explain_missing", "few_detections", "find_targets", "pose_names"]

FEW = 0.2  # share of the images of a source
SAMPLE = 3  # images to explain it


def find_targets(
    view: View, target: CalibrationTarget, say: Callable[[str], None], on_image: Callable[[], None] = lambda: None,
    on_background: CalibrationTarget | None = None,
) -> TargetDetections:  # fmt: skip
    """Detect the target in all images of a view; report how these are read, and those without a detection.

    Where few images have one, it is said why. InputError if none of those in free space has. `on_background` is the
    target on the background, if it differs (a larger print); `on_image` is called after each image.
    """
    detections: dict[str, dict[str, Detection]] = {"target": {}, "background": {}}
    size, diagnosis = (0, 0), ""
    view.open("target")  # the background may be left out, the target may not
    for source in ("target", "background"):
        if source not in view.sources:
            continue
        frames = view.open(source)
        names = pose_names(frames)
        for note in view.notes(source):
            say(f"note: {note}")
        board = on_background or target if source == "background" else target
        missing, negative = [], False
        for i, image in read_each(frames, range(len(frames))):
            if isinstance(image, InputError):
                say(f"left out: {image}")
                continue
            image = view.cropped(image, frames.name(i))
            if size not in ((0, 0), image.shape):
                raise InputError(
                    f"expected an image of {size[0]} x {size[1]} px as the others of view "
                    f"'{view.name}', got {image.shape[0]} x {image.shape[1]}",
                    field=frames.name(i),
                )
            size = (image.shape[0], image.shape[1])
            detection = board.detect(image, negative)
            on_image()
            if detection is None:
                missing.append(i)
            else:
                detections[source][names[i]], negative = detection, detection.negative
        count = len(missing) + len(detections[source])
        if not (missing and few_detections(len(detections[source]), count)):
            for i in missing:
                say(f"left out: {frames.name(i)}: no {board.kind} of {board.columns} x {board.rows} found")
            continue
        say(f"view '{view.name}': looking for the target in the {source} images without a detection")
        text = (
            f"no {board.kind} of {board.columns} x {board.rows} found in {len(missing)} of {count} {source} images; "
            + explain_missing(view, source, board, missing)
        )
        if source == "target":
            if not detections[source]:
                raise InputError(text, field=f"view '{view.name}'")
            diagnosis = text
        say(f"note: view '{view.name}': {text}")
    return TargetDetections(view.name, size, detections["target"], detections["background"], diagnosis)


def few_detections(count: int, total: int) -> bool:
    """Whether so few images have a detection that the fault is not in single images."""
    return count <= FEW * total


def explain_missing(view: View, source: str, target: CalibrationTarget, numbers: Sequence[int]) -> str:
    """Return why the target is not detected in the images of a source with these numbers, by a few of them."""
    frames = view.open(source)
    sample = dict.fromkeys(numbers[i] for i in np.linspace(0, len(numbers) - 1, SAMPLE).round().astype(int))
    images = [view.cropped(frames[i], frames.name(i)) for i in sample]
    return explain(images, target, full_scale(frames), view.crop.flip if view.crop else "")


def pose_names(frames: Frames) -> list[str]:
    """Return the names of the target poses: the last number in each frame's name if these differ, else its position.

    pose_007.png of one camera and cam2-7.tif of another are the same pose.
    """
    names = [frames.name(i) for i in range(len(frames))]
    words = words_of_names([Path(name).stem if " frame " not in name else name for name in names])
    last = [next((str(w) for w in reversed(of_name) if isinstance(w, int)), "") for of_name in words]
    return last if len(set(last)) == len(last) and all(last) else [str(i) for i in range(len(names))]
