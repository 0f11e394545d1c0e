"""The paper's numerical study in small: flame (or any phantom) on the paper's rig at noise 0, 0.1 and 0.15.

    python benchmarks/flame.py --device cuda --preset best fast --time-limit 8 30 --write results/flame-gpu.md

Needs nerif's core only (torch, NumPy, jaxtyping) and scikit-image. Truth and reconstruction meet only in the metrics.
"""

from __future__ import annotations

import argparse
import datetime
import itertools
import platform
import shlex
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch

from nerif.evaluation import evaluate_volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Grid, paper_rig
from nerif.reconstruction.base import Step
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.presets import PRESETS, preset
from nerif.simulation import add_noise, simulate
from nerif.volume import Volume

N_AMBIENT = 1.00027


def machine() -> str:
    """One line on what this ran on."""
    if torch.cuda.is_available():
        return f"{torch.cuda.get_device_name()}, torch {torch.__version__}"
    return f"{platform.machine()}, {torch.get_num_threads()} threads, {torch.backends.cpu.get_cpu_capability()}, " + (
        f"torch {torch.__version__}"
    )


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
    parser.add_argument("--voxels", type=int, default=100, help="of the truth the error is taken on")
    parser.add_argument("--write", type=Path, help="also write the table to this file")
    arguments = parser.parse_args()

    keep_freed_memory()
    cameras, box = paper_rig(arguments.pixels)
    phantom = make_phantom(arguments.phantom, box, arguments.seed)
    grid = Grid.of_resolution(box, arguments.voxels)
    truth = Volume(phantom.sample(grid), grid)
    start = time.perf_counter()
    clean = simulate(phantom, cameras, box, N_AMBIENT)
    lines = [
        f"Command: `python {shlex.join(sys.argv)}`  ",
        f"Machine: {machine()}  ",
        f"Date: {datetime.date.today().isoformat()}; simulated in {time.perf_counter() - start:.0f} s",
        "",
        "| preset | noise | L2 | L2 of variation | CC | SSIM | steps | epochs | seconds | memory [GiB] | outcome |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    print("\n".join(lines), flush=True)

    def tell(step: Step) -> None:
        if step.step % 500 == 0:
            print(
                f"  {step.seconds:.0f} s, step {step.step}, loss {step.losses['loss']:.2e}", file=sys.stderr, flush=True
            )

    for name, seconds, noise in itertools.product(arguments.preset, arguments.time_limit, arguments.noise):
        measurement = add_noise(clean, noise, seed=1)
        if torch.cuda.is_available():
            torch.cuda.reset_peak_memory_stats()
        settings = replace(preset(name), time_limit=seconds, device=arguments.device, epochs=1e6)
        result = settings(measurement, tell)
        m = evaluate_volume(result.field, truth, N_AMBIENT, result.device)
        last = result.history[-1]
        lines.append(
            f"| {name} | {noise:g} | {m['l2']:.3%} | {m['l2_variation']:.2%} | {m['cc']:.5f} | {m['ssim']:.4f} | "
            f"{last['step']:.0f} | {last['epoch']:.1f} | {result.seconds:.0f} | "
            f"{result.peak_memory_bytes / 2**30:.2f} | {result.outcome.reason} |"
        )
        print(lines[-1], flush=True)
    if arguments.write:
        arguments.write.parent.mkdir(parents=True, exist_ok=True)
        arguments.write.write_text(f"# {arguments.phantom} on the paper's rig\n\n" + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
