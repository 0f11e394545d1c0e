"""The paper's numerical study in small: flame (or any phantom) on the paper's rig at noise 0, 0.1 and 0.15.

    python benchmarks/flame.py --preset fast --time-limit 150 --write benchmarks/results/flame-cpu.md

Needs nerif's core only (torch, NumPy, jaxtyping) and scikit-image. Truth and reconstruction meet only in the metrics.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from dataclasses import replace

import torch

from bench import N_AMBIENT, Table, add_write
from nerif.analysis.evaluation import evaluate_volume
from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Grid, paper_rig
from nerif.reconstruction.base import Step
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.neural.presets import PRESETS, preset
from nerif.simulation.simulate import add_noise, simulate

COLUMNS = (
    "preset", "noise", "L2", "L2 of variation", "CC", "SSIM", "steps", "epochs", "seconds", "memory [GiB]", "outcome",
)  # fmt: skip


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--phantom", default="flame")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.1, 0.15])
    parser.add_argument("--pixels", type=int, default=200, help="of an edge of each view (the paper: 200)")
    parser.add_argument("--preset", nargs="+", default=["auto"], choices=["auto", *PRESETS])
    parser.add_argument("--device", default="auto")
    parser.add_argument("--time-limit", type=float, nargs="+", default=[60.0], help="seconds of training")
    parser.add_argument("--points-per-batch", type=int, default=0, help="0 for that of the preset")
    parser.add_argument("--voxels", type=int, default=100, help="of the truth the error is taken on")
    add_write(parser)
    arguments = parser.parse_args()

    keep_freed_memory()
    cameras, box = paper_rig(arguments.pixels)
    phantom = make_phantom(arguments.phantom, box, arguments.seed)
    grid = Grid.of_resolution(box, arguments.voxels)
    truth = Volume(phantom.sample(grid), grid)
    start = time.perf_counter()
    clean = simulate(phantom, cameras, box, N_AMBIENT)
    table = Table(
        f"{arguments.phantom} on the paper's rig",
        COLUMNS,
        arguments.write,
        f"; simulated in {time.perf_counter() - start:.0f} s",
    )

    def tell(step: Step) -> None:
        if step.step % 500 == 0:
            print(
                f"  {step.seconds:.0f} s, step {step.step}, loss {step.losses['loss']:.2e}", file=sys.stderr, flush=True
            )

    for name, seconds, noise in itertools.product(arguments.preset, arguments.time_limit, arguments.noise):
        measurement = add_noise(clean, noise, seed=1)
        if torch.cuda.is_available():
            torch.cuda.reset_peak_memory_stats()
        settings = replace(preset(name), time_limit=seconds, epochs=0, device=arguments.device)
        if arguments.points_per_batch:
            settings = replace(settings, points_per_batch=arguments.points_per_batch)
        result = settings(measurement, tell)
        m = evaluate_volume(result.field, truth, N_AMBIENT, result.device)
        last = result.history[-1]
        cells = [name, f"{noise:g}", f"{m['l2']:.3%}", f"{m['l2_variation']:.2%}", f"{m['cc']:.5f}", f"{m['ssim']:.4f}"]
        cells += [f"{last['step']:.0f}", f"{last['epoch']:.1f}", f"{result.seconds:.0f}"]
        table.row([*cells, f"{result.peak_memory_bytes / 2**30:.2f}", result.outcome.reason])


if __name__ == "__main__":
    main()
