"""Is the verdict right? Simulated measurements, good and spoiled, are reconstructed and judged, and the truth is asked.

    python benchmarks/verdicts.py --cases 200 --write benchmarks/results/verdicts-cpu.md

The limits of the verdict were set on cases 0 to 53 of benchmarks/spoiling.py; the table is of others, from --first on.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from bench import Table, add_write
from nerif.verdict import WORDS
from spoiling import SPOILED, case

BAD, GOOD = 0.05, 0.02  # of the variation
GOAL = 0.03
VOXELS = 48
FIRST, STEPS = 1000, 600  # number of the first case; steps of NeRIF, of 2048 points each


def judged(number: int, method: str, steps: int) -> tuple[str, str, int, float, str, float | None]:
    """Reconstruct a case as a user would; return what was wrong, phantom, views, error, verdict and its estimate."""
    from nerif.evaluation import evaluate
    from nerif.geometry import Grid
    from nerif.reconstruction.base import Reconstructor
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural import NeRIF
    from nerif.reconstruction.total_variation import TotalVariation
    from nerif.result import ResultDirectory
    from nerif.volume import Volume
    from nerif.volume_file import write_netcdf
    from nerif.workflow import Run, reconstruct_into

    keep_freed_memory()
    drawn = case(number)
    grid = Grid.of_resolution(drawn.measurement.box, VOXELS)
    settings: Reconstructor = TotalVariation(voxels=32, device="cpu")
    if method == "nerif":
        settings = NeRIF(max_steps=steps, points_per_batch=2048, seed=number, device="cpu")
    with tempfile.TemporaryDirectory() as folder:
        out, truth = Path(folder) / "r", Path(folder) / "truth.nc"
        reconstruct_into(out, drawn.measurement, settings, Run(report=False), voxels=VOXELS)
        verdict = ResultDirectory(out).metrics()["verdict"]
        volume = Volume(drawn.truth.sample(grid), grid, attributes={"n_ambient": drawn.measurement.n_ambient})
        write_netcdf(truth, [volume])
        error = evaluate(out, truth=truth)["l2_variation"]
    return drawn.wrong, drawn.phantom, drawn.views, error, verdict["word"], verdict["error"]


def share(words: Sequence[str], word: str) -> str:
    """How often a word was said, in words."""
    said = words.count(word)
    return f"{said} of {len(words)} ({said / max(len(words), 1):.1%}; goal: below {GOAL:.0%})"


def columns() -> tuple[str, ...]:
    """Return the head of the table."""
    return ("wrong", "cases", "median error", "largest", *WORDS)


def judge(table: Table, numbers: range, method: str, steps: int, processes: int) -> None:
    """Judge the cases of those numbers, side by side: rows of `columns`, and how often the verdict was right."""
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        waiting = [pool.submit(judged, n, method, steps) for n in numbers]
        found = []
        for number, future in zip(numbers, waiting, strict=True):
            found.append(future.result())
            wrong, phantom, views, error, word, estimate = found[-1]
            told = "-" if estimate is None else f"{estimate:.1%}"
            print(f"{number}: {wrong}, {phantom}, {views} views: error {error:.1%}, told {told}, {word}", flush=True)
    for wrong in SPOILED:
        own = [f for f in found if f[0] == wrong]
        errors, words = sorted(f[3] for f in own), [f[4] for f in own]
        if own:
            middle = f"{errors[len(own) // 2]:.1%}"
            table.row([wrong, str(len(own)), middle, f"{errors[-1]:.1%}", *(str(words.count(w)) for w in WORDS)])
    bad, good = ([f[4] for f in found if keep(f[3])] for keep in (lambda e: e > BAD, lambda e: e < GOOD))
    table.text("", f'Error above {BAD:.0%}: "use" in {share(bad, "use")}.')
    table.text(
        "", f'Error below {GOOD:.0%}: "do not use" in {share(good, "do not use")}; "use" in {good.count("use")}.'
    )
    close = [f for f in found if f[5] is not None]
    within = sum(0.5 <= f[5] / f[3] <= 2 for f in close if f[5] is not None)
    table.text(
        "",
        f"Where a likely error is told, it is within a factor of two in {within} of {len(close)} cases.",
    )


def main() -> None:
    """Judge the cases and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--first", type=int, default=FIRST, help="number of the first case")
    parser.add_argument("--method", default="nerif", choices=["nerif", "tv"])
    parser.add_argument("--steps", type=int, default=STEPS, help="of NeRIF, 2048 points each")
    parser.add_argument("--processes", type=int, default=2)
    add_write(parser)
    asked = parser.parse_args()
    table = Table("Verdicts on simulated measurements", columns(), asked.write, f"\n\nMethod: {asked.method}.")
    judge(table, range(asked.first, asked.first + asked.cases), asked.method, asked.steps, asked.processes)


if __name__ == "__main__":
    main()
