"""Open images of any format by a file name, a folder or a pattern, optionally with a selection of frames.

Frames count from 0, in messages as in selections such as ``rec.cihx[0:50]``.
"""

from __future__ import annotations

import difflib
import glob
import os
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from nerif.common.conventions import InputError
from nerif.common.files import check_file, ending, local_path
from nerif.common.image_names import ARRAYS, EXPORTS, FOLDER_SUFFIXES, HDF5, PHOTRON, SINGLE_SUFFIXES, SUFFIXES, VIDEO
from nerif.imaging.readers.array_files import ArrayFrames, Hdf5Frames
from nerif.imaging.readers.binning import binned_mask
from nerif.imaging.readers.cine import CineFrames
from nerif.imaging.readers.frame_numbers import natural_order
from nerif.imaging.readers.frames import Frames, SelectedFrames, size_in_words
from nerif.imaging.readers.image_files import FileFrames
from nerif.imaging.readers.photron import PhotronFrames
from nerif.imaging.readers.video import VideoFrames

__all__ = ["open_frames", "read_mask"]

FILMS: dict[str, Callable[[Path, str], Frames]] = {
    **dict.fromkeys(PHOTRON, PhotronFrames), ".cine": CineFrames, **dict.fromkeys(VIDEO, VideoFrames),
}  # fmt: skip
READ = " ".join(SUFFIXES)
EXPORT = "export other formats as TIFF"
SELECTION = re.compile(r"(.+)\[(-?\d+|-?\d*:-?\d*(?::-?\d*)?)\]")
DATASET = re.compile(r"(.+\.(?:h5|hdf5|hdf|npz)):(.+)", re.IGNORECASE)


def open_frames(spec: str | Path, base: Path | None = None) -> Frames:
    """Open frames without reading them, in natural order (img2 before img10).

    Parameters
    ----------
    spec : a file, a folder (all images in it) or a pattern such as ``cam1/ref_*.tif`` (with ``*``, ``?`` and ``**``),
        each optionally followed by a selection in the syntax of Python: ``rec.cihx[0:50]``, ``rec.cihx[7]``,
        ``stack.tif[::2]``. HDF5 and .npz files may name a dataset: ``file.h5:/path/to/dataset``. Square brackets
        elsewhere are literal; classes such as ``ref_[ab].tif`` are not patterns.
        Relative paths may be written as on Windows.
    base : folder of a relative spec, omitted from the names in messages
    """
    selection, dataset = "", ""
    root = Path() if base is None else Path(base)
    text = str(local_path(spec, root, "images"))
    if (match := SELECTION.fullmatch(text)) and not (root / text).exists():
        text, selection = match.groups()
    if (match := DATASET.fullmatch(text)) and not (root / text).exists():
        text, dataset = match.groups()
    path = root / Path(text).expanduser()
    files = _find_files(path, base)
    frames = _open_files(files, [_label(file, base) for file in files], dataset)
    frames = _select(frames, selection, _label(path, base)) if selection else frames
    channels = [frames.channel(i) for i in range(len(frames))]
    if count := max(channels) - min(channels):
        part = f"0::{count + 1}" if channels[0] != channels[1] else f"0:{channels.index(1)}"
        raise InputError(
            f"expected one channel, got images of {count + 1} (colours, cameras) in one stack; name one in views.toml: "
            f"'{_label(path, base)}[{part}]'",
            field=_label(path, base),
        )
    return frames


