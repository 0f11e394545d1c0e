"""What a network leaves of a turbulent flow, taken up by splines: does the error follow the residual?

    python benchmarks/detail.py --write benchmarks/results/detail-cpu.md

NeRIF is trained; what its field leaves of the displacements is reconstructed by Tikhonov on finer and finer grids, as a
correction that is added to it. Residual: rms over sigma of all pixels. With more views the same is done again.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from bench import N_AMBIENT, Table, add_write
from nerif.analysis.evaluation import evaluate_volume
from nerif.analysis.prediction import predict_view
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.grid import VoxelField
from nerif.fields.phantoms import make_phantom
from nerif.forward.path_integral import PathIntegral
from nerif.forward.registry import forward_model
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.simulation.simulate import simulate

BOX = Box.cube(50.0)
TRUTH = 100  # voxels along an edge


def seen(field: VoxelField, measurement: Measurement) -> Tensor:
    """What the cameras would see of a field, on the pixels of the measurement."""
    (observation,) = measurement.observations
    projector = PathIntegral(forward_model(observation.technique, measurement, "auto"), 2 * max(field.grid.shape))
    return torch.stack([predict_view(field, camera, projector, measurement.box) for camera in measurement.cameras])


def told(field: VoxelField, predicted: Tensor, measurement: Measurement, truth: Volume) -> list[str]:
    """Return the cells of a field: the residual, L2 and L2 of the variation."""
    (observation,) = measurement.observations
    assert observation.sigma is not None
    left = ((observation.values - predicted) / observation.sigma)[measurement.usable].square().mean().sqrt()
    errors = evaluate_volume(field, truth, N_AMBIENT)
    return [f"{left:.2f}", f"{errors['l2']:.3%}", f"{errors['l2_variation']:.2%}"]


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--phantoms", nargs="+", default=["fire", "turbulence"])
    parser.add_argument("--views", type=int, nargs="+", default=[9, 18])
    parser.add_argument("--pixels", type=int, default=200, help="of an edge of each view")
    parser.add_argument("--noise", type=float, default=0.05, help="share of the rms displacement")
    parser.add_argument("--time-limit", type=float, default=90.0, help="of NeRIF, s")
    parser.add_argument("--voxels", type=int, nargs="+", default=[64, 100, 160], help="of the splines, along an edge")
    parser.add_argument("--seed", type=int, default=0)
    add_write(parser)
    asked = parser.parse_args()
    keep_freed_memory()
    title = f"What a network leaves, {asked.pixels}² px, noise {asked.noise:g}, {asked.time_limit:g} s of training"
    table = Table(title, ["phantom", "views", "field", "residual, sigma", "L2", "of variation", "s"], asked.write)
    fine = Grid.of_resolution(BOX, max(asked.voxels))
    for phantom in asked.phantoms:
        field, grid = make_phantom(phantom, BOX, asked.seed), Grid.of_resolution(BOX, TRUTH)
        truth = Volume(field.sample(grid), grid)
        for views in asked.views:
            arc, pitch = (0.0, 180 * (1 - 1 / views)), 4.0 / asked.pixels
            ring = Ring(views=views, arc=arc, image_size=(asked.pixels, asked.pixels), pixel_pitch=pitch)
            measurement = simulate(field, ring.cameras(), BOX, N_AMBIENT, asked.noise, seed=asked.seed + 1)
            (observation,) = measurement.observations
            name, sigma = observation.technique.name, observation.sigma
            assert sigma is not None
            result = NeRIF(time_limit=asked.time_limit, seed=asked.seed, device="cpu")(measurement)
            network = VoxelField.through(result.field.sample(fine).float(), fine)
            predicted = seen(network, measurement)

            row = [phantom, str(views)]
            table.row([*row, "NeRIF", *told(network, predicted, measurement, truth), f"{result.seconds:.0f}"])
            rest = measurement.observed({name: observation.values - predicted}, {name: sigma})
            for voxels in asked.voxels:
                more = Tikhonov(voxels=voxels, device="cpu")(rest)
                splines = VoxelField.through(more.field.sample(fine).float(), fine)
                both = VoxelField(network.coefficients + splines.coefficients, fine, 3)
                cells = told(both, predicted + seen(splines, measurement), measurement, truth)
                table.row([*row, f"and splines, {voxels}³", *cells, f"{more.seconds:.0f}"])


if __name__ == "__main__":
    main()
