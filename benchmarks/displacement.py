"""Which optical flow: every method on rendered pairs of images, displacements up to 3 px, 12-bit noise.

    python benchmarks/displacement.py --write benchmarks/results/displacement-cpu.md

The truth is the displacement of the pinhole camera by curved rays; errors are taken 8 px inside the image's edge.
`e / sigma` is the rms error in units of the sigma that the method itself states (five reference frames).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
import torch

from bench import N_AMBIENT, Table, add_write
from nerif.common.conventions import Points, Values, Vectors
from nerif.fields.base import Field
from nerif.fields.phantoms import make_phantom
from nerif.geometry import paper_rig
from nerif.imaging.displacement.displacement import DisplacementSettings, measure
from nerif.imaging.displacement.optical_flow import FLOWS
from nerif.imaging.patterns import KINDS, Background
from nerif.simulation.rendering import Sensor, background_texture, pattern_size, render
from nerif.simulation.simulate import view_displacement

LARGEST = 3.0  # px
REFERENCES = 5
EDGE = 8
COLUMNS = ("pixels", "phantom", "background", "method", "median error [px]", "rms error [px]", "e / sigma", "valid",
           "seconds a pair")  # fmt: skip


@dataclass(frozen=True)
class Scaled(Field):
    """Another field, times a factor."""

    field: Field
    factor: float

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        value, gradient = self.field.value_and_gradient(points)
        return self.factor * value, self.factor * gradient


def pair(phantom: str, kind: str, pixels: int, dot: float) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Reference images, flow image, true displacement; the phantom scaled so that the largest is LARGEST."""
    cameras, box = paper_rig(pixels)
    camera = cameras[0]
    field = make_phantom(phantom, box, 0)
    largest = float(view_displacement(field, camera, box, N_AMBIENT, steps=60).norm(dim=-1).max())
    field = Scaled(field, LARGEST / largest)
    truth = view_displacement(field, camera, box, N_AMBIENT, steps=60)
    width, height = pattern_size(camera)
    pixel = width / 1.1 / pixels
    raster = Background(kind, width, height, dot=dot * pixel).raster(pixel / 4)
    texture = background_texture(camera, torch.from_numpy(raster), pixel / 4)
    sensor, still = Sensor(bits=12), render(camera, texture)
    moved = render(camera, texture, field, box, N_AMBIENT, steps=60)
    return [sensor.expose(still, i) for i in range(REFERENCES)], sensor.expose(moved, 99), truth.numpy()


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pixels", type=int, nargs="+", default=[200, 1024], help="of an edge of the images")
    parser.add_argument("--phantom", nargs="+", default=["gaussians", "flame"])
    parser.add_argument("--background", nargs="+", default=list(KINDS))
    parser.add_argument("--method", nargs="+", default=list(FLOWS))
    parser.add_argument("--dot", type=float, default=3.0, help="size of a dot, px")
    add_write(parser)
    arguments = parser.parse_args()

    table = Table(
        "Displacement by every method",
        COLUMNS,
        arguments.write,
        f"\n\nRendered pairs, displacements up to {LARGEST:g} px, 12-bit noise.",
    )
    inner = slice(EDGE, -EDGE)
    for pixels in arguments.pixels:
        for phantom in arguments.phantom:
            for kind in arguments.background:
                references, flow, truth = pair(phantom, kind, pixels, arguments.dot)
                for method in arguments.method:
                    settings = DisplacementSettings(method)
                    start = time.perf_counter()
                    measure(references[:1], [flow], settings)
                    seconds = time.perf_counter() - start
                    found = measure(references, [flow], settings)
                    error = (found.displacement - truth)[inner, inner]
                    length = np.hypot(error[..., 0], error[..., 1])
                    ratio = np.sqrt(np.mean((error / found.sigma[inner, inner]) ** 2))
                    cells = [f"{pixels}²", phantom, kind, method, f"{np.median(length):.4f}"]
                    cells += [f"{np.sqrt(np.mean(length**2)):.4f}", f"{ratio:.1f}"]
                    table.row([*cells, f"{found.valid[inner, inner].mean():.1%}", f"{seconds:.2f}"])


if __name__ == "__main__":
    main()
