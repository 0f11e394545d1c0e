"""The findings of `nerif check` as JSON: agreement of every view, faults, remarks and the remedy."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from nerif.analysis.consistency import Consistency, ViewAgreement
from nerif.common.conventions import InputError
from nerif.common.files import read_json, write_json
from nerif.common.findings import Finding

__all__ = ["CheckFindings", "read_findings", "write_findings"]

FORMAT = "nerif-check-1"


@dataclass(frozen=True)
class CheckFindings:
    """The outcome of a check without the tensors that correct it."""

    measurement: str  #: the file that was checked, as on the command line
    views: tuple[ViewAgreement, ...]  #: agreement of every view; empty if there are too few views to compare
    findings: tuple[Finding, ...]  #: faults, most severe first
    remarks: tuple[str, ...]  #: further notes
    correctable: bool  #: whether `nerif check --out` corrects a fault

    @classmethod
    def of(cls, measurement: str, result: Consistency) -> CheckFindings:
        """Return the findings of a check of this file."""
        return cls(measurement, result.views, result.findings, result.remarks, bool(result.corrections))


def write_findings(path: Path, findings: CheckFindings) -> None:
    """Write findings atomically."""
    write_json(path, {"format": FORMAT, **asdict(findings)})


def read_findings(path: Path) -> CheckFindings:
    """Read findings; InputError for a file of another kind."""
    entries = read_json(path)
    try:
        if not isinstance(entries, dict) or entries.get("format") != FORMAT:
            raise ValueError("another format")
        return CheckFindings(
            str(entries["measurement"]),
            tuple(_view(view) for view in entries["views"]),
            tuple(_finding(finding) for finding in entries["findings"]),
            tuple(map(str, entries["remarks"])),
            bool(entries["correctable"]),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"expected the findings of nerif check ({FORMAT}), got {_cause(error)}; check the measurement again",
            field=path,
        ) from None


def _view(entries: dict[str, Any]) -> ViewAgreement:
    valid, agreement, gain = (_number(entries[name]) for name in ("valid", "agreement", "gain"))
    name, verdict, measured = (str(entries[name]) for name in ("name", "verdict", "measured"))
    return ViewAgreement(name, valid, agreement, gain, verdict, measured)


def _number(value: Any) -> float:
    """A number that was not finite is null in the file."""
    return math.nan if value is None else float(value)


def _finding(entries: dict[str, Any]) -> Finding:
    return Finding(str(entries["code"]), str(entries["sentence"]), tuple(map(str, entries["views"])))


def _cause(error: Exception) -> str:
    return f"no entry {error}" if isinstance(error, KeyError) else f"'{error}'"
