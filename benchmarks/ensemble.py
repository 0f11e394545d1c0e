"""How often the truth lies within two standard deviations of an ensemble (nerif reconstruct --ensemble).

    python benchmarks/ensemble.py --members 10 --write benchmarks/results/ensemble-cpu.md

Simulated data of known noise on the rig of the demo (9 views of 64 x 64 px). For each case: error of the reconstruction
and of the ensemble's mean, the rms standard deviation, and the share of voxels whose truth lies within two standard
deviations: over all voxels, and over those where the flow is (excess above 2 % of its largest). A Gaussian error that
the ensemble knew all of would give 95 %.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import torch

from bench import N_AMBIENT, Table, add_write
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Grid, Ring
from nerif.measurement import Measurement
from nerif.reconstruction.base import Reconstructor
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.ensemble import Ensemble, Spread
from nerif.reconstruction.presets import preset
from nerif.reconstruction.total_variation import TotalVariation
from nerif.simulation import simulate
from nerif.volume import Volume

BOX = Box.cube(50.0)
GRID = Grid.of_resolution(BOX, 64)
COLUMNS = ("L2", "L2 of mean", "std / error", "mean, all", "mean, flow", "reconstruction, all", "reconstruction, flow")


def methods(steps: int) -> dict[str, Reconstructor]:
    """What is measured: the default preset cut to a number of steps, and total variation."""
    return {
        "NeRIF": replace(preset("fast"), max_steps=steps),
        "TV": TotalVariation(voxels=40),
    }


def measure(
    reconstructor: Reconstructor, measurement: Measurement, truth: torch.Tensor, members: int, leave_one_out: bool
) -> dict[str, float]:
    """Reconstruct once and `members` times more, and compare spread and error."""
    best = reconstructor(measurement).volume(GRID)
    assert measurement.sigma is not None
    ensemble, spread = Ensemble(members, leave_one_out), Spread()
    for number in range(1, members + 1):
        noise = {"deflection": measurement.sigma}
        method, noisy = ensemble.member(number, reconstructor, measurement, noise)
        spread.add([method(noisy).volume(GRID)])
    mean, std = (v.values for v in spread.volumes())
    flow = truth.abs() > 0.02 * truth.abs().max()
    norm = float((truth + N_AMBIENT - 1).norm())

    def share(centre: torch.Tensor, where: torch.Tensor) -> float:
        return float(((truth - centre).abs() <= 2 * std)[where].float().mean())

    everywhere = torch.ones_like(flow)
    return {
        "L2": float((best.values - truth).norm()) / norm,
        "L2 of mean": float((mean - truth).norm()) / norm,
        "std / error": float(std[flow].norm() / (mean - truth)[flow].norm()),
        "mean, all": share(mean, everywhere),
        "mean, flow": share(mean, flow),
        "reconstruction, all": share(best.values, everywhere),
        "reconstruction, flow": share(best.values, flow),
    }


def main() -> None:
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--members", type=int, default=10)
    parser.add_argument("--steps", type=int, default=2000, help="of NeRIF")
    parser.add_argument("--phantoms", nargs="+", default=["gaussians", "flame"])
    parser.add_argument("--noise", nargs="+", type=float, default=[0.05, 0.15])
    parser.add_argument("--methods", nargs="+", default=["NeRIF"], help="NeRIF, TV")
    parser.add_argument("--leave-one-out", nargs="+", choices=["no", "yes"], default=["no", "yes"])
    add_write(parser)
    arguments = parser.parse_args()
    keep_freed_memory()
    cameras = Ring(image_size=(64, 64), pixel_pitch=0.02 * 200 / 64).cameras()
    head = ("phantom", "noise", "method", "one view left out", *COLUMNS, "seconds")
    table = Table("Ensemble: is the truth within two standard deviations?", head, arguments.write)
    for phantom in arguments.phantoms:
        field = make_phantom(phantom, BOX, 0, 0.0)
        truth = Volume(field.sample(GRID), GRID).values
        for noise in arguments.noise:
            measurement = simulate(field, cameras, BOX, N_AMBIENT, noise, seed=1)
            for name, method in methods(arguments.steps).items():
                if name not in arguments.methods:
                    continue
                for leave in (choice == "yes" for choice in arguments.leave_one_out):
                    started = time.perf_counter()
                    found = measure(method, measurement, truth, arguments.members, leave)
                    cells = [f"{found[c]:.2f}" if c == "std / error" else f"{found[c]:.2%}" for c in COLUMNS]
                    seconds = f"{time.perf_counter() - started:.0f}"
                    table.row([phantom, f"{noise:g}", name, "yes" if leave else "no", *cells, seconds])


if __name__ == "__main__":
    main()
