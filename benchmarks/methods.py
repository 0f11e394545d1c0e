"""Methods compared on the paper's rig.

NeRIF, its preset with the paper's settings, and voxel methods on Gaussian balls, flame, fire and turbulence, nine
views, with noise; total generalised variation (generalised_variation.py) is no part of the package. The paper's
settings take longer per step, and get the same time. Voxel methods run to their own end. L2 / NeRIF is the ratio to
the default preset on the same data.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.generalised_variation import TotalGeneralisedVariation
from benchmarks.runner import N_AMBIENT, Settings, ratios
from nerif.analysis.evaluation import evaluate_volume
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Grid, paper_rig
from nerif.reconstruction.neural.presets import preset
from nerif.reconstruction.reconstructor import Reconstructor, Step
from nerif.reconstruction.voxels.landweber import Landweber
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.reconstruction.voxels.voxel_reconstructor import VoxelReconstructor
from nerif.simulation.simulate import add_noise, simulate

COLUMNS = {
    "phantom": "{phantom}", "noise": "{noise:g}", "method": "{method}", "grid": "{grid}", "L2": "{l2:.2%}",
    "L2 of variation": "{l2_variation:.2%}", "L2 / NeRIF": "{l2_ratio:.2f}",
    "L2 in NeRIF's time": "{l2_in_time:.2%}", "CC": "{cc:.5f}", "SSIM": "{ssim:.4f}",
    "seconds": "{seconds:.0f}", "memory [GiB]": "{memory:.2f}", "iterations": "{iterations:.0f}",
    "outcome": "{outcome}",
}  # fmt: skip
PRESETS = {"NeRIF": "fast", "NeRIF, paper's settings": "paper"}
VOXELS: dict[str, tuple[VoxelReconstructor, tuple[str, ...]]] = {
    "Tikhonov": (Tikhonov(), ("40³ linear", "80³ linear")),
    "Landweber": (Landweber(), ("40³ linear", "80³ linear")),
    "TV": (TotalVariation(), ("40³ linear", "64³ cubic", "100³ cubic", "128³ cubic")),
    "TGV": (TotalGeneralisedVariation(), ("64³ cubic", "100³ cubic")),
}
"""Settings and grids."""


def cases(quick: bool) -> Iterator[Settings]:
    for phantom in ("gaussians",) if quick else ("gaussians", "flame", "fire", "turbulence"):
        for noise in (0.0, 0.1, 0.15) if phantom in ("gaussians", "flame") and not quick else (0.1,):
            case = {"phantom": phantom, "noise": noise, "pixels": 16 if quick else 200, "device": "auto"}
            case |= {
                "seconds": 2.0 if quick else 60.0,
                "points": 256 if quick else 0,
            }  # of NeRIF; points: 0 for the preset's
            case["truth_voxels"] = 30 if quick else 100
            for name in PRESETS:
                yield {**case, "method": name, "grid": "-"}
            for name, (_, grids) in VOXELS.items():
                for grid in ("12³ linear",) if quick else grids:
                    yield {**case, "method": name, "grid": grid}


def clean(folder: Path, phantom: str, pixels: int) -> Measurement:
    """Simulate a phantom on the paper's rig without noise, once for all cases."""
    path = folder / f"{phantom}-{pixels}.nc"
    if not path.is_file():
        cameras, box = paper_rig(pixels)
        simulate(make_phantom(phantom, box, 0), cameras, box, N_AMBIENT).write(path)
    return Measurement.read(path)


def measure(
    folder: Path, phantom: str, noise: float, pixels: int, device: str, seconds: float, points: int, truth_voxels: int,
    method: str, grid: str,
) -> dict[str, Any]:  # fmt: skip
    measurement = clean(folder, phantom, pixels)
    truth_grid = Grid.of_resolution(measurement.box, truth_voxels)
    truth = Volume(make_phantom(phantom, measurement.box, 0).sample(truth_grid), truth_grid)
    reconstructor: Reconstructor
    if method in PRESETS:
        base = preset(PRESETS[method])
        points = points or base.points_per_batch
        reconstructor = replace(base, time_limit=seconds, epochs=0, points_per_batch=points, device=device)
    else:
        voxels, basis = grid.split("³ ")
        reconstructor = replace(VOXELS[method][0], voxels=int(voxels), basis=basis, device=device)  # type: ignore[arg-type]
    in_time: dict[str, float] = {}

    def score_in_time(step: Step) -> None:
        """Record the error at the time that NeRIF has."""
        if not in_time and step.seconds > seconds:
            in_time.update(evaluate_volume(step.field(), truth, N_AMBIENT))

    result = reconstructor(add_noise(measurement, noise, seed=1), score_in_time)
    scores = evaluate_volume(result.field, truth, N_AMBIENT, result.device)
    return {name: scores[name] for name in ("l2", "l2_variation", "cc", "ssim")} | {
        "l2_in_time": in_time.get("l2", scores["l2"]),
        "seconds": result.seconds,
        "memory": result.peak_memory_bytes / 2**30,
        "iterations": result.history[-1]["step"],
        "outcome": result.outcome.reason,
    }


def derive(rows: list[dict[str, Any]]) -> None:
    ratios(rows, "l2", ("phantom", "noise"), method="NeRIF")
