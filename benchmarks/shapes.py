"""How far sixty steps bring a network of any shape: the loss beside that of the empty field.

    python benchmarks/shapes.py --write benchmarks/results/shapes-cpu.md

Every shape has the same rates, steps and points. The loss is taken over all rays at the end; 1 is a field that explains
nothing. The last column has what the run says of itself.
"""

from __future__ import annotations

import argparse
import datetime
import itertools
import shlex
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch

from flame import N_AMBIENT, machine
from nerif.fields.mlp import NetworkShape
from nerif.fields.phantoms import make_phantom
from nerif.geometry import paper_rig
from nerif.physics.deflection import Deflection, project
from nerif.reconstruction.base import Reconstruction
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.presets import preset
from nerif.reconstruction.target import Target
from nerif.simulation import simulate


def unexplained(result: Reconstruction, target: Target) -> float:
    """Mean square of the residuals over that of what was measured."""
    seen = project(Deflection(samples=100, n_ambient=N_AMBIENT), result.field, target.rays, result.device)
    return float(((seen - target.displacement) * target.inverse_scale).square().mean())


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--octaves", type=int, nargs="+", default=[0, 2, 5, 6, 8])
    parser.add_argument("--width", type=int, nargs="+", default=[32, 64, 128, 256, 512])
    parser.add_argument("--depth", type=int, nargs="+", default=[2, 4, 8])
    parser.add_argument("--pixels", type=int, default=32, help="of an edge of each view")
    parser.add_argument("--noise", type=float, default=0.05)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--write", type=Path, help="also write the table to this file")
    arguments = parser.parse_args()

    keep_freed_memory()
    cameras, box = paper_rig(arguments.pixels)
    measurement = simulate(make_phantom("flame", box, 0), cameras, box, N_AMBIENT, arguments.noise, seed=1)
    target = Target.of(measurement)
    target = target[torch.arange(0, len(target), 5)]
    base = replace(preset(arguments.preset), epochs=1e6, max_steps=arguments.steps, device=arguments.device)
    lines = [
        f"Command: `python {shlex.join(sys.argv)}`  ",
        f"Machine: {machine()}  ",
        f"Date: {datetime.date.today().isoformat()}; flame, {arguments.pixels} x {arguments.pixels} px, "
        f"noise {arguments.noise:g}, {arguments.steps} steps",
        "",
        "| octaves | width | depth | loss / that of the empty field | taken back | seconds | outcome |",
        "|---|---|---|---|---|---|---|",
    ]
    print("\n".join(lines), flush=True)
    for octaves, width, depth in itertools.product(arguments.octaves, arguments.width, arguments.depth):
        start = time.perf_counter()
        result = replace(base, network=NetworkShape(depth=depth, width=width, octaves=octaves))(measurement)
        seconds = time.perf_counter() - start
        back = sum("taken_back" in record for record in result.history)
        said = result.outcome.reason if not result.outcome.failed else f"**{result.outcome.reason}**"
        lines.append(
            f"| {octaves} | {width} | {depth} | {unexplained(result, target):.3f} | {back} | {seconds:.1f} | {said} |"
        )
        print(lines[-1], flush=True)
        if arguments.write:
            arguments.write.parent.mkdir(parents=True, exist_ok=True)
            arguments.write.write_text("# Networks of any shape after sixty steps\n\n" + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
