"""Frames in arrays on disc: NumPy's .npy and .npz, and HDF5."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nerif.common.conventions import InputError
from nerif.common.files import ending
from nerif.common.hdf5 import open_hdf5
from nerif.imaging.readers.frames import Frames

__all__ = ["ArrayFrames", "Hdf5Frames"]

MATLAB = "MATLAB_class"  # attribute of the datasets of its .mat files of version 7.3


class ArrayFrames(Frames):
    """A NumPy array of an .npy file (memory-mapped) or an .npz file (read whole: it has no partial access)."""

    def __init__(self, path: Path, name: str, dataset: str) -> None:
        try:
            if ending(path) == ".npy":
                arrays = {"array": np.load(path, mmap_mode="r", allow_pickle=False)}
            else:
                with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                    keys = [dataset] if dataset in archive.files else archive.files
                    arrays = {key: archive[key] for key in keys}
        except Exception as error:
            raise InputError(f"cannot be read, truncated or damaged? ({error}); copy it again", field=name) from None
        key = _choose({k: a.ndim for k, a in arrays.items()}, dataset, name)
        self._array = arrays[key] if arrays[key].ndim == 3 else arrays[key][None]
        self._name = name
        if not len(self._array):
            raise InputError("expected at least one frame, got none", field=name)

    def __len__(self) -> int:
        return len(self._array)

    def name(self, i: int) -> str:
        return f"{self._name} frame {i}" if len(self) > 1 else self._name

    def load(self, i: int) -> np.ndarray:
        return np.array(self._array[i])


def _choose(dims: dict[str, int], dataset: str, name: str) -> str:
    """Return the dataset named, or the only one that can hold frames."""
    candidates = [key for key, n in dims.items() if n in (2, 3)]
    content = f"the file holds {', '.join(dims) or 'none'}"
    if not dataset:
        if len(candidates) != 1:
            raise InputError(
                f"expected one dataset of 2 or 3 dims, got {len(candidates)}; name it after ':' ({content})", field=name
            )
        return candidates[0]
    if dataset not in dims:
        raise InputError(f"no such dataset; {content}", field=f"{name}:{dataset}")
    if dataset not in candidates:
        raise InputError(f"expected 2 or 3 dims (frame, row, column), got {dims[dataset]}", field=f"{name}:{dataset}")
    return dataset


class Hdf5Frames(Frames):
    """A dataset (frame, row, column) or (row, column) of an HDF5 file.

    Times (s) are in its attribute `times` or in a dataset `times` beside it, effective bits in the attribute `bits`.
    MATLAB stores images(:, :, k) by columns, as (frame, column, row): `save -v7.3` marks them, and they are transposed;
    `h5write` leaves no mark, and views.toml has to transpose them: rotate = 90, flip = "vertical".
    """

    def __init__(self, path: Path, name: str, dataset: str) -> None:
        import h5py

        self._path, self._name = path, name
        try:
            with open_hdf5(path) as file:
                dims: dict[str, int] = {}
                file.visititems(lambda key, x: dims.update({key: x.ndim}) if isinstance(x, h5py.Dataset) else None)
                self._key = _choose(dims, dataset.strip("/"), name)
                data = file[self._key]
                self._stack, self._length = data.ndim == 3, len(data) if data.ndim == 3 else 1
                bits = data.attrs.get("bits")
                times = data.attrs.get("times", data.parent.get("times"))
                times = None if times is None else np.array(times, dtype=float).ravel()
                self._transposed = MATLAB in data.attrs
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"cannot be read as HDF5, truncated or damaged? ({error})", field=name) from None
        self.metadata_bits = None if bits is None else int(bits)
        if not self._length:
            raise InputError("expected at least one frame, got none", field=f"{name}:{self._key}")
        if times is not None and times.shape != (self._length,):
            raise InputError(f"expected {self._length} times, one for each frame, got shape {times.shape}", field=name)
        self.times = times

    def __len__(self) -> int:
        return self._length

    def name(self, i: int) -> str:
        return f"{self._name}:{self._key}" + (f" frame {i}" if self._stack else "")

    def load(self, i: int) -> np.ndarray:
        with open_hdf5(self._path) as file:
            image = file[self._key][i] if self._stack else file[self._key][()]
        return np.ascontiguousarray(image.T) if self._transposed else image
