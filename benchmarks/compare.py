"""Two versions of the code side by side: seconds of a training step and of a voxel iteration, as ratios within a run.

    git worktree add ../before COMMIT
    python benchmarks/compare.py ../before --write benchmarks/results/compare-cpu.md

Each measurement is a process of its own that imports `nerif` from one of the two checkouts; they take turns, so that
both meet the same neighbours on the machine. What is compared is public in both: steps of NeRIF, iterations of
Tikhonov. The ratio of a turn is that of the two that follow one another; shown are the median ratio and its quartiles.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Literal

from bench import N_AMBIENT, Table, add_write

HERE = Path(__file__).resolve().parents[1]
POINTS = {"NeRIF, 8192 points a step": 8192, "NeRIF, 1024 points a step": 1024}
GRIDS: dict[str, Literal["linear", "cubic"]] = {"Tikhonov, linear, 64³": "linear", "Tikhonov, cubic, 64³": "cubic"}
COUNTED = 60
"""Steps of a training; iterations are a third of them."""


def once(data: Path) -> dict[str, float]:
    """Seconds of a step or an iteration of each work, in this process: medians."""
    import time

    from nerif.measurement import Measurement
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural import NeRIF
    from nerif.reconstruction.tikhonov import Tikhonov

    keep_freed_memory()
    measurement, found = Measurement.read(data), {}
    network = NeRIF(max_steps=COUNTED, epochs=1e6, device="cpu")
    voxels = Tikhonov(
        voxels=64, iterations=COUNTED // 3, tolerance=0.0, regularisation=1e-3, coarse_to_fine=False, device="cpu"
    )
    works = {name: replace(network, points_per_batch=points) for name, points in POINTS.items()}
    for name, method in {**works, **{name: replace(voxels, basis=basis) for name, basis in GRIDS.items()}}.items():
        ends: list[float] = []

        def note(_: object, ends: list[float] = ends) -> None:
            ends.append(time.perf_counter())

        method(measurement, note)
        first = len(ends) // 4  # compiling, and memory that is new
        found[name] = statistics.median(b - a for a, b in itertools.pairwise(ends[first:]))
    return found


def seconds(checkout: Path, data: Path) -> dict[str, float]:
    """Seconds of each work by the code of a checkout."""
    command = [sys.executable, str(Path(__file__).resolve()), str(checkout), "--once", str(data)]
    where = {**os.environ, "PYTHONPATH": str(checkout / "src")}
    done = subprocess.run(command, env=where, stdout=subprocess.PIPE, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("before", type=Path, help="another checkout of the repository")
    parser.add_argument("--turns", type=int, default=9)
    parser.add_argument("--once", type=Path, help=argparse.SUPPRESS)
    add_write(parser)
    asked = parser.parse_args()
    if asked.once:
        print(json.dumps(once(asked.once)))
        return
    from nerif.fields.phantoms import Flame
    from nerif.geometry import paper_rig
    from nerif.simulation import add_noise, simulate

    versions = {name: _commit(path) for name, path in (("before", asked.before), ("now", HERE))}
    columns = ("work", "ms before", "ms now", "now / before", "quartiles")
    table = Table(f"Speed of {versions['now']} over {versions['before']}", columns, asked.write)
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "m.nc"
        cameras, box = paper_rig(64)
        add_noise(simulate(Flame(box), cameras, box, N_AMBIENT), 0.05, seed=1).write(data)
        turns = [[seconds(path, data) for path in (asked.before, HERE)] for _ in range(asked.turns + 1)][1:]
    for work in (*POINTS, *GRIDS):
        before, now = ([turn[i][work] for turn in turns] for i in (0, 1))
        low, middle, high = statistics.quantiles((b / a for a, b in zip(before, now, strict=True)), n=4)
        times = (f"{1e3 * statistics.median(column):.2f}" for column in (before, now))
        table.row([work, *times, f"{middle:.3f}", f"{low:.3f} to {high:.3f}"])


def _commit(checkout: Path) -> str:
    named = ["git", "-C", str(checkout), "describe", "--always", "--dirty"]
    return subprocess.run(named, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()
