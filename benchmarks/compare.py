"""Two versions of the code side by side: seconds of a training step and of a voxel iteration, as ratios within a run.

    git worktree add ../before COMMIT
    python benchmarks/compare.py ../before --write benchmarks/results/compare-cpu.md

Each measurement is a process of its own that imports `nerif` from one of the two checkouts; they take turns, so that
both meet the same neighbours on the machine. What is compared is public in both: steps of NeRIF, iterations of
Tikhonov. The ratio of a turn is that of the two that follow one another; shown are the median ratio and its quartiles.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Literal

from bench import N_AMBIENT, Table, add_write

HERE = Path(__file__).resolve().parents[1]
POINTS = {"NeRIF, 8192 points a step": 8192, "NeRIF, 1024 points a step": 1024}
GRIDS: dict[str, Literal["linear", "cubic"]] = {"Tikhonov, linear, 64³": "linear", "Tikhonov, cubic, 64³": "cubic"}
WARM = 20  # steps that are not counted
COUNTED = {"steps": 150, "iterations": 20}


def once(work: str, data: Path) -> float:
    """Seconds of a step or an iteration, in this process: median over steps, mean over iterations."""
    import time

    from nerif.measurement import Measurement
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural import NeRIF
    from nerif.reconstruction.tikhonov import Tikhonov

    keep_freed_memory()
    measurement = Measurement.read(data)
    ends: list[float] = []
    if work in POINTS:
        steps = WARM + COUNTED["steps"]
        method = NeRIF(max_steps=steps, epochs=1e6, points_per_batch=POINTS[work], device="cpu")
        method(measurement, lambda step: ends.append(time.perf_counter()))
        return statistics.median(b - a for a, b in zip(ends[WARM:-1], ends[WARM + 1 :], strict=True))
    tikhonov = Tikhonov(
        voxels=64, basis=GRIDS[work], iterations=COUNTED["iterations"], tolerance=0.0, regularisation=1e-3,
        coarse_to_fine=False, device="cpu",
    )  # fmt: skip
    tikhonov(measurement, lambda step: ends.append(time.perf_counter()))
    return (ends[-1] - ends[0]) / (len(ends) - 1)


def seconds(checkout: Path, work: str, data: Path) -> float:
    """Seconds of `work` by the code of a checkout."""
    command = [sys.executable, str(Path(__file__).resolve()), str(checkout), "--once", work, "--data", str(data)]
    where = {**os.environ, "PYTHONPATH": str(checkout / "src")}
    done = subprocess.run(command, env=where, capture_output=True, text=True, check=True)
    return float(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("before", type=Path, help="another checkout of the repository")
    parser.add_argument("--turns", type=int, default=9)
    parser.add_argument("--once", help=argparse.SUPPRESS)
    parser.add_argument("--data", type=Path, help=argparse.SUPPRESS)
    add_write(parser)
    asked = parser.parse_args()
    if asked.once:
        print(json.dumps(once(asked.once, asked.data)))
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
        for work in (*POINTS, *GRIDS):
            both = [[seconds(path, work, data) for path in (asked.before, HERE)] for _ in range(asked.turns + 1)][1:]
            ratios = [now / before for before, now in both]
            low, middle, high = statistics.quantiles(ratios, n=4)
            before, now = (f"{1e3 * statistics.median(column):.2f}" for column in zip(*both, strict=True))
            table.row([work, before, now, f"{middle:.3f}", f"{low:.3f} to {high:.3f}"])


def _commit(checkout: Path) -> str:
    named = ["git", "-C", str(checkout), "describe", "--always", "--dirty"]
    return subprocess.run(named, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()
