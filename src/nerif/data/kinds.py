"""Kinds of files and folders: how each is recognised, and the command that takes it.

Readers open them within `reading_as`: the error for a file of another kind names that kind and its command.
"""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from nerif.common.conventions import InputError
from nerif.common.files import ending, read_json
from nerif.common.hdf5 import open_hdf5
from nerif.common.image_names import ARRAYS as NUMPY_AND_HDF5
from nerif.common.image_names import FOLDER_SUFFIXES, SOURCES, SUFFIXES
from nerif.common.installation import quoted, word_of
from nerif.common.netcdf import opened
from nerif.forward.registry import TECHNIQUES

__all__ = [
    "ARRAYS", "BOST", "CALIBRATION", "EXPERIMENT", "FIELD", "IMAGES", "MEASUREMENT", "RESULT", "RUN", "SEQUENCE",
    "SEQUENCE_KIND", "SEQUENCE_RESULT", "TRUE_SEQUENCE", "VELOCITY", "VELOCITY_KIND", "VOLUME", "Kind", "are_vectors",
    "check_kind", "kind_of", "known_conventions", "reading_as", "vector_program",
]  # fmt: skip

BOST = ("BOST-1.0", "BOST-1.1", "BOST-1.2", "BOST-1.3")
"""Attribute Conventions of measurements: with the content of version 1.0, with more, with bodies, with interfaces."""
RUN, FIELD = "run.toml", "field.safetensors"
"""Settings and field of a result directory."""
SEQUENCE_KIND = "nerif sequence 1"
"""Attribute `kind` of the result of nerif sequence."""
VELOCITY_KIND = "nerif velocity 1"
"""Attribute `kind` of velocities over time."""
CALIBRATION_MARK = b"nerif-calibration"
MAX_HEAD = 4096  # bytes of a text in which its mark is searched
ARRAY_SUFFIXES = (*NUMPY_AND_HDF5, ".mat")  # HDF5 may also be NetCDF-4


def are_vectors(kind: Kind | None) -> bool:
    """Return whether a kind is that of vectors, of whatever program."""
    return kind is not None and kind.use == VECTORS.use


def known_conventions(conventions: object) -> bool:
    """Return whether an attribute Conventions is that of a measurement."""
    return isinstance(conventions, str) and conventions in BOST


@dataclass(frozen=True)
class Kind:
    """A kind of file or folder."""

    name: str  #: in words, with article
    use: str  #: what to do with it, with the command; {path} and {parent} stand for it and its folder


