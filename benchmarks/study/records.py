"""Records on disk: one JSON file a reconstruction, with what was asked for, and when, where and by what it was made."""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from bench import machine
from nerif import __version__
from nerif.common.files import write_json
from study.cases import Case
from study.results import Record

__all__ = ["of_other_versions", "read_record", "write_record"]


def write_record(folder: Path, case: Case, record: Record) -> Record:
    """Write the record of a case, with its request and its origin, and return it."""
    made = {
        "nerif": __version__,
        "torch": torch.__version__,
        "machine": machine(str(record.get("device", "cpu"))),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
    }
    record = {**record, "request": case.request(), "made": made}
    write_json(_path(folder, case), record)
    return record


def read_record(folder: Path, case: Case) -> Record | None:
    """Return the record of a case, or None where it is not there, was asked otherwise, or is of another nerif."""
    record = _asked(folder, case)
    return record if record is not None and _version(record) == __version__ else None


def of_other_versions(folder: Path, cases: Iterable[Case]) -> dict[str, str]:
    """Return the version of nerif, by key, of the records that would be used but for it."""
    found = {case.key: _version(record) for case in cases if (record := _asked(folder, case)) is not None}
    return {key: version for key, version in found.items() if version != __version__}


def _asked(folder: Path, case: Case) -> Record | None:
    try:
        record: dict[str, Any] = json.loads(_path(folder, case).read_text())
    except (OSError, ValueError):
        return None
    return record if record.get("request") == case.request() else None


def _version(record: Record) -> str:
    return str(record.get("made", {}).get("nerif", "unknown"))


def _path(folder: Path, case: Case) -> Path:
    return folder / "cases" / f"{case.key}.json"
