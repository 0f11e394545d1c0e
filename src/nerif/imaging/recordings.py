"""Formats of pictures: image files, LaVision recordings, NumPy and HDF5 arrays. Opened by readers.py."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from nerif.conventions import InputError
from nerif.imaging.readers import Frames

__all__ = ["FOLDER_SUFFIXES", "SUFFIXES", "ArrayFrames", "FileFrames", "Hdf5Frames", "open_files"]

FOLDER_SUFFIXES = (".tif", ".tiff", ".png", ".bmp", ".jpg", ".jpeg", ".im7")
SINGLE_SUFFIXES = (".cih", ".cihx", ".mraw", ".npy", ".npz", ".h5", ".hdf5", ".hdf")
SUFFIXES = (*FOLDER_SUFFIXES, ".vc7", *SINGLE_SUFFIXES)


def open_files(files: list[Path], names: list[str], dataset: str = "") -> Frames:
    """Open image files, or one recording, by their endings; `names` are for messages."""
    for path, name in zip(files, names, strict=True):
        if path.suffix.lower() not in SUFFIXES:
            raise InputError(f"{name}: expected one of {' '.join(SUFFIXES)}, got '{path.suffix}'")
        if len(files) > 1 and path.suffix.lower() in SINGLE_SUFFIXES:
            raise InputError(f"{name}: one of {len(files)} files of a pattern; name one recording at a time")
    match files[0].suffix.lower():
        case ".cih" | ".cihx" | ".mraw":
            from nerif.imaging.photron import PhotronFrames

            return PhotronFrames(files[0], names[0])
        case ".h5" | ".hdf5" | ".hdf":
            return Hdf5Frames(files[0], names[0], dataset)
        case ".npy" | ".npz":
            return ArrayFrames(files[0], names[0], dataset)
    return FileFrames(files, names)


class FileFrames(Frames):
    """Frames of image files, one or more in each."""

    def __init__(self, files: list[Path], names: list[str]) -> None:
        self._files, self._names = files, names
        self._places: list[tuple[int, int]] = []
        counts: list[int] = []
        for k, path in enumerate(files):
            if path.suffix.lower() in (".im7", ".vc7"):
                _lavision()
                counts.append(counts[0] if counts else _count(path))  # each file would have to be read to know
            else:
                counts.append(_count(path))
            self._places += [(k, i) for i in range(counts[-1])]
        self._counts = counts

    def __len__(self) -> int:
        return len(self._places)

    def name(self, i: int) -> str:
        k, inner = self._places[i]
        return self._names[k] if self._counts[k] == 1 else f"{self._names[k]} frame {inner}"

    def load(self, i: int) -> np.ndarray:
        k, inner = self._places[i]
        try:
            return _format(self._files[k]).read(self._files[k], inner)
        except InputError as error:  # which does not know the name
            raise InputError(f"{self.name(i)}: {error}") from None

    @cached_property
    def _known_bits(self) -> int | None:
        for path in self._files:
            try:
                return _format(path).bits(path)
            except Exception:  # of no interest here: reading it says what is wrong
                continue
        return None

    @property
    def known_bits(self) -> int | None:
        return self._known_bits


class Format(NamedTuple):
    """How files of one kind are read."""

    count: Callable[[Path], int]
    read: Callable[[Path, int], np.ndarray]
    bits: Callable[[Path], int | None]


def _count(path: Path) -> int:
    try:
        return max(1, _format(path).count(path))
    except Exception:  # counts as one frame, which says what is wrong when it is read
        return 1


@contextmanager
def _open_tiff(path: Path) -> Iterator[Any]:
    """A TIFF file; what its reader would log about damage is said by the error that follows."""
    import tifffile

    logger = logging.getLogger("tifffile")
    before, logger.disabled = logger.disabled, True
    try:
        with path.open("rb") as file, tifffile.TiffFile(file) as tiff:
            yield tiff
    finally:
        logger.disabled = before


def _count_tiff(path: Path) -> int:
    with _open_tiff(path) as tiff:
        return len(tiff.pages) + _breaks_off(tiff, path)


def _breaks_off(tiff: Any, path: Path) -> bool:
    """Whether the last page points at another one beyond the end of the file: tifffile leaves that out in silence."""
    handle, layout = tiff.filehandle, tiff.tiff
    order: Literal["little", "big"] = "little" if tiff.byteorder == "<" else "big"
    handle.seek(tiff.pages[-1].offset)
    tags = int.from_bytes(handle.read(layout.tagnosize), order)
    handle.seek(tags * layout.tagsize, 1)
    return int.from_bytes(handle.read(layout.offsetsize), order) >= path.stat().st_size


def _read_tiff(path: Path, i: int) -> np.ndarray:
    with _open_tiff(path) as tiff:
        if i >= len(tiff.pages):
            raise ValueError(f"the file ends after {len(tiff.pages)} frames")
        page = tiff.pages[i]
        if page.bitspersample < 8:
            raise _too_few_bits(page.bitspersample)
        planes_first = page.axes == "SYX"
        try:
            image = page.asarray()
        except (ValueError, NotImplementedError) as error:
            if "imagecodecs" not in str(error):
                raise
            return _read_tiff_by_opencv(path, i, page.bitspersample)
    return np.moveaxis(image, 0, -1) if planes_first else image


def _read_tiff_by_opencv(path: Path, i: int, bits: int) -> np.ndarray:
    """Compressed and packed files that tifffile leaves to another package; OpenCV moves packed bits to the top."""
    import cv2

    _, images = cv2.imreadmulti(str(path), start=i, count=1, flags=cv2.IMREAD_UNCHANGED)
    if not images:
        raise ValueError("neither tifffile nor OpenCV can decode it")
    image = np.asarray(images[0])
    return _as_rgb(np.right_shift(image, 16 - bits) if 8 < bits < 16 else image)


def _tiff_bits(path: Path) -> int | None:
    with _open_tiff(path) as tiff:
        page = tiff.pages[0]
        if 8 < page.bitspersample < 16:
            return page.bitspersample
        if page.bitspersample != 16:
            return None
        if match := re.search(r'SignificantBits="(\d+)"', tiff.ome_metadata or ""):
            return int(match[1])
        top = page.tags.valueof("MaxSampleValue")
        top = max(top) if isinstance(top, tuple) else top
    return {2**bits - 1: bits for bits in (9, 10, 11, 12, 13, 14, 15)}.get(top)


def _png_chunks(data: bytes) -> dict[bytes, bytes]:
    """The first chunk of each kind."""
    chunks: dict[bytes, bytes] = {}
    at = 8
    while at + 8 <= len(data):
        size, kind = int.from_bytes(data[at : at + 4]), data[at + 4 : at + 8]
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 12 + size
    return chunks


def _significant_bits(chunks: dict[bytes, bytes]) -> int | None:
    bits = max(chunks.get(b"sBIT", b"\0"))
    return bits if chunks[b"IHDR"][8] == 16 and 8 < bits < 16 else None


def _png_bits(path: Path) -> int | None:
    return _significant_bits(_png_chunks(path.read_bytes()))


def _read_png(path: Path, i: int) -> np.ndarray:
    import cv2

    data = path.read_bytes()
    chunks = _png_chunks(data)
    if not data.startswith(b"\x89PNG") or b"IEND" not in chunks:
        raise ValueError("no end of a PNG file" if data.startswith(b"\x89PNG") else "no PNG file")
    if (depth := chunks[b"IHDR"][8]) < 8:
        raise _too_few_bits(depth)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError("OpenCV cannot decode it")
    if bits := _significant_bits(chunks):  # the format wants them at the top
        image = np.right_shift(image, 16 - bits)
    return _as_rgb(image)


def _as_rgb(image: np.ndarray) -> np.ndarray:
    """OpenCV's order, B, G, R, turned round; without alpha."""
    return image[..., 2::-1] if image.ndim == 3 and image.shape[2] >= 3 else image