DISPLACEMENT = "nerif displacement {} --calibration calibration.toml -o m.nc"
MEASUREMENT = Kind("a measurement (.nc)", "reconstruct it: nerif reconstruct {path} -o RESULT")
VOLUME = Kind(
    "a volume (.nc, .vti)",
    "describe it: nerif info {path}, or compare a result with it: nerif evaluate RESULT --truth {path}",
)
RESULT = Kind(
    "the result of one reconstruction (a folder)",
    "show it: nerif report {path} or nerif figures {path}; other formats: nerif export {path} -o NAME.vti",
)
SEQUENCE = Kind("a measurement sequence (.zarr)", "reconstruct its frames: nerif sequence {path} -o NAME.zarr")
SEQUENCE_RESULT = Kind(
    "the result of nerif sequence (.zarr)", "show it: nerif movie {path} -o NAME.mp4 or nerif report {path}"
)
VELOCITY = Kind("velocity over time (.zarr)", "show it: nerif movie {path} -o NAME.mp4 or nerif report {path}")
TRUE_SEQUENCE = Kind(
    "true fields over time (.zarr)",
    "show them: nerif movie {path} -o NAME.mp4, or compare a result: nerif evaluate RESULT.zarr --truth {path}",
)
EXPERIMENT = Kind("the images of an experiment (a folder)", f"compute displacements: {DISPLACEMENT.format('{path}')}")
VIEW = Kind("the images of one view (a folder)", f"name the folder of all views: {DISPLACEMENT.format('{parent}')}")
VIEWS = Kind("the list of views of an experiment", f"name its folder: {DISPLACEMENT.format('{parent}')}")
IMAGES = Kind("images", f"put them into FOLDER/VIEW/reference and FOLDER/VIEW/flow: {DISPLACEMENT.format('FOLDER')}")
ARRAYS = Kind(
    "plain arrays", f"of images: {DISPLACEMENT.format('FOLDER')}; of displacements: nerif.Measurement in Python"
)
CONVERT = (
    'python -c "import sys, xarray as x; x.%s(sys.argv[1], decode_times=False).drop_encoding().to_zarr(sys.argv[2], '
    'zarr_format=3, consolidated=False)" {path} NAME.zarr'
)
FILM_FILE = Kind("a film as one NetCDF file", f"make it a store: {CONVERT % 'open_dataset'}")
FORMAT_2 = Kind(
    "a store of Zarr format 2", f"if you trust it (its filters can run code), convert it: {CONVERT % 'open_zarr'}"
)
ZIPPED = Kind("a zipped store", "unpack it: python -m zipfile -e {path} .")
ZIPPED_CONTENT = Kind("a zipped store", "unpack it: python -m zipfile -e {path} NAME.zarr")
CALIBRATION = Kind("a calibration", "nerif displacement FOLDER --calibration {path} -o m.nc uses it")
VECTORS = Kind(
    "vectors of another program",
    "put them into FOLDER/VIEW, and read them: nerif vectors FOLDER --calibration calibration.toml -o m.nc",
)
PROGRAMS = {
    "Dynamic Studio": r"^>>\*HEADER\*<<|^FileID:DSExport", "Insight": r"\"CHC\"|TSI",
    "PIVlab": r"^(# )?PIVlab |\"isNaN\"|px/frame",
    "DaVis": r"^#\w+ [\d.]+ [23]D-vector|^TITLE *= *\"B\d{5}|\"isValid\"", "OpenPIV": r"^# *x\s+y\s+u\s+v",
}  # fmt: skip
"""Marks of programs in the first lines of vectors that they write as text."""
NERIF = 'TITLE = "nerif"'  # an export
DAVIS = (".vc7", ".v7")
PIVLAB = {"u_original", "u_filtered", "typevector_original", "resultslist"}
PIVVIEW = {"piv_data", "piv_flags"}
"""Endings of DaVis, variables of the files of PIVlab (.mat) and PIVview (.nc)."""
SETTINGS = Kind("the settings of a run", "repeat it: nerif reconstruct --config {path} -o RESULT")


def kind_of(path: str | os.PathLike[str]) -> Kind | None:
    """Return the kind of a file or folder; None if it does not exist, is damaged, or none of these."""
    path = Path(path)
    try:
        return _of_folder(path) if path.is_dir() else _of_file(path) if path.is_file() else None
    except (InputError, OSError):
        return None


def check_kind(path: str | os.PathLike[str], *wanted: Kind, ignore: tuple[Kind, ...] = ()) -> None:
    """Raise an InputError for a path of another kind, with the command that takes it.

    None is raised if the kind is unknown or one of `ignore`.
    """
    kind, path = kind_of(path), Path(path)
    if kind is not None and kind not in (*wanted, *ignore):
        use = kind.use.format(path=quoted(word_of(path)), parent=quoted(word_of(path.parent)))
        *names, last = (k.name for k in wanted)
        expected = f"{', '.join(names)} or {last}" if names else last
        raise InputError(f"expected {expected}, got {kind.name}; {use}", field=path)


@contextmanager
def reading_as(path: str | os.PathLike[str], *wanted: Kind, ignore: tuple[Kind, ...] = ()) -> Iterator[None]:
    """Read a file or folder; if that fails and it is of another kind, raise the error of `check_kind` instead."""
    try:
        yield
    except InputError:
        check_kind(path, *wanted, ignore=ignore)
        raise


def _of_folder(path: Path) -> Kind | None:
    if (path / "zarr.json").is_file():
        return _of_store(path / "zarr.json")
    names = {entry.name.lower() for entry in path.iterdir()}
    if names & {".zgroup", ".zmetadata"}:
        return FORMAT_2
    if names & {RUN, FIELD}:
        return RESULT
    if "views.toml" in names or any(_is_view(entry) for entry in path.iterdir() if entry.is_dir()):
        return EXPERIMENT
    if _is_view(path):
        return VIEW
    if any(name.endswith(FOLDER_SUFFIXES) for name in names):
        return IMAGES
    folders = [path, *sorted(entry for entry in path.iterdir() if entry.is_dir())]
    firsts = (next((entry for entry in sorted(folder.iterdir()) if entry.is_file()), None) for folder in folders[:2])
    return next((kind for file in firsts if file is not None and (kind := _vectors(file)) is not None), None)


