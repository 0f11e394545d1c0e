"""Absorption where little light is left: absorbances, transmittances or the square roots of those compared.

    python benchmarks/absorption.py --write benchmarks/results/absorption-cpu.md

The burnt fraction of the flame phantom as extinction, seen by the paper's rig without its backgrounds; each pixel of
the reference counts so many quanta, their noise is Poisson's, and sigma is what the counts themselves tell
(`techniques.absorption.absorbance`). NeRIF by each model, with the same steps on the same data.
"""

from __future__ import annotations

import argparse
import statistics
from dataclasses import replace

from bench import Table, add_write
from nerif.analysis.evaluation import evaluate_volume
from nerif.fields.network import NetworkShape
from nerif.forward.absorption import MODELS
from nerif.geometry import Ring
from nerif.reconstruction.neural.neural import NeRIF
from nerif.simulation.simulate import Simulation


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--views", type=int, default=9)
    parser.add_argument("--pixels", type=int, default=64, help="of an edge of each view")
    parser.add_argument("--counts", type=float, nargs="+", default=[100, 1000], help="quanta of the reference")
    parser.add_argument("--peaks", type=float, nargs="+", default=[0.02, 0.1, 0.3], help="largest extinction, 1/mm")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--seeds", type=int, default=3, help="of noise and training, whose median is shown")
    add_write(parser)
    asked = parser.parse_args()
    size = (asked.pixels, asked.pixels)
    cameras = Ring(views=asked.views, image_size=size, pixel_pitch=0.02 * 200 / asked.pixels).cameras()
    network = NeRIF(network=NetworkShape(width=64), points_per_batch=4096, max_steps=asked.steps, device="cpu")
    title = f"Extinction of a flame, {asked.views} views of {asked.pixels}² px, {asked.steps} steps"
    columns = ("counts", "largest absorbance", *(f"L2, {name}" for name in MODELS))
    table = Table(title, columns, asked.write)
    for counts in asked.counts:
        for peak in asked.peaks:
            errors: dict[str, list[float]] = {name: [] for name in MODELS}
            for seed in range(asked.seeds):
                flame = Simulation(technique=("absorption",), counts=counts, seed=seed, peak=peak)
                measurement, truth = flame(cameras)
                clean = replace(flame, counts=0.0)(cameras)[0].maps["absorbance"]
                for name in MODELS:
                    method = replace(network, model=name, seed=seed)
                    errors[name].append(evaluate_volume(method(measurement).field, truth, 1.0)["l2"])
            medians = (f"{statistics.median(found):.2%}" for found in errors.values())
            table.row([f"{counts:g}", f"{float(clean.nan_to_num().max()):.2f}", *medians])


if __name__ == "__main__":
    main()
