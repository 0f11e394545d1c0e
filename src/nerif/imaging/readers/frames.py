"""Grey frames of one size, counted from 0 and read one at a time; errors name the frame."""

from __future__ import annotations

import math
import operator
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import SupportsIndex

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.files import reading
from nerif.common.memory import check_memory
from nerif.common.times import whole_steps
from nerif.imaging.readers.mosaic import bayer_pattern, phase_means

__all__ = [
    "FilmFrames", "FrameLayout", "Frames", "SelectedFrames", "as_float", "check_count", "check_size", "read_each",
    "size_in_words",
]  # fmt: skip

LUMINANCE = np.array([0.299, 0.587, 0.114])  # of R, G, B (ITU-R BT.601)
SAMPLE = 5  # frames that determine the layout
MOST_PIXELS = 2**28  # of a frame, more than any sensor has: a damaged header must not fill the memory
LEAST_STORED = 1e-3  # of the frames of a header; a copy that was interrupted before is not worth the others


@dataclass(frozen=True)
class FrameLayout:
    """Common properties of most of the sampled frames of a sequence, as they are stored."""

    shape: tuple[int, int]  #: height and width, px
    dtype: np.dtype  #: of the grey values
    example: str  #: name of a frame with these properties
    peak: float  #: largest value
    used: int  #: bits set in any value, 0 for floats
    means: tuple[float, ...]  #: grey values at the places (0, 0), (0, 1), (1, 0), (1, 1) of cells of 2 x 2 px
    pattern: str  #: of a raw mosaic recognised in most of them, such as "RGGB or BGGR"; "" if there is none