def _is_view(folder: Path) -> bool:
    """Whether a folder has images without and with flow, or of a target."""
    stems = {entry.name if entry.is_dir() else entry.stem for entry in folder.iterdir()}
    return bool({stem.lower() for stem in stems} & {*SOURCES} - {"mask", "region"})


def _of_store(metadata: Path) -> Kind | None:
    try:
        attributes = read_json(metadata)["attributes"]
    except (ValueError, KeyError, TypeError):
        return None
    if known_conventions(attributes.get("Conventions")):
        return SEQUENCE
    if attributes.get("kind") == SEQUENCE_KIND:
        return SEQUENCE_RESULT
    if attributes.get("kind") == VELOCITY_KIND:
        return VELOCITY
    return TRUE_SEQUENCE if "box_lower_mm" in attributes else None


def _of_file(path: Path) -> Kind | None:
    suffix = ending(path)
    if suffix == ".vti":
        return VOLUME
    if suffix == ".toml":
        with path.open("rb") as file:
            mark = CALIBRATION_MARK in file.read(MAX_HEAD)
        return CALIBRATION if mark else {"views.toml": VIEWS, RUN: SETTINGS}.get(path.name.lower())
    if suffix in SUFFIXES and suffix not in (*ARRAY_SUFFIXES, *DAVIS):
        return IMAGES
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            heads = [name for name in archive.namelist() if name.endswith(("zarr.json", ".zgroup"))]
        if heads:
            return ZIPPED if min(name.count("/") for name in heads) else ZIPPED_CONTENT
    try:
        with opened(path, "a measurement or a volume") as dataset:
            maps = any(kind.measured in dataset for kind in TECHNIQUES.values())
            if any(variable.dims[:1] == ("time",) and variable.ndim > 2 for variable in dataset.variables.values()):
                return FILM_FILE
            if maps or known_conventions(dataset.attrs.get("Conventions")):
                return MEASUREMENT
            if {"x", "y", "z"} <= set(dataset.coords):
                return VOLUME
            if PIVVIEW & set(dataset.variables):
                return replace(VECTORS, name="vectors of PIVview")
            if {"u", "v"} <= set(dataset.variables):
                return VECTORS
    except InputError:
        pass
    if (vectors := _vectors(path)) is not None:
        return vectors
    return ARRAYS if suffix in ARRAY_SUFFIXES else None


def _vectors(path: Path) -> Kind | None:
    """Return the kind of a file of vectors, with the program that wrote it if known; None for any other file."""
    program, suffix = "", ending(path)
    if suffix in DAVIS:
        program = "DaVis"
    elif suffix == ".mat":
        names = _matlab_names(path)
        if not (PIVLAB & names or {"x", "y", "u", "v"} <= names):
            return None
        program = "PIVlab" if PIVLAB & names else ""
    elif suffix in (".txt", ".dat", ".csv", ".vec"):
        with path.open("rb") as file:
            head = file.read(MAX_HEAD)
        text = head.decode("latin-1")
        if NERIF in text:
            return None
        program = vector_program(text)
        if not (program or _are_vectors(text.splitlines()[:10])):
            return None
    else:
        return None
    return replace(VECTORS, name=f"vectors of {program}") if program else VECTORS


def vector_program(head: str) -> str:
    """Return the program that wrote vectors as text, by their first lines; "" if unknown."""
    return next((name for name, mark in PROGRAMS.items() if re.search(mark, head, re.MULTILINE)), "")


def _are_vectors(lines: list[str]) -> bool:
    """Return whether lines name the columns x, y, u, v, or begin with four to seven numbers, as older OpenPIV."""
    rows = [re.sub(r"\[.*?\]|\(.*?\)|[\",;]", " ", line).lower().split() for line in lines]
    if any({"x", "y"} <= {*row} and ({"u", "v"} <= {*row} or {"vx", "vy"} <= {*row}) for row in rows):
        return True
    try:
        return 4 <= len([float(word) for row in rows[:1] for word in row]) <= 7
    except ValueError:
        return False


def _matlab_names(path: Path) -> set[str]:
    """Names of the variables of a MATLAB file; none of one that cannot be read."""
    import h5py
    import scipy.io

    try:
        if h5py.is_hdf5(path):
            with open_hdf5(path) as file:
                return set(file)
        return {name for name, *_ in scipy.io.whosmat(str(path))}
    except Exception:  # of SciPy and h5py, of many kinds
        return set()
