"""Cameras off by chance, refined with the field: several draws of their errors, with 5, 9 and 18 views.

    python benchmarks/pose_draws.py ../shared/data/rigs --write benchmarks/results/pose-draws-cpu.md

The flame and the cameras are those of thin.nc, made by others; 5 views are every other one of them. 18 are those with
nine more half-way between, whose displacements are predicted from the truth on its voxels, with the same noise. Each
draw turns and shifts every camera by chance, and the displacements stay as they are. Steps and not seconds end a run.
"""

from __future__ import annotations

import argparse
import math
import statistics
from dataclasses import replace
from pathlib import Path

import torch

from bench import Table, add_write, alone
from nerif.data.measurement import Measurement
from nerif.geometry import Camera
from nerif.geometry.pose import GEOMETRY, Corrections

SIZES = {"small": (0.2, 0.01), "large": (0.5, 0.03)}
"""Standard deviation of each camera's place along each axis, mm, and of its turns about them, degrees."""
GOALS = {"small": (0.008, 0.005), "large": (0.014, 0.0065)}
"""L2 of nine views, before and after the best rigid motion of the field."""


def turned(camera: Camera, degrees: float) -> Camera:
    """The camera, turned with its background about the z axis of the world."""
    a = math.radians(degrees)
    turn = torch.tensor([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]], dtype=torch.float64)
    plane = camera.background
    assert plane is not None
    background = replace(plane, normal=turn @ plane.normal.double())
    rotation = camera.rotation.double() @ turn.T
    return replace(camera, name=f"{camera.name}+", rotation=rotation, background=background)


def of_views(folder: Path, views: int, seed: int) -> Measurement:
    """Return the measurement by 5, 9 or 18 views, their cameras as they are."""
    from nerif.analysis.prediction import predict
    from nerif.data.volume_file import read_volume
    from nerif.fields.grid import VoxelField

    thin = Measurement.read(folder / "thin.nc")
    if views <= len(thin.cameras):
        return thin.select(thin.names[:: 2 if 2 * views <= len(thin.cameras) + 1 else 1])
    assert thin.displacement is not None
    assert thin.sigma is not None
    truth = read_volume(folder / "truth.nc")
    more = tuple(turned(camera, 180 / len(thin.cameras) / 2) for camera in thin.cameras)
    field = VoxelField.through(truth.values.double(), truth.grid)
    seen = predict(field, more, thin.box, thin.n_ambient).displacements
    noise = torch.randn(seen.shape, generator=torch.Generator().manual_seed(seed))
    sigma = thin.sigma.nanmedian().expand(thin.sigma.shape)
    both = torch.cat([thin.displacement, seen.to(thin.displacement) + noise * sigma])
    masks = None if thin.valid is None else torch.cat([thin.valid, torch.ones_like(thin.valid)])
    return replace(
        thin, cameras=(*thin.cameras, *more), displacement=both, sigma=torch.cat([thin.sigma, sigma]), valid=masks
    )


def knocked(measurement: Measurement, mm: float, degrees: float, seed: int) -> Measurement:
    """Return the measurement with cameras stated off by chance."""
    drawn = torch.Generator().manual_seed(seed)
    values = torch.zeros(len(measurement.cameras), len(GEOMETRY), dtype=torch.float64)
    values[:, :3] = math.radians(degrees) * torch.randn(len(values), 3, generator=drawn, dtype=torch.float64)
    values[:, 3:6] = mm * torch.randn(len(values), 3, generator=drawn, dtype=torch.float64)
    return replace(measurement, cameras=Corrections(measurement.cameras, values).corrected)


def run(folder: Path, views: int, size: str, seed: int, refine: bool, steps: int) -> tuple[float, float]:
    """Reconstruct, and return L2 before and after the best rigid motion of the field."""
    from nerif.analysis.alignment import aligned
    from nerif.analysis.evaluation import evaluate_volume
    from nerif.data.volume_file import read_volume
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural.neural import NeRIF

    keep_freed_memory()
    mm, degrees = SIZES[size]
    measurement = knocked(of_views(folder, views, seed), mm, degrees, seed)
    settings = NeRIF(max_steps=steps, epochs=1e9, seed=seed, device="cpu")
    if refine:
        settings = replace(settings, refine=("cameras",), pose_sigma_mm=mm, pose_sigma_deg=degrees)
    field = settings(measurement).field
    truth = read_volume(folder / "truth.nc")
    found = [evaluate_volume(f, truth, measurement.n_ambient)["l2"] for f in (field, aligned(field, truth))]
    return found[0], found[1]


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("rigs", type=Path, help="folder with thin.nc and truth.nc")
    parser.add_argument("--views", type=int, nargs="+", default=[9, 5, 18], choices=[5, 9, 18])
    parser.add_argument("--sizes", nargs="+", default=list(SIZES), choices=list(SIZES))
    parser.add_argument("--draws", type=int, default=5, help="of pose errors with nine views; one of other numbers")
    parser.add_argument("--steps", type=int, default=2000, help="of training; some 90 s on two cores with 9 views")
    add_write(parser)
    asked = parser.parse_args()
    columns = ["views", "errors", "refined", "draws", "L2", "goal", "L2 aligned", "goal", "aligned, lowest to highest"]
    more = f"\n\n{asked.steps} steps; medians of the draws."
    table = Table("Cameras off by chance, refined", columns, asked.write, more)
    for views in asked.views:
        for size in asked.sizes:
            for refine in (False, True):
                draws = asked.draws if views == 9 and refine else 1
                found = [alone(run, asked.rigs, views, size, seed, refine, asked.steps) for seed in range(draws)]
                whole, moved = (statistics.median(one[i] for one in found) for i in range(2))
                goal = [f"{g:.2%}" for g in GOALS[size]] if refine and views == 9 else ["", ""]
                mm, degrees = SIZES[size]
                most = f"{min(f[1] for f in found):.3%} to {max(f[1] for f in found):.3%}"
                head = [str(views), f"{mm} mm, {degrees}°", "cameras" if refine else "-", str(draws)]
                table.row([*head, f"{whole:.3%}", goal[0], f"{moved:.3%}", goal[1], most])


if __name__ == "__main__":
    main()