class Frames(ABC):
    """Grey frames of one size and type, each read and checked on access."""

    times: np.ndarray | None = None
    """Recording time of each frame, s; None if the file has none."""
    metadata_bits: int | None = None
    """Effective bits in the metadata of the file."""
    white: int | None = None
    """Grey value of a saturated pixel in the metadata, if not the largest of the effective bits."""
    cfa: str | None = None
    """Bayer pattern of raw values in the metadata, such as RGGB: the colours of the first two pixels of the first two
    rows; None if unknown or none."""
    notes: tuple[str, ...] = ()
    """Warnings about the file, each a line that begins with its name."""
    binning: Callable[[np.ndarray], np.ndarray] | None = None
    """Binning of the raw mosaic of a colour camera; None for grey frames."""
    mosaic: str = ""
    """Its Bayer pattern."""

    @abstractmethod
    def __len__(self) -> int: ...

    @property
    def numbers(self) -> np.ndarray | None:
        """Number of each frame, increasing, with gaps where the times or names have them; None if names have none."""
        steps = None if self.times is None else whole_steps(self.times)
        return np.arange(len(self)) if steps is None else steps

    @abstractmethod
    def name(self, i: int) -> str:
        """Return the name of frame `i` in messages, such as ``cam1/ref_003.tif`` or ``rec.mraw frame 17``."""

    def channel(self, i: int) -> int:
        """Return the channel of frame `i`, such as a colour, where frames alternate between some."""
        return 0

    @abstractmethod
    def load(self, i: int) -> np.ndarray:
        """Return frame `i` as stored, unchecked."""

    def single(self, i: int) -> np.ndarray:
        """Return frame `i` as uint8, uint16 or float32 (row, column), not compared with the others."""
        return self._binned(self._full_size(i))

    def _binned(self, image: np.ndarray) -> np.ndarray:
        return image if self.binning is None else self.binning(image)

    def _full_size(self, i: int) -> np.ndarray:
        """Frame `i` at its full size."""
        with reading("cannot be read, truncated or damaged? Copy or export it again", self.name(i)):
            image = self.load(i)
        return _grey_frame(image, self.name(i))

    @cached_property
    def layout(self) -> FrameLayout:
        """Size and type of the majority of frames spread over the sequence, so that one bad file does not decide."""
        n = len(self)
        layouts: list[FrameLayout] = []
        errors: list[InputError] = []
        spread = dict.fromkeys(round(j * (n - 1) / (SAMPLE - 1)) for j in range(SAMPLE))
        for k, i in enumerate(chain(spread, (i for i in range(n) if i not in spread))):
            if layouts and k >= min(SAMPLE, n):
                break
            try:
                image = self._full_size(i)
            except InputError as error:
                errors.append(error)
                continue
            used = int(np.bitwise_or.reduce(image, axis=None)) if image.dtype.kind == "u" else 0
            size = (image.shape[0], image.shape[1])
            peak, means, pattern = float(image.max()), phase_means(image), bayer_pattern(image)
            layouts.append(FrameLayout(size, image.dtype, self.name(i), peak, used, means, pattern))
        if not layouts:
            raise errors[0]
        (majority, _), *_ = Counter((x.shape, x.dtype) for x in layouts).most_common()
        agreeing = [x for x in layouts if (x.shape, x.dtype) == majority]
        used = int(np.bitwise_or.reduce([x.used for x in agreeing]))
        means = tuple(np.mean([x.means for x in agreeing], axis=0).tolist())
        patterns = Counter(x.pattern for x in agreeing if x.pattern)
        pattern = patterns.most_common(1)[0][0] if 2 * patterns.total() > len(agreeing) else ""
        return FrameLayout(*majority, agreeing[0].example, max(x.peak for x in agreeing), used, means, pattern)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of a frame, px; half of those stored if it is binned."""
        height, width = self.layout.shape
        return (height, width) if self.binning is None else (height // 2, width // 2)

    @property
    def bits(self) -> int:
        """Bits of the metadata, else of the container (8, 16); 1 for floats from 0 to 1. Full scale is 2**bits - 1.

        `effective_bits` (exposure.py) estimates them from the values.
        """
        if self.metadata_bits is not None:
            return self.metadata_bits
        if self.layout.dtype == np.uint8:
            return 8
        return 1 if self.layout.dtype == np.float32 and self.layout.peak <= 1 else 16

    def __getitem__(self, i: SupportsIndex) -> np.ndarray:
        """Return frame `i`; InputError if it is unreadable, or differs from the others in size or type."""
        n, i = len(self), operator.index(i)
        if not -n <= i < n:
            raise IndexError(f"{self.name(0)}: frame {i} of {n}")
        i %= n
        image, layout = self._full_size(i), self.layout
        if (image.shape, image.dtype) != (layout.shape, layout.dtype):
            raise InputError(
                f"expected {size_in_words(layout.shape)} of {layout.dtype} as in {layout.example}, "
                f"got {size_in_words(image.shape)} of {image.dtype}; other frames need a sequence of their own",
                field=self.name(i),
            )
        return self._binned(image)


class FilmFrames(Frames):
    """The frames of one file."""

    _name: str
    _length: int

    def __len__(self) -> int:
        return self._length

    def name(self, i: int) -> str:
        return f"{self._name} frame {i}"


class SelectedFrames(Frames):
    """Some frames of another sequence."""

    def __init__(self, frames: Frames, indices: Sequence[int]) -> None:
        self._frames, self._indices, self.metadata_bits = frames, indices, frames.metadata_bits
        self.white, self.cfa = frames.white, frames.cfa
        if frames.times is not None:
            self.times = frames.times[list(indices)]

    def __len__(self) -> int:
        return len(self._indices)

    def name(self, i: int) -> str:
        return self._frames.name(self._indices[i])

    def channel(self, i: int) -> int:
        return self._frames.channel(self._indices[i])

    def load(self, i: int) -> np.ndarray:
        return self._frames.load(self._indices[i])

    @property
    def numbers(self) -> np.ndarray | None:
        """Number of each frame; a selection begins with 0, as it may have been made to pair the frames of cameras."""
        numbers = self._frames.numbers
        if numbers is None or not self._indices or (np.diff(self._indices) < 0).any():
            return np.arange(len(self)) if numbers is not None else None
        selected = numbers[list(self._indices)]
        return selected - selected[0]

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        return self._frames.notes


def as_float(values: np.ndarray) -> np.ndarray:
    """Return an array as float32, or as float64 where its type needs that: arithmetic of integers would overflow."""
    return np.asarray(values, dtype=np.result_type(values.dtype, np.float32))


def check_size(shape: Sequence[int], path: Path, value: int = 1, name: str = "") -> None:
    """Refuse a size in a file's header that no sensor has, or that the file cannot hold.

    Parameters
    ----------
    shape : height and width, px, and possibly channels
    value : bytes of a pixel
    name : of the file in messages; none where the caller adds it
    """
    if min(shape) < 1 or math.prod(shape) > MOST_PIXELS:
        text = f"damaged header: expected a size of a sensor, got {size_in_words(shape)}; copy it again"
        raise InputError(text, field=name)
    check_memory(math.prod(shape) * value, path, name)


def check_count(count: int, stored: float, name: str) -> None:
    """Refuse a number of frames in a file's header of which the file holds next to none."""
    if stored + 1 < LEAST_STORED * count:
        text = f"expected {count:,} frames by the header, got {stored:,.0f} in the file; damaged? Copy it again"
        raise InputError(text, field=name)


