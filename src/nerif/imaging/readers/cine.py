"""Phantom films (.cine): grey, colour or Bayer frames of 8 or 16 bit, or packed to 10 or 12 bit.

A header refers to a BITMAPINFOHEADER, to a SETUP with the settings of the camera, followed by tagged blocks, and to the
table of the positions of all frames. Before the pixels of a frame are an annotation and their size. Little-endian.
(Vision Research, "The CINE File Format")
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from nerif.common.conventions import InputError
from nerif.imaging.readers.frames import FilmFrames, check_size
from nerif.imaging.readers.packed import unpack

__all__ = ["CineFrames"]

HEADER = "<2s3HiIiI3I8x"
BITMAP = "<4x2i2HI20x"
SETUP = {
    "Mark": (140, "<2s"), "Length": (142, "<H"), "bFlipH": (756, "<i"), "bFlipV": (760, "<i"), "FrameRate": (768, "<I"),
    "CFA": (808, "<I"), "Rotate": (884, "<i"), "RealBPP": (896, "<I"),
}  # fmt: skip
"""Some settings: offset in SETUP, and type."""

PLAIN, UNINTERPOLATED = 0, 2  # compressions: grey or colour, and raw values
TIMES = 1002  # type of the tagged block of times of the frames, s * 2^32
STATE = 3  # lowest bits of a time: synchronisation and event
BAYER = {3: "GBRG", 4: "RGGB", 5: "GRBG", 6: "BGGR"}  # colour filter arrays, of rows from the top
GREY_HEADS = 0xF0000000  # bits of the colour filter array: heads of the camera that are grey
PACKED = {256: 10, 1024: 12}  # bits, by the compression of the bitmap
PIXELS = {k: (np.dtype(kind), n) for k, kind, n in ((8, "u1", 1), (16, "<u2", 1), (24, "u1", 3), (48, "<u2", 3))}
"""Type and channels, by the bits of a pixel."""

STEPS = (
    "3111111111111011111111111111110111111111111111011111111111111101111111111111111011111111111111101111"
    "1111111111110111111111111111011111111111101111111111111111121111111112111111211112111211121112112112"
    "1121121211212121121212121212122121221212212212212212221222122212222212222222122222222222222222222222"
    "3222222232222232223222322232232232232232323223232323232323233232323323323323323332333233323333323333"
    "3333233333333333333333334333333334333343333433343343334334343343433434343434343434344343443443443443"
    "4443444344443444444344444444444444444444444444544444544445444544454454454454454545445454545454554545"
    "4554554554554555455545555455555545555555555555555555555555655555565555655565556556556556565565656565"
    "6565656565665665656656665666566656666566666666566666666666666766666666766667666676667667667667676676"
    "7676767676767676776767767767776777677767777767777777777767777787777777777787777787777877787787787787"
    "7878787787878787887878788788788788788878888788888788888888888888888888888889888889888898889889889889"
    "88989898898988"
)
"""Differences of the 12-bit values of the codes 0 to 1014 of packed frames, the first of which is 2."""
TWELVE_BIT = np.full(1024, 4095, np.uint16)
TWELVE_BIT[:1015] = np.cumsum([2, *map(int, STEPS)])
"""The 12-bit value of each 10-bit code: the table of the format, BT.709's curve from black (64) to white (4064)."""


