"""Volumes of a result directory, or of a film frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

from nerif.common.conventions import STATISTICS, InputError
from nerif.common.files import ending
from nerif.data.quantity_names import INDEX
from nerif.data.velocity_sequence import open_volumes
from nerif.data.volume import Volume
from nerif.data.volume_file import read_volumes
from nerif.plotting.drawing import colour_range, plotted_values
from nerif.report.isosurface import default_level
from nerif.report.packing import coarsen
from nerif.report.volume_movie import finished_frames, ranges_over_time
from nerif.results.directory import VOLUME

__all__ = ["FilmVolumes", "ResultVolumes", "Source", "film_progress", "source_of"]

Limits = tuple[float, float]


class ResultVolumes:
    """A result directory."""

    def __init__(self, path: Path) -> None:
        self.path, self.times = path, (0.0,)
        self.frames: Sequence[int] = (0,)

    @property
    def _volumes(self) -> dict[str, Volume]:
        file = self.path / VOLUME
        if not file.is_file():
            raise InputError("the field is not available before the run has ended", field=self.path.name)
        return _read(str(file), file.stat().st_mtime_ns)

    @property
    def quantities(self) -> tuple[str, ...]:
        """Quantities to display: n only without its excess over ambient, standard deviations after their means."""
        return _display_names(self._volumes)

    def volume(self, quantity: str, frame: int = 0) -> Volume:
        """Return one quantity, averaged down if it is large."""
        volumes = self._volumes
        if quantity not in volumes:
            raise InputError(f"expected one of {', '.join(volumes)}, got '{quantity}'", field=self.path.name)
        return volumes[quantity]

    def limits(self, quantity: str) -> Limits:
        """Return the colour range."""
        return colour_range(plotted_values(self.volume(quantity)))

    def level(self, quantity: str) -> float:
        """Return the default level of the isosurface."""
        return default_level(self.volume(quantity))


class FilmVolumes:
    """A Zarr store of volumes over time, with at least one complete frame."""

    def __init__(self, path: Path) -> None:
        self.path = path
        store = open_volumes(path)
        self.times, self.frames = store.times, finished_frames(store)
        self.quantities = _display_names(store.quantities)
        if not self.frames:
            raise InputError("no frame is complete yet", field=path.name)

    @property
    def _stamp(self) -> int:
        return (self.path / "zarr.json").stat().st_mtime_ns

    def volume(self, quantity: str, frame: int = 0) -> Volume:
        """Return one quantity of a frame, averaged down if it is large."""
        return _frame(str(self.path), self._stamp, quantity, frame)

    def limits(self, quantity: str) -> Limits:
        """Return the colour range over all frames."""
        return _over_time(str(self.path), self._stamp, quantity, tuple(self.frames))[0]

    def level(self, quantity: str) -> float:
        """Return the default level of the isosurface over all frames."""
        return _over_time(str(self.path), self._stamp, quantity, tuple(self.frames))[1]


Source = ResultVolumes | FilmVolumes
"""Volumes of several quantities on one grid, at one or more instants."""


def source_of(path: Path) -> Source:
    """Open a result directory or a store over time."""
    return FilmVolumes(path) if ending(path) == ".zarr" else ResultVolumes(path)


def film_progress(path: Path) -> tuple[float, str]:
    """Return the fraction of complete frames of a film, and the count as text; 0 and empty before there is a store."""
    try:
        store = open_volumes(path)
    except (InputError, FileNotFoundError):  # incomplete
        return 0.0, ""
    done, count = len(finished_frames(store)), len(store)
    return done / max(count, 1), f"{done} of {count} frames"


def _display_names(quantities: Sequence[str] | dict[str, Volume]) -> tuple[str, ...]:
    names = [q for q in quantities if q.rpartition("_")[2] not in STATISTICS and (q != "n" or INDEX not in quantities)]
    return tuple(name for q in names for name in (q, f"{q}_std") if name in quantities)


@lru_cache(maxsize=6)
def _read(path: str, stamp: int) -> dict[str, Volume]:
    return {name: coarsen(volume) for name, volume in read_volumes(path).items()}


@lru_cache(maxsize=24)
def _frame(path: str, stamp: int, quantity: str, frame: int) -> Volume:
    return coarsen(open_volumes(path).volume(frame, quantity))


@lru_cache(maxsize=24)
def _over_time(path: str, stamp: int, quantity: str, frames: tuple[int, ...]) -> tuple[Limits, float]:
    return ranges_over_time(open_volumes(path), quantity, frames)
