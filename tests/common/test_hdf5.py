"""HDF5 files with damaged heaps, over which the HDF5 library would loop for ever."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from nerif.common import hdf5
from nerif.common.conventions import InputError
from nerif.common.netcdf import opened
from nerif.imaging.calibration.importers.importers import import_cameras
from nerif.imaging.readers.open import open_frames


def write(path: Path, signature: bytes = b"") -> None:
    """Write images, the second of which begins with some bytes, with a text in a heap."""
    images = np.arange(3 * 20 * 24, dtype=np.uint8).reshape(3, 20, 24)
    images[1].flat[: len(signature)] = np.frombuffer(signature, np.uint8)
    with h5py.File(path, "w") as file:
        file.create_dataset("images", data=images, chunks=(1, 20, 24)).attrs["bits"] = "8"
        file["plain"] = images[1]


def damage(path: Path) -> None:
    """Set the size of the free space of the heap to 0."""
    content = bytearray(path.read_bytes())
    at = content.index(hdf5.HEAP + (4096).to_bytes(8, "little")) + 16
    while content[at]:
        at += 16 + -(-int.from_bytes(content[at + 8 : at + 16], "little") // 8) * 8
    content[at + 8 : at + 16] = bytes(8)
    path.write_bytes(content)


def read_netcdf(path: Path) -> object:
    with opened(path, "a measurement") as dataset:
        return dataset["images"].values


READERS: dict[str, Callable[[Path], object]] = {
    "h5": lambda path: open_frames(f"{path}:images")[1], "mat": import_cameras, "nc": read_netcdf,
}  # fmt: skip


@pytest.mark.parametrize("kind", READERS)
def test_no_reader_opens_a_file_with_a_damaged_heap(tmp_path, kind):
    path = tmp_path / f"a.{kind}"
    write(path)
    damage(path)
    with pytest.raises(InputError, match="a global heap is damaged"):
        READERS[kind](path)


@pytest.mark.parametrize("size", [0, 1 << 30])
def test_heaps_of_large_files_are_sought_between_the_data(tmp_path, monkeypatch, size):
    monkeypatch.setattr(hdf5, "SEARCHED_WHOLE", size)
    path = tmp_path / "a.h5"
    write(path, hdf5.HEAP)
    if size:  # the image that looks like a heap is searched as well
        with pytest.raises(OSError, match="damaged"):
            hdf5.check_heaps(path)
        return
    assert open_frames(f"{path}:images")[1].shape == (20, 24)
    damage(path)
    with pytest.raises(OSError, match="damaged"):
        hdf5.check_heaps(path)
