"""Images of PCO's cameras: the format .b16, and time stamps in the first pixels of any format."""

from __future__ import annotations

import struct

import numpy as np
from jaxtyping import UInt16

from nerif.imaging.readers.image_file import ImageFile

__all__ = ["B16", "note_of_time_stamp"]

HEADER = "<4s4i"  # mark, and size of the file, size of the header, width, height; settings and a comment may follow
STAMP = 14  # pixels, each with two decimal digits: four of the image number, year (2), month, day, h, min, s, µs (3)


class B16(ImageFile):
    """An image of 16 bit, row by row from the top. (pco.edge manual, "Image file formats")"""

    def read(self, i: int) -> np.ndarray:
        data = self._path.read_bytes()
        head = data[: struct.calcsize(HEADER)].ljust(struct.calcsize(HEADER), b"\0")
        mark, _, begin, width, height = struct.unpack(HEADER, head)
        if mark.upper() != b"PCO-" or min(begin, width, height) < 1:
            raise ValueError("no .b16 file of PCO")
        size = 2 * width * height
        if len(data) < begin + size:
            raise ValueError(f"{len(data)} bytes of {begin + size}")
        return np.frombuffer(data, "<u2", width * height, begin).reshape(height, width)

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        return note_of_time_stamp(self.read(0))


def note_of_time_stamp(image: UInt16[np.ndarray, "row column"]) -> tuple[str, ...]:
    """Return a note if the first pixels of an image are a time stamp (binary coded decimals), in any bits."""
    pixels = image[0, :STAMP].astype(np.uint32)
    if len(pixels) < STAMP:
        return ()
    for shift in range(9):
        tens, ones = pixels >> shift + 4, pixels >> shift & 15
        if (pixels & ((1 << shift) - 1)).any() or max(tens.max(), ones.max()) > 9:
            continue
        number = 10 * tens + ones
        year = 100 * number[4] + number[5]
        month, day, hour, minute, second = number[6:11]
        if 1990 <= year < 2100 and 1 <= month <= 12 and 1 <= day <= 31 and hour < 24 and max(minute, second) < 60:
            when = f"{year}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02}"
            return (f"its first {STAMP} pixels are a time stamp of PCO ({when}), no grey values",)
    return ()
