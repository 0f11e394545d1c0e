"""Emission of a flame from a few views: NeRIF, total variation and MLEM on the same data.

    python benchmarks/emission.py --write benchmarks/results/emission-cpu.md

The paper's rig without its backgrounds; the field is the burnt fraction of the flame phantom, the noise Gaussian. The
truth stands on 100^3 voxels. Each method has its default settings but for those named.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable
from dataclasses import replace

from bench import Table, add_write
from nerif.analysis.evaluation import evaluate_volume
from nerif.geometry import Ring
from nerif.reconstruction.base import Reconstructor
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.multiplicative import MLEM
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.simulation.simulate import Simulation


def methods(asked: argparse.Namespace) -> dict[str, Callable[[int], Reconstructor]]:
    """The methods by name, each for a seed."""
    network = NeRIF(time_limit=asked.time_limit, device="cpu")
    return {
        f"NeRIF, {asked.time_limit:g} s": lambda seed: replace(network, seed=seed),
        f"TV, {asked.voxels}³": lambda seed: TotalVariation(voxels=asked.voxels, device="cpu"),
        f"MLEM, {asked.voxels}³": lambda seed: MLEM(voxels=asked.voxels, device="cpu"),
    }


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--views", type=int, nargs="+", default=[9, 18])
    parser.add_argument("--pixels", type=int, default=100, help="of an edge of each view")
    parser.add_argument("--noise", type=float, default=0.05)
    parser.add_argument("--voxels", type=int, default=64)
    parser.add_argument("--time-limit", type=float, default=60.0, help="seconds of training")
    parser.add_argument("--seeds", type=int, default=1, help="of noise and training, whose median is shown")
    add_write(parser)
    asked = parser.parse_args()
    title = f"Burnt fraction of a flame as emission, {asked.pixels}² px, noise {asked.noise:g}"
    table = Table(title, ("views", "method", "L2", "CC", "SSIM", "seconds"), asked.write)
    size = (asked.pixels, asked.pixels)
    for views in asked.views:
        cameras = Ring(views=views, image_size=size, pixel_pitch=0.02 * 200 / asked.pixels).cameras()
        for name, method in methods(asked).items():
            rows = []
            for seed in range(asked.seeds):
                flame = Simulation(technique=("emission",), noise=asked.noise, seed=seed, peak=1.0)
                measurement, truth = flame(cameras)
                result = method(seed)(measurement)
                m = evaluate_volume(result.field, truth, 1.0)
                rows.append([m["l2"], m["cc"], m["ssim"], result.seconds])
            l2, cc, ssim, seconds = (statistics.median(column) for column in zip(*rows, strict=True))
            table.row([str(views), name, f"{l2:.2%}", f"{cc:.5f}", f"{ssim:.4f}", f"{seconds:.0f}"])


if __name__ == "__main__":
    main()
