"""Rows of the study (settings and metrics of a record) by phantom, noise and method, or by section."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from benchmarks.study.plan import NOISES, PHANTOMS, Scale, section_keys

Row = dict[str, Any]
Cell = tuple[str, float, str]
"""Phantom, noise and method."""


class NoResult(Exception):
    """A claim needs a result that the study lacks, and why."""


class Results:
    """Rows by key; a case without a record has a row with its key alone."""

    def __init__(self, rows: Sequence[Row], scale: Scale) -> None:
        self.by_key, self.scale = {row["key"]: row for row in rows}, scale

    def row(self, key: str) -> Row:
        return self.by_key.get(key, {"key": key})

    def section(self, name: str) -> dict[str, Row]:
        """Return the rows of a section by label."""
        return {label: self.row(key) | {"label": label} for label, key in section_keys(self.scale, name).items()}

    def cell(self, phantom: str, noise: float, method: str) -> Row:
        """Return a row of the tables."""
        return self.row(f"{phantom}-{noise:g}-{method.lower()}")

    def cells(
        self, methods: Iterable[str], noises: Iterable[float] = NOISES, phantoms: Iterable[str] = PHANTOMS
    ) -> dict[Cell, Row]:
        """Return rows of the tables by (phantom, noise, method)."""
        return {(p, noise, m): self.cell(p, noise, m) for m in methods for p in phantoms for noise in noises}


def score(row: Row, name: str) -> Any:
    """Return a metric; NoResult where there is none."""
    if "failed" in row:
        raise NoResult(f"{row['key']} failed: {row['failed']}")
    if "outcome" not in row:
        raise NoResult(f"{row['key']} is not done")
    if row.get(name) is None:  # not finite
        raise NoResult(f"{name} of {row['key']} is not a number (the run ended with: {row['outcome']})")
    return row[name]


def scores(rows: Iterable[Row], name: str) -> list[float]:
    """Return the values of a metric that are there."""
    return [row[name] for row in rows if row.get(name) is not None]


def slice_scores(rows: Iterable[Row], name: str) -> list[float]:
    """Return a score of all slices of some volumes."""
    return scores((one for row in rows for one in row.get("slices") or []), name)


def first_at(row: Row, name: str, level: float | None) -> Row | None:
    """Return the first point of the curve of a run where a metric is at most `level`, or None."""
    points = (point for point in row.get("curve") or [] if level is not None and point.get(name) is not None)
    return next((point for point in points if point[name] <= level), None)


def listed(names: Iterable[str]) -> str:
    """Return names with commas and an "and"."""
    words = list(names)
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
