"""The images of an experiment: a folder with one folder per view, or a file views.toml.

    experiment/
      cam1/target/*.tif  background/*.tif  reference/*.tif  flow/*.tif
      cam2/...

A `views.toml` in the folder replaces that layout. Entries above the tables hold for every view:

    reference = "reference.cihx"        # a file, a folder, a pattern; [0:50] behind it selects frames
    flow = "run1.cihx[100:200]"
    [views.left]
    frame_offset = 2                    # instant i is flow image i + 2 of this view
    row = 0
    column = 0
    height = 512
    width = 512
    flip = "horizontal"                 # seen through a mirror
    mosaic = "none"                     # raw colour images: the Bayer pattern, such as RGGB, or none; else recognised

Raw images of a colour camera are binned as they are read: rows and columns of a crop are those of the binned images.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import overload

import numpy as np
from jaxtyping import Bool

from nerif.common.conventions import InputError, check_name
from nerif.common.files import check_known, ending, local_path, read_toml, write_toml
from nerif.common.image_names import EXPORTS, SOURCES, SUFFIXES
from nerif.data.kinds import EXPERIMENT, reading_as
from nerif.imaging.readers.binning import bin_mosaics
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.exposure import check_exposure, full_scale
from nerif.imaging.readers.frame_numbers import Count, common_count
from nerif.imaging.readers.frames import Frames, read_each, size_in_words
from nerif.imaging.readers.mosaic import PATTERNS
from nerif.imaging.readers.open import open_frames, read_mask

__all__ = [
    "BEFORE", "SOURCES", "VIEWS", "View", "ViewFrames", "find_views", "good_images", "paired", "read_sample",
    "views_file", "words_of_range", "write_crops",
]  # fmt: skip

TOGETHER = (("target", "background"), ("reference", "flow"))
"""Images that are compared: if one of the two is binned, so is the other."""

CROP = tuple(f.name for f in fields(Crop))
HEADS = (*(suffix for suffix in SUFFIXES if suffix != ".mraw"), *EXPORTS)
"""Endings of files of images, also of those that are refused; the .mraw of Photron stands beside its header."""
VIEWS = "views.toml"
OFFSET = "frame_offset"
"""Name of a view's frame offset in views.toml, on the command line and in stores."""
BEFORE = "views.before.toml"
"""Copy of a views.toml as it was before its first change, with its comments."""


