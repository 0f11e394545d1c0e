"""Headers that state absurd sizes: each file is refused before memory is taken for it."""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import psutil
import pytest
import tifffile
import torch

from imaging_files import write_photron
from nerif.cli.cli import main
from nerif.common import memory
from nerif.common.conventions import InputError
from nerif.data.measurement_file import bodies_of
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.volume import Volume, write_netcdf
from nerif.data.volume_file import read_volume
from nerif.data.volume_sequence import VolumeSequence
from nerif.data.vti import read_vti, write_vti
from nerif.fields.network_shape import NetworkShape
from nerif.geometry import Box, Grid
from nerif.imaging.calibration.importers.importers import import_cameras
from nerif.imaging.readers.open import open_frames

SPARE = 2 << 30  # bytes of address space that a test may take
GRID = Grid(Box((0, 0, 0), (4, 5, 6)), (6, 5, 4))
MANY = 1 << 38


@pytest.fixture(autouse=True)
def limit() -> Iterator[None]:
    """Limit the address space: a reader that takes the memory of the header fails, not the machine."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (psutil.Process().memory_info().vms + SPARE, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def imagej(folder: Path) -> None:
    about = f"ImageJ=1.11a\nimages={1 << 27}\nslices={1 << 27}\n"
    tifffile.imwrite(folder / "a.tif", np.zeros((1, 1), np.uint8), description=about, metadata=None)
    with (folder / "a.tif").open("ab") as file:
        file.write(bytes(9))  # else it is one image of a stack
    open_frames(folder / "a.tif")[0]


def wide_tiff(folder: Path) -> None:
    tifffile.imwrite(folder / "a.tif", np.zeros((1, 1), np.float64), compression="zlib")
    with tifffile.TiffFile(folder / "a.tif", mode="r+b") as file:
        for tag in ("ImageWidth", "ImageLength", "RowsPerStrip"):
            file.pages[0].tags[tag].overwrite(15_000)
    open_frames(folder / "a.tif")[0]


def photron(folder: Path) -> None:
    open_frames(write_photron(folder, b"", n=1 << 26, h=1, w=1, bit=8, depth=8))[0]


def png(folder: Path) -> None:
    head = b"IHDR" + struct.pack(">2I5B", 30_000, 30_000, 16, 6, 0, 0, 0)
    chunks = [head, b"IDAT" + zlib.compress(bytes(100)), b"IEND"]
    parts = (struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    (folder / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    open_frames(folder / "a.png")[0]


def npz(folder: Path) -> None:
    with zipfile.ZipFile(folder / "a.npz", "w") as archive, archive.open("x.npy", "w") as file:
        np.lib.format.write_array_header_1_0(file, {"shape": (99_999, 99_999), "fortran_order": False, "descr": "|u1"})
    open_frames(folder / "a.npz")[0]


def unwritten(path: Path, shape: tuple[int, ...], name: str = "x") -> Path:
    """Write an HDF5 dataset without any data."""
    with h5py.File(path, "a", userblock_size=512) as file:
        file.create_dataset(name, shape, "f8", chunks=(1,) * len(shape))
    with path.open("r+b") as head:
        head.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")
    return path


def hdf5_times(folder: Path) -> None:
    unwritten(folder / "a.h5", (3, 4, 4), "x")
    open_frames(f"{unwritten(folder / 'a.h5', (MANY,), 'times')}:x")


def coordinate(folder: Path) -> None:
    write_netcdf(folder / "a.nc", [Volume(torch.zeros(6, 5, 4), GRID)])
    with h5py.File(folder / "a.nc", "a") as file:
        file.create_dataset("view", (1 << 29,), "f8", chunks=(1 << 20,)).make_scale("view")
    read_volume(folder / "a.nc")


def volume(folder: Path) -> None:
    with h5py.File(folder / "a.nc", "w") as file:
        data = file.create_dataset("index_excess", (1200, 1200, 1200), "f4", chunks=(100, 100, 100))
        for i, name in enumerate("zyx"):
            file[name] = np.arange(1200.0)
            file[name].make_scale(name)
            data.dims[i].attach_scale(file[name])
    read_volume(folder / "a.nc")


def vti(folder: Path) -> None:
    write_vti(folder / "a.vti", {"n": torch.zeros(6, 5, 4)}, GRID, {})
    content, block = (folder / "a.vti").read_bytes(), zlib.compress(bytes(1 << 20))
    count = 5000
    sizes = struct.pack(f"<{3 + count}Q", count, 1 << 20, 0, *[len(block)] * count)
    begin = content.index(b"_", content.index(b"<AppendedData")) + 1
    (folder / "a.vti").write_bytes(content[:begin] + sizes + count * block + b"</AppendedData></VTKFile>")
    read_vti(folder / "a.vti")


def bodies(folder: Path) -> None:
    corners = np.eye(4, 3)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    bodies_of({"body_vertices": corners, "body_faces": faces, "body_of_face": np.array([0, 0, 0, 2**31])})


def yaml(folder: Path) -> None:
    rows = [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 10)]
    about = ["a0: &a0 [1.0, 2.0]", *rows]
    about += [f"cam{i}: {{camera_model: pinhole, intrinsics: *a0, distortion_coeffs: *a9}}" for i in (0, 1)]
    (folder / "a.yaml").write_text("\n".join(about))
    import_cameras(folder / "a.yaml")


def network(folder: Path) -> None:
    NetworkShape.of({"depth": 4, "width": 40_000}, 1000)


def sequence(folder: Path, name: str, length: int) -> Path:
    """Write volumes over time, and state another length of an axis."""
    pytest.importorskip("zarr")
    VolumeSequence.create(folder / "a.zarr", [0.0, 1.0], GRID, ["density"], 1.0)
    for path in (folder / "a.zarr").glob("*/zarr.json"):
        about = json.loads(path.read_text())
        if name in about["dimension_names"]:
            about["shape"][about["dimension_names"].index(name)] = length
        path.write_text(json.dumps(about))
    return folder / "a.zarr"


CASES: dict[str, Callable[[Path], object]] = {
    "stack of ImageJ": imagej, "TIFF": wide_tiff, "Photron": photron, "PNG": png, "npz": npz,
    "HDF5 frame": lambda folder: open_frames(unwritten(folder / "a.h5", (2, 200_000, 200_000)))[0],
    "HDF5 frames": lambda folder: open_frames(unwritten(folder / "a.h5", (MANY, 4, 4)))[0],
    "HDF5 times": hdf5_times,
    "MATLAB": lambda folder: import_cameras(unwritten(folder / "a.mat", (MANY,))),
    "coordinate": coordinate, "volume": volume, "vti": vti, "bodies": bodies, "aliases": yaml, "network": network,
    "frame of a film": lambda folder: VolumeSequence(sequence(folder, "x", 1 << 30)).volume(0, "density"),
    "instants of a film": lambda folder: VolumeSequence(sequence(folder, "time", MANY)),
    "instants of views": lambda folder: MeasurementSequence.read(sequence(folder, "time", MANY)),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_absurd_sizes_are_refused(tmp_path, case):
    with pytest.raises(InputError) as error:
        CASES[case](tmp_path)
    assert "allocate" not in str(error.value)


def test_data_must_fit_into_the_file_and_the_memory(tmp_path, monkeypatch):
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(1 << 20))
    monkeypatch.setattr(memory, "free_memory", lambda: 1 << 29)
    memory.check_memory(1 << 29, path)
    memory.check_memory(1 << 27, None)
    for size, folder in ((1 << 29) + 1, path), (1 << 31, None), (1 << 31, tmp_path):
        with pytest.raises(InputError, match="GB"):
            memory.check_memory(size, folder)


@pytest.mark.parametrize("take", [lambda: np.zeros(1 << 50), lambda: torch.zeros(1 << 45), lambda: bytes(1 << 60)])
def test_lack_of_memory_is_one_line(take, monkeypatch, capsys):
    monkeypatch.setattr("nerif.cli.commands.info.main", lambda words: take())
    assert main(["info", __file__]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert "not enough memory" in lines[0]