def _read_picture(path: Path, i: int) -> np.ndarray:
    from imageio import v3

    return v3.imread(path.read_bytes(), extension=path.suffix.lower())


def _too_few_bits(bits: int) -> InputError:
    return InputError(f"expected grey values of 8 to 16 bit, got {bits}-bit ones; export it with 8 or 16 bit")


def _lavision() -> Any:
    try:
        import lvpyio
    except ImportError:
        raise InputError(
            "LaVision files (.im7, .vc7): expected the package lvpyio, which is not installed; "
            "get it by pip install 'nerif[lavision]' (it is under LaVision's own terms)"
        ) from None
    return lvpyio


def _lavision_planes(path: Path) -> list[np.ndarray]:
    """Counts of all pictures in a file, frame by frame (camera, exposure), as stored: masks and scales are left out."""
    planes: list[np.ndarray] = []
    for frame in _lavision().read_buffer(str(path)):
        if "PIXEL" not in frame.components:
            raise InputError("expected pictures, got vectors; give the .im7 files they were computed from")
        planes += list(frame.components["PIXEL"].planes)
    return planes


def _count_lavision(path: Path) -> int:
    return len(_lavision_planes(path))


def _read_lavision(path: Path, i: int) -> np.ndarray:
    planes = _lavision_planes(path)
    if i >= len(planes):
        raise InputError(f"expected at least {i + 1} pictures as in the first file, got {len(planes)}")
    return np.asarray(planes[i])