@dataclass(frozen=True)
class View:
    """The images of one view."""

    name: str
    folder: Path  #: base of relative sources
    sources: dict[str, str]  #: arguments of open_frames, by the names of SOURCES
    crop: Crop | None = None  #: the view's part of each frame
    mosaic: str = ""
    """Bayer pattern of its raw images, such as RGGB, or "none"; "" where it is in the metadata or is recognised."""
    frame_offset: int | None = None
    """Instant i of the measurement is flow image i + frame_offset of this view; None if it is not stated."""
    count: Count | None = field(default=None, repr=False)
    """That pairs the flow images of all views (`paired`); None: of this view alone."""
    _opened: dict[str, Frames] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_name(self.name, f"{self.folder}: view")

    def __reduce__(self) -> tuple[type[View], tuple[object, ...]]:
        """State for another process, which opens the files itself."""
        return View, tuple(getattr(self, f.name) for f in fields(self) if f.init)

    def open(self, source: str) -> Frames:
        """Return the frames of a source, opened once."""
        if source not in self.sources:
            raise InputError(
                f"no {source} images; expected {self.folder / self.name / source}/ or a line "
                f'{source} = "..." in {self.folder / VIEWS}',
                field=f"view '{self.name}'",
            )
        if source not in self._opened:
            self._opened.update(self._open_together(source))
        return self._opened[source]

    def _open_together(self, source: str) -> dict[str, Frames]:
        """Frames of a source and of the one that is compared with it."""
        opened: dict[str, Frames] = {}
        for name in next((group for group in TOGETHER if source in group), (source,)):
            try:
                if name in self.sources:
                    opened[name] = open_frames(self.sources[name], self.folder)
            except InputError:  # of another source, reported when that is opened
                if name == source:
                    raise
        bin_mosaics(list(opened.values()), self.mosaic)
        return opened

    def notes(self, source: str) -> tuple[str, ...]:
        """Return lines about the files of a source, and how they are read."""
        frames = self.open(source)
        if frames.binning is None:
            return frames.notes
        height, width = frames.shape
        line = f"{self.sources[source]}: raw Bayer mosaic ({frames.mosaic}), binned to {height} x {width} px"
        override = "" if self.mosaic else '; mosaic = "none" in views.toml keeps all pixels'
        return *frames.notes, line + override

    @cached_property
    def _places(self) -> dict[int, int]:
        """Places of the flow images by their instants."""
        frames = self.open("flow")
        numbers = np.arange(len(frames)) if frames.numbers is None else frames.numbers
        count = self.count or common_count({self.name: numbers}, {self.name: self.frame_offset})
        return {int(i): k for k, i in enumerate(count.instants(self.name, numbers)) if i >= 0}

    @property
    def offset(self) -> int:
        """Frame offset, stated or by the numbers of the flow images."""
        return self.frame_offset or 0 if self.count is None else self.count.offsets[self.name]

    @property
    def instants(self) -> tuple[int, ...]:
        """Numbers of the instants of which the view has a flow image."""
        return tuple(self._places)

    def check_instants(self, numbers: Sequence[int], parameter: str) -> None:
        """Raise an InputError that names a parameter, unless these instants are within those of the flow images."""
        if self.instants and min(numbers) >= self.instants[0] and max(numbers) <= self.instants[-1]:
            return
        offset = f", frame offset {self.offset}" if self.offset else ""
        raise InputError(
            f"expected numbers within {words_of_range(self.instants)}, those of view '{self.name}' "
            f"({len(self.open('flow'))} flow images{offset}), got {words_of_range(numbers)}",
            field=parameter,
        )

    def flow_image(self, instant: int) -> tuple[np.ndarray, str]:
        """Return the flow image of an instant, cropped, and its name."""
        frames = self.open("flow")
        if instant not in self._places:
            raise InputError(f"no flow image of instant {instant}: a gap in {self.sources['flow']}")
        i = self._places[instant]
        return self.cropped(frames[i], frames.name(i)), frames.name(i)

    def flow_times(self, numbers: Sequence[int]) -> tuple[float, ...] | None:
        """Return the recording times of instants, s, interpolated where a frame is missing; None without times."""
        times, places = self.open("flow").times, self._places
        if times is None:
            return None
        return tuple(np.interp(numbers, list(places), times[list(places.values())]).tolist())

    @property
    def full_scale(self) -> float:
        """Grey value of a saturated pixel, by the images without and with flow."""
        return full_scale(self.open("reference"), self.open("flow"))

    def mask(
        self, source: str, shape: tuple[int, int], say: Callable[[str], None]
    ) -> Bool[np.ndarray, "row column"] | None:  # fmt: skip
        """Return the drawn mask of the view, "mask" or "region", or None.

        The shape is that of the view's images, px; a mask of binned images may have twice the size, which is reported.
        """
        if source not in self.sources:
            return None
        is_binned = self.open("reference").binning is not None
        return read_mask(self.folder / self.sources[source], shape, say if is_binned else None)

    def check_alike(self) -> None:
        """Check that the images without and with flow have one size and bit depth."""
        reference, flow = self.open("reference"), self.open("flow")
        ours, theirs = reference.layout, flow.layout
        depths = [reference.metadata_bits, flow.metadata_bits]
        if None in depths:
            depths = [8 * ours.dtype.itemsize, 8 * theirs.dtype.itemsize]
        sizes = (size_in_words(ours.shape), size_in_words(theirs.shape))
        for expected, actual in (sizes, (f"{depths[0]} bit", f"{depths[1]} bit")):
            if expected != actual:
                raise InputError(
                    f"{theirs.example}: expected {expected} as in its reference {ours.example}, "
                    f"got {actual}; record both with the same settings",
                    field=f"view '{self.name}'",
                )

    def cropped(self, image: np.ndarray, name: str) -> np.ndarray:
        """Return the view's part of a frame."""
        return self.crop(image, name) if self.crop else image


