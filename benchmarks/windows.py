"""Windows and tanks.

Displacements of a flame in air through 20 mm of glass in front of each camera, upright or tilted by 20 degrees to the
right, left, up or down, and of a plume in a tank of water with flat walls of glass; traced rays, 2 % noise. The
calibration was made in air, without windows. Errors (L2 of the variation) of the same cameras without glass in the same
medium, and with the windows ignored or modelled.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

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
    "flow": "{flow}", "medium": "{medium:g}", "walls": "{walls}",
    "without": "{without:.2%}", "ignored": "{ignored:.2%}", "modelled": "{modelled:.2%}",
    "ignored over without": "{ignored_ratio:.2f}", "modelled over without": "{modelled_ratio:.2f}",
}  # fmt: skip


class Wall(NamedTuple):
    """A plate of glass in front of each camera, mm and degrees; of no thickness for none."""

    thickness: float = 0.0
    depth: float = 500.0  #: from the camera, on its axis
    tilt: float = 0.0  #: to the axis
    background: float = 500.0  #: from the middle of the box


WALLS = {
    "none": Wall(), "upright": Wall(20.0), "tilted": Wall(20.0, tilt=20.0), "tank": Wall(20.0, 580.0, 0.0, 150.0),
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    size = {"pixels": 24, "steps": 60} if quick else {"pixels": 64, "steps": 300}
    for walls in ("tilted",) if quick else ("upright", "tilted"):
        yield {"flow": "flame", "medium": 1.00027, "walls": walls, **size, "seed": 0}
    yield {"flow": "plume", "medium": 1.333, "walls": "tank", **size, "seed": 0}


def walled_rig(wall: Wall, pixels: int, medium: float) -> tuple[Camera, ...]:
    """Return nine cameras behind their walls, with a medium of this index around the flow."""
    ring = Ring(pixel_pitch=4.0 / pixels, image_size=(pixels, pixels), background_distance=wall.background)
    if not wall.thickness:
        return ring.cameras()
    return tuple(_behind(camera, i, wall, medium) for i, camera in enumerate(ring.cameras()))


def _behind(camera: Camera, view: int, wall: Wall, medium: float) -> Camera:
    """Return a camera behind a plate that its axis meets at a depth, tilted about its y or x in turns."""
    angle = math.radians(wall.tilt) * (-1) ** (view // 2)
    normal = math.cos(angle) * camera.rotation[2] + math.sin(angle) * camera.rotation[view % 2]
    front = float(normal @ (camera.centre + wall.depth * camera.rotation[2]))
    planes = (Interface(normal, front, GLASS), Interface(normal, front + wall.thickness, medium))
    return replace(camera, interfaces=planes)


def measure(folder: Path, flow: str, medium: float, walls: str, pixels: int, steps: int, seed: int) -> dict[str, Any]:
    air = tuple(replace(camera, interfaces=()) for camera in walled_rig(WALLS[walls], pixels, medium))
    glass = walled_rig(WALLS[walls], pixels, medium)
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