TIFF = Format(_count_tiff, _read_tiff, _tiff_bits)
PICTURE = Format(lambda path: 1, _read_picture, lambda path: None)
LAVISION = Format(_count_lavision, _read_lavision, lambda path: None)
FORMATS = dict.fromkeys((".bmp", ".jpg", ".jpeg"), PICTURE) | dict.fromkeys((".im7", ".vc7"), LAVISION)
FORMATS |= {".tif": TIFF, ".tiff": TIFF, ".png": Format(lambda path: 1, _read_png, _png_bits)}


def _format(path: Path) -> Format:
    return FORMATS[path.suffix.lower()]


class ArrayFrames(Frames):
    """A NumPy array: of an .npy file, mapped, or one of an .npz file, read whole, as these cannot be read in parts."""

    def __init__(self, path: Path, name: str, dataset: str) -> None:
        try:
            if path.suffix.lower() == ".npy":
                arrays = {"array": np.load(path, mmap_mode="r", allow_pickle=False)}
            else:
                with path.open("rb") as file, np.load(file, allow_pickle=False) as found:
                    arrays = {key: found[key] for key in ([dataset] if dataset in found.files else found.files)}
        except Exception as error:
            raise InputError(f"{name}: cannot be read, truncated or damaged? ({error}); copy it again") from None
        key = _choose({k: a.ndim for k, a in arrays.items()}, dataset, name)
        self._array = arrays[key] if arrays[key].ndim == 3 else arrays[key][None]
        self._name = name
        if not len(self._array):
            raise InputError(f"{name}: expected one frame at least, got none")

    def __len__(self) -> int:
        return len(self._array)

    def name(self, i: int) -> str:
        return f"{self._name} frame {i}" if len(self) > 1 else self._name

    def load(self, i: int) -> np.ndarray:
        return np.array(self._array[i])


def _choose(dims: dict[str, int], wanted: str, name: str) -> str:
    """The dataset wanted, or the only one that can hold frames."""
    fitting = [key for key, n in dims.items() if n in (2, 3)]
    there = f"the file holds {', '.join(dims) or 'none'}"
    if wanted:
        if wanted not in dims:
            raise InputError(f"{name}:{wanted}: no such dataset; {there}")
        if wanted not in fitting:
            raise InputError(f"{name}:{wanted}: expected 2 or 3 dims (frame, row, column), got {dims[wanted]}")
        return wanted
    if len(fitting) != 1:
        raise InputError(
            f"{name}: expected one dataset of 2 or 3 dims, got {len(fitting)}; name it after ':' ({there})"
        )
    return fitting[0]


class Hdf5Frames(Frames):
    """A dataset (frame, row, column) or (row, column) of an HDF5 file.

    Times (s) may stand in its attribute `times` or in a dataset `times` beside it, effective bits in `bits`.
    """

    def __init__(self, path: Path, name: str, dataset: str) -> None:
        import h5py

        self._path, self._name = path, name
        try:
            with h5py.File(path, "r") as file:
                dims: dict[str, int] = {}
                file.visititems(lambda key, x: dims.update({key: x.ndim}) if isinstance(x, h5py.Dataset) else None)
                self._key = _choose(dims, dataset.strip("/"), name)
                data = file[self._key]
                self._stack, self._length = data.ndim == 3, len(data) if data.ndim == 3 else 1
                bits = data.attrs.get("bits")
                times = data.attrs.get("times", data.parent.get("times"))
                times = None if times is None else np.atleast_1d(np.array(times, dtype=float))
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"{name}: cannot be read as HDF5, truncated or damaged? ({error})") from None
        self._bits = None if bits is None else int(bits)
        if not self._length:
            raise InputError(f"{name}:{self._key}: expected one frame at least, got none")
        if times is not None and times.shape != (self._length,):
            raise InputError(f"{name}: expected {self._length} times, one for each frame, got shape {times.shape}")
        self.times = times

    def __len__(self) -> int:
        return self._length

    def name(self, i: int) -> str:
        return f"{self._name}:{self._key}" + (f" frame {i}" if self._stack else "")

    @property
    def known_bits(self) -> int | None:
        return self._bits

    def load(self, i: int) -> np.ndarray:
        import h5py

        with h5py.File(self._path, "r") as file:
            return file[self._key][i] if self._stack else file[self._key][()]
