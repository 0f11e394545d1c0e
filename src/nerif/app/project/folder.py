"""A project: a folder and the files in it."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

from nerif.common.conventions import InputError
from nerif.common.files import ending
from nerif.common.installation import word_of
from nerif.data.body_file import FORMATS
from nerif.data.kinds import CALIBRATION, VOLUME, are_vectors, kind_of
from nerif.imaging.readers.views import View, find_views
from nerif.results.directory import LIVE, RUN, check_links

__all__ = ["OWN", "Contents", "ProjectFolder"]

DEPTH = 3  # levels of folders that are searched
LIMIT = 20_000  # entries that are searched
OWN = ".nerif"
CACHED = {"measurement": 2, "image": 400}  # large entries; of others, which are a few lines each, LIMIT

T = TypeVar("T")


@dataclass(frozen=True)
class Contents:
    """Files of a project as paths relative to its folder, as a command takes them, sorted."""

    experiments: tuple[str, ...] = ()  #: folders of images that have views
    vectors: tuple[str, ...] = ()  #: folders of vectors of other programs
    calibrations: tuple[str, ...] = ()  #: calibration files (.toml)
    measurements: tuple[str, ...] = ()  #: measurement files (.nc)
    results: tuple[str, ...] = ()  #: result directories, also of current runs
    films: tuple[str, ...] = ()  #: stores over time (.zarr)
    models: tuple[str, ...] = ()  #: surfaces of bodies (.stl, .obj, .ply)


class ProjectFolder:
    """A folder; everything is read and written below it."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder).resolve()
        if not self.folder.is_dir():
            got = "a file" if self.folder.exists() else "none"
            raise InputError(f"expected a folder to work in, got {got}", field=folder)
        self._cache: dict[str, OrderedDict[Any, tuple[Any, Any]]] = {}
        self._lock = Lock()  # pages use the cache in threads

    @property
    def name(self) -> str:
        """Name of the folder, or its path if it has none."""
        return self.folder.name or str(self.folder)

    @property
    def is_result(self) -> bool:
        """Whether the folder itself is a result directory."""
        return _is_result(self.folder)

    def title(self, name: str) -> str:
        """Return the name of a file or folder for display: that of the project's folder instead of a dot."""
        return self.name if name == "." else name

    @property
    def writable(self) -> bool:
        """Whether files may be written into the folder."""
        return os.access(self.folder, os.W_OK)

    def path(self, name: str | os.PathLike[str]) -> Path:
        """Return the absolute path of a name; InputError if it, or a link in it, leads outside of the folder."""
        if "\0" in str(name):
            raise InputError("expected the name of a file, got one with a null character", field="path")
        path = (self.folder / name).resolve()
        if not path.is_relative_to(self.folder):
            raise InputError(f"expected something in {self.folder}, got '{name}', which is outside of it", field="path")
        return path

    def relative(self, path: str | os.PathLike[str]) -> str:
        """Return a path relative to the folder, as the command line takes it."""
        return word_of(self.path(path).relative_to(self.folder).as_posix())

    def free_name(self, stem: str, reserved: Collection[str] = ()) -> str:
        """Return the first of stem, stem-2, stem-3, ... that neither exists nor is in `reserved`."""
        first, ending = os.path.splitext(stem)
        names = (stem if i == 1 else f"{first}-{i}{ending}" for i in range(1, LIMIT))
        return next(name for name in names if name not in reserved and not self.path(name).exists())

    def views(self, experiment: str) -> tuple[View, ...]:
        """Return the views of a folder of images; InputError if there are none."""
        return find_views(self.path(experiment))

    def from_cache(self, name: str, what: str, read: Callable[[Path], T]) -> T:
        """Return `read` of a file, cached under `what` until the file changes, or many others have been used since."""
        path = self.path(name)
        status = path.stat()
        return self.cached(what, path, (status.st_mtime_ns, status.st_size), lambda: read(path))

    def cached(self, what: str, key: Any, stamp: Any, read: Callable[[], T]) -> T:
        """Return `read()`, cached until the stamp changes, or many others of the same sort have been used since."""
        with self._lock:
            cache = self._cache.setdefault(what, OrderedDict())  # least recently used first
            entry = cache.get(key)
        if entry is None or entry[0] != stamp:
            entry = (stamp, read())
        with self._lock:
            cache[key] = entry
            cache.move_to_end(key)
            while len(cache) > CACHED.get(what, LIMIT):
                cache.popitem(last=False)
        return entry[1]

    def contents(self) -> Contents:
        """Search the folder; what cannot be read is passed over."""
        names: dict[str, list[str]] = {name: [] for name in Contents.__dataclass_fields__}
        for path in self._walk(self.folder, DEPTH, [0]):
            with suppress(OSError, InputError):
                if path.resolve().is_relative_to(self.folder) and (kind := self._kind(path)):
                    names[kind].append(word_of(path.relative_to(self.folder).as_posix()))
        return Contents(**{kind: tuple(sorted(paths)) for kind, paths in names.items()})

    def _walk(self, folder: Path, depth: int, count: list[int]) -> Iterator[Path]:
        """Yield the folder, its files and its folders; stores and results are not searched further."""
        yield folder
        entries: list[os.DirEntry[str]] = []
        with suppress(OSError):
            entries = sorted(os.scandir(folder), key=lambda e: e.name)
        for entry in entries:
            count[0] += 1
            if entry.name.startswith(".") or count[0] > LIMIT:
                continue
            path = Path(entry.path)
            if not entry.is_dir(follow_symlinks=False):
                if path.is_file() or path.is_dir() or not path.exists():  # not a pipe, which would be waited for
                    yield path
            elif ending(path) == ".zarr" or _is_result(path):
                yield path
                yield from (p for p in (path / "measurement.nc",) if p.is_file())
            elif depth:
                yield from self._walk(path, depth - 1, count)

    def _kind(self, path: Path) -> str:
        """Name of the field of Contents that a path belongs to, empty if none."""
        if path.is_dir():
            if ending(path) == ".zarr":
                return "films"
            if _is_result(path):
                check_links(path)
                return "results"
            return "experiments" if _has_views(path) else "vectors" if are_vectors(kind_of(path)) else ""
        if ending(path) in FORMATS:
            return "models"
        if ending(path) == ".toml":
            return "calibrations" if self.from_cache(self.relative(path), "kind", kind_of) is CALIBRATION else ""
        named = ending(path) == ".nc" and path.name != "reprojection.nc"
        return "measurements" if named and self.from_cache(self.relative(path), "kind", kind_of) is not VOLUME else ""


def _is_result(path: Path) -> bool:
    return any((path / name).is_file() for name in (RUN, LIVE))


def _has_views(path: Path) -> bool:
    try:
        return bool(find_views(path))
    except InputError:
        return False
