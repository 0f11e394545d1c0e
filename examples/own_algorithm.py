"""An algorithm of your own in ten lines: Landweber, and total variation by gradient descent, on the forward projector.

    python examples/own_algorithm.py [MEASUREMENT.nc] [--voxels 20] [--out mine.vti]

Without a measurement that of a phantom is simulated, and the errors are those of n - n_ambient. docs/projector.md
defines the operator.
"""

from __future__ import annotations

import argparse

import torch

import nerif
from nerif.fields.field import Field


def landweber(A: nerif.Projector, iterations: int = 100) -> torch.Tensor:
    """x <- x + A^T (data - A x) / |A|^2, until the residual is that of the noise."""
    x = torch.zeros(A.domain_shape)
    for _ in range(iterations):
        residual = A.data - A(x)
        if A.sigma is not None and (residual / A.sigma).square().sum() < A.mask.sum():
            break
        x += A.T(residual) / A.norm**2
    return x


def total_variation(A: nerif.Projector, weight: float, steps: int = 100) -> torch.Tensor:
    """min |(A x - data) / sigma|^2 / N + weight sum |grad x| / max |x|, by Adam with the gradient of autograd."""
    x = landweber(A, 20)
    scale = float(x.abs().max())
    x.requires_grad_(True)
    optimiser = torch.optim.Adam([x], lr=0.03 * scale)
    for _ in range(steps):
        misfit = ((A(x) - A.data) / (1 if A.sigma is None else A.sigma))[A.mask].square().mean()
        variation = sum(x.diff(dim=axis).abs().sum() for axis in range(3)) / scale
        optimiser.zero_grad()
        (misfit + weight * variation).backward()
        optimiser.step()
    return x.detach()


def simulated() -> tuple[nerif.Measurement, Field]:
    """Six views of a flame, and the flame."""
    box = nerif.Box((-25, -22, -20), (25, 22, 20))
    rig = nerif.Ring(views=6, image_size=(24, 30), pixel_pitch=0.14, distance=700, background_distance=500)
    flame = nerif.make_phantom("flame", box)
    return nerif.simulate(flame, rig.cameras(), box, n_ambient=1.00027, noise=0.05, steps=40), flame


def main() -> None:
    """Reconstruct by both, and print residuals and errors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("measurement", nargs="?")
    parser.add_argument("--voxels", type=int, default=20)
    parser.add_argument("--out", help="volume to write: .vti, .nc, ...")
    words = parser.parse_args()
    truth = None
    if words.measurement:
        measurement = nerif.Measurement.read(words.measurement)
    else:
        measurement, truth = simulated()
    grid = nerif.Grid.of_resolution(measurement.box, words.voxels)
    A = nerif.Projector(measurement, grid)
    for name, x in (("Landweber", landweber(A)), ("total variation", total_variation(A, weight=2e-3))):
        residual = (A(x) - A.data)[A.mask].norm() / A.data.norm()
        line = f"{name:<16} residual {residual:.1%} of the data"
        if truth is not None:
            exact = truth.sample(grid)
            line += f", error {(A.volume(x).values - exact).norm() / exact.norm():.1%}"
        print(line)
        if words.out:
            nerif.export(words.out, [A.volume(x)], force=True)


if __name__ == "__main__":
    main()
