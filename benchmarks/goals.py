"""Error and seconds on common cases.

Flame, balls, octahedron, fire and turbulence on the demo's and on the paper's cameras, by NeRIF and the classical
methods; with `--against REV` before and now, in turns. The residual is the rms over sigma on some of the rays.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from benchmarks.runner import N_AMBIENT, Settings
from nerif.analysis.evaluation import evaluate_volume
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume, write_netcdf
from nerif.data.volume_file import read_volume
from nerif.fields.phantoms import make_phantom
from nerif.forward.path_integral import PathIntegral, project
from nerif.forward.registry import forward_model
from nerif.geometry import Grid, paper_rig
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.simulation.simulate import add_noise, simulate

RAYS, SAMPLES = 4096, 300  # of the residual
METHODS = {kind.__name__: kind for kind in (NeRIF, TotalVariation, Tikhonov, Landweber)}
CASES: tuple[tuple[str, int, float, str, float, int], ...] = (
    ("flame", 64, 0.05, "NeRIF", 20, 0),
    ("flame", 64, 0.05, "NeRIF", 90, 0),
    ("flame", 200, 0.1, "NeRIF", 60, 0),
    ("gaussians", 200, 0.1, "NeRIF", 60, 0),
    ("octahedron", 200, 0.1, "NeRIF", 60, 0),
    ("fire", 200, 0.05, "NeRIF", 180, 0),
    ("turbulence", 200, 0.05, "NeRIF", 180, 0),
    ("flame", 200, 0.1, "TotalVariation", 0, 0),
    ("flame", 200, 0.1, "Tikhonov", 0, 0),
    ("flame", 200, 0.1, "Landweber", 0, 0),
    ("flame", 200, 0.1, "TotalVariation", 0, 64),
    ("flame", 200, 0.1, "TotalVariation", 0, 100),
)
"""Phantom, pixels, noise, method, time limit (s) of NeRIF, voxels (0: default)."""
QUICK = (("flame", 16, 0.05, "NeRIF", 3, 0), ("flame", 16, 0.05, "Tikhonov", 0, 12))
COLUMNS = {
    "phantom": "{phantom}", "pixels": "{pixels}²", "noise": "{noise:g}", "method": "{method}", "limit [s]": "{limit:g}",
    "voxels": "{voxels}", "L2": "{l2:.3%}", "of variation": "{l2_variation:.2%}", "residual": "{residual:.2f}",
    "seconds": "{seconds:.0f}", "outcome": "{outcome}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    for values in QUICK if quick else CASES:
        names = ("phantom", "pixels", "noise", "method", "limit", "voxels")
        for seed in (0,) if quick else (0, 1, 2):
            yield {**dict(zip(names, values, strict=True)), "truth_voxels": 40 if quick else 100, "seed": seed}


def simulated(folder: Path, phantom: str, pixels: int, noise: float, voxels: int, seed: int) -> tuple[Path, Path]:
    """Return the files of measurement and truth, simulated once."""
    name = f"goals-{phantom}-{pixels}-{noise:g}-{seed}"
    data, truth = folder / f"{name}.nc", folder / f"{name}.truth-{voxels}.nc"
    if not (data.exists() and truth.exists()):
        cameras, box = paper_rig(pixels)
        field, grid = make_phantom(phantom, box, seed), Grid.of_resolution(box, voxels)
        write_netcdf(truth, [Volume.of(field.sample(grid), grid, "index_excess", N_AMBIENT)])
        add_noise(simulate(field, cameras, box, N_AMBIENT), noise, seed=seed + 1).write(data)
    return data, truth


def measure(
    folder: Path, phantom: str, pixels: int, noise: float, method: str, limit: float, voxels: int, truth_voxels: int,
    seed: int,
) -> dict[str, Any]:  # fmt: skip
    data, truth = simulated(folder, phantom, pixels, noise, truth_voxels, seed)
    settings: dict[str, Any] = {"time_limit": limit, "epochs": 1e9, "seed": seed} if method == "NeRIF" else {}
    settings |= {"voxels": voxels} if voxels else {}
    measurement = Measurement.read(data)
    result = METHODS[method](**settings, device="cpu")(measurement)
    scores = evaluate_volume(result.field, read_volume(truth), measurement.n_ambient)
    (observation,) = measurement.observations
    rays, values, sigma = measurement.rays(observation)
    assert sigma is not None
    subset = torch.randperm(len(rays), generator=torch.Generator().manual_seed(0))[:RAYS]
    projector = PathIntegral(forward_model(observation.technique, measurement, "auto"), SAMPLES)
    prediction = project(projector, result.field, rays[subset], "cpu")
    return {
        "l2": scores["l2"], "l2_variation": scores["l2_variation"], "seconds": result.seconds,
        "residual": float(((prediction - values[subset]) / sigma[subset]).square().mean().sqrt()),
        "outcome": result.outcome.reason,
    }  # fmt: skip
