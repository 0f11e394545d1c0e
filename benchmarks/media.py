"""From measurements, or from images, to the quantities of each medium, with their truth.

A helium jet in air, the flow of a nozzle at Mach 2 that expands to Mach 3, water of 20 degrees C heated by 15 K in a
tank, and a flame behind windows tilted by 20 degrees: the true quantity is a smooth phantom between two values, its
index follows from the medium's own relation, and nine cameras measure it: displacements with 5 % noise, or rendered
images of 12 bits with shot noise, evaluated by `nerif displacement`. The cameras outside of the tank and behind the
windows are those of `windows`. Errors are rms over the box and over the flow (where the quantity is above a tenth of
its range), relative to the range; `within 2 std` is the share of voxels of the flow whose truth lies within two
standard deviations (--uncertainty fast).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.runner import Settings
from benchmarks.windows import WALLS, walled_rig
from nerif.analysis.prediction import predict
from nerif.cli.cli import main
from nerif.fields.phantoms import make_phantom
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid
from nerif.physics.gas import GasSettings
from nerif.physics.isentropic import IsentropicSettings
from nerif.physics.medium import Medium
from nerif.physics.mixture import MixtureSettings
from nerif.physics.water import WaterSettings, fresh_water_index
from nerif.results.directory import ResultDirectory
from nerif.simulation.experiment import Experiment
from nerif.simulation.simulate import add_noise

COLUMNS = {
    "flow": "{flow}", "from": "{source}", "quantity": "{quantity}", "range": "{low:.4g} to {high:.4g}",
    "error over the box": "{box:.2%}", "error in the flow": "{inside:.2%}", "within 2 std": "{covered:.1%}",
}  # fmt: skip
REFERENCES = 5


class Flow(NamedTuple):
    """Medium, quantity, its value around and at most in the flow, options of nerif reconstruct, and walls."""

    medium: Medium
    quantity: str
    low: float
    high: float
    options: tuple[str, ...]
    walls: str = "none"


FLOWS = {
    "helium jet": Flow(MixtureSettings(), "mole_fraction", 0.0, 0.6, ("--medium", "mixture")),
    "nozzle": Flow(
        IsentropicSettings(total_pressure_pa=4e5, mach=2.0), "mach", 2.0, 3.0,
        ("--medium", "isentropic", "--isentropic.total-pressure-pa", "4e5", "--isentropic.mach", "2"),
    ),
    "heated tank": Flow(WaterSettings(), "temperature", 293.15, 308.15, ("--medium", "water"), "tank"),
    "flame behind windows": Flow(GasSettings(), "density", 1.189, 0.6, (), "tilted"),
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    size = {"pixels": 24, "steps": 40, "voxels": 24} if quick else {"pixels": 128, "steps": 800, "voxels": 80}
    for flow in FLOWS:
        for source in ("displacements", "images")[: 1 if quick else 2]:
            yield {"flow": flow, "source": source, **size, "seed": 0}


def measure(
    folder: Path, flow: str, source: str, pixels: int, steps: int, voxels: int, seed: int
) -> dict[str, Any]:  # fmt: skip
    medium, quantity, low, high, words, walls = FLOWS[flow]
    box = Box.cube(50.0)
    grid = Grid.of_resolution(box, voxels)
    shape = -make_phantom("gaussians", box, seed).sample(grid).double()
    shape = (shape / shape.abs().max()).clamp(min=0)
    truth = low + (high - low) * shape
    n_ambient, excess = _index(medium, quantity, truth.numpy(), low, high)
    cameras = walled_rig(WALLS[walls], pixels, n_ambient)
    field = VoxelField.through(torch.from_numpy(excess).float(), grid)
    path, out = folder / f"{flow} from {source}.nc", folder / f"{flow} from {source}"
    if source == "images":
        images = folder / f"images of {flow}"
        experiment = Experiment(poses=0, references=REFERENCES, seed=seed)
        experiment.write(images, cameras, field, box, n_ambient, voxels)
        corners = ["--lower", *box.lower, "--upper", *box.upper, "--n-ambient", n_ambient]
        _run("displacement", images, "--calibration", images / "truth" / "calibration.toml", "--out", path, *corners)
    else:
        add_noise(predict(field, cameras, box, n_ambient), 0.05, seed=seed).write(path)
    options = ["--voxels", voxels, "--max-steps", steps, "--seed", seed, "--uncertainty", "fast", "--no-report"]
    _run("reconstruct", path, "--out", out, *options, *words)
    volumes = ResultDirectory(out).volumes()
    values, std = (volumes[name].values.double() for name in (quantity, f"{quantity}_std"))
    error, inside = (values - truth).abs(), shape > 0.1
    present = inside & values.isfinite() & std.isfinite()
    scale = abs(high - low)
    return {
        "quantity": quantity, "low": low, "high": high,
        "box": float(error[values.isfinite()].square().mean().sqrt()) / scale,
        "inside": float(error[present].square().mean().sqrt()) / scale,
        "covered": float((error <= 2 * std)[present].double().mean()),
    }  # fmt: skip


def _run(command: str, *words: object) -> None:
    """Run a command of nerif."""
    if main([command, *map(str, words), "--force"]):
        raise RuntimeError(f"nerif {command} failed")


def _index(medium: Medium, quantity: str, truth: np.ndarray, low: float, high: float) -> tuple[float, np.ndarray]:
    """Return the ambient index, and the index excess of the true quantity: the relation, inverted by a table."""
    if isinstance(medium, WaterSettings):
        n_ambient, span = float(fresh_water_index(np.array([20.0]), medium.wavelength_nm)[0]), 5e-3
    elif isinstance(medium, IsentropicSettings):
        n_ambient, span = 1 + medium.stream_density(1.0) * 2.26e-4, 3e-4
    else:
        n_ambient, span = 1.000273 if isinstance(medium, MixtureSettings) else 1.00027, 3e-4
    x = torch.linspace(-span, span, 200_001, dtype=torch.float64)
    q = medium.values(x, n_ambient, quantity)[0].numpy()
    good = np.isfinite(q) & (np.abs(q - (low + high) / 2) <= 0.6 * abs(high - low))
    order = np.argsort(q[good])
    return n_ambient, np.interp(truth, q[good][order], x.numpy()[good][order])
