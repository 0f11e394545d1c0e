"""Verdicts on simulated measurements.

Sound and faulty measurements (measurements.py) are reconstructed, judged, and compared with the truth. The
coefficients of verdict.py were fitted to cases 0 to 34; these are others. Records hold the metrics on which a verdict
rests, so a page judges them by the present rules.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.measurements import FAULTS, RIGS, random_case
from benchmarks.runner import Settings, table
from nerif.analysis.evaluation import evaluate
from nerif.analysis.verdict import RATINGS, Verdict, verdict
from nerif.data.volume import Volume, write_netcdf
from nerif.geometry import Grid
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import Reconstructor
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.results.directory import Result, ResultDirectory
from nerif.results.metrics_file import Metrics
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings

BAD, GOOD = 0.05, 0.02  # of the variation
GOAL = 0.03
FACTOR, NINE_IN_TEN = 2.0, 0.9
FIRST = 1000  # number of the first case

Row = dict[str, Any]


def cases(quick: bool) -> Iterator[Settings]:
    for number in range(FIRST, FIRST + (3 if quick else 200)):
        method, steps, pixels = ("tv", 0, 16) if quick else ("nerif", 400, 32)
        yield {"number": number, "method": method, "steps": steps, "pixels": pixels, "voxels": 20 if quick else 48}


def measure(folder: Path, number: int, method: str, steps: int, pixels: int, voxels: int) -> dict[str, Any]:
    """Reconstruct a case as a user would; `steps` of NeRIF with 2048 points each."""
    case = random_case(number, pixels)
    grid = Grid.of_resolution(case.measurement.box, voxels)
    settings: Reconstructor = TotalVariation(voxels=32, device="cpu")
    if method == "nerif":
        settings = NeRIF(max_steps=steps * case.effort, points_per_batch=2048, seed=number, device="cpu")
    with tempfile.TemporaryDirectory(dir=folder) as directory:
        out, truth = Path(directory) / "r", Path(directory) / "truth.nc"
        reconstruct_into(out, case.measurement, settings, RunSettings(report=False), voxels=voxels)
        metrics = ResultDirectory(out).metrics()
        volume = Volume(case.truth.sample(grid), grid, attributes={"n_ambient": case.measurement.n_ambient})
        write_netcdf(truth, [volume])
        error = evaluate(out, truth=truth)["l2_variation"]
    labels = {name: getattr(case, name) for name in ("fault", "phantom", "views", "noise", "rig")}
    return {**labels, "error": error, "metrics": asdict(metrics)}


def judge(row: Row) -> Verdict:
    return verdict(Result(Path(), settings={"method": row["method"]}, metrics=Metrics.of(row["metrics"])))


def blocks(rows: list[Row]) -> list[str]:
    """Return the verdicts by fault and rig, and how often they are right."""
    judged = [(row, judge(row)) for row in rows if "metrics" in row]
    groups = [(fault, [j for j in judged if j[0]["fault"] == fault]) for fault in FAULTS]
    groups += [(f"nothing, rig {rig}", [j for j in groups[0][1] if j[0]["rig"] == rig]) for rig in RIGS]
    cells = []
    for name, group in groups:
        if group:
            errors, words = [row["error"] for row, _ in group], [v.rating for _, v in group]
            median = f"{statistics.median(errors):.1%}"
            counts = (str(words.count(word)) for word in RATINGS)
            cells.append([name, str(len(group)), median, f"{max(errors):.1%}", *counts, close(group)])

    def share(word: str, among: Callable[[float], bool]) -> str:
        words = [v.rating for row, v in judged if among(row["error"])]
        ratio = f"{words.count(word) / max(len(words), 1):.1%}"
        return f'"{word}" in {words.count(word)} of {len(words)} ({ratio}; goal: below {GOAL:.0%})'

    columns = ("fault", "cases", "median error", "largest", *RATINGS, f"within a factor of {FACTOR:g}")
    notes = [
        f"Error above {BAD:.0%}: {share(RATINGS[0], lambda e: e > BAD)}.",
        f"Error below {GOOD:.0%}: {share(RATINGS[2], lambda e: e < GOOD)}.",
        f"Estimates within a factor of {FACTOR:g} of the error: {close(judged)} (goal: {NINE_IN_TEN:.0%}).",
    ]
    ratios = sorted(v.error / row["error"] for row, v in judged if v.error is not None)
    if len(ratios) > 1:
        tenths = statistics.quantiles(ratios, n=10)
        spread = f"eight in ten {tenths[0]:.2f} to {tenths[-1]:.2f}"
        notes.append(f"Estimate over error: median {statistics.median(ratios):.2f}, {spread}.")
    return [table(columns, cells), *notes]


def close(judged: Sequence[tuple[Row, Verdict]]) -> str:
    """Count the estimates within FACTOR of the error."""
    ratios = [v.error / row["error"] for row, v in judged if v.error is not None]
    return f"{sum(1 / FACTOR <= ratio <= FACTOR for ratio in ratios)} of {len(ratios)}"
