"""What bounds of the index are worth on a flame: hot gas in air is never above the ambient.

    python benchmarks/bounds.py --write benchmarks/results/bounds-cpu.md

The flame phantom on the paper's rig with few views and with many, little noise and much; NeRIF with the same steps,
free, with `--upper 0`, and with the lowest excess of hot air too (`--lower`); total variation free and bounded.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable
from dataclasses import replace

from bench import N_AMBIENT, Table, add_write
from nerif.analysis.evaluation import evaluate_volume
from nerif.fields.network import NetworkShape
from nerif.geometry import Ring
from nerif.reconstruction.base import Reconstructor
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.simulation.simulate import Simulation

LOWEST = -2.7e-4
"""Index excess of what is so hot that nothing is left of the index of air."""


def methods(steps: int, voxels: int) -> dict[str, Callable[[int], Reconstructor]]:
    """The methods by name, each for a seed."""
    network = NeRIF(network=NetworkShape(width=64), points_per_batch=4096, max_steps=steps, device="cpu")
    tv = TotalVariation(voxels=voxels, device="cpu")
    return {
        "NeRIF": lambda seed: replace(network, seed=seed),
        "NeRIF, upper 0": lambda seed: replace(network, seed=seed, upper=0.0),
        f"NeRIF, {LOWEST:g} to 0": lambda seed: replace(network, seed=seed, lower=LOWEST, upper=0.0),
        "TV": lambda seed: tv,
        "TV, upper 0": lambda seed: replace(tv, upper=0.0),
    }


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--views", type=int, nargs="+", default=[3, 9])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.05, 0.15])
    parser.add_argument("--pixels", type=int, default=64, help="of an edge of each view")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--voxels", type=int, default=40)
    parser.add_argument("--seeds", type=int, default=3, help="of noise and training, whose median is shown")
    add_write(parser)
    asked = parser.parse_args()
    tried = methods(asked.steps, asked.voxels)
    title = f"Bounds on the flame, {asked.pixels}² px, {asked.steps} steps: L2"
    table = Table(title, ("views", "noise", *tried), asked.write)
    size = (asked.pixels, asked.pixels)
    for views in asked.views:
        cameras = Ring(views=views, image_size=size, pixel_pitch=0.02 * 200 / asked.pixels).cameras()
        for noise in asked.noise:
            errors: dict[str, list[float]] = {name: [] for name in tried}
            for seed in range(asked.seeds):
                measurement, truth = Simulation(noise=noise, seed=seed)(cameras)
                for name, method in tried.items():
                    result = method(seed)(measurement)
                    errors[name].append(evaluate_volume(result.field, truth, N_AMBIENT)["l2"])
            medians = (f"{statistics.median(found):.3%}" for found in errors.values())
            table.row([str(views), f"{noise:g}", *medians])


if __name__ == "__main__":
    main()
