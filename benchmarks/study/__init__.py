"""The numerical study of the NeRIF paper, repeated.

Every table and figure of the paper's numerical section with its numbers beside ours, and a test of each of its
claims. The page (NAME.md, NAME.html and figures/) is generated from the records alone.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.runner import Record, Settings, table
from benchmarks.study.claims import claims
from benchmarks.study.page import write_study
from benchmarks.study.plan import FULL, QUICK, SECTIONS, Case, Scale, study_cases
from benchmarks.study.results import Results
from benchmarks.study.running import run_case

SCALES = {scale.name: scale for scale in (FULL, QUICK)}
CHANGEABLE = ("pixels", "seconds", "preset", "device")


def cases(quick: bool) -> Iterator[Settings]:
    scale = QUICK if quick else FULL
    settings = {name: getattr(scale, name) for name in CHANGEABLE}
    for case in study_cases(scale):
        yield {
            "key": case.key,
            "sections": " ".join(case.labels),
            "scale": scale.name,
            **settings,
            "inputs": case.digest,
        }


def scale_of(settings: Settings) -> Scale:
    """Return the scale of a case, with the changes of `--set`."""
    return dataclasses.replace(SCALES[settings["scale"]], **{name: settings[name] for name in CHANGEABLE})


def measure(folder: Path, key: str, **settings: Any) -> dict[str, Any]:
    return run_case(next(case for case in study_cases(scale_of(settings)) if case.key == key), folder)


def results_of(cases: Sequence[Settings], records: Sequence[Record]) -> Results:
    """Pair the cases with their records; the sections are those of which every case is there."""
    by_key = {record["settings"]["key"]: record for record in records}
    keys = [case["key"] for case in cases]
    all_cases = study_cases(scale_of(cases[0]))
    sections = [s for s in SECTIONS if all(case.key in keys for case in all_cases if s in case.labels)]

    def flat(case: Case) -> Record | None:
        record = by_key.get(case.key)
        return None if record is None else {**record, **record.get("metrics", {})}

    pairs = tuple((case, flat(case)) for case in all_cases if case.key in keys)
    return Results(pairs, tuple(sections))


def write_page(path: Path, cases: Sequence[Settings], records: Sequence[Record]) -> Path:
    return write_study(path, results_of(cases, records), scale_of(cases[0]), records)


def blocks(rows: list[dict[str, Any]]) -> list[str]:
    """Return the verdict on each claim."""
    results = results_of(rows, [{"settings": row, "metrics": row} for row in rows])
    verdicts = claims(results)
    counts = Counter(claim.verdict for claim in verdicts)
    text = f"{results.done} of {len(results.pairs)} reconstructions; " + ", ".join(
        f"{n} {v}" for v, n in counts.items()
    )
    return [table(["verdict", "claim", "here"], [[c.verdict, c.text, c.here] for c in verdicts]), text]
