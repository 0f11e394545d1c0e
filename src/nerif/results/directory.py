"""A result directory: its files, how each is written and read."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path, PureWindowsPath
from typing import Any, TypeVar

from nerif import __version__
from nerif.common.conventions import InputError
from nerif.common.files import atomic, is_near, read_toml, recorded, write_toml
from nerif.common.installation import command_line, word_of
from nerif.common.locks import LOCK, locked
from nerif.common.settings import with_present_names
from nerif.common.written_files import WARN, WRITTEN, OwnFiles, remove_empty
from nerif.data.kinds import RESULT, RUN, check_kind
from nerif.data.measurement import Measurement
from nerif.data.meridian import Meridian
from nerif.data.quantity_names import INDEX, field_of
from nerif.data.reprojection import Reprojection
from nerif.data.surface import SurfaceMap
from nerif.data.volume import Volume, export
from nerif.data.volume_file import read_volume, read_volumes
from nerif.fields.field import Field
from nerif.geometry import Box, Grid
from nerif.geometry.body import Body
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction import field_files
from nerif.reconstruction.field_files import CHECKPOINT, FIELD
from nerif.reconstruction.methods import METHODS
from nerif.reconstruction.reconstructor import Reconstruction, State, sampled
from nerif.reconstruction.rig_parameters import RefinedView
from nerif.results.metrics_file import Metrics

__all__ = [
    "CALIBRATION", "FIGURES", "METRICS", "REPORT", "RUN", "SURFACE", "VOLUME", "VOLUME_VTI", "Gap", "Result",
    "ResultDirectory", "check_links", "versions",
]  # fmt: skip

METRICS, HISTORY, REPORT = "metrics.json", "history.csv", "report.html"
VOLUME, VOLUME_VTI, REPROJECTION = "volume.nc", "volume.vti", "reprojection.nc"
MERIDIAN, LIVE, LIVE_FIELD = ("meridian.nc", "meridian.csv"), "live.json", "live.npz"
SURFACE = ("surface.nc", "surface.vtp")
TRIALS, CROSS_VALIDATION, FIGURES, CALIBRATION = "trials", "cross_validation", "figures", "calibration.toml"
FILES = (RUN, METRICS, HISTORY, FIELD, CHECKPOINT, VOLUME, VOLUME_VTI, REPROJECTION, REPORT, CALIBRATION)

RUN_HEAD = "# nerif reconstruct --config run.toml -o OTHER repeats this run\n"
UNREADABLE = (InputError, OSError, ValueError, KeyError, TypeError)

T = TypeVar("T")


@dataclass(frozen=True)
class Gap:
    """A missing or damaged file of a result."""

    name: str  #: of the file, or "truth"
    sentence: str  #: the consequence, and the remedy


@dataclass(frozen=True)
class Result:
    """The content of a result directory."""

    directory: Path  #: its path
    settings: dict[str, Any] = field(default_factory=dict)  #: of run.toml; empty if missing
    about: dict[str, Any] = field(default_factory=dict)  #: the table [about] of run.toml: versions, outcome
    metrics: Metrics = field(default_factory=Metrics)  #: of metrics.json; all empty if missing
    history: list[dict[str, float]] = field(default_factory=list)  #: records of history.csv, blanks as NaN
    volumes: dict[str, Volume] = field(default_factory=dict)
    """By quantity; with standard deviations also index_excess_std, density_std, ..."""
    reprojection: Reprojection | None = None  #: measured and predicted views, or None
    measurement: Measurement | None = None  #: or None
    truth: Volume | None = None  #: field it was compared with, an index relative to the ambient of the result, or None
    surface: SurfaceMap | None = None  #: quantities on the surface of bodies, or None
    missing: tuple[Gap, ...] = ()  #: files that are missing or damaged

    @property
    def field(self) -> Volume | None:
        """The reconstructed field, from which the other volumes follow."""
        return self.volumes.get(field_of(self.volumes) or "")

    @property
    def meridian(self) -> Meridian | None:
        """The quantities of a symmetric flow over (r, h); None for other flows."""
        axis = self.metrics.axis if self.volumes else None
        return Meridian.of(self.volumes, Symmetry.from_entries(axis["symmetry"])) if axis else None

    @property
    def method(self) -> str:
        """Name of the method, as printed."""
        method = str(self.settings.get("method", "unknown method"))
        return METHODS[method].title if method in METHODS else method


def check_links(directory: Path) -> None:
    """Raise an InputError if a link of a result, which may come from another person, leads out of its directory."""
    names = (*FILES, *MERIDIAN, *SURFACE, LIVE, LIVE_FIELD, WRITTEN, "tensorboard", CROSS_VALIDATION, FIGURES, TRIALS)
    for path in (*(directory / name for name in names), *(directory / TRIALS).glob("[0-9]*")):
        if path.is_symlink() and not path.resolve().is_relative_to(directory.resolve()):
            raise InputError(f"is a link that leads out of {directory}; put what it leads to in its place", field=path)


class ResultDirectory:
    """The directory of a reconstruction; files are written atomically.

    Parameters
    ----------
    path : of the directory, which need not exist; InputError if a link in it leads out of it
    say : called with a line about each foreign file that is renamed or left; a warning by default
    """

    def __init__(self, path: str | os.PathLike[str], say: Callable[[str], None] = WARN) -> None:
        self.path = Path(path)
        self.files = OwnFiles(self.path, say)
        self.begun = False  # whether `begin` has prepared it
        check_links(self.path)

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    def has(self, name: str) -> bool:
        """Whether a file exists."""
        return (self.path / name).is_file()

    def check_free(self, force: bool = False) -> None:
        """Raise an error for a file or, unless forced, a directory that is not empty."""
        if self.path.is_file():
            raise InputError("expected a directory for --out, got a file", field=self.path)
        if self.path.is_dir() and any(entry.name != LOCK for entry in self.path.iterdir()) and not force:
            raise InputError(
                "exists already; give another --out, --force to overwrite it, or --resume to continue the run",
                field=self.path,
            )

    # -- writing -------------------------------------------------------------------------------------------------

    def locked(self) -> AbstractContextManager[None]:
        """Return a context in which no other run writes into the directory; InputError if one does."""
        if self.path.is_file():
            self.check_free()
        return locked(self.path, inside=True)

    def begin(self, settings: Mapping[str, Any], resume: bool = False) -> None:
        """Make the directory, remove the files of an earlier run unless resumed, and write the settings."""
        self.path.mkdir(parents=True, exist_ok=True)
        if not resume:
            self.clear()
        self.write_settings(settings)
        self.begun = True

    def clear(self) -> None:
        """Remove the files of an earlier run; foreign files with names that a run needs are renamed.

        A foreign calibration is renamed only when one is written.
        """
        names = (*FILES, *MERIDIAN, *SURFACE, LIVE, LIVE_FIELD)
        self.files.remove(names)
        self.files.set_aside([name for name in names if name != CALIBRATION])
        if self.has(CALIBRATION):
            self.files.say(f"{self.path / CALIBRATION}: not written by this run, and left unchanged")
        trials = self.path / TRIALS
        for folder in (*sorted(trials.glob("[0-9]*")), self.path / CROSS_VALIDATION, self.path / FIGURES):
            OwnFiles(folder, self.files.say).remove()
        remove_empty(trials)

    def writing(self, name: str) -> AbstractContextManager[Path]:
        """Return a context with the path to write a file of the result to."""
        return self.files.writing(name)

    def write_settings(self, settings: Mapping[str, Any], about: Mapping[str, Any] | None = None) -> None:
        """Write run.toml: settings under the names of the options, outcome and versions in the table [about]."""
        table = {**settings, "about": {"nerif": __version__, **(about or {})}}
        with self.writing(RUN) as path:
            write_toml(path, _without_none(table), RUN_HEAD)

    def write_field(self, result: Reconstruction) -> None:
        """Write the field and, if any, the checkpoint."""
        field_files.write_field(self.path, result)
        if result.state is not None:
            field_files.write_state(self.path, result.state)

    def write_history(self, history: Sequence[Mapping[str, float]]) -> None:
        """Write history.csv, one line per record; columns missing in a record are blank."""
        columns = list(dict.fromkeys(key for record in history for key in record))
        with self.writing(HISTORY) as path, atomic(path) as part, part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, columns, restval="")
            writer.writeheader()
            writer.writerows(history)

    def write_metrics(self, metrics: Metrics) -> None:
        """Write metrics.json."""
        with self.writing(METRICS) as path:
            metrics.write(path)

    def add_metrics(self, **sections: Any) -> None:
        """Replace sections of metrics.json, which is made if there is none."""
        with locked(self.path / METRICS, wait=True):  # nerif evaluate may do the same during a run
            present = self.metrics() if self.has(METRICS) else Metrics()
            self.write_metrics(replace(present, **sections))

    def write_volumes(self, volumes: list[Volume]) -> None:
        """Write volume.nc and volume.vti."""
        for name in (VOLUME, VOLUME_VTI):
            with self.writing(name) as path:
                export(path, volumes, force=True)

    def write_meridian(self, meridian: Meridian) -> None:
        """Write meridian.nc and meridian.csv."""
        for name, write in zip(MERIDIAN, (meridian.write, meridian.write_csv), strict=True):
            with self.writing(name) as path:
                write(path)

    def write_surface(self, surface: SurfaceMap) -> None:
        """Write surface.nc and surface.vtp."""
        for name in SURFACE:
            with self.writing(name) as path:
                surface.write(path)

    def write_reprojection(self, reprojection: Reprojection) -> None:
        """Write measured and predicted views."""
        with self.writing(REPROJECTION) as path:
            reprojection.write(path)

    # -- reading; each raises InputError where the file is missing or damaged --------------------------------------

    def field(self) -> tuple[Field, Box, float]:
        """Return the field, its box (mm) and n_ambient."""
        return field_files.read_field(self.path)

    def bodies(self) -> tuple[Body, ...]:
        """Return the bodies in the flow."""
        return field_files.read_bodies(self.path)

    def sample(self, grid: Grid) -> Volume:
        """Return the field at the voxel centres of a grid, NaN within bodies."""
        field, _, n_ambient = self.field()
        return sampled(field, grid, self.quantity(), n_ambient, self.bodies())

    def quantity(self) -> str:
        """Return the quantity of the field (volume.QUANTITIES)."""
        return field_files.read_quantity(self.path)

    def rig(self) -> list[RefinedView]:
        """Return the corrections of the cameras; none if they were not refined."""
        return field_files.read_rig(self.path)

    def state(self) -> State:
        """Return the checkpoint."""
        return field_files.read_state(self.path)

    def settings(self) -> dict[str, Any]:
        """Return run.toml with [about]; empty if there is none."""
        return with_present_names(read_toml(self.path / RUN)) if self.has(RUN) else {}

    def metrics(self) -> Metrics:
        """Return metrics.json."""
        path = self.path / METRICS
        if not self.has(METRICS):
            words = ["evaluate", word_of(self.path), "--measurement", "FILE"]
            raise InputError(f"missing; {command_line(words)} writes it", field=path)
        return Metrics.read(path)

    def history(self) -> list[dict[str, float]]:
        """Return the records of history.csv, blanks as NaN."""
        path = self.path / HISTORY
        with path.open(newline="", encoding="utf-8") as file:
            rows = [{k: _number(v) for k, v in row.items() if k is not None} for row in csv.DictReader(file)]
        if rows and not {"seconds", "step"} & set(rows[0]):
            raise InputError(f"expected columns 'seconds' or 'step', got {', '.join(list(rows[0])[:5])}", field=path)
        return rows

    def volumes(self) -> dict[str, Volume]:
        """Return the quantities of volume.nc."""
        return read_volumes(self.path / VOLUME)

    def reprojection(self) -> Reprojection:
        """Return measured and predicted views."""
        return Reprojection.read(self.path / REPROJECTION)

    def member(self, number: int) -> ResultDirectory:
        """Return the directory of one bootstrap trial."""
        return ResultDirectory(self.path / TRIALS / f"{number:02d}", self.files.say)

    @property
    def cross_validation(self) -> ResultDirectory:
        """The directory of the run without a view."""
        return ResultDirectory(self.path / CROSS_VALIDATION, self.files.say)

    def read(self, views: bool = True, reprojection: Reprojection | None = None) -> Result:
        """Read a result, complete or not; missing and damaged files are listed in it.

        Parameters
        ----------
        views : False to read only what a verdict needs, which is faster: settings, metrics, and the volumes if they
            have standard deviations
        reprojection : content of its file, if it is in memory
        """
        if not any((self.path / name).exists() for name in (*FILES, LIVE) if name != REPORT):
            check_kind(self.path, RESULT)
            if not self.path.is_dir():
                raise InputError("no such directory; expected one written by nerif reconstruct", field=self.path)
            names = ", ".join((RUN, METRICS, HISTORY, VOLUME, REPROJECTION))
            raise InputError(f"expected a result of nerif reconstruct, got none of {names} in it", field=self.path)
        finished = self.has(FIELD)
        gaps: list[Gap] = []
        pending: list[str] = []

        def attempt(name: str, read: Callable[[], T], default: T, consequence: str) -> T:
            if not self.has(name):
                if finished:
                    gaps.append(Gap(name, f"{name} is missing: {consequence}"))
                else:
                    pending.append(name)
                return default
            try:
                return read()
            except UNREADABLE as error:
                reason = " ".join(str(error).split()).replace(f"{self.path / name}: ", "")
                gaps.append(Gap(name, f"{name} cannot be read ({reason}): {consequence}"))
                return default

        run: dict[str, Any] = attempt(RUN, self.settings, {}, "no settings")
        metrics = attempt(
            METRICS, self.metrics, Metrics(), "no comparison with the views; nerif evaluate --measurement FILE adds it"
        )
        parts: dict[str, Any] = {"volumes": {}, "history": []}
        if views:
            parts["history"] = attempt(HISTORY, self.history, parts["history"], "no convergence curves")
        if views or metrics.uncertainty:
            consequence = "no field to show; nerif export writes it"
            parts["volumes"] = attempt(VOLUME, self.volumes, parts["volumes"], consequence)
        if views:
            consequence = "no views to show; nerif evaluate --measurement FILE adds them"
            read = self.reprojection if reprojection is None else lambda: reprojection
            parts["reprojection"] = predicted = attempt(REPROJECTION, read, None, consequence)
            parts["measurement"] = self._measurement(run) if predicted is None else predicted.measurement
            if self.has(name := SURFACE[0]):
                parts["surface"] = attempt(name, lambda: SurfaceMap.read(self / name), None, "no surface to show")
            parts["truth"] = self._truth(metrics, parts["volumes"], gaps)
        if not finished:
            remedy = "Start it again"
            if self.has(CHECKPOINT):
                remedy = f"Continue with {command_line(['reconstruct', '--resume', '-o', word_of(self.path)])}"
            rest = f" Not written yet: {', '.join(pending)}." if pending else ""
            gaps.insert(0, Gap(FIELD, f"The run has not ended: there is no {FIELD}. {remedy}.{rest}"))
        about = run.pop("about", {})
        return Result(self.path, settings=run, about=about, metrics=metrics, **parts, missing=tuple(gaps))

    def _truth(self, metrics: Metrics, volumes: dict[str, Volume], gaps: list[Gap]) -> Volume | None:
        """The truth of an evaluation, at its path or, if both were moved, beside the result."""
        if metrics.truth is None:
            return None
        path, name = Path(metrics.truth), PureWindowsPath(metrics.truth).name  # with / or \\ between folders
        places = (path, self.path / name, self.path.parent / name)
        try:
            quantity = field_of(volumes)
            path = next((p for p in places if is_near(p, self.path) and p.is_file()), None) or recorded(path, self.path)
            truth = read_volume(path, None if quantity in (None, INDEX) else quantity, gaps=True)
            ambient = volumes[INDEX].n_ambient if quantity == INDEX else None
            return truth if ambient is None else truth.relative_to(ambient)
        except InputError as error:
            gaps.append(Gap("truth", f"The truth cannot be shown: {error}"))
            return None

    def _measurement(self, run: dict[str, Any]) -> Measurement | None:
        try:
            return Measurement.read(recorded(str(run["measurement"]), self.path))
        except (InputError, KeyError):
            return None


def versions() -> dict[str, str]:
    """Return the time, and versions of the software."""
    import platform

    import numpy as np
    import torch

    return {
        "finished": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "machine": f"{platform.system()} {platform.machine()}, up to {torch.get_num_threads()} threads",
    }


def _without_none(value: Any) -> Any:
    """Settings for TOML, which has no null: None is dropped, paths become text."""
    if isinstance(value, Mapping):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [_without_none(v) for v in value]
    return str(value) if isinstance(value, Path) else value


def _number(text: str | None) -> float:
    try:
        return float(text) if text else math.nan
    except ValueError:
        return math.nan
