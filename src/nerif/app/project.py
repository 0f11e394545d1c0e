"""A project: a folder and its content, which is read again each time."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from nerif.cli.commands.info import is_measurement
from nerif.common.conventions import InputError
from nerif.imaging.readers.views import View, find_views
from nerif.results.directory import LIVE, RUN

__all__ = ["OWN", "Contents", "Project"]

DEEP = 3  # folders below the project in which is looked
MANY = 20_000  # entries that are looked at
OWN = ".nerif"

T = TypeVar("T")


@dataclass(frozen=True)
class Contents:
    """What a project holds, as paths relative to its folder, in the order of their names.

    Parameters
    ----------
    experiments : folders of images that have views
    calibrations : calibration files (.toml)
    measurements : measurement files (.nc)
    volumes : volume files (.nc, .vti) that are no part of a result
    results : result directories, those of runs that go on among them
    films : stores over time (.zarr)
    unread : what could not be looked into, and why
    """

    experiments: tuple[str, ...] = ()
    calibrations: tuple[str, ...] = ()
    measurements: tuple[str, ...] = ()
    volumes: tuple[str, ...] = ()
    results: tuple[str, ...] = ()
    films: tuple[str, ...] = ()
    unread: tuple[tuple[str, str], ...] = ()


class Project:
    """A folder, below which everything is read and written.

    Parameters
    ----------
    folder : of the project

    Raises
    ------
    InputError
        If it is not a folder.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder).resolve()
        if not self.folder.is_dir():
            got = "a file" if self.folder.exists() else "none"
            raise InputError(f"expected a folder to work in, got {got}", field=folder)
        self._cache: dict[tuple[str, str], tuple[tuple[int, int], object]] = {}

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.name or str(self.folder)

    @property
    def writable(self) -> bool:
        """Whether files may be written into the folder; where they may not, everything can still be looked at."""
        return os.access(self.folder, os.W_OK)

    def path(self, name: str | os.PathLike[str]) -> Path:
        """Return the path of something in the folder, whether it is there or not.

        Raises
        ------
        InputError
            If it is, or a link in it leads, outside of the folder.
        """
        if "\0" in str(name):
            raise InputError("expected the name of a file, got one with a zero in it", field="path")
        path = (self.folder / name).resolve()
        if not path.is_relative_to(self.folder):
            raise InputError(f"expected something in {self.folder}, got '{name}', which is outside of it", field="path")
        return path

    def relative(self, path: str | os.PathLike[str]) -> str:
        """Return a path in the folder relative to it, as the command line is given it."""
        return str(self.path(path).relative_to(self.folder))

    def free_name(self, stem: str, occupied: Collection[str] = ()) -> str:
        """Return the first of stem, stem-2, stem-3, ... that is not there, nor among the names `taken`."""
        first, ending = os.path.splitext(stem)
        names = (stem if i == 1 else f"{first}-{i}{ending}" for i in range(1, MANY))
        return next(name for name in names if name not in occupied and not self.path(name).exists())

    def views(self, experiment: str) -> tuple[View, ...]:
        """Return the views of a folder of images; InputError where there are none."""
        return find_views(self.path(experiment))

    def cached(self, name: str, what: str, read: Callable[[Path], T]) -> T:
        """Return what `read` makes of a file, kept until the file changes.

        Parameters
        ----------
        name : of the file
        what : of it is kept, such as "thumbnail"
        """
        path = self.path(name)
        outcome = path.stat()
        stamp, key = (outcome.st_mtime_ns, outcome.st_size), (str(path), what)
        memory = self._cache.get(key)
        if memory is None or memory[0] != stamp:
            memory = self._cache[key] = (stamp, read(path))
        return memory[1]  # type: ignore[return-value]

    def contents(self) -> Contents:
        """Look through the folder."""
        outcome: dict[str, list[str]] = {name: [] for name in Contents.__dataclass_fields__ if name != "unread"}
        unread: list[tuple[str, str]] = []
        for path in self._walk(self.folder, DEEP, [0], unread):
            name = str(path.relative_to(self.folder))
            try:
                if not path.resolve().is_relative_to(self.folder):
                    continue
                kind = self._kind(path)
            except OSError as error:
                unread.append((name, error.strerror or str(error)))
                continue
            except InputError as error:
                unread.append((name, str(error)))
                continue
            if kind:
                outcome[kind].append(name)
        return Contents(**{k: tuple(sorted(v)) for k, v in outcome.items()}, unread=tuple(unread))

    def _walk(self, folder: Path, deep: int, visible: list[int], unread: list[tuple[str, str]]) -> Iterator[Path]:
        """The folder itself, its files, and the folders in it that are no store or result themselves."""
        yield folder
        try:
            entries = sorted(os.scandir(folder), key=lambda e: e.name)
        except OSError as error:
            unread.append((str(folder.relative_to(self.folder)), error.strerror or str(error)))
            return
        for entry in entries:
            visible[0] += 1
            if entry.name.startswith(".") or visible[0] > MANY:
                continue
            path = Path(entry.path)
            if not entry.is_dir(follow_symlinks=False):
                yield path
            elif path.suffix == ".zarr" or _is_result(path):
                yield path
                yield from (p for p in (path / "measurement.nc",) if p.is_file())
            elif deep:
                yield from self._walk(path, deep - 1, visible, unread)

    def _kind(self, path: Path) -> str:
        """Name of the list of Contents that it belongs to; empty if to none."""
        if path.is_dir():
            if path.suffix == ".zarr":
                return "films"
            return "results" if _is_result(path) else "experiments" if _has_views(path) else ""
        if path.suffix == ".toml":
            return "calibrations" if self.cached(self.relative(path), "kind", _is_calibration) else ""
        if path.suffix == ".nc" and path.name != "reprojection.nc":
            measured = self.cached(self.relative(path), "kind", is_measurement)
            if measured:
                return "measurements"
        return "volumes" if path.suffix in (".nc", ".vti") and not _is_result(path.parent) else ""


def _is_result(path: Path) -> bool:
    return any((path / name).is_file() for name in (RUN, LIVE))


def _has_views(path: Path) -> bool:
    try:
        return bool(find_views(path))
    except InputError:  # nothing that nerif displacement could go by
        return False


def _is_calibration(path: Path) -> bool:
    with path.open("rb") as file:
        return b"nerif-calibration" in file.read(4096)
