"""Frames in image files, one or more in each: TIFF, PNG, BMP, JPEG, LaVision, and those of other modules."""

from __future__ import annotations

import logging
import math
import re
import struct
import weakref
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from nerif.common.conventions import InputError, within
from nerif.common.files import ending
from nerif.common.image_names import NETPBM, PILLOW, RAW
from nerif.common.installation import optional
from nerif.imaging.readers.camera_raw import CameraRaw
from nerif.imaging.readers.frame_numbers import numbers_in_names
from nerif.imaging.readers.frames import Frames, check_count, check_size
from nerif.imaging.readers.image_file import ImageFile
from nerif.imaging.readers.packed import unpack
from nerif.imaging.readers.pco import B16, note_of_time_stamp

__all__ = ["OPENERS", "FileFrames"]

Value = TypeVar("Value")


class FileFrames(Frames):
    """Frames of image files; the file last read stays open, so that its pages are located once."""

    def __init__(self, files: list[Path], names: list[str]) -> None:
        self._files, self._names = files, names
        self._last: tuple[int, ImageFile] | None = None
        counts: list[int] = []
        for k, path in enumerate(files):
            opener = _opener(path)
            opener.check_package()
            # to count the images of a LaVision file is to read it: all are taken to have as many as the first
            counts.append(counts[0] if opener is LaVision and counts else self._count(k))
        self._counts = counts
        self._places = [(k, i) for k, count in enumerate(counts) for i in range(count)]

    def __getstate__(self) -> dict[str, Any]:
        """State for another process: all but the open file."""
        return {**self.__dict__, "_last": None}

    def _open(self, k: int) -> ImageFile:
        if self._last is None or self._last[0] != k:
            self._last = None
            self._last = k, _opener(self._files[k])(self._files[k])
        return self._last[1]

    def _count(self, k: int) -> int:
        try:
            return max(1, len(self._open(k)))
        except Exception:  # one frame, whose error is reported on access
            return 1

    def __len__(self) -> int:
        return len(self._places)

    @cached_property
    def numbers(self) -> np.ndarray | None:
        counts, size = np.array(self._counts), self._counts[0]
        of_files = numbers_in_names(self._names) if len(counts) > 1 else np.zeros(1, np.int64)
        if of_files is None or (counts[:-1] != size).any() or counts[-1] > size:
            return None
        of_frames = of_files if np.gcd.reduce(np.diff(of_files)) % size == 0 else of_files * size
        return np.concatenate([n + np.arange(count) for n, count in zip(of_frames, counts, strict=True)])

    def name(self, i: int) -> str:
        k, inner = self._places[i]
        return self._names[k] if self._counts[k] == 1 else f"{self._names[k]} frame {inner}"

    @cached_property
    def _channels(self) -> tuple[int, int]:
        count, size = self._metadata(lambda file, _: file.channels, (1, 1))
        only_channels = count == self._counts[0]  # programs that do not know what a stack holds write its frames so
        return (1, 1) if only_channels and (len(self._files) == 1 or count > MOST_CHANNELS) else (count, size)

    def channel(self, i: int) -> int:
        count, size = self._channels
        return self._places[i][1] // size % count

    def load(self, i: int) -> np.ndarray:
        k, inner = self._places[i]
        with within(self.name(i)):
            return self._open(k).read(inner)

    def _metadata(self, read: Callable[[ImageFile, str], Value], default: Value) -> Value:
        """Metadata of the first readable file."""
        for k, name in enumerate(self._names):
            with suppress(Exception):  # reported when the frame is read
                return read(self._open(k), name)
        return default

    @cached_property
    def metadata_bits(self) -> int | None:  # type: ignore[override]
        return self._metadata(lambda file, _: file.bits, None)

    @cached_property
    def white(self) -> int | None:  # type: ignore[override]
        return self._metadata(lambda file, _: file.white, None)

    @cached_property
    def cfa(self) -> str | None:  # type: ignore[override]
        return self._metadata(lambda file, _: file.cfa, None)

    @cached_property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        return self._metadata(lambda file, name: tuple(f"{name}: {note}" for note in file.notes), ())