def paired(views: Sequence[View]) -> tuple[View, ...]:
    """Return the views with their flow images counted in common; those that cannot be opened stay as they are."""
    numbers: dict[str, np.ndarray] = {}
    in_order = False
    for view in views:
        try:
            frames = view.open("flow")
        except InputError:  # reported where they are read
            continue
        in_order |= frames.numbers is None
        numbers[view.name] = np.arange(len(frames)) if frames.numbers is None else frames.numbers
    if not numbers:
        return tuple(views)
    count = common_count(numbers, {view.name: view.frame_offset for view in views}, in_order)
    result = []
    for view in views:
        result.append(replace(view, count=count) if view.name in numbers else view)
        result[-1]._opened.update(view._opened)
    return tuple(result)


def words_of_range(numbers: Sequence[int]) -> str:
    """Return the first and the last of some numbers in words, such as 0 to 9."""
    return f"{numbers[0]} to {numbers[-1]}" if numbers else "none"


def find_views(
    folder: Path, only: Sequence[str] = (), frame_offsets: Mapping[str, int] = MappingProxyType({})
) -> tuple[View, ...]:
    """Find the views of an experiment: those named in `only`, or all; frame offsets by the names of some views."""
    with reading_as(folder, EXPERIMENT):
        return _find(folder, only, frame_offsets)


def _find(folder: Path, only: Sequence[str], frame_offsets: Mapping[str, int]) -> tuple[View, ...]:
    if not folder.is_dir():
        raise InputError("no such folder; expected one with a folder for each view", field=folder)
    file = views_file(folder)
    views = _from_file(file) if file.is_file() else _from_folders(folder)
    if not views:
        raise InputError(
            f"no view found; expected folders such as {folder / 'cam1' / 'reference'} and "
            f"{folder / 'cam1' / 'flow'}, or a file views.toml",
            field=folder,
        )
    names = [v.name for v in views]
    check_known(only, names, "views", "view", f" of {', '.join(names)}")
    check_known(frame_offsets, names, "frame_offset", "view", f" of {', '.join(names)}")
    views = [replace(v, frame_offset=frame_offsets.get(v.name, v.frame_offset)) for v in views]
    return tuple(v for v in views if not only or v.name in only)


def views_file(folder: Path) -> Path:
    """Return the path of the views.toml of a folder, in small or capital letters, whether it exists or not."""
    return next((p for p in sorted(folder.iterdir()) if p.name.lower() == VIEWS), folder / VIEWS)


def _from_folders(folder: Path) -> list[View]:
    """Each folder with an entry named as one of SOURCES, in small or capital letters, is a view."""
    views: dict[str, View] = {}
    for inner in sorted((p for p in folder.iterdir() if p.is_dir()), key=_natural):
        entries: dict[str, str] = {}
        for entry in sorted(inner.iterdir()):
            source = (entry.name if entry.is_dir() else entry.stem).lower()
            if source not in SOURCES or not (entry.is_dir() or ending(entry) in HEADS):
                continue
            path = entry.relative_to(folder).as_posix()
            _check_second(entries.get(source), path, folder)
            entries[source] = path
        if entries:
            _check_second(views[key].name if (key := inner.name.lower()) in views else None, inner.name, folder)
            views[key] = View(inner.name, folder, entries)
    return list(views.values())


def _check_second(first: str | None, second: str, folder: Path) -> None:
    """Refuse two entries of one meaning, such as flow and Flow, or flow and flow.tif."""
    if first is not None:
        raise InputError(f"expected either {first} or {second}, got both; rename or remove one", field=folder)


def _natural(path: Path) -> tuple[list[float], str]:
    """Sort key: cam2 before cam10, and 9deg before 10.5deg."""
    return [float(n) for n in re.findall(r"\d+(?:\.\d+)?", path.name)], path.name


