"""Archives of NumPy arrays (.npz), whose headers are checked before any array is read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from nerif.common.memory import check_memory

__all__ = ["open_npz"]


@contextmanager
def open_npz(path: Path) -> Iterator[tuple[Any, dict[str, tuple[int, ...]]]]:
    """Open an archive, which reads arrays on demand, with the shape of each.

    ValueError or another of NumPy if it is damaged; InputError if an array does not fit into the memory.
    """
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        shapes = {}
        for entry in archive.zip.infolist():
            with archive.zip.open(entry) as member:
                read = npy.read_array_header_1_0 if npy.read_magic(member) == (1, 0) else npy.read_array_header_2_0
                shape, _, dtype = read(member)
            size = math.prod(shape) * dtype.itemsize
            if size > entry.file_size and not dtype.hasobject:
                raise ValueError(f"{entry.filename} has {entry.file_size} bytes, its header states {size}")
            check_memory(size, path, f"{path}: {entry.filename}")
            shapes[entry.filename.removesuffix(".npy")] = shape
        yield archive, shapes
