"""Windows and tanks.

Displacements of a flame in air through windows of glass, one for each camera, tilted to its axis by `tilt`
degrees to the right, left, up or down, and of a plume in a tank of water with flat walls of glass; traced rays,
2 % noise. The calibration was made in air, without windows. Errors (L2 of the variation) of the same cameras without
glass in the same medium, and with the windows ignored or modelled.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.runner import Settings
from nerif.analysis.evaluation import evaluate_volume
from nerif.data.volume import Volume
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Camera, Grid, Interface, Ring
from nerif.reconstruction.neural.neural import NeRIF
from nerif.simulation.simulate import simulate

BOX, GLASS, VOXELS = Box.cube(50.0), 1.52, 40
COLUMNS = {
    "flow": "{flow}", "medium": "{medium:g}", "glass [mm]": "{thickness:g}", "tilt": "{tilt:g}°",
    "without": "{without:.2%}", "ignored": "{ignored:.2%}", "modelled": "{modelled:.2%}",
    "ignored over without": "{ignored_ratio:.2f}", "modelled over without": "{modelled_ratio:.2f}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    size = {"pixels": 24, "steps": 60, "seed": 0} if quick else {"pixels": 64, "steps": 300, "seed": 0}
    yield {"flow": "flame", "medium": 1.00027, "thickness": 20.0, "depth": 500.0, "tilt": 20.0, **size}
    yield {"flow": "plume", "medium": 1.333, "thickness": 20.0, "depth": 580.0, "tilt": 0.0, **size}


def behind_glass(camera: Camera, view: int, depth: float, thickness: float, tilt: float, medium: float) -> Camera:
    """Return a camera behind a plate that its axis meets at a depth, mm, tilted about its y or x in turns."""
    angle = math.radians(tilt) * (-1) ** (view // 2)
    normal = math.cos(angle) * camera.rotation[2] + math.sin(angle) * camera.rotation[view % 2]
    front = float(normal @ (camera.centre + depth * camera.rotation[2]))
    return replace(camera, interfaces=(Interface(normal, front, GLASS), Interface(normal, front + thickness, medium)))


def measure(
    folder: Path, flow: str, medium: float, thickness: float, depth: float, tilt: float, pixels: int, steps: int,
    seed: int,
) -> dict[str, Any]:  # fmt: skip
    water = medium > 1.1
    ring = Ring(pixel_pitch=4.0 / pixels, image_size=(pixels, pixels), background_distance=150.0 if water else 500.0)
    air = ring.cameras()
    glass = tuple(behind_glass(c, i, depth, thickness, tilt, medium) for i, c in enumerate(air))
    field, grid = make_phantom(flow, BOX), Grid.of_resolution(BOX, VOXELS)
    truth = Volume(field.sample(grid), grid)

    def error(cameras: tuple[Camera, ...], calibrated: tuple[Camera, ...]) -> float:
        data = simulate(field, cameras, BOX, medium, 0.02, seed, steps=60)
        settings = NeRIF(max_steps=steps, seed=seed, device="cpu")
        result = settings(replace(data, cameras=calibrated))
        return float(evaluate_volume(result.field, truth, medium)["l2_variation"])

    with torch.random.fork_rng():
        errors = {"without": error(air, air), "ignored": error(glass, air), "modelled": error(glass, glass)}
    return {**errors, **{f"{name}_ratio": errors[name] / errors["without"] for name in ("ignored", "modelled")}}
