"""Frames in arrays on disc: NumPy's .npy and .npz, and HDF5."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.files import ending, reading
from nerif.common.hdf5 import open_hdf5
from nerif.common.memory import check_memory
from nerif.common.npz import open_npz
from nerif.common.times import seconds
from nerif.imaging.readers.frames import FilmFrames, check_count, check_size

if TYPE_CHECKING:
    import h5py

__all__ = ["ArrayFrames", "Hdf5Frames"]

MATLAB = "MATLAB_class"  # attribute of the datasets of its .mat files of version 7.3


class ArrayFrames(FilmFrames):
    """A NumPy array of an .npy file (memory-mapped) or an .npz file (read whole: it has no partial access)."""

    def __init__(self, path: Path, name: str, dataset: str) -> None:
        with reading("cannot be read, truncated or damaged? Copy it again", name):
            if ending(path) == ".npy":
                array = np.load(path, mmap_mode="r", allow_pickle=False)
                _choose({"array": array.shape}, dataset, name)
            else:
                with open_npz(path) as (archive, shapes):
                    key = _choose(shapes, dataset, name)
                    check_size(shapes[key][-2:], path, name=name)
                    array = archive[key]
        self._array = array if array.ndim == 3 else array[None]
        self._name, self._length = name, len(self._array)
        if not len(self):
            raise InputError("expected at least one frame, got none", field=name)

    def name(self, i: int) -> str:
        return super().name(i) if len(self) > 1 else self._name

    def load(self, i: int) -> np.ndarray:
        return np.array(self._array[i])


def _choose(shapes: dict[str, tuple[int, ...]], dataset: str, name: str) -> str:
    """Return the dataset named, or the only one that can hold frames."""
    candidates = [key for key, shape in shapes.items() if len(shape) in (2, 3)]
    content = f"the file holds {', '.join(shapes) or 'none'}"
    if not dataset:
        if len(candidates) != 1:
            raise InputError(
                f"expected one dataset of 2 or 3 dims, got {len(candidates)}; name it after ':' ({content})", field=name
            )
        return candidates[0]
    if dataset not in shapes:
        raise InputError(f"no such dataset; {content}", field=f"{name}:{dataset}")
    if dataset not in candidates:
        dims = len(shapes[dataset])
        raise InputError(f"expected 2 or 3 dims (frame, row, column), got {dims}", field=f"{name}:{dataset}")
    return dataset


class Hdf5Frames(FilmFrames):
    """A dataset (frame, row, column) or (row, column) of an HDF5 file.

    Times (s) are in its attribute `times` or in a dataset `times` beside it, effective bits in the attribute `bits`.
    MATLAB stores images(:, :, k) by columns, as (frame, column, row): `save -v7.3` marks them, and they are transposed;
    `h5write` leaves no mark, and views.toml has to transpose them: rotate = 90, flip = "vertical".
    """

    def __init__(self, path: Path, name: str, dataset: str) -> None:
        import h5py

        self._path, self._name = path, name
        with reading("cannot be read as HDF5, truncated or damaged?", name), open_hdf5(path) as file:
            shapes: dict[str, tuple[int, ...]] = {}
            file.visititems(lambda key, x: shapes.update({key: x.shape}) if isinstance(x, h5py.Dataset) else None)
            self._key = _choose(shapes, dataset.strip("/"), name)
            data = file[self._key]
            self._stack, self._length = data.ndim == 3, len(data) if data.ndim == 3 else 1
            check_size(data.shape[-2:], path, data.dtype.itemsize, name)
            check_count(self._length, self._length * _part_stored(data), name)
            bits = data.attrs.get("bits")
            times = data.attrs.get("times", data.parent.get("times"))
            if times is not None:
                check_memory(times.size * times.dtype.itemsize, path, f"{name}: times")
                unit = getattr(times, "attrs", {}).get("units")
                times = seconds(np.array(times).ravel(), unit, name)
            self._transposed = MATLAB in data.attrs
        self.metadata_bits = None if bits is None else int(bits)
        if not self._length:
            raise InputError("expected at least one frame, got none", field=f"{name}:{self._key}")
        if times is not None and times.shape != (self._length,):
            raise InputError(f"expected {self._length} times, one for each frame, got shape {times.shape}", field=name)
        self.times = times

    def name(self, i: int) -> str:
        return f"{self._name}:{self._key}" + (f" frame {i}" if self._stack else "")

    def load(self, i: int) -> np.ndarray:
        with open_hdf5(self._path) as file:
            image = file[self._key][i] if self._stack else file[self._key][()]
        return np.ascontiguousarray(image.T) if self._transposed else image


def _part_stored(data: h5py.Dataset) -> float:
    """The part of a dataset that is in the file: chunks may not have been written."""
    chunks = math.prod(-(-n // m) for n, m in zip(data.shape, data.chunks, strict=True)) if data.chunks else 0
    return data.id.get_num_chunks() / chunks if chunks else float(data.id.get_storage_size() > 0 or data.is_virtual)
