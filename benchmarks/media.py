"""From measurements to the quantities of each medium, with their truth.

A helium jet in air, the flow of a nozzle at Mach 2 that expands to Mach 3, and water of 20 degrees C heated by 15 K:
the true quantity is a smooth phantom between two values, its index follows from the medium's own relation, and nine
cameras measure it with 5 % noise. Errors are rms over the box and over the flow (where the quantity is above a tenth of
its range), relative to the range; `within 2 std` is the share of voxels of the flow whose truth lies within two
standard deviations (--uncertainty fast).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.runner import Settings
from nerif.analysis.prediction import predict
from nerif.cli.cli import main
from nerif.fields.phantoms import make_phantom
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Grid, paper_rig
from nerif.physics.isentropic import IsentropicSettings
from nerif.physics.medium import Medium
from nerif.physics.mixture import MixtureSettings
from nerif.physics.water import WaterSettings, fresh_water_index
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import add_noise

COLUMNS = {
    "flow": "{flow}", "quantity": "{quantity}", "range": "{low:.4g} to {high:.4g}", "error over the box": "{box:.2%}",
    "error in the flow": "{inside:.2%}", "within 2 std": "{covered:.1%}",
}  # fmt: skip
FLOWS: dict[str, tuple[Medium, str, float, float, tuple[str, ...]]] = {
    "helium jet": (MixtureSettings(), "mole_fraction", 0.0, 0.6, ("--medium", "mixture")),
    "nozzle": (
        IsentropicSettings(total_pressure_pa=4e5, mach=2.0), "mach", 2.0, 3.0,
        ("--medium", "isentropic", "--isentropic.total-pressure-pa", "4e5", "--isentropic.mach", "2"),
    ),
    "heated tank": (WaterSettings(), "temperature", 293.15, 308.15, ("--medium", "water")),
}  # fmt: skip
"""Medium, quantity, its value around and at most in the flow, and options of nerif reconstruct."""


def cases(quick: bool) -> Iterator[Settings]:
    size = {"pixels": 24, "steps": 40, "voxels": 24} if quick else {"pixels": 96, "steps": 800, "voxels": 80}
    for flow in FLOWS:
        yield {"flow": flow, **size, "seed": 0}


def measure(folder: Path, flow: str, pixels: int, steps: int, voxels: int, seed: int) -> dict[str, Any]:
    medium, quantity, low, high, words = FLOWS[flow]
    cameras, box = paper_rig(pixels)
    grid = Grid.of_resolution(box, voxels)
    shape = -make_phantom("gaussians", box, seed).sample(grid).double()
    shape = (shape / shape.abs().max()).clamp(min=0)
    truth = low + (high - low) * shape
    n_ambient, excess = _index(medium, quantity, truth.numpy(), low, high)
    field = VoxelField.through(torch.from_numpy(excess).float(), grid)
    path, out = folder / f"{flow}.nc", folder / flow
    add_noise(predict(field, cameras, box, n_ambient), 0.05, seed=seed).write(path)
    options = ["--voxels", voxels, "--max-steps", steps, "--seed", seed, "--uncertainty", "fast", "--no-report"]
    if main([str(w) for w in ("reconstruct", path, "--out", out, "--force", *options, *words)]):
        raise RuntimeError(f"the run of {flow} failed")
    volumes = ResultDirectory(out).volumes()
    values, std = (volumes[name].values.double() for name in (quantity, f"{quantity}_std"))
    error, inside = (values - truth).abs(), shape > 0.1
    present = inside & values.isfinite() & std.isfinite()
    scale = high - low
    return {
        "quantity": quantity, "low": low, "high": high,
        "box": float(error[values.isfinite()].square().mean().sqrt()) / scale,
        "inside": float(error[present].square().mean().sqrt()) / scale,
        "covered": float((error <= 2 * std)[present].double().mean()),
    }  # fmt: skip


def _index(medium: Medium, quantity: str, truth: np.ndarray, low: float, high: float) -> tuple[float, np.ndarray]:
    """Return the ambient index, and the index excess of the true quantity: the relation, inverted by a table."""
    if isinstance(medium, WaterSettings):
        n_ambient, span = float(fresh_water_index(np.array([20.0]), medium.wavelength_nm)[0]), 5e-3
    elif isinstance(medium, IsentropicSettings):
        n_ambient, span = 1 + medium.stream_density(1.0) * 2.26e-4, 3e-4
    else:
        n_ambient, span = 1.000273, 3e-4
    x = torch.linspace(-span, span, 200_001, dtype=torch.float64)
    q = medium.values(x, n_ambient, quantity)[0].numpy()
    good = np.isfinite(q) & (q >= low - 0.1 * (high - low)) & (q <= high + 0.1 * (high - low))
    order = np.argsort(q[good])
    return n_ambient, np.interp(truth, q[good][order], x.numpy()[good][order])
