"""Photron recordings: a header (.cih, .cihx) and monochrome frames of 8, packed 12, or 16 bit (.mraw)."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.files import ending, reading
from nerif.imaging.readers.frames import FilmFrames, check_count, check_size
from nerif.imaging.readers.packed import unpack

__all__ = ["PhotronFrames"]

NUMBERS = ("Color Bit", "EffectiveBit Depth", "Total Frame", "Image Height", "Image Width", "Record Rate(fps)")
"""Positive numbers that a .cih header must have, whole ones except the rate."""

TAGS = {
    "Color Bit": "imageDataInfo/colorInfo/bit",
    "EffectiveBit Depth": "imageDataInfo/effectiveBit/depth",
    "EffectiveBit Side": "imageDataInfo/effectiveBit/side",
    "Total Frame": "frameInfo/totalFrame",
    "Image Height": "imageDataInfo/resolution/height",
    "Image Width": "imageDataInfo/resolution/width",
    "Record Rate(fps)": "recordInfo/recordRate",
    "Save Step": "frameInfo/skipFrame",
    "File Format": "imageFileInfo/fileFormat",
}
"""Keys of a .cih header and their places in the XML of a .cihx header."""


class PhotronFrames(FilmFrames):
    """A Photron recording, of which every n-th frame was saved (Save Step n); the time of frame i is i n / rate."""

    def __init__(self, path: Path, name: str) -> None:
        is_data = ending(path) == ".mraw"
        header_path = _partner(path, name, (".cihx", ".cih")) if is_data else path
        self._path = path if is_data else _partner(path, name, (".mraw",))
        self._name = Path(name).with_name(self._path.name).as_posix()
        cih = _header(header_path, Path(name).with_name(header_path.name).as_posix())
        self._stored, self._length = int(cih["Color Bit"]), int(cih["Total Frame"])
        self._height, self._width = int(cih["Image Height"]), int(cih["Image Width"])
        stored = self._path.stat().st_size * 8 / (self._height * self._width * self._stored)
        check_size((self._height, self._width), self._path, name=name)
        check_count(self._length, stored, name)
        self.metadata_bits = min(int(cih["EffectiveBit Depth"]), self._stored)
        upper = self._stored == 16 and cih.get("EffectiveBit Side", "").lower() == "higher"
        self._shift = self._stored - self.metadata_bits if upper else 0
        step = max(1.0, float(cih.get("Save Step") or 1))  # some cameras write 0 for every frame
        self.times = np.arange(self._length) * step / float(cih["Record Rate(fps)"])

    def load(self, i: int) -> np.ndarray:
        pixels = self._height * self._width
        if self._stored == 12:
            # two pixels in three bytes throughout the file: a frame may begin in the middle of three
            first, last = i * pixels // 2, -(-(i + 1) * pixels // 2)
            data = self._bytes(i, 3 * first, 3 * last - ((i + 1) * pixels) % 2)
            skip = i * pixels % 2
            values = unpack(data, 12, skip + pixels)[skip:]
        else:
            size = self._stored // 8
            values = self._bytes(i, i * pixels * size, (i + 1) * pixels * size).view("<u2" if size == 2 else "u1")
            values = values >> self._shift
        return values.reshape(self._height, self._width)

    def _bytes(self, i: int, begin: int, end: int) -> np.ndarray:
        data = np.fromfile(self._path, np.uint8, end - begin, offset=begin)
        if len(data) < end - begin:
            raise InputError(
                f"expected {self._length} frames by the header, the file of {self._path.stat().st_size} bytes ends "
                "within this one or before; copy it again",
                field=self.name(i),
            )
        return data


def _partner(path: Path, name: str, suffixes: tuple[str, ...]) -> Path:
    """Return the file of the same name with one of these suffixes; small and capital letters are the same."""
    others = sorted(path.parent.iterdir(), key=lambda other: other.stem != path.stem)
    for suffix in suffixes:
        for other in others:
            if other.stem.lower() == path.stem.lower() and ending(other) == suffix and other.is_file():
                return other
    raise InputError(f"expected a {' or '.join(suffixes)} file of the same name beside it, got none", field=name)


def _header(path: Path, name: str) -> dict[str, str]:
    """Return the entries of a header by the keys of a .cih."""
    with reading("cannot be read as a Photron header; export it again", name):
        text = path.read_bytes().decode("utf-8", errors="ignore")
        cih = _from_xml(text) if ending(path) == ".cihx" else _from_lines(text)
        *counts, rate = (float(cih[key]) if key == NUMBERS[-1] else int(cih[key]) for key in NUMBERS)
        positive = min(*counts, rate) > 0
        float(cih.get("Save Step") or 1)
        kind, stored = cih["File Format"], int(counts[0])
    if kind.lower() != "mraw" or stored not in (8, 12, 16):
        raise InputError(
            f"expected a monochrome MRaw recording of 8, 12 or 16 bit, got {kind} of {stored} bit; "
            "export it in this format, or as TIFF",
            field=name,
        )
    if not positive:
        raise InputError(
            f"expected {', '.join(NUMBERS)} above 0, got {', '.join(cih[key] for key in NUMBERS)}", field=name
        )
    return cih


def _from_lines(text: str) -> dict[str, str]:
    """Lines such as `Image Width : 1024`, up to the first empty one."""
    head = text.replace("\r", "").split("\n\n")[0]
    pairs = (line.split(" : ", 1) for line in head.splitlines() if " : " in line)
    return {key.strip(): value.strip() for key, value in pairs}


def _from_xml(text: str) -> dict[str, str]:
    """The element <cih>, which binary data may surround."""
    begin, end = text.find("<cih>"), text.rfind("</cih>")
    if begin < 0 or end < 0:
        raise ValueError("no element <cih>")
    root = ElementTree.fromstring(text[begin : end + len("</cih>")])
    entries = {key: root.findtext(tag) for key, tag in TAGS.items()}
    return {key: value.strip() for key, value in entries.items() if value is not None}
