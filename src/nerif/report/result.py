"""A result directory as it is found: whole, half-finished or broken. What is missing is told, never fatal."""

from __future__ import annotations

import csv
import json
import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from nerif.conventions import InputError
from nerif.measurement import Measurement
from nerif.reconstruction.files import CHECKPOINT, FIELD
from nerif.reprojection import REPROJECTION, Reprojection
from nerif.volume import Volume, read_volume, read_volumes

__all__ = ["FIGURES", "HISTORY", "METRICS", "REPORT", "RUN", "VOLUME", "Missing", "Result", "read_result"]

RUN, METRICS, HISTORY, VOLUME, REPORT = "run.toml", "metrics.json", "history.csv", "volume.nc", "report.html"
FIGURES = "figures"

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
    volumes : by quantity; with an ensemble also index_excess_mean, index_excess_std, ...
    reprojection : measured and predicted views, or None
    measurement : what was measured, or None
    truth : index excess it was compared with, or None
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
    def method(self) -> str:
        """Name of the method as a reader knows it."""
        names = {"nerif": "NeRIF", "tikhonov": "Tikhonov", "landweber": "Landweber", "tv": "total variation"}
        method = str(self.settings.get("method", "unknown method"))
        return names.get(method, method)


def read_result(directory: Path) -> Result:
    """Read what there is of a result directory.

    Raises
    ------
    InputError
        If there is no such directory, or nothing of a reconstruction in it.
    """
    if not directory.is_dir():
        raise InputError(f"{directory}: no such directory; expected one written by nerif reconstruct")
    known = (RUN, METRICS, HISTORY, VOLUME, REPROJECTION, FIELD, CHECKPOINT)
    if not any((directory / name).exists() for name in known):
        raise InputError(
            f"{directory}: expected a result of nerif reconstruct, got none of {', '.join(known[:5])} in it"
        )
    finished = (directory / FIELD).is_file()
    missing: list[Missing] = []
    not_yet: list[str] = []

    def attempt(name: str, read: Callable[[Path], T], default: T, without: str) -> T:
        path = directory / name
        if not path.is_file():
            if finished:
                missing.append(Missing(name, f"{name} is not there: {without}"))
            else:
                not_yet.append(name)
            return default
        try:
            return read(path)
        except (InputError, OSError, ValueError, KeyError, TypeError) as error:
            reason = " ".join(str(error).split()).replace(f"{path}: ", "")
            missing.append(Missing(name, f"{name} cannot be read ({reason}): {without}"))
            return default

    no_table: dict[str, Any] = {}
    run = attempt(RUN, _toml, no_table, "the settings are not known")
    metrics = attempt(
        METRICS, _metrics, no_table, "how well the field meets the views is not known; nerif evaluate adds it"
    )
    no_history: list[dict[str, float]] = []
    history = attempt(HISTORY, _history, no_history, "there are no training curves")
    nothing: dict[str, Volume] = {}
    volumes = attempt(
        VOLUME, read_volumes, nothing, "there is no field to show; nerif export writes it from the network"
    )
    views = attempt(
        REPROJECTION, Reprojection.read, None, "the views cannot be shown; nerif evaluate --measurement FILE"
    )
    if not finished:
        resume = (directory / CHECKPOINT).is_file()
        go_on = f"Go on with nerif reconstruct --resume -o {directory}" if resume else "Start it again"
        rest = f" Not there yet: {', '.join(not_yet)}." if not_yet else ""
        missing.insert(0, Missing(FIELD, f"The run has not ended: there is no {FIELD}. {go_on}.{rest}"))
    return Result(
        directory=directory,
        settings={k: v for k, v in run.items() if k != "about"},
        about=run.get("about", {}),
        metrics=metrics,
        history=history,
        volumes=volumes,
        reprojection=views,
        measurement=_measurement(run) if views is None else views.measurement,
        truth=_truth(directory, metrics, missing),
        missing=tuple(missing),
    )


def _measurement(run: dict[str, Any]) -> Measurement | None:
    """The measurement of the run, if it is still where it was."""
    try:
        return Measurement.read(str(run["measurement"]))
    except (InputError, KeyError):
        return None


def _truth(directory: Path, metrics: dict[str, Any], missing: list[Missing]) -> Volume | None:
    """The truth it was compared with: where it was then, or beside the result if both have moved."""
    path = metrics.get("truth")
    if not isinstance(path, str):
        return None
    places = (Path(path), directory / Path(path).name, directory.parent / Path(path).name)
    try:
        return read_volume(next((p for p in places if p.is_file()), places[0]))
    except InputError as error:
        missing.append(Missing("truth", f"The truth cannot be shown beside the field: {error}"))
        return None


def _toml(path: Path) -> dict[str, Any]:
    return tomllib.loads(path.read_text())


def _metrics(path: Path) -> dict[str, Any]:
    """metrics.json, refused as a whole where a part is not what nerif writes."""
    found = json.loads(path.read_text())
    if not isinstance(found, dict):
        raise ValueError("expected a table of names and values")
    for name, known in (("views", "name"), ("slices", "z_mm")):
        rows = found.get(name, [])
        if not isinstance(rows, list) or not all(isinstance(row, dict) and known in row for row in rows):
            raise ValueError(f"'{name}' is not a list of tables with '{known}'")
    for name, known in (("ensemble", "members"), ("coverage", "share")):
        table = found.get(name, {known: 0})
        if not isinstance(table, dict) or known not in table:
            raise ValueError(f"'{name}' is not a table with '{known}'")
    return found


def _history(path: Path) -> list[dict[str, float]]:
    with path.open(newline="") as file:
        rows = [{k: _number(v) for k, v in row.items() if k is not None} for row in csv.DictReader(file)]
    if rows and not {"seconds", "step"} & set(rows[0]):
        raise ValueError(f"expected columns 'seconds' or 'step', got {', '.join(list(rows[0])[:5])}")
    return rows


def _number(text: str | None) -> float:
    try:
        return float(text) if text else math.nan
    except ValueError:
        return math.nan