def size_in_words(shape: Sequence[int]) -> str:
    return " x ".join(str(n) for n in shape) + " px (height x width)"


def _grey_frame(image: np.ndarray, name: str) -> np.ndarray:
    """Convert a stored image to grey values in native byte order and check them."""
    if image.dtype == bool:
        raise InputError(
            "expected grey values of 8 to 16 bit, got a 1-bit image; export it with 8 or 16 bit", field=name
        )
    image = np.asarray(image, dtype=image.dtype.newbyteorder("="))
    if image.ndim == 3 and image.shape[2] <= 4:
        image = _grey(image)
    if image.ndim != 2 or not image.size:
        raise InputError(f"expected an image (row, column), got an array of shape {image.shape}", field=name)
    if image.dtype.kind != "f":
        if image.dtype not in (np.uint8, np.uint16):
            raise InputError(f"expected grey values of 8 to 16 bit, got {image.dtype}; save it as uint16", field=name)
        return image
    image = image.astype(np.float32)
    if bad := int(np.count_nonzero(~np.isfinite(image))):
        raise InputError(f"expected numbers in all pixels, got NaN or infinity in {bad} of {image.size}", field=name)
    low, high = float(image.min()), float(image.max())
    if low < 0 or 1 < high < 16 or high > 65535:
        raise InputError(
            f"expected float values from 0 to 1, or counts up to 255 to 65535, got {low:g} to {high:g}; "
            "save the frames as 8- or 16-bit integers",
            field=name,
        )
    return image


def _grey(image: np.ndarray) -> np.ndarray:
    """Luminance of (row, column, channel) as R, G, B without alpha; exact where all channels are equal."""
    first = image[..., 0]
    if image.shape[2] < 3 or ((image[..., 1] == first).all() and (image[..., 2] == first).all()):
        return np.ascontiguousarray(first)
    grey = image[..., :3] @ LUMINANCE
    return (np.rint(grey) if image.dtype.kind == "u" else grey).astype(image.dtype)


def read_each(frames: Frames, indices: Iterable[int]) -> Iterator[tuple[int, np.ndarray | InputError]]:
    """Read frames one after the other: the image, or the error."""
    read: Callable[[int], np.ndarray]
    try:
        read = frames.__getitem__ if frames.shape else frames.single
    except InputError:  # no readable frame
        read = frames.single
    for i in indices:
        try:
            yield i, read(i)
        except InputError as error:
            yield i, error