def read_mask(
    path: Path, shape: tuple[int, int], say: Callable[[str], None] | None = None
) -> Bool[np.ndarray, "row column"]:  # fmt: skip
    """Read a mask from an image of `shape`, of 1 bit or more: True above the middle of its range.

    One of twice the size is binned and reported by `say`, or refused if that is None.
    """
    frames = open_frames(path)
    try:
        stored = frames.load(0)
    except Exception:  # reported by the next line
        stored = frames[0]
    image = stored.astype(np.uint8) if stored.dtype == bool else frames[0]
    is_twice = say is not None and tuple(n // 2 for n in image.shape) == shape
    if image.shape != shape and not is_twice:
        turned = "; rows and columns swapped? Rotate or transpose it" if image.shape == shape[::-1] else ""
        raise InputError(
            f"expected a mask of {size_in_words(shape)} as the view, got {size_in_words(image.shape)}{turned}",
            field=path,
        )
    low, high = float(image.min()), float(image.max())
    if low == high:
        raise InputError(f"expected a mask with black and white in it, got one grey of {high:g}", field=path)
    mask = np.asarray(image > (low + high) / 2)
    if say is None or not is_twice:
        return mask
    say(f"note: {path}: drawn at twice the size of the view, binned to {size_in_words(shape)}")
    return binned_mask(mask)


def _open_files(files: list[Path], names: list[str], dataset: str = "") -> Frames:
    for path, name in zip(files, names, strict=True):
        check_file(path)
        if ending(path) not in SUFFIXES:
            remedy = f"a file {EXPORTS[ending(path)]}" if ending(path) in EXPORTS else f"'{path.suffix}'; {EXPORT}"
            raise InputError(f"expected one of {READ}, got {remedy}", field=name)
        if len(files) > 1 and ending(path) in SINGLE_SUFFIXES:
            raise InputError(f"one of {len(files)} files of a pattern; name one recording at a time", field=name)
    suffix = ending(files[0])
    if suffix in FILMS:
        return FILMS[suffix](files[0], names[0])
    if suffix in ARRAYS:
        return (Hdf5Frames if suffix in HDF5 else ArrayFrames)(files[0], names[0], dataset)
    return FileFrames(files, names)


def _select(frames: Frames, selection: str, name: str) -> Frames:
    n, field = len(frames), f"{name}[{selection}]"
    if ":" not in selection:
        if not -n <= int(selection) < n:
            raise InputError(f"expected a frame from 0 to {n - 1}, got {selection}", field=field)
        return SelectedFrames(frames, [int(selection) % n])
    parts = [int(word) if word else None for word in selection.split(":")]
    if len(parts) == 3 and parts[2] == 0:
        raise InputError("expected a step other than 0", field=field)
    indices = range(n)[slice(*parts)]
    if not indices:
        raise InputError(f"selects none of the {n} frames, which count from 0", field=field)
    return SelectedFrames(frames, indices)


def _find_files(path: Path, base: Path | None) -> list[Path]:
    """Files of a file name, folder or pattern, in natural order."""
    label = _label(path, base)
    if path.is_dir():
        files = [p for p in path.iterdir() if ending(p) in FOLDER_SUFFIXES and not p.name.startswith(".")]
        if not files:
            inside = [p for p in path.iterdir() if not p.name.startswith(".")]
            raise InputError(f"expected images, got {_content(inside, base)}", field=label)
    elif path.exists():
        return [path]
    elif re.search(r"[*?]", str(path)):
        # *.tif is also *.TIF, as on Windows
        classes = [f"[{c}{c.upper()}]" if c.isalpha() else c for c in ending(path)]
        names = glob.glob(str(path.with_suffix("")).replace("[", "[[]") + "".join(classes), recursive=True)
        matches = [p for p in map(Path, names) if p.is_file()]
        files = [p for p in matches if ending(p) in SUFFIXES]
        if not files:
            content = _content(matches, base) if matches else f"none{_nearest(path, base)}"
            raise InputError(f"expected files of this pattern, got {content}", field=label)
    else:
        raise InputError(f"no such file or folder{_nearest(path, base)}", field=label)
    _check_twins(files, label)
    return [files[k] for k in natural_order([path.as_posix() for path in files])]


def _content(paths: list[Path], base: Path | None) -> str:
    """Describe paths among which are no images, with a remedy."""
    endings = Counter(f"ending in {ending(p)}" if p.suffix else "without ending" for p in paths if p.is_file())
    content = [f"{n} file{'s' * (n > 1)} {what}" for what, n in endings.most_common(4)]
    if folders := sum(p.is_dir() for p in paths):
        content.append(f"{folders} folder{'s' * (folders > 1)}")
    text = f"{', '.join(content) or 'none'}; "
    if single := sorted(p for p in paths if ending(p) in SUFFIXES):
        return text + f"name one file, such as '{_label(single[0], base)}'"
    if foreign := next((EXPORTS[ending(p)] for p in paths if ending(p) in EXPORTS), ""):
        return f"{text}they are {foreign}"
    return text + "is it the right folder?" + (f" Images end in {READ}; {EXPORT}" if endings else "")


def _check_twins(files: list[Path], label: str) -> None:
    """Refuse images that are there in two formats, as cameras and converters leave them: they are no repeats."""
    first: dict[Path, Path] = {}
    for path in sorted(files):
        twin = first.setdefault(path.with_suffix(""), path)
        if twin is not path:
            raise InputError(
                f"{twin.name} and {path.name} seem to be one image in two formats; name one of them, such as "
                f"'{label}/*{twin.suffix}', or move the others",
                field=label,
            )


def _nearest(path: Path, base: Path | None) -> str:
    """Suggest the existing name nearest to the first part of a path that does not exist."""
    while not path.parent.is_dir() and path.parent != path:
        path = path.parent
    if not path.parent.is_dir():
        return ""
    names = {name.lower(): name for name in sorted(os.listdir(path.parent), reverse=True)}
    near = difflib.get_close_matches(path.name.lower(), names, n=1, cutoff=0.5)
    return f"; did you mean '{_label(path.parent / names[near[0]], base)}'?" if near else ""


def _label(path: Path, base: Path | None) -> str:
    inside = base is not None and path.is_relative_to(base) and path != base
    return (path.relative_to(base) if base is not None and inside else path).as_posix()
