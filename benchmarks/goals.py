"""Error and seconds on what people have, of two versions of the code, in turns within one run.

    git worktree add ../before COMMIT
    python benchmarks/goals.py ../before --write benchmarks/results/goals-cpu.md

Each reconstruction is a process of its own that imports `nerif` from its checkout, alone on the machine. Data and
truths are simulated once, by this version, and kept in --data. The residual is the rms over sigma on some of the rays.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench import N_AMBIENT, Table, add_write

HERE = Path(__file__).resolve().parents[1]
JUDGES, SAMPLES = 4096, 300  # rays that tell the residual, and samples on each


@dataclass(frozen=True)
class Case:
    """A phantom on the paper's cameras, and how it is reconstructed.

    Parameters
    ----------
    phantom, pixels, noise : of the measurement
    method : name of the reconstructor
    settings : what is asked of it beside the defaults
    """

    phantom: str
    pixels: int
    noise: float
    method: str
    settings: dict[str, Any] = field(default_factory=dict)


def trained(phantom: str, pixels: int, noise: float, seconds: float) -> Case:
    """NeRIF for so many seconds."""
    return Case(phantom, pixels, noise, "NeRIF", {"time_limit": seconds, "epochs": 1e9})


CASES = {
    "demo rig, flame, 20 s": trained("flame", 64, 0.05, 20),
    "demo rig, flame, 90 s": trained("flame", 64, 0.05, 90),
    "paper's rig, flame, 60 s": trained("flame", 200, 0.1, 60),
    "paper's rig, balls, 60 s": trained("gaussians", 200, 0.1, 60),
    "paper's rig, octahedron, 60 s": trained("octahedron", 200, 0.1, 60),
    "paper's rig, fire, 180 s": trained("fire", 200, 0.05, 180),
    "paper's rig, turbulence, 180 s": trained("turbulence", 200, 0.05, 180),
    "total variation as it is": Case("flame", 200, 0.1, "TotalVariation"),
    "Tikhonov as it is": Case("flame", 200, 0.1, "Tikhonov"),
    "Landweber as it is": Case("flame", 200, 0.1, "Landweber"),
    "total variation, 64³": Case("flame", 200, 0.1, "TotalVariation", {"voxels": 64}),
    "total variation, 100³": Case("flame", 200, 0.1, "TotalVariation", {"voxels": 100}),
}
VERSIONS = ("before", "now")
SHOWN = {"l2": "{:.3%}", "l2_variation": "{:.2%}", "residual": "{:.2f}", "seconds": "{:.0f}"}


def simulated(case: Case, seed: int, folder: Path) -> tuple[Path, Path]:
    """Return the files of measurement and truth, made if they are not there."""
    from nerif.data.volume import Volume
    from nerif.data.volume_file import write_netcdf
    from nerif.fields.phantoms import make_phantom
    from nerif.geometry import Grid, paper_rig
    from nerif.simulation.simulate import add_noise, simulate

    name = f"{case.phantom}-{case.pixels}-{case.noise:g}-{seed}"
    data, truth = folder / f"{name}.nc", folder / f"{name}.truth.nc"
    if not (data.exists() and truth.exists()):
        folder.mkdir(parents=True, exist_ok=True)
        cameras, box = paper_rig(case.pixels)
        phantom = make_phantom(case.phantom, box, seed)
        grid = Grid.of_resolution(box, 100)
        write_netcdf(truth, [Volume.of(phantom.sample(grid), grid, "index_excess", N_AMBIENT)])
        add_noise(simulate(phantom, cameras, box, N_AMBIENT), case.noise, seed=seed + 1).write(data)
    return data, truth


def run(case: Case, seed: int, data: Path, truth: Path) -> dict[str, Any]:
    """Reconstruct in this process; return errors, seconds, the residual and why it ended."""
    import torch

    from nerif.analysis.evaluation import evaluate_volume
    from nerif.data.measurement import Measurement
    from nerif.data.volume_file import read_volume
    from nerif.forward.path_integral import PathIntegral, project
    from nerif.forward.registry import forward_model
    from nerif.reconstruction.device import keep_freed_memory
    from nerif.reconstruction.neural.neural import NeRIF
    from nerif.reconstruction.voxels.landweber import Landweber
    from nerif.reconstruction.voxels.tikhonov import Tikhonov
    from nerif.reconstruction.voxels.total_variation import TotalVariation

    keep_freed_memory()
    methods = {kind.__name__: kind for kind in (NeRIF, TotalVariation, Tikhonov, Landweber)}
    asked = {**case.settings, "device": "cpu", **({"seed": seed} if case.method == "NeRIF" else {})}
    measurement = Measurement.read(data)
    result = methods[case.method](**asked)(measurement)
    scores = evaluate_volume(result.field, read_volume(truth), measurement.n_ambient)
    (observation,) = measurement.observations
    rays, values, sigma = measurement.rays(observation)
    assert sigma is not None
    some = torch.randperm(len(rays), generator=torch.Generator().manual_seed(0))[:JUDGES]
    projector = PathIntegral(forward_model(observation.technique, measurement, "auto"), SAMPLES)
    seen = project(projector, result.field, rays[some], "cpu")
    residual = float(((seen - values[some]) / sigma[some]).square().mean().sqrt())
    return {
        "l2": scores["l2"], "l2_variation": scores["l2_variation"], "seconds": result.seconds,
        "residual": residual, "outcome": result.outcome.reason,
    }  # fmt: skip


def in_version(checkout: Path, name: str, seed: int, files: tuple[Path, Path]) -> dict[str, Any]:
    """Do a case in a process that imports another version."""
    command = [sys.executable, __file__, str(checkout), "--run", name, "--seeds", str(seed)]
    command += ["--files", *map(str, files)]
    where = {**os.environ, "PYTHONPATH": os.pathsep.join([str(checkout / "src"), str(HERE / "benchmarks")])}
    told = subprocess.run(command, env=where, stdout=subprocess.PIPE, text=True, check=True).stdout
    return dict(json.loads(told.splitlines()[-1]))


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("before", type=Path, help="another checkout of the repository")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--only", nargs="+", default=list(CASES), help="some of the cases, by words in their names")
    parser.add_argument("--data", type=Path, default=HERE / "out" / "goals", help="folder of the simulated files")
    parser.add_argument("--run", help=argparse.SUPPRESS)
    parser.add_argument("--files", type=Path, nargs=2, help=argparse.SUPPRESS)
    add_write(parser)
    asked = parser.parse_args()
    if asked.run:
        print(json.dumps(run(CASES[asked.run], asked.seeds[0], *asked.files)))
        return
    columns = ["case", *(f"{what} {v}" for what in ("L2", "of variation", "residual", "s") for v in VERSIONS)]
    seeds = f"\n\nMedians of the seeds {' '.join(map(str, asked.seeds))}; residual: rms over sigma."
    table = Table("Goals, before and after", columns, asked.write, seeds)
    for name, case in CASES.items():
        if not any(words in name for words in asked.only):
            continue
        found: dict[str, list[dict[str, Any]]] = {v: [] for v in VERSIONS}
        for i, seed in enumerate(asked.seeds):
            files = simulated(case, seed, asked.data)
            for version in VERSIONS if i % 2 == 0 else VERSIONS[::-1]:
                checkout = asked.before if version == "before" else HERE
                found[version].append(in_version(checkout.resolve(), name, seed, files))
        medians = [[statistics.median(r[key] for r in found[v]) for v in VERSIONS] for key in SHOWN]
        shown = [form.format(x) for form, both in zip(SHOWN.values(), medians, strict=True) for x in both]
        table.row([name, *shown])


if __name__ == "__main__":
    main()
