"""Pictures from files, read one at a time: images, stacks, recordings and arrays, with checks that name the file.

Frames count from 0, in messages as in selections such as ``rec.cihx[0:50]``. The formats are in recordings.py.
"""

from __future__ import annotations

import difflib
import glob
import operator
import os
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from nerif.conventions import InputError

__all__ = [
    "Frames", "check_exposure", "effective_bits", "good_frames", "open_frames", "overexposed", "size_in_words",
]  # fmt: skip

LUMINANCE = np.array([0.299, 0.587, 0.114])  # of R, G, B (ITU-R BT.601)
CANDIDATE_BITS = (10, 12, 14, 16)
SELECTION = re.compile(r"(.+)\[(-?\d+|-?\d*:-?\d*(?::-?\d*)?)\]")
DATASET = re.compile(r"(.+\.(?:h5|hdf5|hdf|npz)):(.+)", re.IGNORECASE)


@dataclass(frozen=True)
class Layout:
    """What most frames of a sequence agree on, and the largest value met while finding out."""

    shape: tuple[int, int]
    dtype: np.dtype
    example: str
    peak: float


class Frames(ABC):
    """Grey frames of one size and type, each read and checked when asked for."""

    times: np.ndarray | None = None
    """When each frame was taken, s; None if the file does not say."""

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def name(self, i: int) -> str:
        """Return what messages call frame `i`, such as ``cam1/ref_003.tif`` or ``rec.mraw frame 17``."""

    @abstractmethod
    def load(self, i: int) -> np.ndarray:
        """Return frame `i` as it is stored, unchecked."""

    @property
    def known_bits(self) -> int | None:
        """Effective bits by the file's metadata, None where it has none."""
        return None

    def single(self, i: int) -> np.ndarray:
        """Return frame `i` as uint8, uint16 or float32 (row, column), checked by itself, not against the others."""
        try:
            image = self.load(i)
        except (InputError, MemoryError):
            raise
        except Exception as error:
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            text = f"{self.name(i)}: cannot be read, truncated or damaged? ({reason}); copy or export it again"
            raise InputError(text) from None
        return _grey_frame(image, self.name(i))

    @cached_property
    def layout(self) -> Layout:
        """Size and type of most out of five frames spread over the sequence, so that one bad file does not rule."""
        n = len(self)
        found: list[Layout] = []
        errors: list[InputError] = []
        for k, i in enumerate(dict.fromkeys([*(round(j * (n - 1) / 4) for j in range(5)), *range(n)])):
            if found and k >= min(5, n):
                break
            try:
                image = self.single(i)
            except InputError as error:
                errors.append(error)
            else:
                found.append(Layout((image.shape[0], image.shape[1]), image.dtype, self.name(i), float(image.max())))
        if not found:
            raise errors[0]
        (most, _), *_ = Counter((x.shape, x.dtype) for x in found).most_common()
        agreeing = [x for x in found if (x.shape, x.dtype) == most]
        return Layout(*most, agreeing[0].example, max(x.peak for x in agreeing))

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, px."""
        return self.layout.shape

    @property
    def bits(self) -> int:
        """Effective bits, full scale being 2**bits - 1: by the metadata, else all the container has (8, 16).

        Floats from 0 to 1 have 1 bit (full scale 1), others 16. For a guess from the values see `effective_bits`.
        """
        if self.known_bits is not None:
            return self.known_bits
        if self.layout.dtype == np.uint8:
            return 8
        return 1 if self.layout.dtype == np.float32 and self.layout.peak <= 1 else 16

    def __getitem__(self, i: int) -> np.ndarray:
        """Return frame `i`; InputError if it cannot be read, or differs from the others in size or type."""
        n, i = len(self), operator.index(i)
        if not -n <= i < n:
            raise IndexError(f"{self.name(0)}: frame {i} of {n}")
        i %= n
        image, layout = self.single(i), self.layout
        if (image.shape, image.dtype) != (layout.shape, layout.dtype):
            raise InputError(
                f"{self.name(i)}: expected {size_in_words(layout.shape)} of {layout.dtype} as in {layout.example}, "
                f"got {size_in_words(image.shape)} of {image.dtype}; other frames need a sequence of their own"
            )
        return image


class SelectedFrames(Frames):
    """Some frames of another sequence."""

    def __init__(self, frames: Frames, indices: Sequence[int]) -> None:
        self._frames, self._indices = frames, indices
        if frames.times is not None:
            self.times = frames.times[list(indices)]

    def __len__(self) -> int:
        return len(self._indices)

    def name(self, i: int) -> str:
        return self._frames.name(self._indices[i])

    def load(self, i: int) -> np.ndarray:
        return self._frames.load(self._indices[i])

    @property
    def known_bits(self) -> int | None:
        return self._frames.known_bits


def open_frames(spec: str | Path, base: Path | None = None) -> Frames:
    """Open frames without reading them.

    Parameters
    ----------
    spec : a file, a folder (all images in it) or a pattern such as ``cam1/ref_*.tif`` (with ``*``, ``?`` and ``**``),
        each followed by a selection if wanted, as Python indexes: ``rec.cihx[0:50]``, ``rec.cihx[7]``,
        ``stack.tif[::2]``. HDF5 and .npz files may name a dataset: ``file.h5:/path/to/dataset``. Square brackets
        elsewhere mean themselves; classes such as ``ref_[ab].tif`` are not patterns.
    base : folder that a relative spec starts from, left out of the names in messages

    Returns
    -------
    The frames in natural order (img2 before img10)

    Raises
    ------
    InputError
        If there is no such file, nothing matches, the format is unknown, or the selection is empty.
    """
    from nerif.imaging.recordings import open_files

    text, selection = str(spec), ""
    root = Path() if base is None else Path(base)
    if (match := SELECTION.fullmatch(text)) and not (root / text).exists():
        text, selection = match.groups()
    dataset = ""
    if (match := DATASET.fullmatch(text)) and not (root / text).exists():
        text, dataset = match.groups()
    path = root / Path(text).expanduser()
    files = _find_files(path, base)
    frames = open_files(files, [_shown(file, base) for file in files], dataset)
    return _select(frames, selection, _shown(path, base)) if selection else frames


def _select(frames: Frames, selection: str, name: str) -> Frames:
    n = len(frames)
    if ":" not in selection:
        if not -n <= int(selection) < n:
            raise InputError(f"{name}[{selection}]: expected a frame from 0 to {n - 1}, got {selection}")
        return SelectedFrames(frames, [int(selection) % n])
    parts = [int(word) if word else None for word in selection.split(":")]
    if len(parts) == 3 and parts[2] == 0:
        raise InputError(f"{name}[{selection}]: expected a step other than 0")
    indices = range(n)[slice(*parts)]
    if not indices:
        raise InputError(f"{name}[{selection}]: selects none of the {n} frames, which count from 0")
    return SelectedFrames(frames, indices)


def _find_files(path: Path, base: Path | None) -> list[Path]:
    """Files of a file name, folder or pattern, in natural order."""
    from nerif.imaging.recordings import FOLDER_SUFFIXES, SUFFIXES

    shown = _shown(path, base)
    if path.is_dir():
        files = [p for p in path.iterdir() if p.suffix.lower() in FOLDER_SUFFIXES and not p.name.startswith(".")]
        if not files:
            others = sorted(p.name for p in path.iterdir() if p.suffix.lower() in SUFFIXES)
            remedy = f"name the file, such as '{shown}/{others[0]}'" if others else "is it the right folder?"
            raise InputError(f"{shown}: expected images ({' '.join(FOLDER_SUFFIXES)}), got none; {remedy}")
    elif path.is_file():
        return [path]
    elif re.search(r"[*?]", str(path)):
        found = (Path(p) for p in glob.glob(str(path).replace("[", "[[]"), recursive=True))
        files = [p for p in found if p.suffix.lower() in SUFFIXES and p.is_file()]
        if not files:
            raise InputError(f"{shown}: expected files of this pattern, got none{_nearest(path, base)}")
    else:
        raise InputError(f"{shown}: no such file or folder{_nearest(path, base)}")
    return sorted(files, key=_natural)


def _nearest(path: Path, base: Path | None) -> str:
    """Return a hint at the existing name most like the first missing part of a path, or nothing."""
    while not path.parent.is_dir() and path.parent != path:
        path = path.parent
    if not path.parent.is_dir():
        return ""
    there = {name.lower(): name for name in sorted(os.listdir(path.parent), reverse=True)}
    near = difflib.get_close_matches(path.name.lower(), there, n=1, cutoff=0.5)
    return f"; did you mean '{_shown(path.parent / there[near[0]], base)}'?" if near else ""


def _shown(path: Path, base: Path | None) -> str:
    inside = base is not None and path.is_relative_to(base) and path != base
    return (path.relative_to(base) if base is not None and inside else path).as_posix()


def _natural(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    words = re.findall(r"\d+|\D+", path.as_posix())
    return [(0, int(w), "") if w.isdecimal() else (1, 0, w.lower()) for w in words], path.as_posix()


def size_in_words(shape: Sequence[int]) -> str:
    return " x ".join(str(n) for n in shape) + " px (height x width)"


def _grey_frame(image: np.ndarray, name: str) -> np.ndarray:
    """Return a stored image as a grey one in native byte order, its values checked."""
    if image.dtype == bool:
        raise InputError(f"{name}: expected grey values of 8 to 16 bit, got a 1-bit image; export it with 8 or 16 bit")
    image = np.asarray(image, dtype=image.dtype.newbyteorder("="))
    if image.ndim == 3 and image.shape[2] <= 4:
        image = _grey(image)
    if image.ndim != 2 or not image.size:
        raise InputError(f"{name}: expected an image (row, column), got an array of shape {image.shape}")
    if image.dtype.kind != "f":
        if image.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{name}: expected grey values of 8 to 16 bit, got {image.dtype}; save it as uint16")
        return image
    image = image.astype(np.float32)
    if bad := int(np.count_nonzero(~np.isfinite(image))):
        raise InputError(f"{name}: expected numbers in all pixels, got NaN or infinity in {bad} of {image.size}")
    low, high = float(image.min()), float(image.max())
    if low < 0 or 1 < high < 16 or high > 65535:
        raise InputError(
            f"{name}: expected float values from 0 to 1, or counts up to 255 to 65535, got {low:g} to {high:g}; "
            "save the frames as 8- or 16-bit integers"
        )
    return image


def _grey(image: np.ndarray) -> np.ndarray:
    """Luminance of (row, column, channel) as R, G, B; one channel if all agree; alpha is left out."""
    first = image[..., 0]
    if image.shape[2] < 3 or ((image[..., 1] == first).all() and (image[..., 2] == first).all()):
        return np.ascontiguousarray(first)
    grey = image[..., :3] @ LUMINANCE
    return (np.rint(grey) if image.dtype.kind == "u" else grey).astype(image.dtype)


def good_frames(frames: Frames) -> tuple[list[int], list[str]]:
    """Return the indices of the frames that can be used, and for each other one a line that says what is wrong."""
    good, lines = [], []
    try:
        read = frames.__getitem__ if frames.shape else frames.single
    except InputError:  # none can be read
        read = frames.single
    for i in range(len(frames)):
        try:
            read(i)
        except InputError as error:
            lines.append(str(error))
        else:
            good.append(i)
    return good, lines


def effective_bits(frames: Frames) -> int:
    """Return the bits the camera filled: from the metadata, else the fewest that hold the values seen.

    Files of 16 bit often hold 10, 12 or 14 without saying so. The guess is the smallest of 10, 12, 14 and 16 whose
    range holds the largest value of the frames looked at (up to five); dark pictures make it too small.
    Frames of 8 bit have 8, floats between 0 and 1 have 1.
    """
    if frames.known_bits is not None or frames.layout.dtype == np.uint8 or frames.bits == 1:
        return frames.bits
    return next(bits for bits in CANDIDATE_BITS if frames.layout.peak <= 2**bits - 1)


def overexposed(image: np.ndarray, bits: int) -> float:
    """Return the share of pixels at full scale, 2**bits - 1, or above.

    Where 10, 12 or 14 bits stand in the upper part of 16, their largest value is taken as full scale.
    """
    full = 2**bits - 1
    if bits == 16 and image.dtype == np.uint16:
        used = int(np.bitwise_or.reduce(image, axis=None))
        unused = next((k for k in (6, 4, 2) if used and used % 2**k == 0), 0)
        full = full >> unused << unused
    return float(np.mean(image >= full))


def check_exposure(image: np.ndarray, bits: int, name: str, limit: float = 0.01) -> str | None:
    """Return a line naming the picture if more than `limit` of it is over-exposed, or it is nearly black, else None."""
    full = 2**bits - 1
    scale = f"{full} of {bits} bit" if bits > 1 else "1 of float"
    if (share := overexposed(image, bits)) > limit:
        return f"{name}: {share:.1%} of the pixels are over-exposed ({scale}); lower the exposure"
    top = float(np.percentile(image, 99.9))  # a few hot pixels do not make light
    if top < 0.02 * full:
        return f"{name}: nearly black, {top / full:.1%} of the range is used ({scale}); raise the exposure"
    return None
