"""One camera and a flow with an axis.

A jet, a plume and an underexpanded jet seen through rays that are nearly parallel, or spread by a half field of view
of 5 or 10 degrees. The inverse Abel transforms (abel_peers.py, most of them PyAbel's) know axis and geometry; of
their smoothing, regularisation and interpolation they get those nearest to the truth, for each draw of noise: more
than a user has. NeRIF, Tikhonov and TV have the same axis and never the truth. L2 (L2 of the variation) are over the
volume of revolution of a map, from 10 to 90 % of the height of the box: the simulated flow ends where the box does,
which only a method that knows the box allows for.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.abel_peers import ORDERS, PEERS, ParallelView, Peer, Revolution, attempts
from benchmarks.runner import N_AMBIENT, Settings, Unavailable
from nerif.analysis.evaluation import evaluate_volume
from nerif.analysis.metrics import volume_errors
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.jets import AXISYMMETRIC
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box, Camera, Grid, Ring
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.reconstructor import Reconstructor
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.simulation.simulate import add_noise, simulate

BOX = Box.cube(50.0)
EVALUATED = Box((-25.0, -25.0, -20.0), (25.0, 25.0, 20.0))
BACKGROUND, SENSOR = 500.0, 4.0  # axis to background, width of the sensor, mm
NERIF = ("NeRIF", "Tikhonov", "TV")
TITLES = [peer.title for peer in PEERS]
COLUMNS = {
    "phantom": "{phantom}", "noise": "{noise:g}", "half field of view": "{half_angle:g}°", "best peer": "{best}",
    **{title: f"{{{title} l2:.3%}} ({{{title} variation:.1%}})" for title in (*TITLES, *NERIF)},
    "L2, best peer over best of nerif": "{ratio:.2f}", "not run": "{unavailable}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    size = {"pixels": 24, "voxels": 24, "seconds": 3.0} if quick else {"pixels": 100, "voxels": 100, "seconds": 20.0}
    for phantom in ("gaussian-jet",) if quick else AXISYMMETRIC:
        for half_angle in (5.0,) if quick else (1.0, 5.0, 10.0):
            for noise in (0.05,) if quick else (0.02, 0.05, 0.15):
                for seed in (0,) if quick else (0, 1, 2):
                    yield {
                        "phantom": phantom, "noise": noise, "half_angle": half_angle, **size, "device": "cpu",
                        "seed": seed,
                    }  # fmt: skip


def camera_of(half_angle: float, pixels: int) -> Camera:
    """Return a camera with a half field of view (degrees) at the distance from which it sees the whole box."""
    tangent, edge = math.tan(math.radians(half_angle)), BOX.edges[0] / 2
    ring = Ring(
        views=1, arc=(0.0, 0.0), focal_length=SENSOR / 2 / tangent, pixel_pitch=SENSOR / pixels,
        image_size=(pixels, pixels), distance=edge + 1.04 * edge / tangent, background_distance=BACKGROUND,
    )  # fmt: skip
    return ring.cameras()[0]


def best_of(peer: Peer, measurement: Measurement, truth: Volume) -> tuple[float, float, str]:
    """Return L2, L2 of the variation and options of a transform with the options nearest to the truth."""
    view = ParallelView.of(measurement.cameras[0], BOX.centre)
    maps = list(attempts(peer, measurement.displacements[0].numpy(), view, N_AMBIENT))
    scores = []
    for order, reading in ORDERS.items():
        volume = Revolution(view, maps[0][1].shape, truth.grid, order)
        for options, index_map in maps:
            errors = volume_errors(truth.values.numpy(), volume(index_map), N_AMBIENT)
            scores.append((errors["l2"], errors["l2_variation"], f"{options}, {reading}"))
    return min(scores)


def measure(
    folder: Path, phantom: str, noise: float, half_angle: float, pixels: int, voxels: int, seconds: float,
    device: str, seed: int,
) -> dict[str, Any]:  # fmt: skip
    field, grid = make_phantom(phantom, BOX), Grid.of_resolution(EVALUATED, voxels)
    truth = Volume(field.sample(grid), grid)
    measurement = add_noise(simulate(field, [camera_of(half_angle, pixels)], BOX, N_AMBIENT), noise, seed)
    metrics: dict[str, Any] = {"unavailable": ""}
    for peer in PEERS:
        try:
            l2, variation, options = best_of(peer, measurement, truth)
            metrics |= {f"{peer.title} l2": l2, f"{peer.title} variation": variation, f"{peer.title} options": options}
        except Unavailable as error:
            metrics["unavailable"] = str(error)
    axis: dict[str, Any] = {"symmetry": "axis", "device": device}
    methods: dict[str, Reconstructor] = {
        "NeRIF": NeRIF(time_limit=seconds, seed=seed, **axis),
        "Tikhonov": Tikhonov(voxels=voxels, **axis),
        "TV": TotalVariation(voxels=voxels, **axis),
    }
    for name, method in methods.items():
        errors = evaluate_volume(method(measurement).field, truth, N_AMBIENT, device)
        metrics |= {f"{name} l2": errors["l2"], f"{name} variation": errors["l2_variation"]}
    return metrics


def derive(rows: list[dict[str, Any]]) -> None:
    for row in rows:
        peers = {title: row[f"{title} l2"] for title in TITLES if f"{title} l2" in row}
        if peers:
            best = min(peers, key=lambda title: peers[title])
            row["best"] = f"{best}; {row[f'{best} options']}"
            row["ratio"] = peers[best] / min(row[f"{name} l2"] for name in NERIF)
