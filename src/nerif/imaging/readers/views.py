"""Where the images of an experiment are: a folder with a folder a view, or a file views.toml that says it.

    experiment/
      cam1/target/*.tif  background/*.tif  reference/*.tif  flow/*.tif
      cam2/...

A `views.toml` in the folder takes the place of that layout. What stands above the tables holds for every view:

    reference = "reference.cihx"        # a file, a folder, a pattern; [0:50] behind it selects frames
    flow = "run1.cihx[100:200]"
    [views.left]
    row = 0
    column = 0
    height = 512
    width = 512
    flip = "horizontal"                 # what is seen through a mirror
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import overload

import numpy as np
from jaxtyping import Bool

from nerif.common.conventions import InputError
from nerif.common.files import check_known, read_toml
from nerif.imaging.calibration.targets import CalibrationTarget, Detection, ViewImages
from nerif.imaging.displacement.exposure import check_exposure, full_scale
from nerif.imaging.masks import read_mask
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.frames import Frames, read_each, size_in_words
from nerif.imaging.readers.open import open_frames

__all__ = ["SOURCES", "Images", "View", "find_targets", "find_views", "good_images", "pose_names"]

SOURCES = ("target", "background", "reference", "flow", "mask", "region")
"""What a view may have: target images, the target on the background, images without and with flow, drawn masks."""

CROP = tuple(f.name for f in fields(Crop))


@dataclass(frozen=True)
class View:
    """Where the images of one view are.

    Parameters
    ----------
    name : of the view
    folder : that the sources are relative to
    sources : what open_frames takes, by the names of SOURCES
    crop : the view's part of each frame
    """

    name: str
    folder: Path
    sources: dict[str, str]
    crop: Crop | None = None
    _opened: dict[str, Frames] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __reduce__(self) -> tuple[type[View], tuple[object, ...]]:
        """What another process gets: where the images are, which it opens for itself."""
        return View, (self.name, self.folder, self.sources, self.crop)

    def open(self, source: str) -> Frames:
        """Return the frames of a source, opened once.

        Raises
        ------
        InputError
            If the view has none, or they cannot be read.
        """
        if source not in self.sources:
            raise InputError(
                f"no {source} images; expected {self.folder / self.name / source}/ or a line "
                f'{source} = "..." in {self.folder / "views.toml"}',
                field=f"view '{self.name}'",
            )
        if source not in self._opened:
            self._opened[source] = open_frames(self.sources[source], self.folder)
        return self._opened[source]

    @property
    def full_scale(self) -> float:
        """Grey value of a full sensor, as far as the images without and with flow tell."""
        return full_scale(self.open("reference"), self.open("flow"))

    def drawn(self, source: str, shape: tuple[int, int]) -> Bool[np.ndarray, "row column"] | None:
        """Return the mask that was drawn for the view, "mask" or "region", or None."""
        return read_mask(self.folder / self.sources[source], shape) if source in self.sources else None

    def check_alike(self) -> None:
        """Check that the images without and with flow are of one size and bit depth.

        Raises
        ------
        InputError
            If they are not.
        """
        reference, flow = self.open("reference"), self.open("flow")
        ours, theirs = reference.layout, flow.layout
        depths = [reference.known_bits, flow.known_bits]
        if None in depths:  # as far as the files tell
            depths = [8 * ours.dtype.itemsize, 8 * theirs.dtype.itemsize]
        sizes = (size_in_words(ours.shape), size_in_words(theirs.shape))
        for expected, got in (sizes, (f"{depths[0]} bit", f"{depths[1]} bit")):
            if expected != got:
                raise InputError(
                    f"{theirs.example}: expected {expected} as in its reference {ours.example}, "
                    f"got {got}; record both alike",
                    field=f"view '{self.name}'",
                )

    def cropped(self, image: np.ndarray, name: str) -> np.ndarray:
        """Return the view's part of a frame."""
        return self.crop(image, name) if self.crop else image


def find_views(folder: Path, only: Sequence[str] = ()) -> tuple[View, ...]:
    """Find the views of an experiment.

    Parameters
    ----------
    folder : of the experiment
    only : names of the views wanted; all if empty

    Raises
    ------
    InputError
        If the folder is missing, holds no view, or `only` names one that is not there.
    """
    if not folder.is_dir():
        raise InputError("no such folder; expected one with a folder for each view", field=folder)
    file = folder / "views.toml"
    views = _from_file(file) if file.is_file() else _from_folders(folder)
    if not views:
        raise InputError(
            f"no view found; expected folders such as {folder.name}/cam1/reference and "
            f"{folder.name}/cam1/flow, or a file views.toml",
            field=folder,
        )
    names = [v.name for v in views]
    for name in only:
        if name not in names:
            raise InputError(f"expected some of {', '.join(names)}, got '{name}'", field="views")
    return tuple(v for v in views if not only or v.name in only)