class Tiff(ImageFile):
    """A TIFF file, each page an image, without thumbnails; its values as stored, whatever the orientation tag says.

    Larger values are brighter: MinIsWhite is inverted, a palette becomes colours. ImageJ writes stacks above 4 GB with
    one page only, behind which the other images follow.
    """

    def __init__(self, path: Path) -> None:
        import tifffile

        self._path = path
        handle = path.open("rb")
        weakref.finalize(self, handle.close)
        with _quiet():
            self._tiff = tifffile.TiffFile(handle)
            pages = self._tiff.pages
            self._pages = list(range(len(pages)))
            if any(_is_reduced(pages[i]) for i in self._pages[:2]):  # of a long film, all pages take seconds
                self._pages = [i for i in self._pages if not _is_reduced(pages[i])] or [0]
            self._stack = _images_of_imagej(self._tiff) if len(pages) == 1 and self._tiff.is_imagej else 0
        if self._stack:
            page: Any = pages[0]
            check_size(page.shape, path, page.dtype.itemsize)
            stored = (path.stat().st_size - page.dataoffsets[0]) / page.nbytes
            if stored < 2:  # one image of a stack that ImageJ saved as a sequence, with the description of the stack
                self._stack = 0
            check_count(self._stack, stored, "the stack of ImageJ")

    def __len__(self) -> int:
        return self._stack or len(self._pages) + self._is_truncated()

    def _is_truncated(self) -> bool:
        """Whether the last page points beyond the end of the file, which tifffile ignores silently."""
        handle, layout = self._tiff.filehandle, self._tiff.tiff
        order: Literal["little", "big"] = "little" if self._tiff.byteorder == "<" else "big"
        handle.seek(self._tiff.pages[-1].offset)
        tags = int.from_bytes(handle.read(layout.tagnosize), order)
        handle.seek(tags * layout.tagsize, 1)
        return int.from_bytes(handle.read(layout.offsetsize), order) >= self._path.stat().st_size

    def read(self, i: int) -> np.ndarray:
        if self._stack:
            return self._read_from_stack(i)
        if i >= len(self._pages):
            raise ValueError(f"the file ends after {len(self._pages)} frames")
        with _quiet():
            page: Any = self._tiff.pages[self._pages[i]]
            if 1 < page.bitspersample < 8:
                raise _too_few_bits(page.bitspersample)
            check_size(page.shape, self._path, page.dtype.itemsize)
            try:
                image = self._read_packed(page) if _is_packed(page) else page.asarray()
            except (ValueError, NotImplementedError) as error:
                if "imagecodecs" not in str(error):
                    raise
                return self._read_by_opencv(self._pages[i], page)
        if page.photometric == PALETTE and page.colormap is not None:
            return np.moveaxis(page.colormap[:, image] >> 8, 0, -1).astype(np.uint8)
        image = np.moveaxis(image, 0, -1) if page.axes == "SYX" else image
        return _inverted(image, page.bitspersample) if page.photometric == MIN_IS_WHITE else image

    def _read_from_stack(self, i: int) -> np.ndarray:
        """An image behind the only page of an ImageJ stack."""
        page: Any = self._tiff.pages[0]
        first, size = page.dataoffsets[0], int(np.prod(page.shape)) * page.dtype.itemsize
        image = np.fromfile(self._path, page.dtype.newbyteorder(self._tiff.byteorder), size // page.dtype.itemsize,
                            offset=first + i * size)  # fmt: skip
        if image.nbytes < size:
            raise ValueError(f"the file ends within or before frame {i} of {self._stack}")
        image = image.reshape(page.shape)
        return _inverted(image, page.bitspersample) if page.photometric == MIN_IS_WHITE else image

    def _read_packed(self, page: Any) -> np.ndarray:
        """A page of 9 to 15 bit; each row begins with a new byte."""
        (height, width), bits = page.shape, page.bitspersample
        row = -(-width * bits // 8)
        strips: Any = self._tiff.filehandle.read_segments(page.dataoffsets, page.databytecounts)
        data = np.frombuffer(b"".join(strip or b"" for strip, _ in strips), np.uint8)
        if len(data) < height * row:
            raise ValueError(f"{len(data)} bytes of {height * row}")
        if page.fillorder == LOWEST_BIT_FIRST:
            data = np.packbits(np.unpackbits(data, bitorder="little"))
        padded = np.zeros((height, row + -row % bits), np.uint8)  # rows of whole values
        padded[:, :row] = data[: height * row].reshape(height, row)
        return unpack(padded.ravel(), bits, padded.size * 8 // bits).reshape(height, -1)[:, :width]

    def _read_by_opencv(self, i: int, page: Any) -> np.ndarray:
        """Compressed pages that tifffile cannot decode; OpenCV shifts packed bits to the top and turns."""
        import cv2

        _, images = cv2.imreadmulti(str(self._path), start=i, count=1, flags=cv2.IMREAD_UNCHANGED)
        if not images:
            raise ValueError("neither tifffile nor OpenCV can decode it")
        image, bits = np.asarray(images[0]), page.bitspersample
        if (orientation := page.tags.valueof("Orientation")) in TURNED:
            image = TURNED[orientation](image)
        image = np.right_shift(image, 16 - bits) if 8 < bits < 16 else image
        return _inverted(image, bits) if page.photometric == MIN_IS_WHITE else _as_rgb(image)

    @property
    def channels(self) -> tuple[int, int]:  # type: ignore[override]
        return _channels(self._tiff, len(self))

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        page: Any = self._tiff.pages[0]
        return note_of_time_stamp(self.read(0)) if page.bitspersample == 16 and page.samplesperpixel == 1 else ()

    @property
    def cfa(self) -> str | None:  # type: ignore[override]
        page: Any = self._tiff.pages[0]
        size, codes = (page.tags.valueof(name, ()) for name in ("CFARepeatPatternDim", "CFAPattern"))
        plain = page.photometric == CFA and tuple(size) == (2, 2) and len(codes) == 4 and max(codes) < len("RGB")
        return "".join("RGB"[code] for code in codes) if plain else None

    @property
    def bits(self) -> int | None:  # type: ignore[override]
        page: Any = self._tiff.pages[0]
        if 8 < page.bitspersample < 16:
            return int(page.bitspersample)
        if page.bitspersample != 16:
            return None
        if match := re.search(r'SignificantBits="(\d+)"', self._tiff.ome_metadata or ""):
            return int(match[1])
        top = page.tags.valueof("MaxSampleValue")
        top = max(top) if isinstance(top, tuple) else top
        return {2**bits - 1: bits for bits in range(9, 16)}.get(top)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the messages of tifffile and OpenCV: the error that follows reports the damage."""
    import cv2

    logger, level = logging.getLogger("tifffile"), cv2.utils.logging.getLogLevel()
    before, logger.disabled = logger.disabled, True
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logger.disabled = before
        cv2.utils.logging.setLogLevel(level)


class Png(ImageFile):
    """A PNG file, checked for its end, which OpenCV does not do."""

    def read(self, i: int) -> np.ndarray:
        import cv2

        data = self._path.read_bytes()
        chunks = _png_chunks(data)
        if not data.startswith(b"\x89PNG") or b"IEND" not in chunks:
            raise ValueError("no end of a PNG file" if data.startswith(b"\x89PNG") else "no PNG file")
        check_size(struct.unpack(">2I", chunks[b"IHDR"][:8]), self._path)
        depth, palette = chunks[b"IHDR"][8], chunks[b"IHDR"][9] == PNG_PALETTE
        if 1 < depth < 8 and not palette:
            raise _too_few_bits(depth)
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise ValueError("OpenCV cannot decode it")
        if depth == 1 and not palette:
            return image > 0
        bits = _significant_bits(chunks)
        return _as_rgb(np.right_shift(image, 16 - bits) if bits else image)  # the format stores them at the top

    @property
    def bits(self) -> int | None:  # type: ignore[override]
        return _significant_bits(_png_chunks(self._path.read_bytes()))


def _png_chunks(data: bytes) -> dict[bytes, bytes]:
    """The first chunk of each kind; the checksums of all are checked, as OpenCV prints what does not fit."""
    chunks: dict[bytes, bytes] = {}
    start = 8
    while start + 8 <= len(data):
        size, kind = int.from_bytes(data[start : start + 4]), data[start + 4 : start + 8]
        end = start + 8 + size
        if end + 4 <= len(data) and zlib.crc32(data[start + 4 : end]) != int.from_bytes(data[end : end + 4]):
            raise ValueError(f"wrong checksum in the chunk at byte {start}")
        chunks.setdefault(kind, data[start + 8 : end])
        start = end + 4
    return chunks


def _significant_bits(chunks: dict[bytes, bytes]) -> int | None:
    bits = max(chunks.get(b"sBIT", b"\0"))
    return bits if chunks[b"IHDR"][8] == 16 and 8 < bits < 16 else None


class Image(ImageFile):
    """An image that Pillow reads; of others by such a name, EPS would start Ghostscript."""

    def read(self, i: int) -> np.ndarray:
        from PIL import Image as Pillow

        with Pillow.open(self._path, formats=("BMP", "JPEG", "JPEG2000", "WEBP")) as image:
            check_size(image.size, self._path)
            palette = image.palette if image.mode == "P" else None
            return np.array(image if palette is None else image.convert(palette.mode))


class Netpbm(ImageFile):
    """A grey (PGM: P2, P5) or colour (PPM: P3, P6) image of one byte or two, or its numbers as text."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with path.open("rb") as file:
            head = NETPBM_HEAD.match(file.read(4096))
        if head is None:
            raise ValueError("no PGM or PPM file")
        kind, width, height, self._top = map(int, head.groups())
        self._is_text, channels, self._begin = kind < 4, 3 if kind in (3, 6) else 1, head.end()
        self._shape, self._type = (height, width, channels), ">u2" if self._top > 255 else "u1"
        check_size(self._shape, path)

    @property
    def bits(self) -> int | None:  # type: ignore[override]
        bits = self._top.bit_length()
        return bits if 8 < bits < 16 and self._top == 2**bits - 1 else None

    def read(self, i: int) -> np.ndarray:
        data = self._path.read_bytes()[self._begin :]
        count = math.prod(self._shape)
        if self._is_text:
            return np.array(data.split()[:count], dtype=self._type).reshape(self._shape)
        return np.frombuffer(data, self._type, count).reshape(self._shape)


class LaVision(ImageFile):
    """Counts of all images in a file, frame by frame (camera, exposure), as stored, without masks and scales."""

    def __init__(self, path: Path) -> None:
        self._planes: list[np.ndarray] = []
        for frame in _lvpyio().read_buffer(str(path)):
            if "PIXEL" not in frame.components:
                raise InputError("expected images, got vectors; give the .im7 files they were computed from")
            self._planes += list(frame.components["PIXEL"].planes)

    @staticmethod
    def check_package() -> None:
        _lvpyio()

    def __len__(self) -> int:
        return len(self._planes)

    def read(self, i: int) -> np.ndarray:
        if i >= len(self._planes):
            raise InputError(f"expected at least {i + 1} images as in the first file, got {len(self._planes)}")
        return np.asarray(self._planes[i])


def _lvpyio() -> Any:
    return optional("lvpyio", "lavision", "LaVision files (.im7, .vc7)", " (LaVision's own terms)")


NETPBM_HEAD = re.compile(rb"P([2356])" + 3 * rb"(?:\s|#[^\n]*\n)+(\d{1,9})" + rb"\s")
MOST_CHANNELS = 4
NO_COMPRESSION, LOWEST_BIT_FIRST = 1, 2  # compression and fill order of TIFF
MIN_IS_WHITE, PALETTE, CFA = 0, 3, 32803  # photometric interpretations of TIFF
PNG_PALETTE = 3  # colour type
REDUCED = 1  # bit of NewSubfileType: a thumbnail

TURNED: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: lambda a: a[:, ::-1], 3: lambda a: a[::-1, ::-1], 4: lambda a: a[::-1], 5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, 1), 7: lambda a: np.rot90(a, 2).swapaxes(0, 1), 8: lambda a: np.rot90(a, -1),
}  # fmt: skip
"""How to undo the orientations of TIFF, which OpenCV applies."""


