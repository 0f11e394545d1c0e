"""A result directory: the names of its files, how each is written and read, and the message where one is missing."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from nerif import __version__
from nerif.common.conventions import InputError
from nerif.common.files import atomic, read_toml, write_json, write_toml
from nerif.common.written_files import WARN, OwnFiles, remove_empty
from nerif.data.exports import export
from nerif.data.measurement import Measurement
from nerif.data.meridian import Meridian
from nerif.data.reprojection import Reprojection
from nerif.data.volume import INDEX, Volume, field_of
from nerif.data.volume_file import read_volume, read_volumes
from nerif.fields.base import Field
from nerif.geometry import Box
from nerif.geometry.symmetry import Symmetry
from nerif.reconstruction import files as kept
from nerif.reconstruction.base import Reconstruction, State
from nerif.reconstruction.files import CHECKPOINT, FIELD, read_field, read_quantity, read_state

__all__ = [
    "CALIBRATION",
    "FIGURES",
    "METRICS",
    "REPORT",
    "RUN",
    "VOLUME",
    "Missing",
    "Result",
    "ResultDirectory",
    "glance",
    "versions",
]

RUN, METRICS, HISTORY, REPORT = "run.toml", "metrics.json", "history.csv", "report.html"
VOLUME, VOLUME_VTI, REPROJECTION = "volume.nc", "volume.vti", "reprojection.nc"
MERIDIAN, LIVE, LIVE_LOOK = ("meridian.nc", "meridian.csv"), "live.json", "live.npz"
TRIALS, CROSS_VALIDATION, FIGURES, CALIBRATION = "trials", "cross_validation", "figures", "calibration.toml"
FILES = (RUN, METRICS, HISTORY, FIELD, CHECKPOINT, VOLUME, VOLUME_VTI, REPROJECTION, REPORT, CALIBRATION)

RUN_HEAD = "# nerif reconstruct --config run.toml -o OTHER repeats this run\n"
UNREADABLE = (InputError, OSError, ValueError, KeyError, TypeError)

T = TypeVar("T")


@dataclass(frozen=True)
class Missing:
    """Something that is not there or cannot be read.

    Parameters
    ----------
    what : name of the file, or "truth"
    sentence : what follows from it, with the remedy
    """

    what: str
    sentence: str


@dataclass(frozen=True)
class Result:
    """What a result directory holds.

    Parameters
    ----------
    directory : where it was found
    settings : of run.toml; empty if missing
    about : the table [about] of run.toml: versions, outcome
    metrics : of metrics.json; empty if missing
    history : records of history.csv, blanks as NaN
    volumes : by quantity; with error bars also index_excess_std, density_std, ...
    reprojection : measured and predicted views, or None
    measurement : what was measured, or None
    truth : field it was compared with, an index relative to the ambient of the result, or None
    missing : what is not there or cannot be read
    """

    directory: Path
    settings: dict[str, Any] = field(default_factory=dict)
    about: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    history: list[dict[str, float]] = field(default_factory=list)
    volumes: dict[str, Volume] = field(default_factory=dict)
    reprojection: Reprojection | None = None
    measurement: Measurement | None = None
    truth: Volume | None = None
    missing: tuple[Missing, ...] = ()

    @property
    def field(self) -> Volume | None:
        """The reconstructed field, from which the other volumes follow."""
        return self.volumes.get(field_of(self.volumes) or "")

    @property
    def meridian(self) -> Meridian | None:
        """The quantities over (r, h) of a symmetric flow; None of any other."""
        axis = self.metrics.get("axis") if self.volumes else None
        return Meridian.of(self.volumes, Symmetry.from_entries(axis["symmetry"])) if axis else None

    @property
    def method(self) -> str:
        """Name of the method as a reader knows it."""
        names = {"nerif": "NeRIF", "tikhonov": "Tikhonov", "landweber": "Landweber", "tv": "total variation"}
        names |= {"mlem": "MLEM", "mart": "MART"}
        method = str(self.settings.get("method", "unknown method"))
        return names.get(method, method)


class ResultDirectory:
    """The directory a reconstruction is written to and read from; every file appears whole or not at all.

    Parameters
    ----------
    path : of the directory, which need not be there yet
    say : is given a line about each file of somebody else that is renamed or left; a warning by default
    """

    def __init__(self, path: str | os.PathLike[str], say: Callable[[str], None] = WARN) -> None:
        self.path = Path(path)
        self.files = OwnFiles(self.path, say)

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    def has(self, name: str) -> bool:
        """Whether a file of that name is there."""
        return (self.path / name).is_file()

    def check_free(self, force: bool = False) -> None:
        """Refuse a directory that holds anything, unless forced.

        Raises
        ------
        InputError
            If it does, or is a file.
        """
        if self.path.is_file():
            raise InputError("expected a directory for --out, got a file", field=self.path)
        if self.path.is_dir() and any(self.path.iterdir()) and not force:
            raise InputError(
                "exists already and was left as it is; give another --out, --force to overwrite, "
                "or --resume to go on with it",
                field=self.path,
            )

    # -- writing -------------------------------------------------------------------------------------------------

    def begin(self, settings: Mapping[str, Any], resume: bool = False) -> None:
        """Make the directory and keep the settings; what an earlier run has left is removed, unless it is resumed."""
        self.path.mkdir(parents=True, exist_ok=True)
        if not resume:
            self.clear()
        self.write_settings(settings)

    def clear(self) -> None:
        """Remove the files that this program wrote, and nothing else.

        What somebody else wrote under a name that a run needs is renamed; a calibration only once one is written.
        """
        of_a_run = (*FILES, *MERIDIAN, LIVE, LIVE_LOOK)
        self.files.remove(of_a_run)
        self.files.set_aside([name for name in of_a_run if name != CALIBRATION])
        if self.has(CALIBRATION):
            self.files.say(f"{self.path / CALIBRATION}: left as it is; this run did not write it")
        trials = self.path / TRIALS
        for folder in (*sorted(trials.glob("[0-9]*")), self.path / CROSS_VALIDATION, self.path / FIGURES):
            OwnFiles(folder, self.files.say).remove()
        remove_empty(trials)

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """Give the path to write a file of the result to; every one is written by this."""
        with self.files.writing(name) as path:
            yield path

    def write_settings(self, settings: Mapping[str, Any], about: Mapping[str, Any] | None = None) -> None:
        """Write run.toml: settings under the names of the flags, and what came out in the table [about]."""
        table = {**settings, "about": {"nerif": __version__, **(about or {})}}
        with self.writing(RUN) as path:
            write_toml(path, _without_none(table), RUN_HEAD)

    def write_field(self, result: Reconstruction) -> None:
        """Write the field and, where there is one, the checkpoint to go on from."""
        kept.write_field(self.path, result)
        if result.state is not None:
            kept.write_state(self.path, result.state)

    def write_history(self, history: Sequence[Mapping[str, float]]) -> None:
        """Write history.csv, a line a record, blank where a record lacks a column."""
        columns = list(dict.fromkeys(key for record in history for key in record))
        with self.writing(HISTORY) as path, atomic(path) as part, part.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns, restval="")
            writer.writeheader()
            writer.writerows(history)

    def write_metrics(self, entries: Mapping[str, Any]) -> None:
        """Write metrics.json afresh: scores of an earlier field do not stay."""
        with self.writing(METRICS) as path:
            write_json(path, entries)

    def add_metrics(self, entries: Mapping[str, Any]) -> None:
        """Add entries to metrics.json."""
        path = self.path / METRICS
        try:
            known = json.loads(path.read_text()) if path.is_file() else {}
        except ValueError:
            raise InputError("not a JSON file, or truncated; remove it and evaluate again", field=path) from None
        self.write_metrics({**known, **entries})

    def write_volumes(self, volumes: list[Volume]) -> None:
        """Write volume.nc and volume.vti."""
        for name in (VOLUME, VOLUME_VTI):
            with self.writing(name) as path:
                export(path, volumes)

    def write_meridian(self, meridian: Meridian) -> None:
        """Write meridian.nc and meridian.csv."""
        for name, write in zip(MERIDIAN, (meridian.write, meridian.write_csv), strict=True):
            with self.writing(name) as path:
                write(path)

    def write_reprojection(self, reprojection: Reprojection) -> None:
        """Write measured and predicted views."""
        with self.writing(REPROJECTION) as path:
            reprojection.write(path)

    # -- reading; each raises InputError where the file is missing or damaged --------------------------------------

    def field(self) -> tuple[Field, Box, float]:
        """Return the field, its box (mm) and n_ambient."""
        return read_field(self.path)

    def quantity(self) -> str:
        """Return what the field is (volume.QUANTITIES)."""
        return read_quantity(self.path)

    def state(self) -> State:
        """Return the checkpoint."""
        return read_state(self.path)

    def settings(self) -> dict[str, Any]:
        """Return run.toml as it is, with [about]; nothing where there is none."""
        return read_toml(self.path / RUN) if self.has(RUN) else {}

    def metrics(self) -> dict[str, Any]:
        """Return metrics.json, refused as a whole where a part is not what nerif writes."""
        path = self.path / METRICS
        try:
            return _checked(json.loads(path.read_text()))
        except FileNotFoundError:
            raise InputError(
                f"no such file; nerif evaluate {self.path} --measurement FILE adds it", field=path
            ) from None
        except ValueError as error:
            raise InputError(f"not a JSON file of nerif, or truncated ({error})", field=path) from None

    def history(self) -> list[dict[str, float]]:
        """Return the records of history.csv, blanks as NaN."""
        path = self.path / HISTORY
        with path.open(newline="") as file:
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
        """Return the directory of one trial of the bootstrap."""
        return ResultDirectory(self.path / TRIALS / f"{number:02d}", self.files.say)

    @property
    def cross_validation(self) -> ResultDirectory:
        """The directory of what was found while a view was kept out."""
        return ResultDirectory(self.path / CROSS_VALIDATION, self.files.say)

    def read(self) -> Result:
        """Read what there is, whole, half-finished or broken: what is missing is told in the Result, never fatal.

        Raises
        ------
        InputError
            If there is no such directory, or nothing of a reconstruction in it.
        """
        if not self.path.is_dir():
            raise InputError("no such directory; expected one written by nerif reconstruct", field=self.path)
        if not any((self.path / name).exists() for name in FILES if name != REPORT):
            known = ", ".join((RUN, METRICS, HISTORY, VOLUME, REPROJECTION))
            raise InputError(f"expected a result of nerif reconstruct, got none of {known} in it", field=self.path)
        finished = self.has(FIELD)
        missing: list[Missing] = []
        not_yet: list[str] = []

        def attempt(name: str, read: Callable[[], T], default: T, without: str) -> T:
            if not self.has(name):
                if finished:
                    missing.append(Missing(name, f"{name} is not there: {without}"))
                else:
                    not_yet.append(name)
                return default
            try:
                return read()
            except UNREADABLE as error:
                reason = " ".join(str(error).split()).replace(f"{self.path / name}: ", "")
                missing.append(Missing(name, f"{name} cannot be read ({reason}): {without}"))
                return default

        run: dict[str, Any] = attempt(RUN, self.settings, {}, "the settings are not known")
        metrics: dict[str, Any] = attempt(
            METRICS, self.metrics, {}, "how well the field meets the views is not known; nerif evaluate adds it"
        )
        history: list[dict[str, float]] = attempt(HISTORY, self.history, [], "there are no training curves")
        volumes: dict[str, Volume] = attempt(
            VOLUME, self.volumes, {}, "there is no field to show; nerif export writes it from the network"
        )
        views = attempt(
            REPROJECTION, self.reprojection, None, "the views cannot be shown; nerif evaluate --measurement FILE"
        )
        if not finished:
            go_on = "Start it again"
            if self.has(CHECKPOINT):
                go_on = f"Go on with nerif reconstruct --resume -o {self.path}"
            rest = f" Not there yet: {', '.join(not_yet)}." if not_yet else ""
            missing.insert(0, Missing(FIELD, f"The run has not ended: there is no {FIELD}. {go_on}.{rest}"))
        return Result(
            directory=self.path,
            settings={k: v for k, v in run.items() if k != "about"},
            about=run.get("about", {}),
            metrics=metrics,
            history=history,
            volumes=volumes,
            reprojection=views,
            measurement=_measurement(run) if views is None else views.measurement,
            truth=self._truth(metrics, volumes, missing),
            missing=tuple(missing),
        )

    def _truth(self, metrics: dict[str, Any], volumes: dict[str, Volume], missing: list[Missing]) -> Volume | None:
        """The truth it was compared with: where it was then, or beside the result if both have moved."""
        path = metrics.get("truth")
        if not isinstance(path, str):
            return None
        places = (Path(path), self.path / Path(path).name, self.path.parent / Path(path).name)
        try:
            found = field_of(volumes)
            path = next((p for p in places if p.is_file()), places[0])
            truth = read_volume(path, None if found in (None, INDEX) else found)
            ambient = volumes[INDEX].n_ambient if found == INDEX else None
            return truth if ambient is None else truth.relative_to(ambient)
        except InputError as error:
            missing.append(Missing("truth", f"The truth cannot be shown beside the field: {error}"))
            return None


def versions() -> dict[str, str]:
    """When and with what it was done."""
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
    """Settings as TOML has them: no word for nothing, paths as text."""
    if isinstance(value, Mapping):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [_without_none(v) for v in value]
    return str(value) if isinstance(value, Path) else value


def _measurement(run: dict[str, Any]) -> Measurement | None:
    """The measurement of the run, if it is still where it was."""
    try:
        return Measurement.read(str(run["measurement"]))
    except (InputError, KeyError):
        return None


def _checked(found: Any) -> dict[str, Any]:
    if not isinstance(found, dict):
        raise ValueError("expected a table of names and values")
    for name, known in (("views", "name"), ("slices", "z_mm")):
        rows = found.get(name, [])
        if not isinstance(rows, list) or not all(isinstance(row, dict) and known in row for row in rows):
            raise ValueError(f"'{name}' is not a list of tables with '{known}'")
    for name, known in (
        ("uncertainty", "members"), ("coverage", "share"), ("cross_validation", "views"),
    ):  # fmt: skip
        table = found.get(name, {known: 0})
        if not isinstance(table, dict) or known not in table:
            raise ValueError(f"'{name}' is not a table with '{known}'")
    first = found.get("cross_validation", {}).get("views") or []
    # older files knew displacements only
    for row in (*found.get("views", []), *first):
        for key, value in (("measured", "displacement"), ("unit", "px"), ("rms", row.get("rms_px"))):
            row.setdefault(key, value)
    return found


def _number(text: str | None) -> float:
    try:
        return float(text) if text else math.nan
    except ValueError:
        return math.nan


def glance(path: str | os.PathLike[str]) -> Result:
    """Return what a verdict rests on: settings, figures, and the volumes where there are standard deviations.

    Views and curves are not read, which makes it quick; files that cannot be read are listed in the Result.
    """
    directory, missing = ResultDirectory(path), []
    run: dict[str, Any] = {}
    metrics: dict[str, Any] = {}
    volumes: dict[str, Volume] = {}
    try:
        run = directory.settings()
        metrics = directory.metrics() if directory.has(METRICS) else {}
        if "uncertainty" in metrics and directory.has(VOLUME):
            volumes = directory.volumes()
    except UNREADABLE as error:
        missing.append(Missing(RUN, " ".join(str(error).split())))
    if not directory.has(FIELD):
        missing.append(Missing(FIELD, f"The run has not ended: there is no {FIELD}."))
    return Result(
        directory=directory.path,
        settings={k: v for k, v in run.items() if k != "about"},
        about=run.get("about", {}),
        metrics=metrics,
        volumes=volumes,
        missing=tuple(missing),
    )
