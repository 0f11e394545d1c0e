"""The records of a study as the page asks for them: by phantom, noise and method, or by section."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from nerif.reconstruction.neural.neural import NeRIF
from study.cases import NOISES, PHANTOMS, SECTIONS, Case

__all__ = ["NoResult", "Record", "Results", "finite", "first_at", "metric", "score", "typical"]

Record = dict[str, Any]
Cell = tuple[str, float, str]
"""Phantom, noise and method."""


class NoResult(Exception):
    """A claim or a table asks for a result that the study does not have; the message says why."""


@dataclass(frozen=True)
class Results:
    """Cases with their records.

    Parameters
    ----------
    pairs : every case of the study with its record; None where there is none yet
    sections : asked for
    """

    pairs: tuple[tuple[Case, Record | None], ...]
    sections: tuple[str, ...] = tuple(SECTIONS)

    def __post_init__(self) -> None:
        named = ((case, None if record is None else {**record, "key": case.key}) for case, record in self.pairs)
        object.__setattr__(self, "pairs", tuple(named))

    @property
    def done(self) -> int:
        """Number of reconstructions that came to their end."""
        return sum(record is not None and "failed" not in record for _, record in self.pairs)

    @property
    def failed(self) -> list[tuple[Case, str]]:
        """Cases that failed, and why."""
        return [(case, str(record["failed"])) for case, record in self.pairs if record and "failed" in record]

    def rows(self, section: str) -> list[tuple[str, Case, Record | None]]:
        """Return label, case and record of what a section shows; a failed record is None, too."""
        return [
            (case.labels[section], case, None if record and "failed" in record else record)
            for case, record in self._of(section)
        ]

    def cell(self, phantom: str, noise: float, method: str) -> Record | None:
        """Return a record of the tables, or None."""
        known = (record for _, case, record in self.rows("tables") if _cell(case) == (phantom, noise, method))
        return next(known, None)

    def failed_cell(self, phantom: str, noise: float, method: str) -> bool:
        """Whether a reconstruction of the tables failed."""
        cells = [_cell(case) for case, _ in self.failed if "tables" in case.labels]
        return (phantom, noise, method) in cells

    def cells(
        self, methods: Iterable[str], noises: Iterable[float] = NOISES, phantoms: Iterable[str] = PHANTOMS
    ) -> dict[Cell, Record]:
        """Return the records of the tables by (phantom, noise, method); NoResult where one is not there."""
        wanted = [(p, noise, method) for method in methods for p in phantoms for noise in noises]
        cases = {_cell(case): (case, record) for case, record in self.pairs if "tables" in case.labels}
        return dict(zip(wanted, self._require([cases.get(cell) for cell in wanted], "tables"), strict=True))

    def one(self, phantom: str, noise: float, method: str) -> Record:
        """Return one record of the tables; NoResult where it is not there."""
        return next(iter(self.cells((method,), (noise,), (phantom,)).values()))

    def labelled(self, section: str) -> dict[str, Record]:
        """Return the records of a section by label; NoResult where one is not there."""
        pairs = self._of(section)
        records = self._require(pairs or [None], section)
        return dict(zip((case.labels[section] for case, _ in pairs), records, strict=True))

    def _of(self, section: str) -> list[tuple[Case, Record | None]]:
        """Return what a section shows, those in order whose labels are numbers."""
        pairs = [(case, record) for case, record in self.pairs if section in case.labels]
        return sorted(pairs, key=lambda pair: _order(section, pair[0]))

    def _require(self, pairs: Sequence[tuple[Case, Record | None] | None], section: str) -> list[Record]:
        found = [pair for pair in pairs if pair is not None]
        records = [record for _, record in found if record is not None and "failed" not in record]
        if len(records) == len(pairs):
            return records
        for case, record in found:
            if record is not None and "failed" in record:
                raise NoResult(f"{case.key} failed: {record['failed']}")
        if len(found) < len(pairs):
            raise NoResult(f"the section “{SECTIONS[section]}” was not asked for")
        if len(pairs) == 1:
            raise NoResult(f"{found[0][0].key} is not done yet")
        raise NoResult(f"{len(records)} of {len(pairs)} reconstructions done")


def _cell(case: Case) -> Cell:
    return case.phantom, case.noise, case.method


def _order(section: str, case: Case) -> int:
    if section == "views":
        return case.ring.views
    return case.reconstructor.network.octaves if section == "encoding" and isinstance(case.reconstructor, NeRIF) else 0


def finite(value: object) -> float | None:
    """Return a number that is one, or None."""
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


def metric(record: Record | None, name: str) -> float | None:
    """Return a metric of a record; None where there is no record, or no number in it."""
    return None if record is None else finite(record["metrics"].get(name))


def score(record: Record, name: str) -> float:
    """Return a metric of a record; NoResult where it is not a number, as of a run that diverged."""
    value = finite(record["metrics"].get(name))
    if value is None:
        raise NoResult(f"{name} of {record['key']} is not a number (the run ended with: {record['outcome']})")
    return value


def first_at(record: Record, name: str, level: float) -> dict[str, float] | None:
    """Return the first point of a record's curve where a metric is at most `level`, or None."""
    for point in record.get("curve") or []:
        value = finite(point.get(name))
        if value is not None and value <= level:
            return dict(point)
    return None


def typical(records: Iterable[Record], name: str) -> float | None:
    """Return the median of a value of records, such as seconds; None where there is none."""
    values = [v for v in (finite(record.get(name)) for record in records) if v is not None]
    return median(values) if values else None
