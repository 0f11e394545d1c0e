"""Is the verdict right? Simulated measurements, good and spoiled, are reconstructed, judged, and compared with a truth.

    python benchmarks/verdicts.py --cases 200 --folder out/verdicts --write benchmarks/results/verdicts-cpu.md

The coefficients of verdict.py were set on cases 0 to 34 of benchmarks/spoiling.py; the table is of others, from --first
on. What a verdict rests on is kept in --folder, a file for each case; a case that is there is judged anew and not
reconstructed again.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from bench import Table, add_write
from nerif.analysis.verdict import WORDS, Verdict, verdict
from nerif.common.files import atomic
from nerif.results.directory import Result
from spoiling import RIGS, SPOILED, case

BAD, GOOD = 0.05, 0.02  # of the variation
GOAL = 0.03
FACTOR, NINE_IN_TEN = 2.0, 0.9
VOXELS = 48
FIRST, STEPS, PIXELS = 1000, 400, 32  # first case; steps of NeRIF, of 2048 points each; edge of a view, px


@dataclass(frozen=True)
class Record:
    """A case, what its verdict rests on, and the error.

    Parameters
    ----------
    number, wrong, phantom, views, noise, rig : of the case
    method : of the reconstruction
    error : L2 of the variation
    metrics : of metrics.json
    """

    number: int
    wrong: str
    phantom: str
    views: int
    noise: float
    rig: str
    method: str
    error: float
    metrics: dict[str, Any]

    @property
    def verdict(self) -> Verdict:
        """The verdict on the result, by its figures."""
        return verdict(Result(Path(), settings={"method": self.method}, metrics=self.metrics))


def record(number: int, folder: Path, method: str, steps: int, pixels: int) -> Record:
    """Reconstruct a case as a user would, or read its record."""
    path = folder / f"{number:05d}.json"
    if not path.is_file():
        with atomic(path) as part:
            part.write_text(json.dumps(_reconstructed(number, method, steps, pixels), indent=1))
    return Record(**json.loads(path.read_text()))


def _reconstructed(number: int, method: str, steps: int, pixels: int) -> dict[str, Any]:
    from nerif.analysis.evaluation import evaluate
    from nerif.data.volume import Volume
    from nerif.data.volume_file import write_netcdf
    from nerif.geometry import Grid
    from nerif.reconstruction.base import Reconstructor
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural.neural import NeRIF
    from nerif.reconstruction.voxels.total_variation import TotalVariation
    from nerif.results.directory import ResultDirectory
    from nerif.workflow.job import Run
    from nerif.workflow.pipeline import reconstruct_into

    keep_freed_memory()
    drawn = case(number, pixels)
    grid = Grid.of_resolution(drawn.measurement.box, VOXELS)
    settings: Reconstructor = TotalVariation(voxels=32, device="cpu")
    if method == "nerif":
        settings = NeRIF(max_steps=steps * drawn.effort, points_per_batch=2048, seed=number, device="cpu")
    with tempfile.TemporaryDirectory() as directory:
        out, truth = Path(directory) / "r", Path(directory) / "truth.nc"
        reconstruct_into(out, drawn.measurement, settings, Run(report=False), voxels=VOXELS)
        metrics = ResultDirectory(out).metrics()
        volume = Volume(drawn.truth.sample(grid), grid, attributes={"n_ambient": drawn.measurement.n_ambient})
        write_netcdf(truth, [volume])
        error = evaluate(out, truth=truth)["l2_variation"]
    about = {name: getattr(drawn, name) for name in ("number", "wrong", "phantom", "views", "noise", "rig")}
    return {**about, "method": method, "error": error, "metrics": metrics}


def share(words: Sequence[str], word: str) -> str:
    """How often a word was said, in words."""
    said = words.count(word)
    return f"{said} of {len(words)} ({said / max(len(words), 1):.1%}; goal: below {GOAL:.0%})"


def columns() -> tuple[str, ...]:
    """Return the head of the table."""
    return ("wrong", "cases", "median error", "largest", *WORDS, f"within a factor of {FACTOR:g}")


def judge(table: Table, records: Sequence[Record]) -> None:
    """Write the rows of `columns`, and how often the verdict was right."""
    judged = [(r, r.verdict) for r in records]
    for r, v in judged:
        told = "-" if v.error is None else f"{v.error:.1%}"
        case_ = f"{r.number}: {r.wrong}, {r.phantom}, {r.rig}, {r.views} views"
        print(f"{case_}: error {r.error:.1%}, estimated {told}, {v.word}", flush=True)
    groups = [(wrong, [j for j in judged if j[0].wrong == wrong]) for wrong in SPOILED]
    sound = [j for j in judged if j[0].wrong == SPOILED[0]]
    groups += [(f"nothing, rig {rig}", [j for j in sound if j[0].rig == rig]) for rig in RIGS]
    for name, own in groups:
        if own:
            errors, words = [r.error for r, _ in own], [v.word for _, v in own]
            counts = (str(words.count(word)) for word in WORDS)
            middle = f"{statistics.median(errors):.1%}"
            table.row([name, str(len(own)), middle, f"{max(errors):.1%}", *counts, close(own)])
    bad, good = ([v.word for r, v in judged if chosen(r.error)] for chosen in (lambda e: e > BAD, lambda e: e < GOOD))
    table.text("", f'Error above {BAD:.0%}: "use" in {share(bad, WORDS[0])}.')
    table.text("", f'Error below {GOOD:.0%}: "do not use" in {share(good, WORDS[2])}; "use" in {good.count("use")}.')
    table.text("", f"Estimates within a factor of {FACTOR:g} of the error: {close(judged)} (goal: {NINE_IN_TEN:.0%}).")
    ratios = sorted(v.error / r.error for r, v in judged if v.error is not None)
    if len(ratios) < 2:
        return
    tenths = statistics.quantiles(ratios, n=10)
    spread = f"eight in ten {tenths[0]:.2f} to {tenths[-1]:.2f}"
    table.text(f"Estimate over error: median {statistics.median(ratios):.2f}, {spread}.")


def close(judged: Sequence[tuple[Record, Verdict]]) -> str:
    """How many of the estimates are within FACTOR of the error."""
    ratios = [v.error / r.error for r, v in judged if v.error is not None]
    within = sum(1 / FACTOR <= ratio <= FACTOR for ratio in ratios)
    return f"{within} of {len(ratios)}"


def main() -> None:
    """Judge the cases and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--first", type=int, default=FIRST, help="number of the first case")
    parser.add_argument("--folder", type=Path, default=Path("out/verdicts"), help="where the records are kept")
    parser.add_argument("--method", default="nerif", choices=["nerif", "tv"])
    parser.add_argument("--steps", type=int, default=STEPS, help="of NeRIF, 2048 points each")
    parser.add_argument("--pixels", type=int, default=PIXELS, help="along the edge of a view")
    parser.add_argument("--processes", type=int, default=2)
    add_write(parser)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    one = partial(record, folder=options.folder, method=options.method, steps=options.steps, pixels=options.pixels)
    numbers = range(options.first, options.first + options.cases)
    with ProcessPoolExecutor(options.processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        records = list(pool.map(one, numbers))
    table = Table("Verdicts on simulated measurements", columns(), options.write, f"\n\nMethod: {options.method}.")
    judge(table, records)


if __name__ == "__main__":
    main()
