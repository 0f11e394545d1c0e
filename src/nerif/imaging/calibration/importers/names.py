"""Names of cameras: by the folders and files of their images, or none where a file has only their order."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath

import torch

from nerif.common.conventions import InputError
from nerif.data.cameras_file import CalibratedCamera

__all__ = ["UNNAMED", "cameras_by_view", "named_by_images"]

UNNAMED = "unnamed"
"""Name, with a number appended, of a camera to which its file gives none."""
NUMBER = re.compile(rf"(?:{UNNAMED})?(\d+)")
"""A name that is only a number, such as that of a frame, says no more than the order."""
INSTANT = re.compile(r"(.+)[ _.-](\d+)")
SAME = ("intrinsics", "rotation", "translation", "distortion")


def named_by_images(cameras: Sequence[CalibratedCamera], images: Sequence[str]) -> list[CalibratedCamera]:
    """Return cameras with the names in the paths of their images; several images of one camera are one.

    Cameras have the name of the folder in which all their images lie, or else that of the file, without a number that
    is common to all cameras; where cameras share these they are unnamed.

    Parameters
    ----------
    images : path of the image of each camera, "" if unknown
    """
    candidates = _labels([PurePosixPath(image.replace("\\", "/")) for image in images])
    for labels in sorted(candidates, key=lambda labels: all(NUMBER.fullmatch(label) for label in labels)):
        by_name: dict[str, CalibratedCamera] = {}
        if all(
            label and all(torch.equal(getattr(by_name.setdefault(label, c), x), getattr(c, x)) for x in SAME)
            for label, c in zip(labels, cameras, strict=True)
        ):
            return [replace(camera, name=label) for label, camera in by_name.items()]
    return [replace(camera, name=f"{UNNAMED}{i}") for i, camera in enumerate(cameras, 1)]


def _labels(paths: list[PurePosixPath]) -> Iterator[list[str]]:
    """Yield possible names of the cameras, the best first."""
    for i in range(max((len(path.parent.parts) for path in paths), default=0)):
        folders = [path.parents[i].name if i < len(path.parents) else "" for path in paths]
        if len(set(folders)) > 1:
            yield folders
    stems = [path.stem for path in paths]
    parts = [match.groups() for stem in stems if (match := INSTANT.fullmatch(stem))]
    instants = {name: {number for n, number in parts if n == name} for name, _ in parts}
    if len(parts) == len(stems) and len(instants) > 1 and len({frozenset(i) for i in instants.values()}) == 1:
        yield [name for name, _ in parts]
    yield stems


def cameras_by_view(
    views: Sequence[str], cameras: Sequence[CalibratedCamera], say: Callable[[str], None]
) -> Mapping[str, CalibratedCamera]:  # fmt: skip
    """Return cameras by the names of the views: their own, or, if they have none, in the order of the views.

    Parameters
    ----------
    views : all views of the experiment, in order
    say : called with the pairs by order

    Raises InputError if cameras have no names and the views are more or fewer.
    """
    names = {camera.name: camera for camera in cameras}
    numbers = [int(match[1]) for name in names if (match := NUMBER.fullmatch(name))]
    if len(numbers) < len(names) or set(views) <= names.keys():
        if idle := [name for name in names if name not in views]:
            say(f"note: the calibration has cameras without a view of their name: {', '.join(idle)}")
        return names
    if len(names) != len(views):
        raise InputError(
            f"its {len(names)} cameras have numbers instead of names ({', '.join(names)}), the experiment has "
            f"{len(views)} views ({', '.join(views)}); by order some might get the camera of another: import it with "
            "nerif calibrate, and give each camera in the file the name of its view",
            field="calibration",
        )
    ordered = [camera for _, camera in sorted(zip(numbers, cameras, strict=True), key=lambda pair: pair[0])]
    pairs = ", ".join(f"{view}: {camera.name}" for view, camera in zip(views, ordered, strict=True))
    say(f"note: cameras without names, assigned to the views in order ({pairs})")
    return {view: replace(camera, name=view) for view, camera in zip(views, ordered, strict=True)}
