"""Does a run without a limit end where it should? Its error beside that of a run of four times as many steps.

    python benchmarks/ending.py --write benchmarks/results/ending-cpu.md

The flame on the paper's rig in images of several sizes (full_size.py). The run without a limit ends when rays that
no step is given are met no better, or after its longest time; the other has one schedule over all of its steps, and no
rays held back. Each is a process of its own.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch

from bench import N_AMBIENT, Table, add_write, alone
from full_size import flame, measured
from nerif.analysis.evaluation import evaluate_volume
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.geometry import Grid
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.neural.presets import preset

LONGER = 4


def run(path: Path, steps: int, seed: int, threads: int) -> tuple[int, float, float, str]:
    """Reconstruct without a limit, or for so many steps; return steps, seconds, L2 and why it ended."""
    torch.set_num_threads(threads)
    keep_freed_memory()
    measurement, settings = Measurement.read(path), replace(preset("fast"), seed=seed, device="cpu")
    result = (replace(settings, max_steps=steps) if steps else settings)(measurement)
    grid = Grid.of_resolution(measurement.box, 100)
    truth = Volume(flame(measurement.box).sample(grid), grid)
    error = evaluate_volume(result.field, truth, N_AMBIENT)["l2"]
    done = steps or int(result.history[-1]["step"])
    return done, result.seconds, error, f"{result.outcome.reason}: {result.outcome.message}"


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pixels", type=int, nargs="+", default=[64, 200, 1000], help="of an edge of each view")
    parser.add_argument("--noise", type=float, default=0.05, help="share of the rms displacement")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--folder", type=Path, help="where measurements are kept")
    add_write(parser)
    asked = parser.parse_args()
    columns = ["pixels", "seed", "steps", "s", "L2", f"steps x {LONGER}", "s", "L2", "ratio of L2", "ended"]
    table = Table("A run without a limit", columns, asked.write, f"; flame, 9 views, noise {asked.noise:g}")
    with tempfile.TemporaryDirectory() as folder:
        for pixels in asked.pixels:
            kept = asked.folder or Path(folder)
            kept.mkdir(parents=True, exist_ok=True)
            path = alone(measured, pixels, asked.noise, kept)
            for seed in asked.seeds:
                steps, seconds, error, why = alone(run, path, 0, seed, asked.threads)
                print(f"{pixels}²: {steps} steps, {seconds:.0f} s, {error:.3%}, {why}", file=sys.stderr, flush=True)
                more, longer, least, _ = alone(run, path, LONGER * steps, seed, asked.threads)
                cells = [str(steps), f"{seconds:.0f}", f"{error:.3%}", str(more), f"{longer:.0f}", f"{least:.3%}"]
                table.row([f"{pixels}²", str(seed), *cells, f"{error / least:.2f}", why])


if __name__ == "__main__":
    main()