def _is_reduced(page: Any) -> bool:
    return bool(int(page.tags.valueof("NewSubfileType", 0) or 0) & REDUCED) if hasattr(page, "tags") else False


def _is_packed(page: Any) -> bool:
    """Whether grey values of 9 to 15 bit follow one another, in strips."""
    plain = page.compression == NO_COMPRESSION and page.samplesperpixel == 1 and not page.is_tiled
    return plain and 8 < page.bitspersample < 16


def _images_of_imagej(tiff: Any) -> int:
    """The number of images of an ImageJ stack with one page; 0 unless there are several."""
    page: Any = tiff.pages[0]
    count = int((tiff.imagej_metadata or {}).get("images", 1))
    return count if count > 1 and page.compression == 1 and len(page.dataoffsets) == 1 else 0


def _channels(tiff: Any, images: int) -> tuple[int, int]:
    """The number of channels of a stack of ImageJ or OME, and how many images of one follow one another."""
    if tiff.is_imagej:
        return int((tiff.imagej_metadata or {}).get("channels", 1)), 1
    text = tiff.ome_metadata or ""
    sizes = {axis: int(n) for axis, n in re.findall(r'\bSize([CZT])="(\d+)"', text)}
    order = re.search(r'DimensionOrder="XY([CZT]{3})"', text)
    samples = tiff.pages[0].samplesperpixel
    if order is None or len(sizes) < 3 or math.prod(sizes.values()) != images * samples:  # or one file per channel
        return 1, 1
    return sizes["C"] // samples, math.prod(sizes[axis] for axis in order[1].partition("C")[0])


def _inverted(image: np.ndarray, bits: int) -> np.ndarray:
    if image.dtype == bool:
        return ~image
    top = (1 << bits) - 1
    return (top - image).astype(image.dtype) if image.dtype.kind == "u" else image.max() - image


OPENERS: dict[str, type[ImageFile]] = {
    ".tif": Tiff, ".tiff": Tiff, ".pcoraw": Tiff, ".png": Png, **dict.fromkeys(PILLOW, Image),
    **dict.fromkeys(NETPBM, Netpbm), ".im7": LaVision, ".vc7": LaVision, ".b16": B16, **dict.fromkeys(RAW, CameraRaw),
}  # fmt: skip


def _opener(path: Path) -> type[ImageFile]:
    return OPENERS[ending(path)]


def _as_rgb(image: np.ndarray) -> np.ndarray:
    """Convert OpenCV's B, G, R, alpha to R, G, B."""
    return image[..., 2::-1] if image.ndim == 3 and image.shape[2] >= 3 else image


def _too_few_bits(bits: int) -> InputError:
    return InputError(f"expected grey values of 8 to 16 bit, got {bits}-bit ones; export it with 8 or 16 bit")
