"""How far sixty steps bring a network of any shape: the loss beside that of the empty field.

    python benchmarks/shapes.py --write benchmarks/results/shapes-cpu.md

Every shape has the same rates, steps and points. The loss is taken over every 20th ray at the end; 1 is a field that
explains nothing. The last column has what the run says of itself.
"""

from __future__ import annotations

import argparse
import itertools
import time
from dataclasses import replace

import torch

from bench import N_AMBIENT, Table, add_write
from nerif.fields.network import NetworkShape
from nerif.fields.phantoms import make_phantom
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import paper_rig
from nerif.reconstruction.base import Reconstruction
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.neural.presets import preset
from nerif.reconstruction.target import Target
from nerif.simulation.simulate import simulate

COLUMNS = ("octaves", "width", "depth", "loss / that of the empty field", "taken back", "seconds", "outcome")


def unexplained(result: Reconstruction, target: Target) -> float:
    """Mean square of the residuals over that of what was measured."""
    (part,) = target.parts
    seen = project(PathIntegral(part.model, 60), result.field, part.rays, result.device)
    return float(part.residual(seen).square().mean())


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
    parser.add_argument("--batch", type=int, default=8192, help="sample points of a step")
    add_write(parser)
    arguments = parser.parse_args()

    keep_freed_memory()
    cameras, box = paper_rig(arguments.pixels)
    measurement = simulate(make_phantom("flame", box, 0), cameras, box, N_AMBIENT, arguments.noise, seed=1)
    target = Target.of(measurement)
    target = target[torch.arange(0, len(target), 20)]
    base = replace(preset(arguments.preset), max_steps=arguments.steps, device=arguments.device)
    base = replace(base, points_per_batch=arguments.batch)
    size = f"{arguments.pixels} x {arguments.pixels} px"
    more = f"; flame, {size}, noise {arguments.noise:g}, {arguments.steps} steps of {arguments.batch} points"
    table = Table("Networks of any shape after sixty steps", COLUMNS, arguments.write, more)
    for octaves, width, depth in itertools.product(arguments.octaves, arguments.width, arguments.depth):
        start = time.perf_counter()
        result = replace(base, network=NetworkShape(depth=depth, width=width, octaves=octaves))(measurement)
        seconds = time.perf_counter() - start
        back = sum("taken_back" in record for record in result.history)
        said = f"**{result.outcome.reason}**" if result.outcome.failed else result.outcome.reason
        said += " (said in its message)" if "not explained yet" in result.outcome.message else ""
        shape = (str(octaves), str(width), str(depth))
        table.row((*shape, f"{unexplained(result, target):.3f}", str(back), f"{seconds:.1f}", said))


if __name__ == "__main__":
    main()
