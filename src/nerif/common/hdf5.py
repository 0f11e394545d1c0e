"""HDF5 files, opened for reading once their global heaps are known to be sound and all parts to be in the file."""

from __future__ import annotations

import mmap
import os
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import h5py

__all__ = ["check_heaps", "open_hdf5"]

HEAP = b"GCOL\x01\0\0\0"
"""Signature and version of a global heap."""
SEARCHED_WHOLE = 1 << 25  # bytes of a file whose table of chunks is not needed to be fast


def open_hdf5(path: Path) -> h5py.File:
    """Open a file for reading; OSError if it is damaged. Every HDF5 file of a user is opened here."""
    import h5py

    check_heaps(path)
    return h5py.File(path, "r")


def check_heaps(path: Path) -> None:
    """Raise OSError if a global heap does not end where its header states: the HDF5 library would loop forever.

    Heaps are sought in the whole of a small file, and between the data of the arrays of a large one.
    """
    status = path.stat()
    _check_heaps(os.fspath(path), status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=256)  # of a film, each frame opens the file
def _check_heaps(path: str, size: int, changed_ns: int) -> None:
    if not size:
        return
    data = _extents(path) if size > SEARCHED_WHOLE else []
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        end = 0
        for (_, begin), (until, _) in pairwise([(0, 0), *data, (size, size)]):
            start = content.find(HEAP, end := max(begin, end), until)
            while start >= 0:
                end = _end_of_heap(content, start)
                start = content.find(HEAP, end, until)
    _check_links(path)


def _check_links(path: str) -> None:
    """Raise OSError if a part of a file, which may come from another person, is in another file."""
    import h5py

    def check(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            names = [name] if item.external or item.is_virtual else []
        else:
            names = [key for key in item if isinstance(item.get(key, getlink=True), h5py.ExternalLink)]
        if names:
            raise OSError(f"'{names[0]}' is in another file; copy it into this one, as by h5repack")

    with h5py.File(path, "r") as file:
        check("/", file)
        file.visititems(check)


def _extents(path: str) -> list[tuple[int, int]]:
    """Return first byte and end of the data of all arrays of a file, in order."""
    import h5py

    extents: list[tuple[int, int]] = []

    def add(name: str, item: object) -> None:
        if not isinstance(item, h5py.Dataset):
            return
        if item.chunks:
            item.id.chunk_iter(lambda chunk: extents.append((chunk.byte_offset, chunk.byte_offset + chunk.size)))
        elif (offset := item.id.get_offset()) is not None:
            extents.append((offset, offset + item.id.get_storage_size()))

    with h5py.File(path, "r") as file:
        file.visititems(add)
    return sorted(extents)


def _end_of_heap(content: mmap.mmap, start: int) -> int:
    """Return the end of a heap, or raise OSError.

    A heap is a header of 16 bytes with its size, and objects: index (2 bytes), references (2), 4 free, size (8), data
    up to a multiple of 8 bytes. Object 0 is the free space, whose size counts its own header.

    Source: HDF5 File Format Specification 3.0, III.E.
    """
    header = 16
    end = start + int.from_bytes(content[start + 8 : start + header], "little")
    position = start + header
    while position + header <= min(end, len(content)):
        index = int.from_bytes(content[position : position + 2], "little")
        size = int.from_bytes(content[position + 8 : position + header], "little")
        length = header + -(-size // 8) * 8 if index else size
        if length < header or position + length > end:
            raise OSError("a global heap is damaged")
        position += length
    return max(end, start + header)