def _from_file(file: Path) -> list[View]:
    table = read_toml(file)
    tables = table.pop("views", {})
    if not isinstance(tables, dict) or not all(isinstance(t, dict) for t in tables.values()):
        raise InputError("expected a table [views.NAME] for each view", field=file)
    views = []
    for name, entries in tables.items():
        entries = {**table, **entries}
        check_known(entries, (*SOURCES, *CROP, "mosaic", OFFSET), str(file))
        for key, value in entries.items():
            kind = str if key in (*SOURCES, "flip", "mosaic") else int
            if not isinstance(value, kind) or isinstance(value, bool):
                raise InputError(f"'{key}' of view '{name}': expected {kind.__name__}, got {value!r}", field=file)
        mosaic = entries.get("mosaic", "")
        if mosaic not in ("", "none", *PATTERNS):
            expected = f"expected {', '.join(PATTERNS)} or none"
            raise InputError(f"'mosaic' of view '{name}': {expected}, got '{mosaic}'", field=file)
        crop, paths = ({k: v for k, v in entries.items() if k in keys} for keys in (CROP, SOURCES))
        sources = {k: str(local_path(v, file.parent, f"{file}: {k} of view '{name}'")) for k, v in paths.items()}
        views.append(View(name, file.parent, sources, Crop(**crop) if crop else None, mosaic, entries.get(OFFSET)))
    return views


def write_crops(folder: Path, crops: Mapping[str, Crop]) -> Path:
    """Write the crops of views, by name, into views.toml in the folder of an experiment, and return its path.

    Other views keep theirs; a folder without the file gets one that lists all views. Before its first change a file is
    copied to views.before.toml.
    """
    views, file = find_views(folder), views_file(folder)
    check_known(crops, [view.name for view in views], "crops", "view")
    if file.is_file():
        table = read_toml(file)
        if not (folder / BEFORE).exists():
            shutil.copyfile(file, folder / BEFORE)
    else:
        table = {"views": {view.name: dict(view.sources) for view in views}}
    default = asdict(Crop())
    for name, crop in crops.items():
        sources = {k: v for k, v in table["views"][name].items() if k not in CROP}
        # a value that holds for all views has to be overridden, even by the default
        entries = {k: v for k, v in asdict(crop).items() if v != default[k] or k in table}
        table["views"][name] = sources | entries
    write_toml(file, table)
    return file


class ViewFrames(Sequence[np.ndarray]):
    """Some images of a view, cropped, read on access."""

    def __init__(self, view: View, frames: Frames, indices: Sequence[int]) -> None:
        self._view, self._frames, self._indices = view, frames, indices

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, i: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, i: slice) -> ViewFrames: ...
    def __getitem__(self, i: int | slice) -> np.ndarray | ViewFrames:
        if isinstance(i, slice):
            return ViewFrames(self._view, self._frames, self._indices[i])
        index = self._indices[i]
        return self._view.cropped(self._frames[index], self._frames.name(index))

    def name(self, i: int) -> str:
        """Return the name of an image in messages."""
        return self._frames.name(self._indices[i])

    def select(self, numbers: Sequence[int]) -> ViewFrames:
        """Return the images of these numbers."""
        return ViewFrames(self._view, self._frames, [self._indices[i] for i in numbers])


def read_sample(view: View, source: str, most: int = 0) -> Iterator[tuple[int, str, np.ndarray | InputError]]:
    """Yield number, name and cropped image (or its error) of `most` evenly spread images of a source; 0 for all."""
    frames = view.open(source)
    count = len(frames)
    numbers = np.linspace(0, count - 1, min(most or count, count)).round().astype(int).tolist()
    for i, image in read_each(frames, numbers):
        name = frames.name(i)
        try:
            yield i, name, image if isinstance(image, InputError) else view.cropped(image, name)
        except InputError as error:
            yield i, name, error


def good_images(view: View, source: str, say: Callable[[str], None], most: int = 0) -> ViewFrames:
    """Return the usable images out of `most` evenly spread ones of a source (0: all); report what is wrong."""
    frames, numbers, errors = view.open(source), [], []
    for note in view.notes(source):
        say(f"note: {note}")
    for i, name, image in read_sample(view, source, most):
        if isinstance(image, InputError):
            errors.append(image)
            say(f"left out: {image}")
            continue
        numbers.append(i)
        if exposure := check_exposure(image, full_scale(frames), name):
            say(f"note: {exposure}")
    if not numbers:
        total = f"{len(errors)}" if len(errors) == len(frames) else f"{len(errors)} checked out of {len(frames)}"
        raise InputError(f"none of its {total} {source} images can be used; {errors[0]}", field=f"view '{view.name}'")
    return ViewFrames(view, frames, numbers)
