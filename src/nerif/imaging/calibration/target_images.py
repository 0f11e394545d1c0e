"""Calibration targets in the images of a view."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from nerif.common.conventions import InputError
from nerif.imaging.calibration.targets import CalibrationTarget, Detection, ViewImages
from nerif.imaging.readers.frames import Frames, read_each
from nerif.imaging.readers.views import View

__all__ = ["find_targets", "pose_names"]


def find_targets(
    view: View,
    target: CalibrationTarget,
    say: Callable[[str], None],
    on_image: Callable[[], None] = lambda: None,
    on_background: CalibrationTarget | None = None,
) -> ViewImages:
    """Detect the target in all images of a view; report how these are read, and those without a detection.

    `on_background` is the target on the background, if it differs (a larger print).
    """
    detections: dict[str, dict[str, Detection]] = {"target": {}, "background": {}}
    size = (0, 0)
    view.open("target")  # the background may be left out, the target may not
    for source in ("target", "background"):
        if source not in view.sources:
            continue
        frames = view.open(source)
        names = pose_names(frames)
        for note in view.notes(source):
            say(f"note: {note}")
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
            board = on_background or target if source == "background" else target
            detection = board.detect(image)
            on_image()
            if detection is None:
                say(f"left out: {frames.name(i)}: no {board.kind} of {board.columns} x {board.rows} found")
            else:
                detections[source][names[i]] = detection
    return ViewImages(view.name, size, detections["target"], detections["background"])


def pose_names(frames: Frames) -> list[str]:
    """Return the names of the target poses: the last number in each frame's name if these differ, else its position.

    pose_007.png of one camera and cam2-7.tif of another are the same pose.
    """
    names = [frames.name(i) for i in range(len(frames))]
    numbers = [re.findall(r"\d+", Path(name).stem if " frame " not in name else name) for name in names]
    last = [str(int(n[-1])) if n else "" for n in numbers]
    return last if len(set(last)) == len(last) and all(last) else [str(i) for i in range(len(names))]
