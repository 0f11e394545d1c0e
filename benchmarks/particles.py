"""Tomographic particle imaging: quality of the volumes and error of the velocity in a vortex ring, by MLEM and MART.

    python benchmarks/particles.py --write benchmarks/results/particles-cpu.md

Four views; at two instants the particles of a ring whose fastest move so many voxels in between. Nothing but the last
columns sees the truth.
"""

from __future__ import annotations

import argparse
import statistics
from dataclasses import replace

from bench import Table, add_write
from nerif.data.volume import Volume
from nerif.geometry import Grid
from nerif.reconstruction.base import Reconstructor
from nerif.reconstruction.neural.presets import preset
from nerif.reconstruction.voxels.multiplicative import MART, MLEM
from nerif.simulation.particles.cloud import Particles, quality_factor
from nerif.simulation.particles.images import images
from nerif.simulation.particles.rig import four_cameras
from nerif.simulation.particles.ring import VortexRing
from nerif.simulation.particles.velocity import velocity_between

SECONDS, VOXEL = 1e-3, 0.1
METHODS = ("MART", "MLEM", "NeRIF")
COLUMNS = (
    "particles a pixel", "volumes", "Q", "iterations", "seconds a volume", "rms error [voxel]", "vectors found",
)  # fmt: skip


def method_of(name: str, voxels: int, time_limit: float) -> Reconstructor:
    """Return the settings of a method."""
    if name == "NeRIF":
        return replace(preset("fast"), time_limit=time_limit, device="cpu")
    return (MART if name == "MART" else MLEM)(voxels=voxels, basis="linear", device="cpu")


class Case:
    """Two instants of a ring, seen, and what is to be compared with them."""

    def __init__(self, arguments: argparse.Namespace, per_pixel: float, seed: int) -> None:
        self.cameras, self.box = four_cameras(arguments.pixels, arguments.depth)
        self.ring = VortexRing.within(self.box, arguments.displacement * VOXEL / SECONDS)
        self.window, self.time_limit = arguments.window, arguments.time_limit
        before = Particles.draw(self.box, round(per_pixel * arguments.pixels**2), arguments.variation, seed)
        self.particles = before, self.ring.advect(before, SECONDS)
        self.grid = Grid.of_resolution(self.box, round(max(self.box.edges) / VOXEL))
        self.ideal = [particles.volume(self.grid) for particles in self.particles]
        self.seen = [
            images(particles, self.cameras, arguments.counts, seed=2 * seed + i)
            for i, particles in enumerate(self.particles)
        ]

    def volumes(self, method: str) -> tuple[list[Volume], dict[str, float]]:
        """Return the volumes by a method, or the ideal ones, and what they took, the mean of both."""
        if method == "ideal":
            return self.ideal, {}
        settings = method_of(method, max(self.grid.shape), self.time_limit)
        results = [settings(measurement) for measurement in self.seen]
        volumes = [result.volume(self.grid) for result in results]
        quality = [quality_factor(v.values, ideal.values) for v, ideal in zip(volumes, self.ideal, strict=True)]
        return volumes, {
            "Q": statistics.mean(quality),
            "iterations": statistics.mean(result.history[-1]["step"] for result in results),
            "seconds": statistics.mean(result.seconds for result in results),
        }

    def run(self, method: str) -> dict[str, float]:
        """Return the figures of a method."""
        volumes, figures = self.volumes(method)
        velocity = velocity_between(volumes[0], volumes[1], SECONDS, self.window)
        truth = self.ring.velocity(velocity.points.reshape(-1, 3)).reshape(velocity.points.shape)
        return figures | {"error": velocity.rms_error(truth) / VOXEL, "found": float(velocity.valid.double().mean())}


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--per-pixel", type=float, nargs="+", default=[0.02, 0.05], help="particles a pixel")
    parser.add_argument("--method", nargs="+", default=["ideal", *METHODS[:2]], choices=["ideal", *METHODS])
    parser.add_argument("--pixels", type=int, default=200, help="of an edge of each image")
    parser.add_argument("--depth", type=int, default=40, help="of the volume, in pixels")
    parser.add_argument("--counts", type=float, default=1000.0, help="quanta of a particle in an image")
    parser.add_argument("--variation", type=float, default=0.0, help="of brightness: deviation of its logarithm")
    parser.add_argument("--displacement", type=float, default=4.0, help="of the fastest particles, voxels")
    parser.add_argument("--window", type=int, default=24, help="of the correlation, voxels")
    parser.add_argument("--seeds", type=int, default=3, help="clouds, of whose figures the median is taken")
    parser.add_argument("--time-limit", type=float, default=60.0, help="of NeRIF, seconds")
    add_write(parser)
    arguments = parser.parse_args()
    table = Table(
        "Tomographic particle imaging",
        COLUMNS,
        arguments.write,
        f"\n\nFour views of {arguments.pixels} x {arguments.pixels} px; voxels of a pixel, {arguments.depth} of them "
        f"deep; {arguments.counts:g} quanta a particle. The fastest particles of the vortex ring move "
        f"{arguments.displacement:g} voxels; windows of {arguments.window}. Medians of {arguments.seeds} clouds, "
        "errors are rms over components and vectors. Ideal volumes are made from the true particles: the error that "
        "is left there is that of the correlation.",
    )
    for per_pixel in arguments.per_pixel:
        cases = [Case(arguments, per_pixel, seed) for seed in range(arguments.seeds)]
        for method in arguments.method:
            runs = [case.run(method) for case in cases]
            m = {name: statistics.median(run[name] for run in runs) for name in runs[0]}
            made = ["1", "-", "-"] if method == "ideal" else [
                f"{m['Q']:.3f}", f"{m['iterations']:.0f}", f"{m['seconds']:.0f}"
            ]  # fmt: skip
            table.row([f"{per_pixel:g}", method, *made, f"{m['error']:.3f}", f"{m['found']:.1%}"])


if __name__ == "__main__":
    main()
