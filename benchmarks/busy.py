"""What another program on the machine costs a run: steps of NeRIF in equal seconds, of two versions, in turns.

    git worktree add ../before COMMIT
    python benchmarks/busy.py ../before --write benchmarks/results/busy-cpu.md

A run is alone, beside a program that takes one core, or beside another run of the same version. Each run is a process
of its own that imports `nerif` from its checkout; what the others do begins before it and ends after it.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from bench import N_AMBIENT, Table, add_write

HERE = Path(__file__).resolve().parents[1]
BESIDE = {"nothing": "", "a program on one core": "while True: pass", "another run": "run"}
WARM = 20.0  # seconds until another run trains
VERSIONS = ("before", "now")


def train(path: Path, seconds: float) -> int:
    """Return the steps of a run of so many seconds in this process."""
    from nerif.data.measurement import Measurement
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural.neural import NeRIF

    keep_freed_memory()
    result = NeRIF(epochs=0, time_limit=seconds, seed=0, device="cpu")(Measurement.read(path))
    return int(result.history[-1]["step"])


def command(path: Path, seconds: float) -> list[str]:
    """Return the command of a run."""
    return [sys.executable, __file__, ".", "--run", str(path), "--seconds", str(seconds)]


@contextlib.contextmanager
def beside(what: str, where: dict[str, str], path: Path) -> Iterator[None]:
    """Let something else go on meanwhile."""
    if not what:
        yield
        return
    words = command(path, 3600.0) if what == "run" else [sys.executable, "-c", what]
    with subprocess.Popen(words, env=where, stdout=subprocess.DEVNULL) as other:
        time.sleep(WARM if what == "run" else 0.5)
        try:
            yield
        finally:
            other.kill()


def main() -> None:
    """Run the turns and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("before", type=Path, help="another checkout of the repository")
    parser.add_argument("--pixels", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each run")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--run", type=Path, help=argparse.SUPPRESS)
    add_write(parser)
    asked = parser.parse_args()
    if asked.run:
        print(train(asked.run, asked.seconds))
        return
    from nerif.fields.phantoms import make_phantom
    from nerif.geometry import paper_rig
    from nerif.simulation.simulate import simulate

    more = f"; nine views of {asked.pixels} x {asked.pixels} px, {asked.seconds:g} s a run, medians of {asked.turns}"
    columns = ("beside", "steps before", "steps now", "now / before")
    table = Table("Steps of a run on a machine that is busy", columns, asked.write, more)
    places = {"before": asked.before.resolve(), "now": HERE}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.nc"
        cameras, box = paper_rig(asked.pixels)
        simulate(make_phantom("flame", box, 0), cameras, box, N_AMBIENT).write(path)
        for name, what in BESIDE.items():
            found: dict[str, list[int]] = {version: [] for version in VERSIONS}
            for turn in range(asked.turns):
                for version in VERSIONS if turn % 2 == 0 else VERSIONS[::-1]:
                    where = {
                        **os.environ,
                        "PYTHONPATH": os.pathsep.join([str(places[version] / "src"), str(HERE / "benchmarks")]),
                    }
                    with beside(what, where, path):
                        told = subprocess.run(
                            command(path, asked.seconds), env=where, capture_output=True, text=True, check=True
                        )
                    found[version].append(int(told.stdout))
            before, now = (statistics.median(found[version]) for version in VERSIONS)
            table.row([name, f"{before:g}", f"{now:g}", f"{now / before:.2f}"])


if __name__ == "__main__":
    main()