def _from_folders(folder: Path) -> list[View]:
    """Each folder that holds something named as one of SOURCES is a view."""
    views = []
    for inner in sorted((p for p in folder.iterdir() if p.is_dir()), key=_natural):
        entries = {
            source: str(entry.relative_to(folder))
            for source in SOURCES
            for entry in sorted(inner.iterdir())
            if (entry.name if entry.is_dir() else entry.stem) == source and not entry.name.endswith(".mraw")
        }
        if entries:
            views.append(View(inner.name, folder, entries))
    return views


def _natural(path: Path) -> tuple[list[float], str]:
    """Sort key by which cam2 comes before cam10, and 9deg before 10.5deg."""
    return [float(n) for n in re.findall(r"\d+(?:\.\d+)?", path.name)], path.name


def _from_file(file: Path) -> list[View]:
    table = read_toml(file)
    tables = table.pop("views", {})
    if not isinstance(tables, dict) or not all(isinstance(t, dict) for t in tables.values()):
        raise InputError("expected a table [views.NAME] for each view", field=file)
    views = []
    for name, own in tables.items():
        entries = {**table, **own}
        check_known(entries, (*SOURCES, *CROP), str(file))
        for key, value in entries.items():
            wanted = str if key in (*SOURCES, "flip") else int
            if not isinstance(value, wanted) or isinstance(value, bool):
                raise InputError(f"'{key}' of view '{name}': expected {wanted.__name__}, got {value!r}", field=file)
        crop = {k: v for k, v in entries.items() if k in CROP}
        sources = {k: v for k, v in entries.items() if k in SOURCES}
        views.append(View(name, file.parent, sources, Crop(**crop) if crop else None))
    return views


class Images(Sequence[np.ndarray]):
    """Some images of a view, its part of each frame, read whenever one is asked for."""

    def __init__(self, view: View, frames: Frames, indices: Sequence[int]) -> None:
        self._view, self._frames, self._indices = view, frames, indices

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, i: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, i: slice) -> Images: ...
    def __getitem__(self, i: int | slice) -> np.ndarray | Images:
        if isinstance(i, slice):
            return Images(self._view, self._frames, self._indices[i])
        index = self._indices[i]
        return self._view.cropped(self._frames[index], self._frames.name(index))


def good_images(view: View, source: str, say: Callable[[str], None], most: int = 0) -> Images:
    """Look for the images of a source that can be used; what is wrong with the others is said.

    Parameters
    ----------
    most : number of images to look at, evenly spread; 0 for all

    Raises
    ------
    InputError
        If none can be used.
    """
    frames = view.open(source)
    count = len(frames)
    chosen = np.linspace(0, count - 1, min(most or count, count)).round().astype(int).tolist()
    good, bad = [], []
    for i, found in read_each(frames, chosen):
        if isinstance(found, InputError):
            bad.append(str(found))
            say(f"left out: {found}")
            continue
        good.append(i)
        exposure = check_exposure(view.cropped(found, frames.name(i)), full_scale(frames), frames.name(i))
        if exposure:
            say(f"note: {exposure}")
    if not good:
        looked = f"{len(chosen)}" if len(chosen) == count else f"{len(chosen)} looked at out of {count}"
        raise InputError(f"none of its {looked} {source} images can be used; {bad[0]}", field=f"view '{view.name}'")
    return Images(view, frames, good)


def find_targets(
    view: View,
    target: CalibrationTarget,
    say: Callable[[str], None],
    on_image: Callable[[], None] = lambda: None,
    on_background: CalibrationTarget | None = None,
) -> ViewImages:
    """Find the target in all images of a view; say which images were of no use.

    `on_background` is the target that lay on the background, if that was another one (a larger print, say).

    Poses are named by the last number in the name of an image, so that pose_007.png of one camera and cam2-7.tif of
    another are the same pose; by the number of the frame in a stack or recording.
    """
    found: dict[str, dict[str, Detection]] = {"target": {}, "background": {}}
    size = (0, 0)
    for source in ("target", "background"):
        if source not in view.sources:
            if source == "target":
                view.open(source)  # says what is missing
            continue
        frames = view.open(source)
        keys = pose_names(frames)
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
            used = on_background or target if source == "background" else target
            detection = used.detect(image)
            on_image()
            if detection is None:
                say(f"left out: {frames.name(i)}: no {used.kind} of {used.columns} x {used.rows} found")
            else:
                found[source][keys[i]] = detection
    return ViewImages(view.name, size, found["target"], found["background"])


def pose_names(frames: Frames) -> list[str]:
    """Return the names of the poses that images of a target show: see find_targets."""
    return _pose_keys([frames.name(i) for i in range(len(frames))])


def _pose_keys(names: list[str]) -> list[str]:
    """The last number in each name, if these differ; else the position."""
    numbers = [re.findall(r"\d+", Path(name).stem if " frame " not in name else name) for name in names]
    last = [str(int(n[-1])) if n else "" for n in numbers]
    return last if len(set(last)) == len(last) and all(last) else [str(i) for i in range(len(names))]
