"""Records of the study by phantom, noise and method, or by section."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from benchmarks.study.plan import NOISES, PHANTOMS, SECTIONS, Case
from nerif.reconstruction.neural.neural import NeRIF

Record = dict[str, Any]
Cell = tuple[str, float, str]
"""Phantom, noise and method."""


class NoResult(Exception):
    """A claim or a table needs a result that the study lacks, and why."""


@dataclass(frozen=True)
class Results:
    """Cases with their records.

    Parameters
    ----------
    pairs : every case with its record; None where there is none yet
    sections : of the page
    """

    pairs: tuple[tuple[Case, Record | None], ...]
    sections: tuple[str, ...] = tuple(SECTIONS)

    def __post_init__(self) -> None:
        pairs = ((case, None if record is None else {**record, "key": case.key}) for case, record in self.pairs)
        object.__setattr__(self, "pairs", tuple(pairs))

    @property
    def done(self) -> int:
        return sum(record is not None and "failed" not in record for _, record in self.pairs)

    @property
    def failed(self) -> list[tuple[Case, str]]:
        """Cases that failed, and why."""
        return [(case, str(record["failed"])) for case, record in self.pairs if record and "failed" in record]

    def rows(self, section: str) -> list[tuple[str, Case, Record | None]]:
        """Return label, case and record of a section; None for a failed record."""
        return [
            (case.labels[section], case, None if record and "failed" in record else record)
            for case, record in self._of(section)
        ]

    def cell(self, phantom: str, noise: float, method: str) -> Record | None:
        """Return a record of the tables, or None."""
        records = (record for _, case, record in self.rows("tables") if _cell(case) == (phantom, noise, method))
        return next(records, None)

    def failed_cell(self, phantom: str, noise: float, method: str) -> bool:
        """Whether a reconstruction of the tables failed."""
        return (phantom, noise, method) in [_cell(case) for case, _ in self.failed if "tables" in case.labels]

    def cells(
        self, methods: Iterable[str], noises: Iterable[float] = NOISES, phantoms: Iterable[str] = PHANTOMS
    ) -> dict[Cell, Record]:
        """Return records of the tables by (phantom, noise, method); NoResult where one is missing."""
        keys = [(p, noise, method) for method in methods for p in phantoms for noise in noises]
        cases = {_cell(case): (case, record) for case, record in self.pairs if "tables" in case.labels}
        return dict(zip(keys, self._require([cases.get(key) for key in keys], "tables"), strict=True))

    def one(self, phantom: str, noise: float, method: str) -> Record:
        """Return one record of the tables; NoResult where it is missing."""
        return next(iter(self.cells((method,), (noise,), (phantom,)).values()))

    def labelled(self, section: str) -> dict[str, Record]:
        """Return the records of a section by label; NoResult where one is missing."""
        pairs = self._of(section)
        records = self._require(pairs or [None], section)
        return dict(zip((case.labels[section] for case, _ in pairs), records, strict=True))

    def _of(self, section: str) -> list[tuple[Case, Record | None]]:
        """Return the pairs of a section, in order where the labels are numbers."""
        pairs = [(case, record) for case, record in self.pairs if section in case.labels]
        return sorted(pairs, key=lambda pair: _order(section, pair[0]))

    def _require(self, pairs: Sequence[tuple[Case, Record | None] | None], section: str) -> list[Record]:
        present = [pair for pair in pairs if pair is not None]
        records = [record for _, record in present if record is not None and "failed" not in record]
        if len(records) == len(pairs):
            return records
        for case, record in present:
            if record is not None and "failed" in record:
                raise NoResult(f"{case.key} failed: {record['failed']}")
        if len(present) < len(pairs):
            raise NoResult(f"the section “{SECTIONS[section]}” was left out")
        if len(pairs) == 1:
            raise NoResult(f"{present[0][0].key} is not done yet")
        raise NoResult(f"{len(records)} of {len(pairs)} reconstructions done")


def _cell(case: Case) -> Cell:
    return case.phantom, case.noise, case.method


def _order(section: str, case: Case) -> int:
    if section == "views":
        return case.ring.views
    return case.reconstructor.network.octaves if section == "encoding" and isinstance(case.reconstructor, NeRIF) else 0


def finite(value: object) -> float | None:
    """Return a finite number, or None."""
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


def metric(record: Record | None, name: str) -> float | None:
    """Return a metric; None where there is no record, or no number in it."""
    return None if record is None else finite(record["metrics"].get(name))


def score(record: Record, name: str) -> float:
    """Return a metric; NoResult where it is not a number, as of a run that diverged."""
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
    """Return the median of a value over records; None where there is none."""
    values = [v for v in (finite(record.get(name)) for record in records) if v is not None]
    return median(values) if values else None
