"""Two versions of the code side by side: a training step and a voxel iteration, as ratios within one run.

    git worktree add ../before COMMIT
    python benchmarks/compare.py ../before --write benchmarks/results/compare-cpu.md

Each version is a process of its own that imports `nerif` from its checkout. Both stand ready at once and take turns of
some steps or of one run, while the other waits: both meet the same neighbours on the machine. Compared is what is
public in both: steps of NeRIF, runs of Tikhonov to the end, for an iteration need not be the same in both. Shown are
medians over turns, of the ratio with its quartiles.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import IO

from bench import N_AMBIENT, Table, add_write

HERE = Path(__file__).resolve().parents[1]
WORKS = {
    "NeRIF, 8192 points a step": 6,
    "NeRIF, 1024 points a step": 25,
    "Tikhonov, linear, 64³, a run": 1,
    "Tikhonov, cubic, 64³, a run": 1,
}
"""What is compared, and steps or runs of a turn."""
WARM = 3  # turns that are not counted


def take_turns(work: str, data: Path) -> None:
    """Do the work in this process: wait for a line, do a turn, print its seconds a step, for ever."""
    from nerif.data.measurement import Measurement
    from nerif.reconstruction.base import Reconstructor
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural.neural import NeRIF
    from nerif.reconstruction.voxels.tikhonov import Tikhonov

    keep_freed_memory()
    network = NeRIF(max_steps=10**7, epochs=1e9, device="cpu")
    voxels = Tikhonov(voxels=64, regularisation=1e-3, device="cpu")
    methods: dict[str, Reconstructor] = {
        "8192": network,
        "1024": replace(network, points_per_batch=1024),
        "linear": replace(voxels, basis="linear"),
        "cubic": voxels,
    }
    method = next(method for key, method in methods.items() if key in work)
    measurement, done, start = Measurement.read(data), 0, 0.0

    def note(_: object = None) -> None:
        nonlocal done, start
        if done % WORKS[work] == 0:
            if done:
                print((time.perf_counter() - start) / WORKS[work], flush=True)
            sys.stdin.readline()
            start = time.perf_counter()
        done += 1

    if "step" in work:
        method(measurement, note)
    while True:
        note()
        method(measurement)


class Worker:
    """A version at work, which goes on when it is told."""

    def __init__(self, checkout: Path, work: str, data: Path) -> None:
        command = [sys.executable, str(Path(__file__).resolve()), str(checkout), "--work", work, "--data", str(data)]
        where = {**os.environ, "PYTHONPATH": str(checkout / "src"), "OMP_WAIT_POLICY": "PASSIVE"}
        self.process = subprocess.Popen(command, env=where, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def turn(self) -> float:
        """Seconds a step of the next turn."""
        go, told = self._pipe(self.process.stdin), self._pipe(self.process.stdout)
        go.write("\n")
        go.flush()
        return float(told.readline())

    @staticmethod
    def _pipe(pipe: IO[str] | None) -> IO[str]:
        assert pipe is not None
        return pipe


def turns(before: Path, work: str, data: Path, count: int) -> list[tuple[float, float]]:
    """Seconds a step before and now, turn by turn; which goes first changes."""
    workers = [Worker(path, work, data) for path in (before, HERE)]
    try:
        found = []
        for i in range(WARM + count):
            order = (0, 1) if i % 2 else (1, 0)
            taken = {k: workers[k].turn() for k in order}
            found.append((taken[0], taken[1]))
        return found[WARM:]
    finally:
        for worker in workers:
            worker.process.kill()
            worker.process.communicate()


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("before", type=Path, help="another checkout of the repository")
    parser.add_argument("--turns", type=int, default=40)
    parser.add_argument("--work", help=argparse.SUPPRESS)
    parser.add_argument("--data", type=Path, help=argparse.SUPPRESS)
    add_write(parser)
    asked = parser.parse_args()
    if asked.work:
        take_turns(asked.work, asked.data)
        return
    from nerif.fields.phantoms import Flame
    from nerif.geometry import paper_rig
    from nerif.simulation.simulate import add_noise, simulate

    versions = {name: _commit(path) for name, path in (("before", asked.before), ("now", HERE))}
    columns = ("work", "ms before", "ms now", "now / before", "quartiles")
    table = Table(f"Speed of {versions['now']} over {versions['before']}", columns, asked.write)
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "m.nc"
        cameras, box = paper_rig(64)
        add_noise(simulate(Flame(box), cameras, box, N_AMBIENT), 0.05, seed=1).write(data)
        for work in WORKS:
            both = turns(asked.before, work, data, asked.turns)
            low, middle, high = statistics.quantiles((now / before for before, now in both), n=4)
            times = (f"{1e3 * statistics.median(column):.2f}" for column in zip(*both, strict=True))
            table.row([work, *times, f"{middle:.3f}", f"{low:.3f} to {high:.3f}"])


def _commit(checkout: Path) -> str:
    named = ["git", "-C", str(checkout), "describe", "--always", "--dirty"]
    return subprocess.run(named, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()
