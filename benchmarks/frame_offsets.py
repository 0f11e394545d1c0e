"""Frame offsets found in films.

Films of 14 or 30 instants, 5 % noise, in which some views are late or early by some frames, or none is; `nerif check`
of a film names views and offsets (analysis/film_check.py). A case is right if it names exactly those.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.runner import N_AMBIENT, Settings, table
from nerif.analysis.film_check import Excerpt, frame_shifts
from nerif.analysis.prediction import predict
from nerif.common.arrays import Points, Values, Vectors
from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.fields.turbulence import TurbulentPlume
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid, Ring

BOX, NOISE = Box.cube(50.0), 0.05
SPEED = {"puffs": 3.0, "turbulence": 1.5, "steady": 0.0}  # mm a frame
OFFSETS = ("", "1:+1", "2:-1", "1:+2", "3:-2", "2:+4", "0:+2 3:+2")
"""Views and their frames, as `text` writes them."""
COLUMNS = {
    "flow": "{flow}", "frames": "{frames}", "views": "{views}", "late": "{late}", "named": "{named}",
    "right": "{right}", "seconds": "{seconds:.0f}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    if quick:
        yield {"flow": "puffs", "frames": 14, "views": 4, "late": "1:+2", "seed": 0}
        return
    moving = [(flow, 14, views, late) for flow in ("puffs", "turbulence") for views in (6, 9, 12) for late in OFFSETS]
    long = [(flow, 30, views, "2:+4") for flow in ("puffs", "turbulence") for views in (6, 9, 12)]
    steady = [("steady", 14, views, "") for views in (6, 9, 12)]
    for seed, (flow, frames, views, late) in enumerate(moving + long + steady):
        yield {"flow": flow, "frames": frames, "views": views, "late": late, "seed": seed}


class Drifting(Field):
    """The turbulent plume, its scalar carried upwards by a distance (mm); the scalar is periodic."""

    def __init__(self, plume: TurbulentPlume, distance: float) -> None:
        self.plume, self.distance = plume, distance

    def value_and_gradient(self, points: Points) -> tuple[Values, Vectors]:
        edge, lower = BOX.edges[2], BOX.lower[2]
        z = (points[..., 2:] - self.distance - lower) % edge + lower
        return self.plume.value_and_gradient(torch.cat([points[..., :2], z], dim=-1))


def puffs(seed: int, distance: float) -> VoxelField:
    """Hot balls at random places, which rise and drift."""
    grid, rng = Grid.of_resolution(BOX, 28), np.random.default_rng(seed)
    points, excess = grid.points().numpy(), np.zeros(grid.shape)
    sizes, starts = rng.uniform(3, 5, 18), np.linspace(-60, 25, 18)
    for (x, y), start, size in zip(rng.uniform(-9, 9, (18, 2)), starts, sizes, strict=True):
        centre = np.array([x + 0.2 * distance, y, start + distance])
        excess -= 1e-4 * np.exp(-np.square((points - centre) / size).sum(axis=-1) / 2)
    return VoxelField.through(torch.from_numpy(excess).float(), grid)


class Film:
    """Frames in memory, of which some views are late."""

    def __init__(self, flow: str, count: int, views: int, late: dict[int, int], seed: int) -> None:
        ring = Ring(views=views, arc=(0.0, 180 - 180 / views), image_size=(20, 18), pixel_pitch=0.2)
        plume = TurbulentPlume(BOX, seed, shortest=0.1)
        frames = []
        for i in range(count + 8):
            distance = SPEED[flow] * i
            field = puffs(seed, distance) if flow != "turbulence" else Drifting(plume, distance)
            frames.append(predict(field, ring.cameras(), BOX, N_AMBIENT, samples=40))
        d = torch.stack([frame.displacements for frame in frames])
        d += NOISE * d.square().mean().sqrt() * torch.randn(d.shape, generator=torch.Generator().manual_seed(seed))
        self.times = tuple(float(i) for i in range(count))
        self.frames: list[Measurement] = []
        for i in range(4, count + 4):
            values = torch.stack([d[i - late.get(view, 0), view] for view in range(views)])
            self.frames.append(replace(frames[i], displacement=values))

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, index: int) -> Measurement:
        return self.frames[index]

    def fullest(self) -> Measurement:
        return self.frames[0]


def text(offsets: dict[int, int]) -> str:
    return " ".join(f"{view}:{frames:+d}" for view, frames in offsets.items())


def measure(folder: Path, flow: str, frames: int, views: int, late: str, seed: int) -> dict[str, Any]:
    offsets = {int(view): int(frames) for view, frames in (part.split(":") for part in late.split())}
    excerpt = Excerpt(Film(flow, frames, views, offsets, seed))
    shifts = frame_shifts(excerpt, excerpt.liveliest())
    named = {i: shift.frames for i, shift in enumerate(shifts) if shift.clear}
    return {"named": text(named), "right": named == offsets}


def blocks(rows: list[dict[str, Any]]) -> list[str]:
    """Return how many cases are right, by flow, number of frames and number of frames that a view is late."""
    groups: dict[tuple[str, ...], list[bool]] = {}
    for row in rows:
        late = max((abs(int(part.split(":")[1])) for part in row["late"].split()), default=0)
        groups.setdefault((row["flow"], str(row["frames"]), str(late)), []).append(row["right"])
    lines = [[*group, f"{sum(right)} of {len(right)}"] for group, right in sorted(groups.items())]
    return [table(("flow", "frames", "late or early by", "right"), lines, left=1)]