class CineFrames(FilmFrames):
    """A Phantom film, or the range of its frames that was saved."""

    def __init__(self, path: Path, name: str) -> None:
        self._path, self._name = path, name
        try:
            with path.open("rb") as file:
                mark, _, compression, version, _, _, _, count, bitmap, setup, table = _fields(file, 0, HEADER)
                if mark != b"CI" or version != 1:
                    raise InputError("expected a Phantom film, got another file; export it again", field=name)
                width, height, _, depth, packing = _fields(file, bitmap, BITMAP)
                settings = {key: _fields(file, setup + at, kind)[0] for key, (at, kind) in SETUP.items()}
                blocks = _tagged_blocks(file, setup + settings["Length"], table)
                self._positions = np.frombuffer(_bytes(file, table, 8 * count), "<i8")
        except EOFError:
            raise InputError("the file ends within its header; copy it again", field=name) from None
        if min(count, width, abs(height)) < 1 or settings["Mark"] != b"ST":
            raise InputError(
                f"expected at least one frame, got {count} of {width} x {height} px (width x height); save it again",
                field=name,
            )
        if compression not in (PLAIN, UNINTERPOLATED) or (packing not in PACKED if packing else depth not in PIXELS):
            raise InputError(
                "expected frames of 8 or 16 bit, or packed to 10 or 12 bit, got others "
                f"(compression {compression} and {packing}, {depth} bit); save the film uncompressed",
                field=name,
            )
        check_size((abs(height), width), path, name=name)
        self._length = len(self._positions)
        self._shape, self._is_bottom_up = (abs(height), width), height > 0 and not packing
        self._packed, (self._dtype, self._channels) = PACKED.get(packing, 0), PIXELS[16 if packing else depth]
        bits = 12 if packing else settings["RealBPP"]
        self.metadata_bits = bits if 8 <= bits <= 8 * self._dtype.itemsize else None
        self._set_colours(settings["CFA"] if compression == UNINTERPOLATED else 0)
        self._set_times(settings["FrameRate"], blocks.get(TIMES, b""))
        if settings["bFlipH"] or settings["bFlipV"] or settings["Rotate"]:
            self.notes += (f"{name}: shown flipped or rotated by Phantom's software, read as recorded",)

    def _set_colours(self, code: int) -> None:
        """Set the Bayer pattern; other mosaics are noted."""
        if code & GREY_HEADS == GREY_HEADS or not code & 0xFF:
            return
        self.cfa = BAYER.get(code & 0xFF)
        if self.cfa is None or code & GREY_HEADS:
            self.cfa = None
            self.notes += (f"{self._name}: raw values of a colour mosaic that is no Bayer pattern ({code:#x})",)

    def _set_times(self, rate: int, block: bytes) -> None:
        """Set the times from those of the frames, else from the frame rate."""
        stamps = np.frombuffer(block[: len(block) // 8 * 8], "<u8") & ~np.uint64(STATE)
        if len(stamps) == len(self) and (stamps[1:] > stamps[:-1]).all():
            self.times = (stamps - stamps[0]) / 2**32
        elif rate:
            self.times = np.arange(len(self)) / rate
            if block:
                self.notes += (f"{self._name}: time stamps out of order; times by its {rate} frames per second",)

    def load(self, i: int) -> np.ndarray:
        data, (height, width) = self._pixels(i), self._shape
        if self._packed:
            values = unpack(data, self._packed, height * width).reshape(height, width)
            return TWELVE_BIT[values] if self._packed == 10 else values
        row = width * self._channels * self._dtype.itemsize
        image = data.reshape(height, -1)[:, :row].view(self._dtype).reshape(height, width, self._channels)
        image = image[::-1] if self._is_bottom_up else image
        return image[..., 0] if self._channels == 1 else image[..., ::-1]  # stored as B, G, R

    def _pixels(self, i: int) -> np.ndarray:
        """The bytes of a frame, behind its annotation."""
        height, width = self._shape
        begin, end = int(self._positions[i]), self._path.stat().st_size
        try:
            with self._path.open("rb") as file:
                begin += max(8, _fields(file, begin, "<I")[0]) if begin else end  # 0: not saved
                (size,) = _fields(file, begin - 4, "<I")
                data = np.frombuffer(_bytes(file, begin, size), np.uint8)
        except EOFError:
            raise InputError(
                f"expected {len(self)} frames by the header, the file of {end} bytes lacks data of this one; was "
                "saving or copying interrupted? Save or copy it again",
                field=self.name(i),
            ) from None
        row = width * self._channels * self._dtype.itemsize
        least = -(-height * width * self._packed // 8) if self._packed else height * row
        if size < least or (not self._packed and size not in (least, height * (row + -row % 4))):
            raise InputError(f"expected {least} bytes of pixels, got {size}; export it again", field=self.name(i))
        return data


def _fields(file: BinaryIO, at: int, layout: str) -> tuple[Any, ...]:
    return struct.unpack(layout, _bytes(file, at, struct.calcsize(layout)))


def _bytes(file: BinaryIO, at: int, size: int) -> bytes:
    """Part of a file; EOFError if the file ends before."""
    if at + size > os.fstat(file.fileno()).st_size:
        raise EOFError
    file.seek(at)
    return file.read(size)


def _tagged_blocks(file: BinaryIO, begin: int, end: int) -> dict[int, bytes]:
    """Content of each block by its type."""
    blocks: dict[int, bytes] = {}
    while begin + 8 <= end:
        size, kind = _fields(file, begin, "<IH2x")
        if not 8 <= size <= end - begin:
            break
        blocks[kind] = _bytes(file, begin + 8, size - 8)
        begin += size
    return blocks
